"""The second process of `gallery`: draws what the first has not claimed yet, from the end of the list."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

from ipe_bench.report.figures.gallery import claim, draw_task


def main(desk: Path) -> None:
    jobs, folder = pickle.loads((desk / "jobs").read_bytes())
    import matplotlib.backends.backend_agg  # noqa: F401  (before the first job is claimed)
    import seaborn  # noqa: F401

    for i in reversed(range(len(jobs))):
        if claim(desk, i):
            task, formats = jobs[i]
            entries = draw_task(task, folder, formats)
            unfinished = desk / f"unfinished-{i}"
            unfinished.write_bytes(pickle.dumps(entries))
            unfinished.rename(desk / f"done-{i}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
