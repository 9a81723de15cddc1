"""Builds the documentation: pages about ipe-bench, a reference read from the code, and a gallery of
experiments.

`make docs` builds the site into outputs/docs/html by the extra `docs`. As an extension of Sphinx
this module writes formulas as MathML, which needs no script and no network.
"""

from __future__ import annotations

import re
from pkgutil import resolve_name
from typing import Annotated, Any, get_args, get_origin

from ipe_bench.basics import options

_CONSTRAINED = {
    n: get_args(t)[0].__name__ for n, t in vars(options).items() if get_origin(t) is Annotated
}
"""Plain types of the annotations that name a constraint, such as Positive."""
_STYLE = "margin: 1rem 0; padding: .5rem 0; overflow-x: auto"


def show_type(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Gives an attribute its type; napoleon, which comes before, takes the words before a colon of
    its docstring."""
    if what in ("attribute", "property") and lines:
        for line in [line for line in lines if line.startswith(":type: ")]:
            lines.remove(line)
            lines[0] = f"{line.removeprefix(':type: ')}: {lines[0]}"
        owner, _, attribute = name.rpartition(".")
        lines += ["", f":type: {type_of(resolve_name(owner), attribute) or 'object'}"]


def type_of(cls: type, attribute: str) -> str:
    """Returns the type of an attribute or a property as its class writes it, without constraints,
    or an empty text."""
    for base in cls.__mro__:
        member = vars(base).get(attribute)
        getter = getattr(member, "fget", None) or getattr(member, "func", None)
        written = getattr(getter, "__annotations__", {}).get("return")
        written = written or vars(base).get("__annotations__", {}).get(attribute)
        if written:
            plain = re.sub(r"^ClassVar\[(.*)\]$", r"\1", getattr(written, "__name__", str(written)))
            plain = re.sub(r"Annotated\[(\w+),.*\]", r"\1", plain)
            return re.sub(r"\w+", lambda word: _CONSTRAINED.get(word[0], word[0]), plain)
        if isinstance(member, bool | int | float | str | tuple):
            return type(member).__name__
    return ""


def setup(app: Any) -> dict[str, bool]:
    """Registers the renderer of formulas with Sphinx."""
    from docutils.nodes import SkipNode  # pyright: ignore[reportMissingModuleSource]
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]

    def inline(translator: Any, node: Any) -> None:
        translator.body.append(convert(node.astext()))
        raise SkipNode

    def display(translator: Any, node: Any) -> None:
        translator.body.append(
            f'<div style="{_STYLE}">{convert(node.astext(), display="block")}</div>'
        )
        raise SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    app.connect("autodoc-process-docstring", show_type, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
