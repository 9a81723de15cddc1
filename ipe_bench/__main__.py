"""`python -m ipe_bench`: the same as the command `ipe-bench`."""

from ipe_bench.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
