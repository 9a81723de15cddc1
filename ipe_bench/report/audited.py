"""What `audit` found, as sentences and a table."""

from __future__ import annotations

import math
from pathlib import Path

from ipe_bench.report.table import Part, Table, texts, words
from ipe_bench.report.writer import write
from ipe_bench.statistics.audit import Audit


def contents(found: Audit) -> list[Part]:
    """The sentences, and a row per parameter."""
    names = found.claims.names
    columns = [
        words("parameter", names),
        texts("true over reported", [f"{f.value:.2f}" for f in found.each]),
        texts("97.5 %", [f"{f.low:.2f} to {f.high:.2f}" for f in found.each]),
        words("deviation", [f.verdict for f in found.each]),
        texts("bias", [f"{value:+.2f}" for value in found.bias[:, 0]]),
        texts("95 % of bias", [f"{low:+.2f} to {high:+.2f}" for low, high in found.bias[:, 1:]]),
    ]
    runs, left_out = found.claims.runs, found.claims.left_out
    notes = [
        "true over reported is the root mean square of errors in reported standard deviations, 1 if the report is"
        " right;  "
        "bias is their mean. Intervals hold for all parameters together, and for heavy tails."
    ]
    low, high = found.nees_limits
    if math.isfinite(low):
        notes.append(f"NEES over n is {found.nees:.3f}; normal errors would leave it within {low:.3f} to {high:.3f}.")
    if not found.claims.joint:
        notes.append("No covariances are reported, so directions and the NEES are not judged.")
    title = f"Audit of {runs} runs" + (f", {left_out} rows without an estimate left out" if left_out else "")
    return [*found.sentences, Table("audit", title, "", columns, notes=notes)]


def write_audit(found: Audit, output: Path) -> list[Path]:
    """Writes audit.csv and audit.html, and returns them."""
    output.mkdir(parents=True, exist_ok=True)
    return write(output, "audit", "Audit", contents(found), table=("audit.csv", found.table()))
