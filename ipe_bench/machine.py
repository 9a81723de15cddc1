"""What this machine offers a run."""

from __future__ import annotations

import os


def cores() -> int:
    """Cores that this process may use: fewer than there are where an affinity mask says so."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
