"""The headline: what the data say, in a few facts that are computed from them; `templates/headline.j2` words each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures.views import family_of
from ipe_bench.report.table import Table, environment, texts, words
from ipe_bench.report.words import brief, duration, enumerate_few, short, value_text
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.certified import certified_averages, certified_table, published_table
from ipe_bench.statistics.records import ALL, BEST

if TYPE_CHECKING:
    from ipe_bench.statistics.collect import Collection

ALIKE = 0.05
"""Efficiencies within this part of each other count as equal."""
BROKEN = 0.9
"""Share of success that an estimator holds as long as it is not surely below."""
MET = 1e-9
"""Difference up to which a published number is met."""
OVERCONFIDENT, UNDECIDED = ("optimistic", "diverged but confident"), ("undecided", "-")
"""Verdicts on the reported covariance."""
SHARED = ("shared_trials", "shared_success", "shared_silent")
Fact = tuple[str, dict[str, Any]]
"""Names the macro that words a finding, and its arguments."""


def headline(analysis: Analysis) -> list[str]:
    """Says who solves most certified problems and, in trials, who agrees, is honest, breaks where, at what cost."""
    return [sentence for _, sentence in _worded(analysis)]


def _worded(analysis: Analysis) -> list[tuple[str, str]]:
    """Returns the kind of each fact with its sentence."""
    module: Any = environment().overlay(autoescape=False).get_template("headline.j2").module
    found = ((name, " ".join(getattr(module, name)(**values).split())) for name, values in facts(analysis))
    # A number and its sign stay on one line.
    return [(name, sentence.replace(" %", "\u00a0%")) for name, sentence in found]


def box(analysis: Analysis) -> tuple[list[str], Table | None]:
    """Returns what opens a page: the sentences, or for a sweep some of them, and a row per estimator."""
    said, rows = _worded(analysis), _totals(analysis)
    rows = rows[rows["noise"] != "certified"]
    one_kind = len(set(rows["noise"] == "model")) == 1  # constants, or states that move
    if not one_kind or not {"honesty", "reach", "costs"} <= {name for name, _ in said}:
        return [sentence for _, sentence in said], None
    return [sentence for name, sentence in said if name not in ("honesty", "reach", "costs")], _limits(rows)


def _limits(rows: pd.DataFrame) -> Table:
    """Returns up to which error scale the claims and the success of each estimator hold, and what a trial costs."""
    (_, claims), (_, success) = *honesty(rows), *reach(rows)
    ends = rows.groupby("estimator", sort=False)["error_scale"]
    undecided = [label for _, pairs in success["open"] for label, _ in pairs]

    def until(first: Mapping[str, float], label: str, open_at: Sequence[str]) -> str:
        if label in first:
            before = [scale for scale in ends.get_group(label) if scale < first[label]]
            return value_text(max(before)) if before else "none"
        return "undecided" if label in open_at else value_text(ends.max()[label])

    scale, listed = _costs(rows, sorted(rows["error_scale"].unique()))[1]["scales"][0]
    cost = {label: f"{brief(each)} ({duration(time, 2)})" for label, each, time in listed}
    broken, wrong = ({one: at for at, each in fact["first"] for one, _ in each} for fact in (success, claims))
    labels = sorted(map(str, ends.groups), key=lambda one: (-broken.get(one, np.inf), -wrong.get(one, np.inf)))
    claimed = {*claims["never"], *claims["undecided"], *(one for _, pairs in claims["first"] for one, _ in pairs)}
    columns = [
        words("estimator", labels),
        texts(
            "honest up to scale", [until(wrong, one, claims["undecided"]) if one in claimed else "-" for one in labels]
        ),
        texts(f"holds {100 * BROKEN:.0f} % up to scale", [until(broken, one, undecided) for one in labels]),
        texts(f"median cost (time) at {value_text(scale)}", [cost.get(one, "-") for one in labels]),
    ]
    return Table("limits", "", "", columns)


def _totals(analysis: Analysis) -> pd.DataFrame:
    return analysis.summary[analysis.summary["parameter"] == ALL].reset_index(drop=True)


def facts(analysis: Analysis) -> list[Fact]:
    """Returns the findings of the rules: at least one fact, if only that no trial is stored."""
    rows = _totals(analysis)
    if rows.empty:
        return [("nothing", {})]
    # Both have a row per scenario and estimator, in the same order.
    rows = rows.join(analysis.scores.reset_index(drop=True)[["scenario", *SHARED]])
    certified, moving = rows["noise"] == "certified", rows["noise"] == "model"
    collected = [*_certified(analysis), *_published(analysis.collection)]
    own = [] if collected else _ranking(rows[certified], "certified")
    constants = _constants(rows[~certified & ~moving], analysis.collection)
    return [*collected, *own, *constants, *_moving(rows[moving], analysis.summary)]


def in_common(rows: pd.DataFrame, key: str | list[str]) -> pd.DataFrame:
    """Returns the rows of the scenarios or problems that every estimator has: only these permit a ranking."""
    return rows[rows.groupby(key)["estimator"].transform("nunique") == rows["estimator"].nunique()]


def _unranked(what: str, rows: pd.DataFrame) -> Iterator[Fact]:
    yield "unranked", {"what": what, "labels": list(rows["estimator"].unique())}


# Certified readings, published numbers --------------------------------------------------------------------------


def _certified(analysis: Analysis) -> Iterator[Fact]:
    rows = certified_table(analysis.collection)
    each = certified_averages(in_common(rows, ["dataset", "start"]))
    if each.empty:
        yield from _unranked("data set", rows) if len(rows) else ()
        return
    each["digits"] = each["mean_lre_parameters"] * each["datasets"]
    totals = each.groupby("estimator", sort=False)[["solved", "datasets", "digits"]].sum()
    best = totals[totals["solved"] == totals["solved"].max()].sort_values("digits", ascending=False, kind="stable")
    first = best.iloc[0]
    found = {"problems": int(first["datasets"]), "solved": int(first["solved"]), "labels": list(best.index)}
    yield "certified", found | {"digits": first["digits"] / first["datasets"]}


def _published(collection: Collection) -> Iterator[Fact]:
    rows = published_table(collection)
    if len(rows):
        difference = rows["difference"].abs().fillna(np.inf)
        worst = rows.iloc[int(difference.argmax())]
        found = {"number": len(rows), "met": int((difference <= MET).sum()), "most": difference.max(), "limit": MET}
        yield "published", found | {"where": f"{worst['estimator']}, {worst['state']}"}


# Simulated trials -----------------------------------------------------------------------------------------------------


def _constants(rows: pd.DataFrame, collection: Collection) -> Iterator[Fact]:
    """Finds success rates of several settings or of one scale, or the course over error scales of one setting."""
    if rows.empty:
        return
    scales = sorted(rows["error_scale"].unique())
    several = rows.groupby(["error_scale", "estimator"]).size().max() > 1
    if several or len(scales) < 2 or rows["estimator"].nunique() < 2:
        yield from _ranking(rows, "constants")
        return
    yield from _agreement(rows, scales, {one.estimator: family_of(one.footer) for one in collection.groups})
    yield from honesty(rows)
    yield from reach(rows)
    yield from _silent(rows)
    yield _costs(rows, scales)


def _moving(rows: pd.DataFrame, summary: pd.DataFrame) -> Iterator[Fact]:
    """Finds who keeps the track how often and, for a single model at one scale, how large the errors are; for a sweep
    over scales, who holds up to where and is honest, and the costs."""
    if rows.empty:
        return
    scales = sorted(rows["error_scale"].unique())
    if len(scales) > 1 and rows.groupby(["error_scale", "estimator"]).size().max() == 1:
        yield from reach(rows)
        yield from honesty(rows)
        yield from _silent(rows)
        yield _costs(rows, scales)
        return
    yield from _ranking(rows, "moving")
    one = rows["scenario"].min() == rows["scenario"].max()
    if one and (rows["trials"] == rows["shared_trials"]).all():
        listed = rows.sort_values("error_median", kind="stable")[["estimator", "error_median"]]
        yield "errors", {"errors": list(listed.itertuples(index=False, name=None))}
        yield from _over_paths(summary)


def _over_paths(summary: pd.DataFrame) -> Iterator[Fact]:
    """Finds the errors over all epochs, root mean square over the states, in multiples of the largest."""
    states = summary[(summary["parameter"] != ALL) & (summary["noise"] == "model")]
    errors = states.pivot_table(index="estimator", columns="parameter", values="path_rmse")
    errors = errors.loc[:, (errors > 0).all()].dropna()
    if len(errors) < 2 or errors.empty:
        return
    size = (errors / errors.max()).pow(2).mean(axis=1).pow(0.5).sort_values(kind="stable")
    yield "paths", {"errors": list((size / size.max()).items())}


def _agreement(rows: pd.DataFrame, scales: Sequence[float], kinds: Mapping[str, str]) -> Iterator[Fact]:
    """Finds up to which scale IPE and filters attain the same in the same trials."""
    compared = rows[rows["estimator"].map(kinds).isin(["IPE", "filters"])]
    named = {kind: [e for e in compared["estimator"].unique() if kinds[e] == kind] for kind in ("IPE", "filters")}
    if not all(named.values()):
        return
    same = compared[compared["trials"] == compared["shared_trials"]]
    agreed, differ = [], None
    for scale in scales:
        here = same[same["error_scale"] == scale]
        if here["estimator"].nunique() < compared["estimator"].nunique():
            break  # not all of them have these trials
        efficiency = here["efficiency_capped"]
        if not here[BEST].all() or not efficiency.max() <= efficiency.min() * (1 + ALIKE):
            differ = scale
            break
        agreed.append(here)
    if agreed:
        whole = pd.concat(agreed)
        found = {"last": whole["error_scale"].max(), "everywhere": len(agreed) == len(scales)}
        found |= {"success": whole["success"].min()}
        found |= {"low": whole["efficiency_capped"].min(), "high": whole["efficiency_capped"].max()}
        yield "agreement", {"named": named, **found}
    elif differ is not None:
        yield "difference", {"named": named, "scale": differ}


def _by_scale(rows: pd.DataFrame, column: str) -> list[tuple[float, list[tuple[str, float]]]]:
    """Returns the estimators of these rows with a column's value, by the smallest error scale of each."""
    first = rows.sort_values("error_scale", kind="stable").drop_duplicates("estimator")
    parts: Any = first.groupby("error_scale")
    return [
        (float(scale), list(part[["estimator", column]].itertuples(index=False, name=None))) for scale, part in parts
    ]


