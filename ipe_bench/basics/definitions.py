"""Digests classes and functions as they are in this process, whatever a file says of them.

A cell of a notebook, `exec`, a factory, `importlib.reload` and an assignment to a module's constant
change what a name stands for while the process runs. So a definition is digested with all that it
reaches: code, constants, defaults, values of closures, bases, class attributes, and by name the
functions, classes and variables of its module and of other modules that are not installed.
Installed packages stand for themselves by name.
"""

from __future__ import annotations

import copy
import dataclasses
import dis
import functools
import hashlib
import importlib.util
import inspect
import operator
import sys
import sysconfig
import types
import uuid
import weakref
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.options import component_classes

_BY_NAME = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS", "IMPORT_NAME")
"""Instructions that ask for a variable of the module, or for a module."""
_PLAIN = (type(None), type(...), bool, int, float, complex, str, bytes)
_DEFINED = (
    type,
    types.FunctionType,
    types.MethodType,
    types.ModuleType,
    staticmethod,
    classmethod,
    property,
    functools.cached_property,
)
_PARTS = ("__func__", "__self__", "__wrapped__", "fget", "func")
"""Attributes that hold the functions of a method, of a property, and of what functools or a
compiler makes of one."""
_THROUGH: dict[type, Callable[[Any], Any]] = {
    types.MappingProxyType: dict,
    memoryview: bytes,
    weakref.ReferenceType: operator.call,
}
"""Functions by which what only shows another object becomes what it shows."""
_BEYOND_NAMES = {"eval", "exec", "globals", "__import__"}
"""Built-in functions by which code reaches what no name in it tells."""
_PIN = "_definition"
"""Attribute that holds the digest of a component's definition from when a run of it began."""
_tokens: dict[int, tuple[Any, str]] = {}
"""Tokens of what cannot be digested, by its id, with the thing itself, so that its id stays its
own."""


@dataclass(frozen=True)
class Definition:
    """Holds what the numbers of a component depend on beside options and installed packages."""

    digest: str
    """Empty if the component is of installed packages alone."""
    modules: frozenset[str]
    """Modules that the code reaches, whose files may fill variables that are not digested."""


def definition_of(component: Any) -> Definition:
    """Returns the definition of a component; that of a component that is `pinned` stays as it was
    then."""
    held = getattr(component, "__dict__", {}).get(_PIN)
    if held is not None:
        return held
    definitions = Definitions()
    digest = _digest(component_classes(component), definitions)
    return Definition(digest, frozenset(definitions.modules))


def statement_of(component: Any) -> Any:
    """Describes a component with its options; None if any of its code is not of an installed
    package."""
    definitions = Definitions()
    described = definitions.of(component)
    return None if definitions.modules else described


def importable_digest(component: Any) -> str:
    """Computes a digest of the code that another process imports by name, whatever its variables
    hold."""
    named = [thing for thing in component_classes(component) if _is_named(thing)]
    return _digest(named, Definitions(values=False))


def _digest(things: list[Any], definitions: Definitions) -> str:
    own = [thing for thing in things if not _stands_by_name(thing)]
    if not own:
        return ""
    described = repr(definitions.of(own))
    return hashlib.sha256(described.encode()).hexdigest()[:16]


def pinned(component: Any) -> Any:
    """Copies a component with the digest of its definition, and without what it has worked out, its
    components alike: code that it works with can have changed since. One of installed packages
    alone is returned as it is."""
    return _copied(component, pin=True)


def renewed(component: Any) -> Any:
    """Copies a component without what it has worked out, as `pinned` does; its definition may
    change later."""
    return _copied(component, pin=False)


def as_defined(component: Any, held: dict[str, Any]) -> Any:
    """Returns a component as its definition is today: itself if it is pinned or of installed
    packages, or else the copy that `held` has, or gets, by the digest of the definition."""
    if _PIN in getattr(component, "__dict__", ()):
        return component
    digest = definition_of(component).digest
    if not digest:
        return component
    if digest not in held:
        held.clear()
        held[digest] = renewed(component)
    return held[digest]


def _copied(component: Any, *, pin: bool) -> Any:
    if isinstance(component, tuple | list):
        return type(component)(_copied(one, pin=pin) for one in component)
    if not dataclasses.is_dataclass(component):
        return component
    if _PIN in getattr(component, "__dict__", {_PIN: ""}):
        return component
    found = definition_of(component)
    if not found.digest:
        return component
    fresh = copy.copy(component)
    state = {name: _copied(value, pin=pin) for name, value in _state_of(component).items()}
    fresh.__dict__.clear()
    fresh.__dict__.update(state)
    if pin:
        fresh.__dict__[_PIN] = found
    return fresh


