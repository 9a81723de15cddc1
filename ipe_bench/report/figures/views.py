"""Kinds of figures, and what they are drawn from: the analysis setting by setting, with the looks
of its estimators."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import pandas as pd

from ipe_bench.basics.errors import UserError
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.finding import Finding
from ipe_bench.report.style import (
    GREY,
    MOST_FACES,
    MOST_TOGETHER,
    REFERENCE,
    Look,
    Which,
    drawn_settings,
    looks,
)
from ipe_bench.report.words import assignments, value_text, varying
from ipe_bench.runs.store import traits
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.records import family_of
from ipe_bench.statistics.statistic import ALL

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from ipe_bench.statistics.collect import Collection

MOST_LETTERS = 70
"""Largest length of a setting in a file name; longer ones are cut and end in a number."""
FOCUS = ("newton", "ekf", "fixed_point", "ukf")
"""Those that the bench is about, behind the best of all."""
FRAMES = tuple(field.name for field in fields(Analysis) if field.type == "pd.DataFrame")
"""The tables of an analysis that a figure may ask for."""


@dataclass(frozen=True)
class View:
    """Holds one setting (measurement, noise and other differing options) over all its error scales,
    or all settings."""

    suffix: str
    """Suffix of the file names of its figures; empty if there is one setting, and for all
    settings."""
    label: str
    frames: Mapping[str, pd.DataFrame]
    look: Mapping[str, Look]
    """Look of each estimator in these frames, in the order of the legend."""
    equations: Mapping[str, str | None]
    """Equation that each estimator solves; None for filters and direct estimates, which have no
    iterations."""
    families: Mapping[str, str]
    """Family of each estimator, of which smoothers are one."""
    parameters: Sequence[Mapping[str, Any]] = ()
    """Name, unit, size and group of each; empty for all settings."""
    focus: Sequence[str] = ()
    """The estimators in colour where not all can be: the best, then those that the bench is
    about."""
    winner: str = ""
    """The one that holds longest and succeeds most; empty if several do."""
    paper: bool = False
    """Whether this is the setting of the paper: the gimballed INS with quantised readings."""
    moving: bool = False
    """Whether the setting has states that move."""
    collection: Collection | None = None
    """Stored results; the view of all settings alone has them."""

    @property
    def reference(self) -> str:
        """Names the unit of the errors."""
        return "the linearised filter" if self.moving else "the bound"

    def __getitem__(self, frame: str) -> pd.DataFrame:
        return self.frames[frame]

    @property
    def n(self) -> int:
        return len(self.parameters)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """The rows of the summary, with the number of trials `solved_trials` behind each."""
        rows = self["summary"]
        return rows.assign(solved_trials=(rows["solved"] * rows["trials"]).round())

    @cached_property
    def totals(self) -> pd.DataFrame:
        """Those over all parameters, by error scale."""
        rows = self.summary
        return rows[rows["parameter"] == ALL].sort_values("error_scale", kind="stable")

    @cached_property
    def scales(self) -> list[float]:
        """The error scales, ascending."""
        frames = [frame for frame in self.frames.values() if "error_scale" in frame.columns]
        return sorted({float(s) for frame in frames for s in frame["error_scale"]})

    def with_look(self, estimators: Any) -> dict[str, Look]:
        """Returns the looks of those of the estimators that are present, of many in grey but for
        the focus."""
        colored = self.focus if len(self.look) > MOST_FACES else self.look
        return only(in_focus(self.look, colored), set(estimators))

    def drawing(self, figure: Canvas, name: str, title: str, *caption: str) -> Drawing:
        """Returns a figure of this setting, whose label stands with the title; empty parts of the
        caption go."""
        titled = f"{title} ({self.label})" if self.label else title
        words = " ".join(filter(None, caption))
        return Drawing(f"{name}{self.suffix}", titled, words, figure, name)

    def only(self, names: Sequence[str]) -> View:
        """Returns the same view with those frames alone."""
        return replace(self, frames={name: self.frames[name] for name in names})


@dataclass(frozen=True)
class Figure:
    """Declares a kind of figure: the frames that it reads, and how it is drawn.

    Required: `draw` and `frames`. Optional: `together` and `main`. Promised: `draw` reads the
    view's `frames` and does not write into them; it yields drawings, made by `view.drawing(figure,
    name, title, ...)`, whose names are new. A statistic of a plugin is a column of the frame
    `summary`; a figure that raises is left out with a line.

    >>> Figure(lambda view: iter(()), ("summary",)).together
    False
    """

    draw: Callable[[View], Iterator[Drawing]]
    """Draws what a view allows; no figure where it would be empty."""
    frames: tuple[str, ...]
    """Frames of the analysis that the figure reads; its view has no others."""
    together: bool = False
    """Drawn once of all settings instead of once of each."""
    main: bool = False
    """Belongs to the few figures that are drawn by default."""


def views(analysis: Analysis, which: Which = "all") -> tuple[list[View], View]:
    """Returns the settings of simulated trials that are drawn, those with most failures first, and
    all settings together with every estimator."""
    every = _looks(analysis)
    collection = analysis.collection
    analysis = analysis.simulated
    groups = analysis.collection.groups
    columns = analysis.setting_columns
    whole: dict[str, Any] = {name: getattr(analysis, name) for name in FRAMES}
    split = {name: _split(frame, columns) for name, frame in whole.items()}
    footers = {_setting(group.columns, columns): group.footer for group in groups}
    look = _looks(analysis)
    equations = {group.estimator: group.footer.get("equation") for group in groups}
    families = {group.estimator: _smoothers_apart(group.footer) for group in groups}
    settings = list(split["scores"])
    apart = varying(columns, [dict(zip(columns, key, strict=True)) for key in settings])
    most, left_out = drawn_settings(len(settings), which)
    parts: list[View] = []
    for key in sorted(settings[:most], key=lambda key: _success(split["summary"][key])):
        setting = dict(zip(columns, key, strict=True))
        frames = {name: split[name].get(key, frame.iloc[:0]) for name, frame in whole.items()}
        # An option that this setting does not have is not spoken of.
        own = {column: setting[column] for column in apart if setting[column] != "-"}
        label = _label(setting, own)
        if left_out and len(parts) + 1 == most:
            label += f" ({left_out})"
        focus, winner = focus_of(frames["summary"])
        part = View(
            suffix=_suffix(own.values(), [part.suffix for part in parts]) if apart else "",
            label=label,
            frames=frames,
            look=only(look, set(frames["scores"]["estimator"])),
            equations=equations,
            families=families,
            parameters=footers[key]["parameters"],
            focus=focus,
            winner=winner,
            paper=(setting.get("measurement"), setting.get("noise")) == ("gins", "quantization"),
            moving=setting.get("noise") == "model",
        )
        parts.append(part)
    focus, winner = focus_of(analysis.summary)
    together = View("", "", whole, every, equations, families, (), focus, winner)
    return parts, replace(together, collection=collection)


def _setting(values: Mapping[str, Any], columns: Sequence[str]) -> tuple[str, ...]:
    return tuple(_word(values.get(column)) for column in columns)


def _label(setting: Mapping[str, str], own: Mapping[str, str]) -> str:
    """Words a setting: its model and noise, then its own values."""
    first = {column: setting.get(column, "-") for column in ("measurement", "noise")}
    return assignments({**first, **own})


def _suffix(words: Iterable[str], taken: Sequence[str]) -> str:
    """Returns how names of files end, unlike those that are taken."""
    letters = re.sub(r"[^A-Za-z0-9.]+", "-", "_".join(words)).strip("-.")
    suffix = f"_{letters}"
    if len(letters) > MOST_LETTERS or suffix in ("_", *taken):
        return f"_{letters[:MOST_LETTERS]}-{len(taken) + 1}"
    return suffix


def _success(summary: pd.DataFrame) -> float:
    """Returns the mean rate of success to a tenth, so that settings which are alike keep their
    order."""
    success = summary.loc[summary["parameter"] == ALL, "success"]
    return round(success.mean(), 1)


def _split(frame: pd.DataFrame, columns: Sequence[str]) -> dict[tuple[str, ...], Any]:
    """Returns the rows of each setting; none of a frame over all settings."""
    if not set(columns) <= set(frame.columns) or frame.empty:
        return {}
    if not columns:
        return {(): frame}
    grouped = frame.groupby([*columns], sort=False, dropna=False)
    return {tuple(map(_word, key)): part for key, part in grouped}


def _word(value: Any) -> str:
    """Returns a setting's value as it is compared and shown; a dash where a setting does not have
    that option."""
    if value is None or (pd.api.types.is_scalar(value) and pd.isna(value)):
        return "-"
    text = value_text(value)

    if isinstance(value, float) and float(text) != value:
        return str(value)
    return text


def _looks(analysis: Analysis) -> dict[str, Look]:
    return _looks_by({group.estimator: group.footer for group in analysis.collection.groups})


def _looks_by(footers: Mapping[str, Mapping[str, Any]]) -> dict[str, Look]:
    """Returns a look for each label: the colour and marker that its class names, or those of its
    family."""
    families = {label: family_of(footer) for label, footer in footers.items()}
    named = [(label, footer.get("look")) for label, footer in footers.items()]
    own = {label: _named(label, look) for label, look in named if look}
    return looks(list(footers), families, own=own)


def only(look: Mapping[str, Look], labels: Container[str]) -> dict[str, Look]:
    """Returns the looks of these labels."""
    return {label: one for label, one in look.items() if label in labels}


def in_focus(look: Mapping[str, Look], colored: Container[str]) -> dict[str, Look]:
    """Returns the looks, those in colour that are asked for and the others in grey."""
    return {
        e: one if e in colored else replace(one, color=GREY, width=0.7) for e, one in look.items()
    }


def focus_of(summary: pd.DataFrame) -> tuple[list[str], str]:
    """Returns the estimators that are in colour where not all can be, the best first, and the best
    if it is one."""
    totals = summary[summary["parameter"] == ALL]
    rows: Any = totals[totals["estimator"] != REFERENCE]
    if rows.empty:
        return [], ""
    standings = Finding.of(rows.to_dict("records")).standings
    ranked = [one.label for one in standings]
    known = [label for label in FOCUS if label in ranked]
    order = dict.fromkeys([*ranked[:1], *known, *ranked])
    shown = list(order)[:MOST_TOGETHER]
    first = [one.label for one in standings if one.rank == standings[0].rank]
    return shown, first[0] if len(first) == 1 else ""


def looks_of(estimators: Mapping[str, Any]) -> dict[str, Look]:
    """Returns the looks that a run's figures give these estimators, where there is no run."""
    return _looks_by({label: traits(estimator) for label, estimator in estimators.items()})


def _named(label: str, look: Any) -> tuple[str, str]:
    """Returns the colour and marker that an estimator's class names; raises UserError if there are
    none such."""
    from matplotlib.colors import to_hex
    from matplotlib.markers import MarkerStyle

    try:
        color, marker = look
        MarkerStyle(marker)
        return to_hex(color), marker
    except (TypeError, ValueError):
        raise UserError(
            f'{label}: look={look} is no colour and marker; write look = ("#c51b7d", "s")'
        ) from None


def _smoothers_apart(footer: Mapping[str, Any]) -> str:
    family = family_of(footer)
    return "smoothers" if footer.get("smooths") and family != "IPE" else family
