"""What figures are drawn from: the analysis seen setting by setting, with what a figure may know of its estimators.

A figure gets a `View` that holds the frames which it declared and nothing else.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.report.style import MOST_FACES, Look, looks
from ipe_bench.report.words import plain
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.summary import ALL

MOST_SETTINGS = 6
"""Settings that have figures of their own; the tables have all."""
MOST_LETTERS = 80
"""Of a setting in a file name; longer ones end in a digest instead of being cut to the same beginning."""
FRAMES = (
    "summary",
    "by_group",
    "scores",
    "distributions",
    "correlations",
    "convergence",
    "calibration",
    "profiles",
    "attained",
)


@dataclass(frozen=True)
class View:
    """One setting (measurement, noise and whatever else differs) over all its error scales, or all settings."""

    suffix: str
    """What the file names of its figures end in; empty where there is one setting, and for all settings."""
    label: str
    frames: Mapping[str, pd.DataFrame]
    look: Mapping[str, Look]
    """Of every estimator in these frames, in the order of the legend."""
    equations: Mapping[str, str | None]
    """What each estimator solves; None for filters and direct estimates, which have no iterations and no root."""
    parameters: Sequence[Mapping[str, Any]] = ()
    """Name, unit, size and group of each; empty for all settings."""
    bound_correlation: Any = None
    """Correlation (n, n) of the linear bound's covariance, if it is known."""
    paper: bool = False
    """Whether this is the setting of the paper: the gimballed INS with quantised readings."""
    parts: Sequence[View] = field(default=())
    """The settings one by one, in a view of all."""

    def __getitem__(self, frame: str) -> pd.DataFrame:
        return self.frames[frame]

    @property
    def n(self) -> int:
        return len(self.parameters)

    @cached_property
    def totals(self) -> pd.DataFrame:
        """The rows of the summary over all parameters, with the number of trials `solved_trials` behind each."""
        rows = self["summary"]
        rows = rows[rows["parameter"] == ALL].sort_values("error_scale", kind="stable")
        return rows.assign(solved_trials=(rows["solved"] * rows["trials"]).round())

    @cached_property
    def scales(self) -> list[float]:
        """The error scales, ascending."""
        frames = [frame for frame in self.frames.values() if "error_scale" in frame.columns]
        return sorted({float(s) for frame in frames for s in frame["error_scale"]})

    def with_look(self, estimators: Any) -> dict[str, Look]:
        """The looks of those of the estimators that are here."""
        present = set(estimators)
        return {label: look for label, look in self.look.items() if label in present}

    def only(self, names: Sequence[str]) -> View:
        """The same with those frames alone."""
        frames = {name: self.frames[name] for name in names}
        return replace(self, frames=frames, parts=tuple(part.only(names) for part in self.parts))


def views(analysis: Analysis) -> tuple[list[View], View]:
    """The settings of an analysis, at most `MOST_SETTINGS`, and all of them together."""
    look = _looks(analysis)
    equations = {g.estimator: g.footer.get("equation") for g in analysis.collection.groups}
    columns = analysis.setting_columns
    keys = {name: _keys(getattr(analysis, name), columns) for name in FRAMES}
    groups = list(dict.fromkeys(keys["scores"]))
    varying = [c for i, c in enumerate(columns) if len({key[i] for key in groups}) > 1]
    footers = {tuple(_word(g.columns.get(c)) for c in columns): g.footer for g in analysis.collection.groups}
    parts: list[View] = []
    for number, key in enumerate(groups[:MOST_SETTINGS], 1):
        frames = {
            name: getattr(analysis, name).loc[np.array([k == key for k in keys[name]], dtype=bool)] for name in FRAMES
        }
        there = set(frames["scores"]["estimator"])
        label = _label(dict(zip(columns, key, strict=True)), varying)
        if number == MOST_SETTINGS < len(groups):
            label += f" ({len(groups) - number} further settings are in the tables)"
        suffix = _suffix(dict(zip(columns, key, strict=True)), varying, [part.suffix for part in parts])
        seen = {label: one for label, one in look.items() if label in there}
        solve = {label: equations[label] for label in seen}
        footer, names = footers[key], dict(zip(columns, key, strict=True))
        paper = (names.get("measurement"), names.get("noise")) == ("gins", "quantization")
        known = footer["parameters"], footer.get("linear_correlation"), paper
        parts.append(View(suffix, label, frames, seen, solve, *known))
    frames = {name: getattr(analysis, name) for name in FRAMES}
    return parts, View("", "", frames, look, equations, parts=tuple(parts))