def _state_of(thing: Any) -> dict[str, Any]:
    """Returns an object's attributes without the values of cached properties."""
    return {
        name: value
        for name, value in vars(thing).items()
        if not isinstance(
            inspect.getattr_static(type(thing), name, None), functools.cached_property
        )
    }


@functools.cache
def is_installed(module: str) -> bool:
    """Tells whether a module belongs to this package, to Python or to an installed package, which
    no session edits."""
    top = module.partition(".")[0]
    if top == "__main__":
        return False
    if top in sys.stdlib_module_names or top == "ipe_bench":
        return True
    loaded = sys.modules.get(top)
    try:
        spec = loaded.__spec__ if loaded is not None else importlib.util.find_spec(top)
    except (ValueError, ImportError):
        return False
    if spec is None:
        return False
    homes = {Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib")}
    for origin in (spec.origin, *(spec.submodule_search_locations or ())):
        if origin and not homes.isdisjoint(Path(origin).resolve().parents):
            return True
    return False


def _is_named(thing: Any) -> bool:
    """Tells whether another process that imports the module finds this class or function by its
    name."""
    module = getattr(thing, "__module__", None)
    name = getattr(thing, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or module == "__main__":
        return False
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found is thing


def _stands_by_name(thing: Any) -> bool:
    """Tells whether a class or function is one of an installed package, and not one that a factory
    there made."""
    return _is_named(thing) and is_installed(thing.__module__)


def _wraps(thing: Any) -> bool:
    """Tells whether an installed package made this of a function, with no numbers of its own."""
    return hasattr(thing, "__wrapped__") and _stands_by_name(type(thing))


class Definitions:
    """Describes things as nested tuples of plain data, which are equal where definitions are.

    With `values` False they hold code alone, and no variables.
    """

    def __init__(self, *, values: bool = True) -> None:
        self.values = values
        self.modules: set[str] = set()
        """Modules that are not installed, of what was met."""
        self.met: dict[int, tuple[int, Any]] = {}
        """Place in the order of meeting of each thing by its id, with the thing itself, so that its
        id stays so."""

    def of(self, thing: Any) -> Any:
        """Describes one thing."""
        if type(thing) in _PLAIN:
            return type(thing).__name__, repr(thing)
        if id(thing) in self.met:
            return "met", self.met[id(thing)][0]
        self.met[id(thing)] = len(self.met), thing
        try:
            return type(thing).__name__, self._described(thing)
        except Exception:  # a foreign object may do anything when it is taken apart
            return "token", _token(thing)

    def _described(self, thing: Any) -> Any:
        if isinstance(thing, types.ModuleType):
            return thing.__name__
        if _stands_by_name(thing):
            return thing.__module__, thing.__qualname__
        if isinstance(thing, type):
            return self._class(thing)
        if isinstance(thing, types.FunctionType):
            return self._function(thing)
        if isinstance(thing, _DEFINED) or _wraps(thing):
            return [self.of(getattr(thing, part, None)) for part in _PARTS]
        if type(thing) in _THROUGH:
            return self.of(_THROUGH[type(thing)](thing))
        if type(thing) in (tuple, list):
            return [self.of(one) for one in thing]
        if type(thing) in (set, frozenset):
            return sorted(repr(Definitions().of(one)) for one in thing)
        return self._object(thing)

    def _note(self, module: str | None) -> None:
        if module and not is_installed(module):
            self.modules.add(module)

    def _object(self, thing: Any) -> Any:
        """Describes an object as pickle takes it apart, without what it has worked out."""
        taken = thing.__reduce_ex__(4)
        if isinstance(taken, str):  # a constant of a module
            return getattr(thing, "__module__", ""), taken
        make, arguments, state, *several = (*taken, None, None, None)[:5]
        if isinstance(state, dict) and hasattr(thing, "__dict__"):
            kept = _state_of(thing)
            state = {name: value for name, value in state.items() if name in kept}
        listed = [each and list(each) for each in several]
        return [self.of(part) for part in (make, arguments, state, *listed)]

    def _class(self, cls: type) -> Any:
        self._note(cls.__module__)
        slots = types.MemberDescriptorType | types.GetSetDescriptorType
        own = {
            name: value for name, value in sorted(vars(cls).items()) if not isinstance(value, slots)
        }
        attributes = self._kept(own, in_file=_is_named(cls))
        # What Python and dataclasses note in a class is no number's: annotations, docstring, lines,
        # fields.
        for name, value in own.items():
            noted = name.startswith("__") and not isinstance(value, _DEFINED)
            if noted or name == "_abc_impl":
                attributes.pop(name, None)
        own_kind = () if _stands_by_name(type(cls)) else (type(cls),)
        bases = [self.of(base) for base in (*cls.__bases__, *own_kind)]
        return cls.__qualname__, bases, self.of(attributes)

    def _function(self, function: types.FunctionType) -> Any:
        self._note(function.__module__)
        code = function.__code__
        known = function.__globals__
        text, names, attributes = _read(code)
        if names & _BEYOND_NAMES - known.keys():
            names |= {name for name in known if not name.startswith("_")}
        module = sys.modules.get(function.__module__)
        of_module = known is getattr(module, "__dict__", None)
        in_file = of_module and function.__module__ != "__main__"
        found = {name: known.get(name, sys.modules.get(name)) for name in sorted(names)}
        reached = self._kept(found, in_file=in_file)
        contents = map(_content, function.__closure__ or ())
        cells = dict(zip(code.co_freevars, contents, strict=True))
        reached |= self._kept(cells, in_file=_is_named(function))
        described = [(name, self._reached(one, attributes)) for name, one in reached.items()]
        own = vars(function) if self.values else None
        given = (function.__defaults__, function.__kwdefaults__, own)
        return text, described, self.of(given)

    def _kept(self, variables: Mapping[str, Any], *, in_file: bool) -> dict[str, Any]:
        """Keeps those variables that belong to a definition: of a file's containers those that hold
        numbers and words alone, such as tables of constants. Others are mostly caches, and what
        the file fills them with is in its source."""
        if self.values and not in_file:
            return dict(variables)

        def belongs(value: Any) -> bool:
            if isinstance(value, _DEFINED) or _wraps(value):
                return True
            return self.values and (isinstance(value, tuple | frozenset) or _is_table(value))

        return {name: value for name, value in variables.items() if belongs(value)}

    def _reached(self, value: Any, attributes: Set[str]) -> Any:
        """Describes what a name stands for: of a module those of its attributes that the code asks
        for."""
        if not isinstance(value, types.ModuleType) or is_installed(value.__name__):
            return self.of(value)
        self._note(value.__name__)
        content = vars(value)
        named = {name: content[name] for name in sorted(attributes & content.keys())}
        asked = self._kept(named, in_file=True)
        described = [(name, self._reached(one, attributes - {name})) for name, one in asked.items()]
        return value.__name__, described


def _is_table(value: Any, depth: int = 5) -> bool:
    """Tells whether a value is a number, a word, or a container of such, however nested."""
    if isinstance(value, (*_PLAIN, np.ndarray, np.generic)):
        return True
    if not isinstance(value, list | tuple | set | frozenset | dict) or not depth:
        return False
    parts = [*value, *value.values()] if isinstance(value, dict) else value
    return all(_is_table(part, depth - 1) for part in parts)


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # it is empty as yet
        return None


def _token(thing: Any) -> str:
    """Returns a token that is this very object's as long as the process lives."""
    return _tokens.setdefault(id(thing), (thing, uuid.uuid4().hex))[1]


@functools.lru_cache(maxsize=4096)
def _read(code: types.CodeType) -> tuple[Any, frozenset[str], frozenset[str]]:
    """Returns the instructions of code without its lines and docstring, the names of variables of
    the module that it reads and of modules that it imports, and all names in it, attributes among
    them."""
    arguments = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    parameters = code.co_varnames[: sum(arguments[:3])]
    text: list[Any] = [arguments, parameters, code.co_exceptiontable]
    names: set[str] = set()
    attributes = set(code.co_names)
    for step in dis.get_instructions(code):
        argument: Any = step.argval
        # Python 3.11 gives the names of keywords by their place alone.
        if step.opcode in dis.hasconst and step.arg is not None:
            argument = code.co_consts[step.arg]
        if isinstance(argument, types.CodeType):
            argument, more, further = _read(argument)
            names |= more
            attributes |= further
        elif step.opname in _BY_NAME:
            names.add(argument)
        text.append((step.opname, _constant(argument)))
    return tuple(text), frozenset(names), frozenset(attributes)


def _constant(value: Any) -> str:
    """Writes a constant of code, whatever the order of a set in it."""
    if isinstance(value, frozenset):
        return f"frozenset({sorted(map(_constant, value))})"
    if isinstance(value, tuple):
        return f"({', '.join(map(_constant, value))})"
    return repr(value)
