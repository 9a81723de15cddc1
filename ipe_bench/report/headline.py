"""The headline: what the data say, in a few sentences that are computed from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from ipe_bench.report.figures.views import family_of
from ipe_bench.report.words import brief, duration, enumerate_few, percent, plain, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.certified import attained_totals, certified_averages, certified_table
from ipe_bench.statistics.records import ALL, BEST

ALIKE = 0.05
"""Efficiencies within this part of each other count as equal."""
BROKEN = 0.9
"""Share of success that an estimator holds as long as it is not surely below."""


def headline(analysis: Analysis) -> list[str]:
    """Who solves most certified problems; of simulated trials, who agrees, is honest, breaks where, at what cost."""
    found = [*_certified(analysis), *_attained(analysis), *_simulated(analysis.simulated)]
    # A number and its sign stay on one line.
    return [s.replace(" %", "\u00a0%") for s in found] or ["Nothing is stored yet, so there is nothing to find."]


def _certified(analysis: Analysis) -> Iterator[str]:
    each = certified_averages(certified_table(analysis.collection))
    if each.empty:
        return
    each["digits"] = each["mean_lre_parameters"] * each["datasets"]
    totals = each.groupby("estimator", sort=False)[["solved", "datasets", "digits"]].sum()
    best = totals[totals["solved"] == totals["solved"].max()].sort_values("digits", ascending=False, kind="stable")
    first = best.iloc[0]
    yield (
        f"Of {first['datasets']:.0f} certified problems, {enumerate_few(list(best.index))} solve"
        f"{'s' * (len(best) == 1)} most, {first['solved']:.0f}, with four digits or more of every parameter;"
        f" {best.index[0]} has {first['digits'] / first['datasets']:.1f} of 11 digits on average."
    )


def _attained(analysis: Analysis) -> Iterator[str]:
    if analysis.attained.empty or (totals := attained_totals(analysis.attained)).empty:
        return
    best = totals[totals["solved"] == totals["solved"].max()]
    yield (
        f"Of {best['problems'].iloc[0]} problems of known minimum, {enumerate_few(list(best['estimator']))} attain"
        f"{'s' * (len(best) == 1)} most, {best['solved'].iloc[0]}."
    )


def _simulated(analysis: Analysis) -> Iterator[str]:
    """What a sweep over error scales says of one setting; of several, or of one scale, who succeeds how often."""
    rows = analysis.summary[analysis.summary["parameter"] == ALL]
    if rows.empty:
        return
    scales = sorted(rows["error_scale"].unique())
    several = rows.groupby(["error_scale", "estimator"]).size().max() > 1
    if several or len(scales) < 2 or rows["estimator"].nunique() < 2:
        yield _ranked(analysis, rows, scales)
        return
    yield from _agreement(rows, scales, {one.estimator: family_of(one.footer) for one in analysis.collection.groups})
    yield from _honesty(rows)
    yield from _reach(rows, scales)
    yield _costs(rows, scales)


def _agreement(rows: pd.DataFrame, scales: Sequence[float], kinds: Mapping[str, str]) -> Iterator[str]:
    """Up to which scale IPE and filters attain the same."""
    compared = rows[rows["estimator"].map(kinds).isin(["IPE", "filters"])]
    named = {kind: [e for e, k in kinds.items() if k == kind] for kind in ("IPE", "filters")}
    if not all(named.values()):
        return
    who = " and ".join(f"{kind} ({enumerate_few(names)})" for kind, names in named.items())
    last = None
    for scale in scales:
        here = compared[compared["error_scale"] == scale]
        efficiency = here["efficiency_capped"]
        if not here[BEST].all() or efficiency.max() > efficiency.min() * (1 + ALIKE):
            break
        last = here
    if last is None:
        yield f"{who} differ already at error scale {plain(scales[0])}."
        return
    low, high = (f"{v:.2f}" for v in (last["efficiency_capped"].min(), last["efficiency_capped"].max()))
    success, scale = last["success"].min(), last["error_scale"].iloc[0]
    succeed = "all their trials succeed" if success == 1 else f"at least {percent(success)} of their trials succeed"
    reach = "at every error scale" if scale == scales[-1] else f"up to error scale {plain(scale)}"
    yield f"{who} agree {reach}: {succeed} there, with an efficiency of {low if low == high else f'{low} to {high}'}."


def _listed(rows: pd.DataFrame, value: Callable[[Any], str]) -> str:
    return enumerate_few([f"{row['estimator']} ({value(row)})" for _, row in rows.iterrows()])


def _from_scale(rows: pd.DataFrame, value: Callable[[Any], str]) -> list[str]:
    """The estimators of the rows, by the smallest scale at which each is there."""
    first = rows.sort_values("error_scale", kind="stable").drop_duplicates("estimator")
    return [f"{_listed(part, value)} from scale {plain(scale)}" for scale, part in first.groupby("error_scale")]


def _honesty(rows: pd.DataFrame) -> Iterator[str]:
    """From which scale on who claims smaller errors than it makes."""
    claims = rows[rows["nees_median"].notna()]
    sure = claims[claims["verdict"].isin(["optimistic", "diverged but confident"])]
    parts = _from_scale(sure, lambda row: brief(row["nees_median"]))
    others = claims[~claims["estimator"].isin(sure["estimator"])]
    open_ = others[others["verdict"].isin(["undecided", "-"])]["estimator"].unique()
    honest = [label for label in others["estimator"].unique() if label not in open_]
    parts += [f"{enumerate_few(honest)} never"] if honest else []
    parts += [f"undecided for {enumerate_few(list(open_))}"] if len(open_) else []
    if len(claims):
        yield f"Overconfident (NEES, 1 is honest): {'; '.join(parts)}."


def _reach(rows: pd.DataFrame, scales: Sequence[float]) -> Iterator[str]:
    """From which scale on who surely fails in more than a tenth of the trials, and who never does."""
    broken = rows[rows["success_high"] < BROKEN]
    parts = _from_scale(broken, lambda row: percent(row["success"]))
    top = rows[(rows["error_scale"] == scales[-1]) & ~rows["estimator"].isin(broken["estimator"])]
    for part, verb in ((top[top["success"] >= BROKEN], "hold"), (top[top["success"] < BROKEN], "may hold")):
        if len(part):
            who, ending = _listed(part, lambda row: percent(row["success"])), "s" * (len(part) == 1 and verb == "hold")
            parts.append(f"{who} {verb}{ending} to {plain(scales[-1])}")
    yield f"Success falls surely below {100 * BROKEN:.0f} %: {'; '.join(parts)}."
    silent = rows.sort_values("failed_silent", kind="stable").iloc[-1]
    if silent["failed_silent"] > 0:
        worst = f"{silent['estimator']} at scale {plain(silent['error_scale'])}"
        yield f"Failures that look right: at most {percent(silent['failed_silent'])} of the trials ({worst})."


def _costs(rows: pd.DataFrame, scales: Sequence[float]) -> str:
    """What a trial costs at the largest scale at which most hold, and at the largest for those that still do."""
    holding = rows[rows["success_high"] >= BROKEN]
    number = holding.groupby("error_scale")["estimator"].nunique()
    most = number.index[number > rows["estimator"].nunique() / 2]
    parts = []
    for scale in dict.fromkeys([*most[-1:], number.index.max() if len(number) else scales[-1]]):
        part = (holding if len(number) else rows).query("error_scale == @scale")
        part = part.sort_values("simulations_median", kind="stable")
        costs = zip(part["estimator"], part["simulations_median"], part["time_median_s"], strict=True)
        listed = enumerate_few([f"{e} {brief(cost)} ({duration(time, 2)})" for e, cost, time in costs])
        parts.append(f"at scale {plain(scale)} {listed}")
    return f"A trial costs, in simulations: {'; '.join(parts)}."


def _ranked(analysis: Analysis, rows: pd.DataFrame, scales: Sequence[float]) -> str:
    """Who succeeds in how many of the trials, pooled over all scenarios, and who fails silently."""
    rows = rows.assign(**{name: rows[name] * rows["trials"] for name in ("success", "failed_silent")})
    sums = rows.groupby("estimator", sort=False)[["success", "failed_silent", "trials"]].sum()
    sums = sums.assign(share=sums["success"] / sums["trials"], silent=sums["failed_silent"] / sums["trials"])
    sums = sums.sort_values("share", ascending=False, kind="stable")
    listed = [f"{label} in {percent(row['share'])}" for label, row in sums.iterrows()]
    reach = f"scale{'s' * (len(scales) > 1)} {' to '.join(dict.fromkeys(plain(s) for s in (scales[0], scales[-1])))}"
    scenarios = len(set(analysis.scores["scenario"]))
    number = f"{int(sums['trials'].max()):,} trials" + (f" in {scenarios} scenarios" if scenarios > 1 else "")
    sentence = f"At error {reach}, of {number} succeed: {enumerate_few(listed)}."
    if (worst := sums.sort_values("silent").iloc[-1])["silent"] > 0:
        sentence += f" Failures that look right: {percent(worst['silent'])} at most ({worst.name})."
    return sentence


def about(analysis: Analysis) -> list[str]:
    """What the model of each setting is: its readings and parameters, and what the error scale means."""
    found: dict[str, str] = {}
    for group in analysis.collection.groups:
        footer, name = group.footer, str(group.columns["measurement"])
        if name in found or group.columns["noise"] == "certified":
            continue
        groups: dict[str, Mapping[str, Any]] = {}
        for parameter in footer["parameters"]:
            groups.setdefault(parameter.get("group") or parameter["name"], parameter)
        sizes = [f"{label} {short(p['size'])} {p['unit']}".strip() for label, p in groups.items()]
        words = str(footer.get("about") or "").rstrip(".")
        readings = f"{footer['readings']} readings" if "readings" in footer else "Its readings"
        found[name] = (
            f"{name}{': ' * bool(words)}{words}. {readings} determine {len(footer['parameters'])} parameters; at error"
            f" scale s the true ones scatter about the nominal ones by s times {enumerate_few(sizes, 8)}."
        )
    return list(found.values())