def honesty(rows: pd.DataFrame) -> Iterator[Fact]:
    """Finds from which scale each estimator claims smaller errors than it makes, who never does, and who may."""
    claims = rows[rows["nees_median"].notna()]
    sure = claims[claims["verdict"].isin(OVERCONFIDENT)]
    others = claims[~claims["estimator"].isin(sure["estimator"])]
    undecided = list(others[others["verdict"].isin(UNDECIDED)]["estimator"].unique())
    never = [label for label in others["estimator"].unique() if label not in undecided]
    if len(claims):
        yield "honesty", {"first": _by_scale(sure, "nees_median"), "never": never, "undecided": undecided}


def reach(rows: pd.DataFrame) -> Iterator[Fact]:
    """Finds at which scale each estimator first surely fails in over a tenth of the trials, and who does so at none."""
    broken = rows[rows["success_high"] < BROKEN]
    rest = rows[~rows["estimator"].isin(broken["estimator"])]
    of_each = rest.groupby("estimator", sort=False)
    ends = of_each.agg(error_scale=("error_scale", "max"), least=("success", "min")).reset_index()
    kept = ends["least"] >= BROKEN
    found = {"first": _by_scale(broken, "success"), "held": _by_scale(ends[kept], "least")}
    yield "reach", found | {"open": _by_scale(ends[~kept], "least"), "limit": BROKEN}


