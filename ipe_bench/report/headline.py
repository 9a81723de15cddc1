"""Says what the data say: sentences that open a page, and for a sweep how far each estimator holds and is honest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.figures.views import family_of
from ipe_bench.report.table import Part, Table, texts, words
from ipe_bench.report.tables import differing
from ipe_bench.report.words import brief, duration, enumerate_few, percent, value_text
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.certified import certified_averages, certified_table, published_table
from ipe_bench.statistics.statistic import ALL, BEST

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
_LIMITS = (
    "Honest: at no scale up to there is the reported covariance surely too small (none: at the least it is; undecided:"
    f" too few trials). Holds: {100 * BROKEN:.0f} % of the trials or more may succeed; who does not hold has no cost."
)
SHARED = ("shared_trials", "shared_success", "shared_silent")
_SILENT = "Failures that no test of fit notices:"


def headline(analysis: Analysis) -> list[Part]:
    """Returns what opens a page: who solves most, who agrees and who fails silently, and the limits of a sweep."""
    rows = analysis.summary[analysis.summary["parameter"] == ALL].reset_index(drop=True)
    if rows.empty:
        return ["No trial is stored yet, so there is no finding."]
    # Both have a row per scenario and estimator, in the same order.
    rows = rows.join(analysis.scores.reset_index(drop=True)[["scenario", *SHARED]])
    rows = rows.assign(setting=differing(rows, analysis.setting_columns))
    certified, moving = rows["noise"] == "certified", rows["noise"] == "model"
    found = [*_certified(analysis), *_published(analysis.collection)]
    found += [] if found else _ranking(rows[certified], "certified")
    found += [*_constants(rows[~certified & ~moving], analysis.collection), *_moving(rows[moving], analysis.summary)]
    # A number and its sign stay on one line.
    return [part.replace(" %", "\u00a0%") if isinstance(part, str) else part for part in found]


def in_common(rows: pd.DataFrame, key: str | list[str]) -> pd.DataFrame:
    """Returns the rows of the scenarios or problems that every estimator has: only these permit a ranking."""
    return rows[rows.groupby(key)["estimator"].transform("nunique") == rows["estimator"].nunique()]


def _unranked(what: str, rows: pd.DataFrame) -> str:
    return f"No {what} is common to {enumerate_few(list(rows['estimator'].unique()))}, so they are not ranked."


def _each(pairs: Iterable[tuple[Any, float]]) -> str:
    return enumerate_few([f"{label} ({brief(value)})" for label, value in pairs])


# Certified readings, published numbers --------------------------------------------------------------------------


def _certified(analysis: Analysis) -> Iterator[str]:
    rows = certified_table(analysis.collection)
    each = certified_averages(in_common(rows, ["dataset", "start"]))
    if each.empty:
        yield from [_unranked("data set", rows)] if len(rows) else []
        return
    each["digits"] = each["mean_lre_parameters"] * each["datasets"]
    totals = each.groupby("estimator", sort=False)[["solved", "datasets", "digits"]].sum()
    best = totals[totals["solved"] == totals["solved"].max()].sort_values("digits", ascending=False, kind="stable")
    solved, problems, digits = best.iloc[0]
    most = f"{enumerate_few(list(best.index))} solve{'s' * (len(best) == 1)} most, {solved:.0f},"
    yield (
        f"Of {problems:.0f} certified problems, {most if solved else 'none is solved'} with four digits or more of"
        f" every parameter; {best.index[0]} has {digits / problems:.1f} of 11 digits on average."
    )


def _published(collection: Collection) -> Iterator[str]:
    rows = published_table(collection)
    if rows.empty:
        return
    difference = rows["difference"].abs().fillna(np.inf)
    number, met, most = len(rows), int((difference <= MET).sum()), difference.max()
    if met == number:
        who = f"All {number} published errors are" if number > 1 else "The published error is"
        yield f"{who} met, to {most:.1e} at worst."
    else:
        worst = rows.iloc[int(difference.argmax())]
        yield (
            f"Of {number} published errors, {met} are met to {MET:.0e}; the largest difference is {most:.1e}"
            f" ({worst['estimator']}, {worst['state']})."
        )


# Simulated trials -----------------------------------------------------------------------------------------------------


def _is_sweep(rows: pd.DataFrame) -> bool:
    """Returns whether these are the rows of one setting over several error scales."""
    return len(set(rows["error_scale"])) > 1 and not rows.duplicated(["error_scale", "estimator"]).any()


def _constants(rows: pd.DataFrame, collection: Collection) -> Iterator[Part]:
    """Finds success rates of several settings or of one scale, or the course over error scales of one setting."""
    if _is_sweep(rows) and len(set(rows["estimator"])) > 1:
        yield from _agreement(rows, {one.estimator: family_of(one.footer) for one in collection.groups})
        yield from _silent(rows)
        yield limits(rows, "limits")
    else:
        yield from _ranking(rows, "constants")


def _moving(rows: pd.DataFrame, summary: pd.DataFrame) -> Iterator[Part]:
    """Finds who keeps the track how often and, for a single model at one scale, how large the errors are; or the course
    over error scales."""
    if _is_sweep(rows):
        yield from _silent(rows)
        yield limits(rows, "limits_of_states")
        return
    yield from _ranking(rows, "moving")
    if len(set(rows["scenario"])) == 1 and (rows["trials"] == rows["shared_trials"]).all():
        errors = rows.set_index("estimator")["error_median"].sort_values(kind="stable")
        yield (
            "Median error at the last epoch, in multiples of that of the filter linearised at the true path:"
            f" {_each(errors.items())}."
        )
        yield from _over_paths(summary)


def _over_paths(summary: pd.DataFrame) -> Iterator[str]:
    """Finds the errors over all epochs, root mean square over the states."""
    states = summary[(summary["parameter"] != ALL) & (summary["noise"] == "model")]
    errors = states.pivot_table(index="estimator", columns="parameter", values="path_rmse")
    errors = errors.loc[:, (errors > 0).all()].dropna()
    if len(errors) > 1 and not errors.empty:
        size = (errors / errors.max()).pow(2).mean(axis=1).pow(0.5).sort_values(kind="stable")
        of_largest = _each((size / size.max()).items())
        yield f"Root mean square error over all epochs, in multiples of the largest: {of_largest}."


def _agreement(rows: pd.DataFrame, kinds: Mapping[str, str]) -> Iterator[str]:
    """Finds up to which scale IPE and filters attain the same in the same trials."""
    compared = rows[rows["estimator"].map(kinds).isin(["IPE", "filters"])]
    named = {kind: [e for e in compared["estimator"].unique() if kinds[e] == kind] for kind in ("IPE", "filters")}
    if not all(named.values()):
        return
    who = " and ".join(f"{kind} ({enumerate_few(labels)})" for kind, labels in named.items())
    same, scales = compared[compared["trials"] == compared["shared_trials"]], sorted(rows["error_scale"].unique())
    agreed: list[pd.DataFrame] = []
    for scale in scales:
        here = same[same["error_scale"] == scale]
        if here["estimator"].nunique() < compared["estimator"].nunique():
            break  # not all of them have these trials
        efficiency = here["efficiency_capped"]
        if not here[BEST].all() or not efficiency.max() <= efficiency.min() * (1 + ALIKE):
            if not agreed:
                yield f"{who} differ already at error scale {value_text(scale)}."
            break
        agreed.append(here)
    if agreed:
        whole = pd.concat(agreed)
        last, least = whole["error_scale"].max(), whole["success"].min()
        where = "at every error scale" if len(agreed) == len(scales) else f"up to error scale {value_text(last)}"
        most = "all their trials succeed" if least == 1 else f"at least {percent(least)} of their trials succeed"
        ends = dict.fromkeys(f"{whole['efficiency_capped'].agg(end):.2f}" for end in ("min", "max"))
        yield f"{who} agree {where}: {most} there, with an efficiency of {' to '.join(ends)}."


def _silent(rows: pd.DataFrame) -> Iterator[str]:
    worst = rows.sort_values("failed_silent", kind="stable").iloc[-1]
    if worst["failed_silent"] > 0:
        where = f"{worst['estimator']} at scale {value_text(worst['error_scale'])}"
        yield f"{_SILENT} up to {percent(worst['failed_silent'])} of the trials ({where})."


def limits(rows: pd.DataFrame, name: str) -> Table:
    """Returns up to which error scale the claims and the success of each estimator hold, and what a trial costs."""
    found = []
    for label, own in rows.groupby("estimator", sort=False):
        claims, broken = own[own["nees_median"].notna()], own["success_high"] < BROKEN
        wrong, unsure = (claims["verdict"].isin(verdicts) for verdicts in (OVERCONFIDENT, UNDECIDED))
        honest = _until(claims["error_scale"], wrong, bool(unsure.any())) if len(claims) else ("-", np.inf)
        holds = _until(own["error_scale"], broken, bool((own["success"] < BROKEN).any()))
        found.append((str(label), *honest, *holds))
    found.sort(key=lambda one: (-one[4], -one[2]))  # who holds longest first, then who is honest longest
    scale, spent = _costs(rows)
    columns = [
        words("estimator", [label for label, *_ in found]),
        texts("honest up to scale", [honest for _, honest, *_ in found]),
        texts(f"holds {100 * BROKEN:.0f} % up to scale", [holds for *_, holds, _ in found]),
        texts(f"median cost (time) at scale {value_text(scale)}", [spent.get(label, "-") for label, *_ in found]),
    ]
    return Table(name, "", "", columns, notes=[_LIMITS])


def _until(scales: pd.Series[float], broken: pd.Series[bool], unsure: bool) -> tuple[str, float]:
    """Returns the last of the scales before it is broken, in a word, and the first at which it is."""
    if not broken.any():
        return "undecided" if unsure else value_text(scales.max()), np.inf
    first = scales[broken].min()
    return value_text(scales[scales < first].max()) if (scales < first).any() else "none", first


def _costs(rows: pd.DataFrame) -> tuple[float, dict[str, str]]:
    """Returns the largest scale at which most estimators hold, or else any, and the cost of a trial for those."""
    holding = rows[rows["success_high"] >= BROKEN]
    holding = rows if holding.empty else holding
    number = holding.groupby("error_scale")["estimator"].nunique()
    scale = max(number.index[number > rows["estimator"].nunique() / 2], default=number.index.max())
    here = holding[holding["error_scale"] == scale]
    costs = here[["estimator", "simulations_median", "time_median_s"]].itertuples(index=False, name=None)
    return scale, {label: f"{brief(cost)} ({duration(time, 2)})" for label, cost, time in costs}


def _ranking(rows: pd.DataFrame, kind: str) -> Iterator[str]:
    """Finds who succeeds in how many of the shared trials, pooled over all scenarios, and who fails silently."""
    if rows.empty:
        return
    common = in_common(rows[rows["shared_trials"] > 0], "scenario")
    if common.empty or common["estimator"].nunique() < rows["estimator"].nunique():
        yield _unranked("trial", rows)
        return
    weights = common["shared_trials"]
    counts = common.assign(success=common["shared_success"] * weights, silent=common["shared_silent"] * weights)
    sums = counts.groupby("estimator", sort=False)[["success", "silent", "shared_trials"]].sum()
    shares = sums[["success", "silent"]].div(sums["shared_trials"], axis=0)
    ranked = shares["success"].sort_values(ascending=False, kind="stable")
    trials, scenarios = int(sums["shared_trials"].iloc[0]), common["scenario"].nunique()
    scales = dict.fromkeys(value_text(common["error_scale"].agg(end)) for end in ("min", "max"))
    where = {
        "constants": f"At error scale{'s' * (len(scales) > 1)} {' to '.join(scales)}, ",
        "certified": "With certified readings, ",
        "moving": "",
    }
    verb, track = ("keep", " the track to the last epoch") if kind == "moving" else ("succeed", "")
    number = f"{trials:,} trial{'s' * (trials != 1)}{f' in {scenarios} scenarios' if scenarios > 1 else ''}"
    if len(ranked) > 1 and ranked.min() == ranked.max():
        share = f"{percent(ranked.max())} of " if ranked.max() < 1 else "all of " * (trials > 1)
        told = f"{enumerate_few(list(ranked.index))} {verb}{track} in {share}{number}"
    else:
        (first, most), *others = ranked.items()
        head = f"{first} {verb}s{track} in {percent(most)} of {number}"
        told = enumerate_few([head, *(f"{label} in {percent(share)}" for label, share in others)])
    sentences = [f"{where[kind]}{told}."]
    if left_out := rows["scenario"].nunique() - scenarios:
        are = "scenario is" if left_out == 1 else "scenarios are"
        sentences.append(f"{left_out} other {are} left out, which not all of them have.")
    if (most := common["shared_silent"].max()) > 0:
        worst = common[common["shared_silent"] == most]
        first = worst.iloc[0]
        labels = worst.loc[worst["scenario"] == first["scenario"], "estimator"]
        place = f", {first['setting']}" * (first["setting"] != "-") + f", scale {value_text(first['error_scale'])}"
        where = f"{enumerate_few(list(labels))}{place * (scenarios > 1)}"
        where = f"the trials{' of a scenario' * (scenarios > 1)} ({where})"
        sentences.append(f"{_SILENT} up to {percent(most)} of {where}.")
    yield " ".join(sentences)


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
    sizes = [f"{label} {p['size']:g} {p['unit']}".strip() for label, p in groups.items()]
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
