"""Compiles functions with Numba to machine code that can be called without it; see `compiled`, which alone uses it."""

from __future__ import annotations

import linecache
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import cfunc, types
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic, register_jitable
from numba.np.numpy_support import carray

from ipe_bench.basics.machine import ARRAY_DATA, ARRAY_DIMENSIONS


@dataclass(frozen=True)
class Compiled:
    """Machine code, and what is to be known of it to call it."""

    code: bytes
    symbol: str
    arguments: list[tuple[str, int]]
    """Of each argument, the type of its numbers and its dimensions."""
    result: str
    needs: list[str]
    """What it calls."""


def compiled(source: str, name: str) -> Compiled:
    """The one function of a source that is decorated with its signature."""
    module: dict[str, Any] = {"__name__": name}
    exec(_code(source, name), module)
    (function,) = [value for value in module.values() if isinstance(value, CPUDispatcher) and value.signatures]
    (signature,) = function.nopython_signatures
    dimensions = [getattr(kind, "ndim", 0) for kind in signature.args]
    numbers = [str(getattr(kind, "dtype", kind)) for kind in signature.args]
    words = [f"a{i}" for i in range(len(dimensions))]
    taken = [f"array{i}({word})" if dimensions[i] else word for i, word in enumerate(words)]
    known: dict[str, Any] = {"__name__": name, "function": function}
    known |= {f"array{i}": _array(kind.dtype, kind.ndim) for i, kind in enumerate(signature.args) if dimensions[i]}
    text = f"def entry({', '.join(words)}):\n    return function({', '.join(taken)})\n"
    exec(_code(text, f"{name}_entry"), known)
    entry = cfunc(signature.return_type(*[types.int64] * len(words)), error_model="numpy")(known["entry"])
    library: Any = entry._library  # type: ignore[attr-defined]
    needs = {f.name for f in library._final_module.functions if f.is_declaration}
    return Compiled(
        code=library._get_compiled_object(),
        symbol=entry.native_name,
        arguments=list(zip(numbers, dimensions, strict=True)),
        result=str(signature.return_type),
        # An intrinsic such as llvm.sin.f64 may end as a call of sin.
        needs=sorted({name.split(".")[1] if name.startswith("llvm.") else name for name in needs}),
    )


def _code(text: str, name: str) -> Any:
    file = f"<{name}>"
    # Where Numba and tracebacks look for the lines.
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    return compile(text, file, "exec")


def _array(dtype: Any, ndim: int) -> Any:
    """array(address): NumPy's array at the address of its object."""
    pointer = _pointer(dtype)
    shape = "".join(f"word(dimensions, {8 * i}), " for i in range(ndim))
    text = f"""def array(address):
    dimensions = word(address, {ARRAY_DIMENSIONS})
    return carray(pointer(word(address, {ARRAY_DATA})), ({shape}))
"""
    known = {"carray": carray, "word": _word, "pointer": pointer}
    exec(_code(text, f"array_{dtype}_{ndim}"), known)
    return register_jitable(known["array"])


@intrinsic
def _word(typingctx: Any, address: Any, offset: Any) -> Any:
    """What lies in memory so many bytes after an address."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.inttoptr(builder.add(args[0], args[1]), ir.PointerType(ir.IntType(64)))
        return builder.load(place)

    return types.int64(types.int64, types.int64), generate


def _pointer(dtype: Any) -> Any:
    @intrinsic
    def pointer(typingctx: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

        return types.CPointer(dtype)(types.int64), generate

    return pointer