def _silent(rows: pd.DataFrame) -> Iterator[Fact]:
    worst = rows.sort_values("failed_silent", kind="stable").iloc[-1]
    if worst["failed_silent"] > 0:
        where = f"{worst['estimator']} at scale {value_text(worst['error_scale'])}"
        yield "silent", {"share": worst["failed_silent"], "where": where}


def _costs(rows: pd.DataFrame, scales: Sequence[float]) -> Fact:
    """Finds the cost of a trial at the largest scale at which most hold, and at the largest for those that still do."""
    holding = rows[rows["success_high"] >= BROKEN]
    number = holding.groupby("error_scale")["estimator"].nunique()
    most = number.index[number > rows["estimator"].nunique() / 2]
    found = []
    for scale in dict.fromkeys([*most[-1:], number.index.max() if len(number) else scales[-1]]):
        part = (holding if len(number) else rows).query("error_scale == @scale")
        part = part.sort_values("simulations_median", kind="stable")
        listed = part[["estimator", "simulations_median", "time_median_s"]].itertuples(index=False, name=None)
        found.append((scale, list(listed)))
    unit = "evaluations" if (rows["noise"] == "model").all() else "simulations"
    return "costs", {"scales": found, "unit": unit}


def _ranking(rows: pd.DataFrame, kind: str) -> Iterator[Fact]:
    """Finds who succeeds in how many of the shared trials, pooled over all scenarios, and who fails silently."""
    if rows.empty:
        return
    common = in_common(rows[rows["shared_trials"] > 0], "scenario")
    if common.empty or common["estimator"].nunique() < rows["estimator"].nunique():
        yield from _unranked("trial", rows)
        return
    weights = common["shared_trials"]
    counts = common.assign(success=common["shared_success"] * weights, silent=common["shared_silent"] * weights)
    sums = counts.groupby("estimator", sort=False)[["success", "silent", "shared_trials"]].sum()
    shares = sums[["success", "silent"]].div(sums["shared_trials"], axis=0)
    ranked = shares.sort_values("success", ascending=False, kind="stable")
    worst = shares.sort_values("silent", kind="stable").iloc[-1]
    scenarios = common["scenario"].nunique()
    yield (
        "ranking",
        {
            "kind": kind,
            "ranked": list(ranked["success"].items()),
            "trials": int(sums["shared_trials"].iloc[0]),
            "scenarios": scenarios,
            "left_out": rows["scenario"].nunique() - scenarios,
            "scales": list(dict.fromkeys((common["error_scale"].min(), common["error_scale"].max()))),
            "silent": (worst.name, worst["silent"]) if worst["silent"] > 0 else None,
        },
    )


