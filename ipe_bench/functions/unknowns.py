"""Numbers and arrays that are not known while a function of NumPy is recorded.

A function is called once, with an array of unknowns in place of its argument. NumPy asks what it
meets how to go on: an `Unknown` is a single number, which notes each operation in a graph; an
`Unknowns` is an array of them. Operators and ufuncs, such as np.sin, come to `call`, entry by
entry; other functions of NumPy, such as np.where or np.cumsum, to `_function`.

What an unknown cannot do as a number does raises `Refused` and marks the graph, since a bare
`except` of a user catches even that.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ipe_bench.engine.trace import Expression
from ipe_bench.functions.exact import HUGE, OPERATIONS, SAME, TRUTHS, ExactGraph


def _unary(name: str) -> Any:
    return lambda self: call(name, self)


def _binary(name: str) -> Any:
    return lambda self, other: call(name, self, other)


def _reflected(name: str) -> Any:
    return lambda self, other: call(name, other, self)


def _trap(what: str) -> Any:
    def refuse(self: Unknown, *_: Any) -> Any:
        raise self.node.graph.refuse(what)

    return refuse


_BRANCH = (
    "it branches on its argument, by if, and, or, min, max, or a comparison of what np.asarray"
    " returned; np.where, np.minimum and np.maximum of x itself are recorded"
)
_NUMBER = (
    "it takes its argument as plain numbers, as math.sin, float() and NumPy arrays of floats do;"
    " np.sin and np.empty_like(x) are recorded"
)
_KEY = "it takes its argument as a key or an index; np.interp is recorded"
_WHOLE = "it rounds its argument; np.floor is recorded"


class Unknown:
    """A number, or a truth value, that is not known yet."""

    __slots__ = ("node", "truth")

    def __init__(self, node: Expression, truth: bool = False) -> None:
        self.node: Any = node
        self.truth = truth

    @property
    def __class__(self) -> type:  # isinstance(x, float) holds, as of NumPy's numbers
        return np.bool_ if self.truth else np.float64

    __add__, __radd__ = _binary("add"), _reflected("add")
    __sub__, __rsub__ = _binary("subtract"), _reflected("subtract")
    __mul__, __rmul__ = _binary("multiply"), _reflected("multiply")
    __truediv__, __rtruediv__ = _binary("divide"), _reflected("divide")
    __pow__, __rpow__ = _binary("power"), _reflected("power")
    __mod__, __rmod__ = _binary("remainder"), _reflected("remainder")
    __and__, __rand__ = _binary("logical_and"), _reflected("logical_and")
    __or__, __ror__ = _binary("logical_or"), _reflected("logical_or")
    __xor__, __rxor__ = _binary("not_equal"), _reflected("not_equal")
    __lt__, __gt__ = _binary("less"), _binary("greater")
    __le__, __ge__ = _binary("less_equal"), _binary("greater_equal")
    __eq__, __ne__ = _binary("equal"), _binary("not_equal")
    __neg__, __pos__, __abs__ = map(_unary, ("negative", "positive", "absolute"))
    __invert__ = _unary("invert")
    __bool__ = _trap(_BRANCH)
    __index__ = __hash__ = _trap(_KEY)
    __float__ = __complex__ = __str__ = __format__ = _trap(_NUMBER)
    __int__ = __round__ = __floor__ = __ceil__ = _trap(_WHOLE)
    __floordiv__ = __rfloordiv__ = __divmod__ = __rdivmod__ = _trap(_WHOLE)
    __len__ = __iter__ = _trap("it takes the length of a number")
    shape, ndim, size = (), 0, 1

    def conjugate(self) -> Unknown:
        return self

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        graph = self.node.graph
        if method != "__call__" or kwargs:
            raise graph.refuse(f"np.{ufunc.__name__}.{method} is not recorded")
        if any(isinstance(one, Unknowns) for one in inputs):
            return NotImplemented
        if any(isinstance(one, np.ndarray) for one in inputs):
            return _each(ufunc, inputs, graph)
        return call(ufunc.__name__, *inputs)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _function(self.node.graph, function, args, kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name in ("real", "T"):
            return self
        if name in OPERATIONS:  # NumPy calls the method of each object in an array
            return lambda *others: call(name, self, *others)
        raise self.node.graph.refuse(f".{name} of its argument is not recorded")


def is_unknown(value: Any) -> bool:
    return type(value) is Unknown


def _is_truth(value: Any) -> bool:
    return value.truth if is_unknown(value) else type(value) in (bool, np.bool_)


_OF_TRUTHS_ALONE = ("bitwise_and", "bitwise_or", "bitwise_xor", "logical_xor")
"""Functions that of numbers are errors, or are something else."""
_ASKED = {"logical_and": 2, "logical_or": 2, "where": 1}
"""How many arguments of a function, from the first on, are asked whether they hold."""


def call(name: str, *given: Any) -> Any:
    """Applies a function of NumPy to unknowns and numbers."""
    graph = next(one.node.graph for one in given if is_unknown(one))
    truths = [_is_truth(one) for one in given]
    if name in _OF_TRUTHS_ALONE and not all(truths):
        raise graph.refuse(f"np.{name} of numbers is not recorded")
    name = SAME.get(name, name)
    if name not in OPERATIONS:
        raise graph.refuse(f"np.{name} is not recorded")
    if any(isinstance(one, np.ndarray) for one in given):
        return NotImplemented
    nodes = [one.node if is_unknown(one) else _number(graph, one) for one in given]
    if any(truths):
        name = _of_truths(graph, name, truths)
    elif name == "invert":
        raise graph.refuse("~ of a number is not recorded")
    # Where a truth is asked for, a number holds unless it is 0.
    for i in range(_ASKED.get(name, 0)):
        if not truths[i]:
            nodes[i] = OPERATIONS["not_equal"](graph.apply, nodes[i], 0.0)
    made = OPERATIONS[name](graph.apply, *nodes)
    chosen = name == "where" and all(truths[1:])
    return Unknown(made, name in TRUTHS or chosen)


def _of_truths(graph: ExactGraph, name: str, truths: Sequence[bool]) -> str:
    """Returns what NumPy does with truth values in place of numbers."""
    if not all(truths):
        return name
    if name in ("subtract", "negative"):
        raise graph.refuse(f"np.{name} of truth values is an error")
    if name in TRUTHS or name == "where":
        return name
    if name in ("add", "maximum", "fmax"):
        return "logical_or"
    if name in ("multiply", "minimum", "fmin"):
        return "logical_and"
    raise graph.refuse(f"np.{name} of truth values is not recorded")


def _number(graph: ExactGraph, one: Any) -> Expression:
    if isinstance(one, complex | np.complexfloating):
        raise graph.refuse("it computes with complex numbers")
    if not isinstance(one, bool | int | float | np.bool_ | np.number):
        raise graph.refuse(f"its argument meets {type(one).__name__}, which is no number")
    return graph.constant(float(one))


class Unknowns(np.ndarray):
    """An array of unknowns, which knows what it is until np.asarray strips it."""

    graph: ExactGraph

    def __array_finalize__(self, other: Any) -> None:
        self.graph = getattr(other, "graph", None)  # type: ignore[assignment]

    @property
    def dtype(self) -> np.dtype[Any]:  # type: ignore[override]
        held = np.ndarray.dtype.__get__(self)  # type: ignore[attr-defined]
        return np.dtype(float) if held.kind == "O" else held

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, out: Any = None, **kwargs: Any
    ) -> Any:
        met = [*inputs, *(out or ())]
        graph = next(one.graph for one in met if isinstance(one, Unknowns))
        name = ufunc.__name__
        # What np.mean and the like say beside, and numbers need not be told.
        kwargs.pop("casting", None)
        kwargs.pop("subok", None)
        if kwargs.get("where") is True:
            kwargs.pop("where")
        kind = kwargs.pop("dtype", None)
        plain = kind in (None, float, np.dtype(float))
        if not plain and name not in ("logical_or", "logical_and"):
            raise graph.refuse(f"np.{name} with a dtype is not recorded")
        if method == "__call__" and ufunc.signature:  # matrix products, of operators
            found = ufunc(*map(objects, inputs), **kwargs)
        elif method == "__call__" and not kwargs:
            found = _each(ufunc, inputs, graph)
        elif method in ("reduce", "accumulate", "outer"):
            found = _gathered(ufunc, method, inputs, kwargs)
        else:
            raise graph.refuse(f"np.{name}.{method} is not recorded")
        if out is None:
            return unknowns(found, graph)
        if not isinstance(out[0], Unknowns):
            raise graph.refuse(_NUMBER)
        out[0][...] = found
        return out[0]

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _function(self.graph, function, args, kwargs, super().__array_function__)

    def __getitem__(self, key: Any) -> Any:
        if _has_unknowns(key):
            raise self.graph.refuse(
                "it selects by what its argument says, as x[x > 0] does; np.where is recorded"
            )
        return super().__getitem__(key)

    def __setitem__(self, key: Any, value: Any) -> None:
        by_entry = isinstance(key, Unknowns) and key.shape == self.shape
        if by_entry and np.ndim(value) == 0:
            chosen = _by_entry(_where, objects(key), value, objects(self))
            self[...] = unknowns(chosen, self.graph)
        elif _has_unknowns(key):
            raise self.graph.refuse("it writes where its argument says; np.where is recorded")
        else:
            super().__setitem__(key, value)

    def astype(self, kind: Any, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        if np.dtype(kind) != np.dtype(float):
            raise self.graph.refuse(f".astype({np.dtype(kind)}) is not recorded")
        return unknowns(_counted(objects(self)), self.graph)

    def tolist(self) -> Any:
        return objects(self).tolist()


def objects(one: Any) -> Any:
    return np.asarray(one, dtype=object)


def unknowns(found: Any, graph: ExactGraph) -> Any:
    """Returns an array of objects as unknowns; a single one stays what it is."""
    if not isinstance(found, np.ndarray):
        return found
    view = found.view(Unknowns)
    view.graph = graph
    return view


def _kept(found: Any, graph: ExactGraph) -> Any:
    """Returns arrays of objects as unknowns, which NumPy's concatenation and the like forget."""
    if isinstance(found, list | tuple):
        return type(found)(_kept(one, graph) for one in found)
    if type(found) is np.ndarray and found.dtype.kind == "O":
        return unknowns(found, graph)
    return found


