"""Compiles LLVM's intermediate representation to machine code for this processor, kept in files
between processes.

A function takes pointers and whole numbers and returns nothing; a call lets other threads run.
Where no machine code can be made, that is a UserError.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib.metadata
import logging
import sys
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, one_line
from ipe_bench.basics.files import cache_folder, kept

_LOG = logging.getLogger(__name__)

_IN_LIBRARY = (
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "exp",
    "expm1",
    "log",
    "log1p",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
    "atanh",
    "cbrt",
    "erf",
    "erfc",
    "pow",
    "fmod",
)
_IN_LIBRARY += ("fma", "memset", "memcpy", "malloc", "free")
"""Functions of the C library that machine code may call: those of recorded programs, those LLVM
puts in place of an instruction that the processor lacks or of a loop, and memory."""

POINTER = ctypes.c_void_p
INTEGER = ctypes.c_int64
EMITTING = sorted(Path(__file__).with_name("emit").glob("*.py"))
"""The modules that write intermediate representation."""


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Raises UserError where something that makes machine code is missing."""
    try:
        yield
    except (ImportError, OSError, RuntimeError) as error:
        raise UserError(
            f"compilation is not available here ({one_line(error)}): install the package llvmlite "
            "again (pip install --force-reinstall llvmlite)"
        ) from error


@functools.cache
@_refusing()
def _target() -> Any:
    """Returns LLVM's description of this processor."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # Machine code is for this very processor: files keep its name and features in their keys.
    cpu = llvm.get_host_cpu_name()
    features = llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=cpu, features=features, opt=1, reloc="pic", jit=True)


@functools.cache
@_refusing()
def _addresses() -> dict[str, int]:
    """Returns the addresses of the functions of the C library."""
    library = ctypes.CDLL(None if sys.platform != "win32" else "ucrtbase")
    mathematics = ctypes.CDLL(find_library("m")) if sys.platform.startswith("linux") else library
    found = {}
    for name in _IN_LIBRARY:
        function = getattr(mathematics, name, None) or getattr(library, name, None)
        if function is None:
            raise OSError(f"the C library has no function {name}")
        found[name] = ctypes.cast(function, ctypes.c_void_p).value or 0
    return found


@functools.cache
@_refusing()
def width() -> int:
    """Returns the numbers that a vector register holds."""
    import llvmlite.binding as llvm

    return 8 if llvm.get_host_cpu_features().get("avx512f") else 4


@functools.lru_cache(maxsize=256)
def load(
    key: str, write: Callable[[], str], name: str, arguments: tuple[Any, ...]
) -> Callable[..., None]:
    """Loads the function `name` of the module that `write` writes and `key` identifies, compiled
    once per machine.

    A kept file is used only if it was made of this key for this processor, is whole, and belongs to
    this user or the system.
    """
    target = _target()
    import llvmlite.binding as llvm

    made_of = repr((name, key, _machine()))
    code = kept(made_of, ".o", lambda: _object_code(write()))
    # The object is linked against the functions of the C library that it may call.
    library = llvm.JITLibraryBuilder().add_object_img(code).export_symbol(name)
    for called, address in _addresses().items():
        library.import_symbol(called, address)
    engine = llvm.create_lljit_compiler(target)
    tracker = library.link(engine, hashlib.sha256(made_of.encode()).hexdigest())
    function = ctypes.CFUNCTYPE(None, *arguments)(tracker[name])
    # The code lives as long as the function that calls it.
    function.keeps = engine, tracker  # type: ignore[attr-defined]
    return function


def _object_code(text: str) -> bytes:
    _LOG.info("compiling a model, once per machine: it is kept in %s", cache_folder())
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.triple = _target().triple
    module.data_layout = str(_target().target_data)
    # LLVM's passes must not reorder sums: no fast-math flag is set in what is written.
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = (
        False  # vectors are explicit
    )
    builder = llvm.create_pass_builder(_target(), options)
    builder.getModulePassManager().run(module, builder)
    return _target().emit_object(module)


@functools.cache
def _machine() -> tuple[str, ...]:
    """Describes what machine code depends on besides its source."""
    import llvmlite.binding as llvm

    version = importlib.metadata.version("llvmlite")
    return (
        version,
        _target().triple,
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
    )


@functools.cache
def digest_of(*files: Path) -> str:
    """Stands for the code of modules that write intermediate representation: what they compiled
    before a change is not used after it."""
    code = [file.read_bytes() for file in (*files, Path(__file__))]
    return hashlib.sha256(b"".join(code)).hexdigest()


_NOTHING = ctypes.c_char * 0
DOUBLE = np.dtype(np.float64)
WHOLE = np.dtype(np.int64)


def at(a: Any, kind: Any = DOUBLE) -> int:
    """Returns the address of a C-contiguous array's numbers, in a third of the time that
    `a.ctypes.data` takes."""
    if a.dtype != kind:
        raise TypeError(f"an array of {a.dtype}, where one of {kind} is taken")
    if not a.size:
        return 0
    return ctypes.addressof(_NOTHING.from_buffer(a))


def aligned(numbers: int) -> tuple[np.ndarray[Any, Any], int]:
    """Allocates memory for this many numbers; returns it and its first address on the border of a
    cache line."""
    memory = np.empty(numbers + 8)
    return memory, -(-at(memory) // 64) * 64
