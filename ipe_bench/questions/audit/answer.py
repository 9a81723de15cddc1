"""Shows an audit: sentences, table, picture, files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.questions.audit.maths import Audit, audit, read_claims
from ipe_bench.report.page.writer import digests, write_files
from ipe_bench.report.tables.table import Fact, Legend, Part, Shown, Table, texts, words
from ipe_bench.report.words import counted


class AuditAnswer(Shown, Audit):
    """Shows an audit."""

    def parts(self) -> list[Part]:
        """Returns the sentences of an audit, and a row per parameter."""
        names = self.claims.names
        columns = [
            words("parameter", names),
            texts("true over reported", [_known(f"{f.value:.2f}") for f in self.each]),
            texts("97.5 % interval", [_known(f"{f.low:.2f} to {f.high:.2f}") for f in self.each]),
            words("reported", [f.verdict for f in self.each]),
            texts("bias", [_known(f"{value:+.2f}") for value in self.bias[:, 0]]),
            texts(
                "95 % of bias",
                [_known(f"{low:+.2f} to {high:+.2f}") for low, high in self.bias[:, 1:]],
            ),
        ]
        joint = "No covariances are reported, so directions are not judged."
        if self.claims.joint:
            joint = "The headline covers all parameters jointly."
        legend = Legend(
            "true over reported is the root mean square of errors in reported standard deviations,"
            " 1 if the report is right; bias is their mean. Intervals are joint, and valid for"
            " heavy tails."
        )
        title = f"Audit of {self.claims.runs} runs"
        if self.claims.left_out:
            title += f", {self.claims.left_out} rows without an estimate left out"
        return [*self.sentences, Table("audit", title, "", columns, notes=[legend, joint])]

    def facts(self) -> list[str]:
        """States what was found besides the scale, and the parameter whose errors are farthest from
        the report."""
        _, *faults = self.sentences
        found: list[str] = [Fact("Also found", sentence) for sentence in faults]
        apart = [factor.apart for factor in self.each]
        if len(apart) > 1 and max(apart) > 0:
            worst = apart.index(max(apart))
            words = f"errors of {self.claims.names[worst]} are {self.each[worst].words}."
            found.append(Fact("Worst parameter", words))
        clear = (self.bias[:, 1] <= 0) & (self.bias[:, 2] >= 0)
        if clear.all():
            found.append(Fact("Bias", "no parameter has a significant one."))
        return found


def _known(text: str) -> str:
    return "-" if "nan" in text else text


def write_audit(folder: Path, found: AuditAnswer, sources: Sequence[tuple[str, str]]) -> None:
    """Writes audit.csv and its page."""
    from ipe_bench.questions.audit.figure import draw_audit

    parts = [part for part in found.parts() if isinstance(part, Table)]
    title = found.sentences[0]
    write_files(
        folder,
        "audit",
        ("audit.csv", found.table()),
        title.removesuffix("."),
        found.facts(),
        parts,
        draw_audit(found),
        lead=(
            "A covariance is right if the errors over their reported standard deviations have a"
            " root mean square of 1."
        ),
        facts=[f"{found.claims.runs} runs", counted(found.claims.n, "parameter")],
        sources=sources,
    )


def audited(table: Any, output: Path | str | None = None) -> AuditAnswer:
    """Audits a file or a frame, and writes audit.csv and its page into a folder if one is
    named."""
    found = AuditAnswer(**vars(audit(read_claims(table))))
    if output is not None:
        sources = [] if isinstance(table, pd.DataFrame) else digests([Path(table)])
        write_audit(Path(output), found, sources)
    return found