def _by_entry(function: Callable[..., Any], *arrays: Any) -> Any:
    each = np.frompyfunc(function, len(arrays), 1)
    return objects(each(*map(objects, arrays)))


def _counted(array: Any) -> Any:
    """Returns truth values as the numbers 1 and 0."""
    if not any(_is_truth(one) for one in array.ravel()):
        return array

    def number(a: Any) -> Any:
        return call("multiply", a, 1.0) if is_unknown(a) else float(a)

    return _by_entry(number, array)


def _has_unknowns(key: Any) -> bool:
    keys = key if isinstance(key, tuple) else (key,)
    return any(is_unknown(k) or isinstance(k, Unknowns) for k in keys)


@functools.cache
def _entries(ufunc: np.ufunc) -> Any:
    """Returns a function of NumPy for entries, of which some may be unknown."""
    name = ufunc.__name__

    def one(*args: Any) -> Any:
        if any(type(arg) is Unknown for arg in args):
            return call(name, *args)
        return ufunc(*args)

    return np.frompyfunc(one, ufunc.nin, 1)


def _each(ufunc: np.ufunc, inputs: Sequence[Any], graph: Any) -> Any:
    return unknowns(objects(_entries(ufunc)(*map(objects, inputs))), graph)


def _gathered(ufunc: np.ufunc, method: str, inputs: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """Computes a sum, a product or the like over an axis, or an outer product."""
    function = _entries(ufunc)
    if kwargs.get("initial", 0) is np._NoValue:
        kwargs.pop("initial")
    if method == "outer":
        return function.outer(*map(objects, inputs))
    first = objects(inputs[0])
    if ufunc.__name__ == "add":
        first = _counted(first)
    over_all = kwargs.get("axis", 0) is None and not kwargs.get("keepdims")
    if method == "reduce" and over_all:
        first = first.ravel()
        kwargs["axis"] = 0
    return getattr(function, method)(first, *inputs[1:], **kwargs)


_MOVING = """
    all amax amin any append array_split atleast_1d atleast_2d broadcast_arrays broadcast_to
    column_stack concatenate copy cross cumsum delete diagonal diff dot einsum empty_like
    expand_dims flip fliplr flipud full_like hstack inner insert matmul max mean min moveaxis ndim
    ones_like outer polyval prod ravel repeat reshape roll shape sinc size split squeeze stack sum
    swapaxes take tensordot tile trace transpose tril triu vstack zeros_like
"""
_MOVED = {getattr(np, name) for name in _MOVING.split()}
_MOVED |= {np.linalg.matmul, np.linalg.outer}
"""Functions of NumPy that move entries, or add, multiply and compare them by operators."""


def _where(condition: Any, a: Any, b: Any) -> Any:
    if is_unknown(condition):
        return call("where", condition, a, b)
    return a if condition else b


def _clip(a: Any, low: Any, high: Any) -> Any:
    if any(map(is_unknown, (a, low, high))):
        return call("clip", a, low, high)
    return np.clip(a, low, high)


def _chosen(condition: Any, a: Any, b: Any) -> Any:
    return _by_entry(_where, condition, a, b)


def _clipped_array(a: Any, low: Any, high: Any) -> Any:
    return _by_entry(_clip, a, low, high)


def _select(conditions: Any, choices: Any, default: Any = 0.0) -> Any:
    found = default
    for condition, choice in zip(reversed(conditions), reversed(choices), strict=True):
        found = _chosen(condition, choice, found)
    return found


def _interp(x: Any, xp: Any, fp: Any) -> Any:
    places = np.asarray(xp, dtype=float)
    values = np.asarray(fp, dtype=float)
    slopes = np.diff(values) / np.diff(places)
    found = np.where(np.isnan(x), x, values[0])
    pieces = zip(places[:-1], values[:-1], slopes, strict=True)
    for left, value, slope in pieces:
        reached = x >= left
        line = slope * (x - left) + value
        found = np.where(reached, line, found)
    return np.where(x >= places[-1], values[-1], found)


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    if ord is not None and (ord != 2 or not isinstance(axis, int)):
        raise NotImplementedError(f"np.linalg.norm of order {ord} is not recorded")
    return np.sqrt(np.sum(x * x, axis=axis, keepdims=keepdims))


def _var(x: Any, axis: Any = None, keepdims: bool = False) -> Any:
    away = x - np.mean(x, axis=axis, keepdims=True)
    return np.mean(away * away, axis=axis, keepdims=keepdims)


def _std(x: Any, axis: Any = None, keepdims: bool = False) -> Any:
    return np.sqrt(_var(x, axis, keepdims))


def _without_nan(x: Any) -> Any:
    infinite = np.isinf(x)
    largest = np.sign(x) * HUGE
    finite = np.where(infinite, largest, x)
    return np.where(np.isnan(x), 0.0, finite)


def _copied(to: Any, given: Any, casting: str = "", where: Any = True) -> None:
    if where is not True:
        raise TypeError
    to[...] = given


_WRITTEN_OUT: dict[Any, Callable[..., Any]] = {
    np.where: _chosen,
    np.clip: _clipped_array,
    np.select: _select,
    np.interp: _interp,
    np.linalg.norm: _norm,
    np.var: _var,
    np.std: _std,
    np.nan_to_num: _without_nan,
    np.copyto: _copied,
    np.real: lambda x: x,
    np.iscomplexobj: lambda x: False,
    np.asarray: lambda x: x,
}
"""Functions of NumPy that are made of others, with the arguments that are recorded."""


def _function(graph: Any, function: Any, args: Any, kwargs: Any, plain: Any = None) -> Any:
    """Records a function of NumPy that is no ufunc; `plain` is NumPy's own for arrays."""
    if function in _MOVED:
        if plain is None:
            return _kept(function._implementation(*args, **kwargs), graph)
        return _kept(plain(function, (Unknowns,), args, kwargs), graph)
    if function not in _WRITTEN_OUT:
        raise graph.refuse(f"np.{function.__name__} is not recorded")
    try:
        found = _WRITTEN_OUT[function](*args, **kwargs)
    except TypeError:
        raise graph.refuse(f"np.{function.__name__} is not recorded of these arguments") from None
    return unknowns(found, graph)
