"""What this machine offers a run."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform

_LIBRARIES = (
    "numpy",
    "scipy",
    "llvmlite",
    "filterpy",
    "hydra-core",
    "pandas",
    "pyarrow",
    "seaborn",
    "matplotlib",
)


def cores() -> int:
    """Counts the cores that this process may use: fewer than there are where an affinity mask says
    so."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@functools.cache
def library_versions() -> dict[str, str]:
    """Returns Python and the libraries that results depend on, with their versions."""
    versions = {name: importlib.metadata.version(name) for name in _LIBRARIES}
    return {"python": platform.python_version(), **versions}
