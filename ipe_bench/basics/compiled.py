"""Modules that Numba compiles, kept where they may be between processes, also where the package cannot be written to."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import logging
import os
import sys
import tempfile
from types import ModuleType

from ipe_bench.basics.files import cache_folder

_LOG = logging.getLogger(__name__)


@functools.cache
def load(source: str, what: str = "an integrator") -> ModuleType:
    """The module of a source, compiled at most once per machine."""
    name = f"ipe_bench_kernel_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    path = cache_folder() / f"{name}.py"
    if not path.exists():
        _LOG.info("compiling %s, once per machine: it is kept in %s", what, path.parent)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False) as file:
            file.write(source)
        os.replace(file.name, path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
