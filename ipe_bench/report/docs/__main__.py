"""`python -m ipe_bench.report.docs [OUTPUT] [--trials N]`: builds the site."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ipe_bench.report.docs.build import build

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", default="outputs/docs", type=Path)
    parser.add_argument("--trials", type=int, default=20, help="of an experiment that has 1000 by itself")
    parser.add_argument("--experiments", nargs="*", help="those of the gallery; all where it is not given")
    arguments = parser.parse_args()
    sys.exit(build(arguments.output, arguments.trials, arguments.experiments))
