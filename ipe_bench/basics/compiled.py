"""Functions that Numba compiles, kept as machine code: what was compiled once is called without Numba, which takes
longer to load than a small run to compute.

A source is the text of a module in which one function is decorated with its signature:

    @njit("void(float64[:, ::1], int64[::1], int64)", error_model="numpy")

It takes C-contiguous arrays that may be written into, and whole numbers, and returns nothing or a number. It allocates
nothing and raises nothing. A call lets other threads run.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib.metadata
import json
import logging
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from ctypes.util import find_library
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import BLANK_SEAL, cache_folder, is_sealed, seal, write_bytes
from ipe_bench.basics.machine import ARRAY_DATA, ARRAY_DIMENSIONS

if TYPE_CHECKING:
    # Imported where something is compiled, and here so that results are known to depend on it.
    from ipe_bench.basics import compiler as compiler

_LOG = logging.getLogger(__name__)

_RESULTS = {"none": None, "float64": ctypes.c_double}


@functools.cache
def load(source: str, what: str = "an integrator") -> Function:
    """The one function of a source that is decorated with its signature, compiled at most once per machine."""
    name = f"ipe_bench_{hashlib.sha256(f'{source}{_machine()}'.encode()).hexdigest()[:16]}"
    path = cache_folder() / f"{name}.o"
    content = path.read_bytes() if path.is_file() else b""
    if not is_sealed(content):
        from ipe_bench.basics.compiler import compiled

        _LOG.info("compiling %s, once per machine: it is kept in %s", what, path.parent)
        found = compiled(source, name)
        header = {"symbol": found.symbol, "arguments": found.arguments, "result": found.result, "needs": found.needs}
        content = seal(json.dumps(header | {"seal": BLANK_SEAL}).encode() + b"\n" + found.code)
        with contextlib.suppress(StorageError):
            write_bytes(path, content)
    head, _, code = content.partition(b"\n")
    return _linked(json.loads(head), code)


class Function:
    """A compiled function."""

    def __init__(self, engine: Any, symbol: str, arguments: Sequence[tuple[str, int]], result: str) -> None:
        self._engine = engine  # which its code lives as long as
        self._kinds = [(np.dtype(name), ndim) if ndim else None for name, ndim in arguments]
        words = [ctypes.c_void_p if ndim else ctypes.c_int64 for _, ndim in arguments]
        self._call = ctypes.CFUNCTYPE(_RESULTS[result], *words)(engine.get_function_address(symbol))

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*[_word(a, kind) for a, kind in zip(arguments, self._kinds, strict=True)])


def _word(argument: Any, kind: tuple[np.dtype[Any], int] | None) -> int:
    """What is handed over: a number itself, an array by the address of its object."""
    if kind is None:
        return argument
    if argument.dtype != kind[0] or argument.ndim != kind[1] or not argument.flags.carray:
        raise TypeError(
            f"an array of {argument.ndim} dimensions of {argument.dtype}, where one of {kind[1]} of {kind[0]} is taken "
            "that is C-contiguous and may be written into"
        )
    return id(argument)


def _linked(header: Mapping[str, Any], code: bytes) -> Function:
    import llvmlite.binding as llvm

    _prepare()
    for name, address in _addresses(header["needs"]):
        llvm.add_symbol(name, address)
    # An engine owns its target, and names need not differ between engines.
    target = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Function(engine, header["symbol"], header["arguments"], header["result"])


def _addresses(names: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Where the functions are that compiled code calls: those of the C library. What Numba would call where something
    is raised or freed, which nothing is, ends the process."""
    library = ctypes.CDLL(None if sys.platform != "win32" else "ucrtbase")
    mathematics = ctypes.CDLL(find_library("m")) if sys.platform.startswith("linux") else library
    for name in names:
        function = next((f for lib in (mathematics, library) if (f := getattr(lib, name, None))), library.abort)
        address = ctypes.cast(function, ctypes.c_void_p).value
        assert address is not None
        yield name, address


@functools.cache
def _prepare() -> None:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


@functools.cache
def _machine() -> str:
    """What machine code depends on besides its source: the processor, the compiler and how NumPy and Python lay out
    arrays."""
    import llvmlite.binding as llvm

    _check_layout()
    here = Path(__file__)
    code = b"".join(here.with_name(name).read_bytes() for name in (here.name, "compiler.py"))
    versions = [importlib.metadata.version(name) for name in ("llvmlite", "numba")]
    processor = (llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())
    return repr((hashlib.sha256(code).hexdigest(), versions, processor, ARRAY_DATA))


def _check_layout() -> None:
    probe = np.zeros((2, 3))
    data = ctypes.c_void_p.from_address(id(probe) + ARRAY_DATA).value
    dimensions = ctypes.c_void_p.from_address(id(probe) + ARRAY_DIMENSIONS).value
    if data != probe.ctypes.data or (ctypes.c_int64 * 2).from_address(dimensions or 0)[:] != [2, 3]:
        raise RuntimeError("NumPy's arrays lie otherwise in memory than compiled code takes them to")