def _looks(analysis: Analysis) -> dict[str, Look]:
    """A look for each estimator, in the family of its kind; of more than `MOST_FACES` the two best of each kind and the
    reference are in colour."""
    labels = analysis.collection.estimators
    kinds = {g.estimator: kind_of(g.footer) for g in analysis.collection.groups}
    if len(labels) <= MOST_FACES or analysis.summary.empty:
        return looks(labels, kinds)
    totals = analysis.summary[analysis.summary["parameter"] == ALL]
    success = totals.groupby("estimator")["success"].mean()
    ranked = sorted(labels, key=lambda label: -success.get(label, 0.0))
    best = [label for label in labels if label in [e for e in ranked if kinds.get(e) == kinds.get(label)][:2]]
    return looks(labels, kinds, chosen=best)


def kind_of(footer: Mapping[str, Any]) -> str:
    """The kind of estimator, one of `FAMILIES`, from what is stored of it."""
    path = str(footer["identity"]["estimator"]["_target_"])
    if ".enkf." in path or ".es_mda." in path:
        return "ensembles"
    if footer.get("sequential"):
        return "filters"
    return "IPE" if ".solvers." in path or footer.get("equation") == "frozen" else "least squares"


def _keys(frame: pd.DataFrame, columns: Sequence[str]) -> list[tuple[str, ...]]:
    """What each row's setting is; frames over all settings have none."""
    if not set(columns) <= set(frame.columns):
        return [()] * len(frame)
    return list(zip(*(_words(frame[c]) for c in columns), strict=True)) if columns else [()] * len(frame)


def _words(column: pd.Series) -> Any:
    """What `_word` makes of a column of few different values."""
    if column.dtype == object:
        # True and 1 are two settings here, and one value there.
        return column.map(_word)
    codes, values = pd.factorize(column, use_na_sentinel=False)
    return np.array([_word(value) for value in values], dtype=object)[codes]


def _word(value: Any) -> str:
    """A setting's value as it is compared and shown; a dash where a setting does not have that option."""
    if value is None or (pd.api.types.is_scalar(value) and pd.isna(value)):
        return "-"
    # Six figures where they say it all: values that differ later are different settings.
    return plain(value) if isinstance(value, float) and float(plain(value)) == value else str(value)


def _label(named: Mapping[str, str], varying: Sequence[str]) -> str:
    # An option that this setting does not have is not spoken of.
    shown = [named[c] for c in ("measurement", "noise") if named.get(c, "-") != "-"]
    others = [c for c in varying if c not in ("measurement", "noise") and named[c] != "-"]
    return ", ".join([*shown, *(f"{c}={named[c]}" for c in others)])


def _suffix(named: Mapping[str, str], varying: Sequence[str], taken: Sequence[str]) -> str:
    if not varying:
        return ""
    words = "_".join(named[c] for c in varying if named[c] != "-")
    safe = re.sub(r"[^A-Za-z0-9.]+", "-", words).strip("-.")
    if len(safe) > MOST_LETTERS or not safe or f"_{safe}" in taken:
        safe = f"{safe[: MOST_LETTERS - 9]}-{hashlib.sha256(repr(named).encode()).hexdigest()[:8]}".strip("-")
    return f"_{safe}"
