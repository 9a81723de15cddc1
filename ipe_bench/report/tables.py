"""Tables for papers and mails: CSV, Markdown and LaTeX, from the analysis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.report.terminal import duration, percent, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL
from ipe_bench.store import write_atomically


@dataclass(frozen=True)
class Table:
    """A table with its file name, title and caption; `shown` are the texts that a reader sees."""

    name: str
    title: str
    caption: str
    data: pd.DataFrame
    shown: pd.DataFrame
    numeric: Sequence[str] = field(default_factory=tuple)

    def markdown(self) -> str:
        def cell(value: Any) -> str:
            return str(value).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")

        columns = list(self.shown.columns)
        lines = [f"**{self.title}.** {self.caption}", ""]
        lines.append("| " + " | ".join(map(cell, columns)) + " |")
        lines.append("|" + "|".join("---:" if c in self.numeric else ":---" for c in columns) + "|")
        lines += ["| " + " | ".join(map(cell, row)) + " |" for row in self.shown.itertuples(index=False)]
        return "\n".join(lines) + "\n"


def overview(analysis: Analysis) -> Table:
    """A row per scenario and estimator: who solves how much, how well and at what cost."""
    rows = analysis.summary[analysis.summary["parameter"] == ALL]
    varying = [c for c in analysis.setting_columns if len(set(rows[c].astype(str))) > 1]
    shown = pd.DataFrame({c: rows[c].astype(str) for c in varying})
    shown["error scale"] = [f"{v:g}" for v in rows["error_scale"]]
    shown["estimator"] = rows["estimator"].astype(str)
    shown["trials"] = rows["trials"].astype(str)
    for name in ("converged", "solved", "success", "false_root"):
        shown[name.replace("_", " ")] = [percent(v) for v in rows[name]]
    shown["rmse / bound"] = [short(v) for v in rows["rmse_over_linear_bound"]]
    shown["95 %"] = [f"{short(a)} to {short(b)}" for a, b in zip(rows["rmse_low"], rows["rmse_high"], strict=True)]
    shown["common trials"] = [short(v) for v in rows["rmse_common"]]
    shown["efficiency"] = [short(v) for v in rows["efficiency"]]
    shown["NEES"] = [short(v) for v in rows["nees"]]
    shown["coverage"] = [percent(v) for v in rows["coverage95"]]
    shown["iterations"] = [short(v) for v in rows["iterations_median"]]
    shown["simulations"] = [short(v) for v in rows["simulations_median"]]
    shown["time"] = [duration(v) for v in rows["time_median_s"]]
    numeric = [c for c in shown.columns if c not in (*varying, "estimator")]
    caption = (
        "Shares are of all trials; errors are root mean squares over the parameters of error over linear bound, over"
        " the trials that the estimator solved (common trials: that every estimator solved)."
    )
    return Table("overview", "Overview", caption, rows, shown, numeric)


def write_tables(analysis: Analysis, folder: Path) -> tuple[Path, ...]:
    """Writes each table as CSV and Markdown."""
    if analysis.summary.empty:
        return ()
    paths = []
    for table in (overview(analysis),):
        texts = {".csv": table.data.to_csv(index=False), ".md": table.markdown()}
        for suffix, content in texts.items():
            path = folder / f"{table.name}{suffix}"
            write_atomically(path, lambda temporary, content=content: temporary.write_text(content, encoding="utf-8"))
            paths.append(path)
    return tuple(paths)