def about(analysis: Analysis) -> list[str]:
    """Describes the model of each setting: its readings and parameters, and what the error scale means."""
    found: dict[str, str] = {}
    for group in analysis.collection.groups:
        footer, name = group.footer, str(group.columns["measurement"])
        if name in found or group.columns["noise"] == "certified":
            continue
        found[name] = (_about_states if "times" in footer else _about_constants)(name, footer)
    return list(found.values())


def _about_constants(name: str, footer: Mapping[str, Any]) -> str:
    groups: dict[str, Mapping[str, Any]] = {}
    for parameter in footer["parameters"]:
        groups.setdefault(parameter.get("group") or parameter["name"], parameter)
    sizes = [f"{label} {short(p['size'])} {p['unit']}".strip() for label, p in groups.items()]
    words = str(footer.get("about") or "").rstrip(".")
    readings = f"{footer['readings']} readings" if "readings" in footer else "Its readings"
    return (
        f"{name}{': ' * bool(words)}{words}. {readings} determine {len(footer['parameters'])} parameters; at error"
        f" scale s the true ones scatter about the nominal ones by s times {enumerate_few(sizes, 8)}."
    )


def _about_states(name: str, footer: Mapping[str, Any]) -> str:
    """Describes a model of states; the general docstring of models by formulas is left out."""
    states = [f"{p['name']} in {p['unit']}" if p["unit"] else p["name"] for p in footer["parameters"]]
    all_states = footer.get("states", len(states))
    words = "" if "next" in footer["identity"]["scenario"].get("model", {}) else str(footer.get("about") or "")
    return (
        f"{name}{': ' * bool(words)}{words.rstrip('.')}. {footer['readings']} readings at {len(footer['times'])} epochs"
        f" tell {all_states} states that move{', of which are scored' * (all_states > len(states))}:"
        f" {enumerate_few(states, 12)}. Error scale s multiplies the standard deviations of their prior by s."
    )
