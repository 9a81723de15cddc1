"""The summary that `ib.run` returns: a frame that shows itself, with its trials, figures and
report."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pandas as pd

from ipe_bench.basics.errors import UserError
from ipe_bench.report.figures import drawings
from ipe_bench.report.formats import PAGE
from ipe_bench.report.page.run import ReportResult, begin_report
from ipe_bench.report.style import house_style
from ipe_bench.report.tables.table import html, plain_text
from ipe_bench.report.tables.terminal import summary_tables
from ipe_bench.statistics.analysis import analyse
from ipe_bench.statistics.collect import collect, trials_frame
from ipe_bench.statistics.registry import summary_columns
from ipe_bench.statistics.statistic import ALL

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Stored:
    """The folder of a run; one that was not named is removed with the last frame on it."""

    def __init__(self, folder: Path | str | None = None) -> None:
        self.named = folder is not None
        self.folder = Path(tempfile.mkdtemp(prefix="ipe-bench-") if folder is None else folder)
        if not self.named:
            weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)


class Summary(pd.DataFrame):
    """Shows a row per scenario, estimator and parameter as the terminal does, while it has the
    columns for that."""

    _metadata: ClassVar = ["_stored"]
    _stored: Stored | None = None

    @property
    def _constructor(self) -> Any:
        return Summary

    @classmethod
    def of(cls, frame: pd.DataFrame, stored: Stored) -> Summary:
        """Reads the summary of the results stored in a folder."""
        made = cls(frame)
        made.attrs = frame.attrs
        made._stored = stored
        return made

    @property
    def trials(self) -> pd.DataFrame:
        """A row per trial and estimator; see `ib.load`."""
        return trials_frame(collect([self._folder]))

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures of `ib.report` by their names, as Matplotlib's figures."""
        with house_style():
            drawn = drawings(analyse([self._folder]))
            return {drawing.name: drawing.shown() for drawing in drawn}

    def report(
        self, output: Path | str | None = None, *, figures: Any = "main", formats: Any = PAGE
    ) -> ReportResult:
        """Writes the report into `output`, or else into the folder of the run; see `ib.report`."""
        if output is None and not (self._stored and self._stored.named):
            raise UserError("report: the run has no folder; give output=, or run with output=")
        return begin_report([self._folder], output, figures=figures, formats=formats).written()

    @property
    def _folder(self) -> Path:
        if self._stored is None or not self._stored.folder.is_dir():
            raise UserError(
                "this frame was modified and lost its trials; take them from the one that `ib.run`"
                " returned"
            )
        return self._stored.folder

    @property
    def _is_whole(self) -> bool:
        needed = {"parameter", "noise", *summary_columns()}
        return needed <= set(self.columns) and ALL in set(self["parameter"])

    def _tables(self, width: int) -> list[Any]:
        rows: Any = self.to_dict("records")
        collection = collect([self._folder]) if self._needs_results else None
        return summary_tables(rows, collection, width)

    @property
    def _needs_results(self) -> bool:
        """Whether its words need more than its rows, and the results are known."""
        of_truth = any(column.partition(".")[0] == "truth" for column in self.columns)
        certified = (self["noise"] == "certified").any()
        is_there = self._stored is not None and self._stored.folder.is_dir()
        return is_there and bool(certified or of_truth)

    def __repr__(self) -> str:
        if not self._is_whole:
            return super().__repr__()
        return plain_text(self._tables(120), 120).rstrip()

    def _repr_html_(self) -> str | None:
        return html(self._tables(1000)) if self._is_whole else super()._repr_html_()  # type: ignore[operator]
