"""Runs the command `ipe-bench` as `python -m ipe_bench`."""

from ipe_bench.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
