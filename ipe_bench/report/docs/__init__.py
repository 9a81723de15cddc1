"""The documentation: pages about ipe-bench, a reference read from the code, and a gallery of executed experiments.

`make docs` builds the site into outputs/docs/html; what a page says of options, statuses and statistics is taken from
where the program itself takes it. Needs the extra `docs`. As an extension of Sphinx this package writes formulas as
MathML, which browsers draw by themselves: no script and no network.
"""

from __future__ import annotations

from typing import Any

_STYLE = "margin: 1rem 0; padding: .5rem 0; overflow-x: auto"


def setup(app: Any) -> dict[str, bool]:
    """Registers the renderer of formulas with Sphinx."""
    from docutils.nodes import SkipNode  # pyright: ignore[reportMissingModuleSource]
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]

    def inline(translator: Any, node: Any) -> None:
        translator.body.append(convert(node.astext()))
        raise SkipNode

    def display(translator: Any, node: Any) -> None:
        translator.body.append(f'<div style="{_STYLE}">{convert(node.astext(), display="block")}</div>')
        raise SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
