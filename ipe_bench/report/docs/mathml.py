"""Formulas as MathML, which browsers draw by themselves: no script and no network."""

from __future__ import annotations

from typing import Any

from docutils import nodes  # pyright: ignore[reportMissingModuleSource]
from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]

_STYLE = "margin: 1rem 0; padding: .5rem 0; overflow-x: auto"


def setup(app: Any) -> dict[str, bool]:
    """Registers the renderer with Sphinx."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _display(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div style="{_STYLE}">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode
