"""Makes tables, and shows them in terminals and files. Plugins find here what plugins/README
promises."""

from typing import Any

_PROMISED = ("Table", "column", "head", "words")


def __getattr__(name: str) -> Any:
    if name in _PROMISED:
        from ipe_bench.report.tables import reports  # which loads pandas

        return getattr(reports, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
