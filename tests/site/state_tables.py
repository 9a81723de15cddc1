"""Writes the tables of trackers into the page on states that move, of what is stored of
`+experiment=states`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import pandas as pd

from ipe_bench.report.tables import words
from ipe_bench.report.tables.table import Column, Table, cells, column, markdown, texts
from ipe_bench.report.words import brief, p_value
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.comparisons import ALPHA, holm, mcnemar
from ipe_bench.statistics.statistic import ALL

HERE = "(Tables: `make docs`.)\n"
"""The line of the page that its tables replace."""
FIRST = "auto"
"""The tracker that is compared with all others in pairs."""
MODELS = {
    "bearings_only": "Bearings only",
    "coordinated_turn": "Coordinated turn",
    "pendulum": "Pendulum",
    "walking_gins": "The paper's system, drifts walking",
}
"""Headings of the state models."""


def _share(share: float) -> str:
    return f"{100 * share:.3g}"


MEASURES: dict[str, tuple[str, Callable[[float], str]]] = {
    "undetected": ("failed_silent", _share),
    "NEES": ("nees_mean", brief),
    "cost": ("simulations_median", brief),
    "ms": ("time_mean_s", lambda seconds: brief(1000 * seconds)),
}
"""Columns of a summary by their titles, with their formats."""


def with_tables(page: str, analysis: Analysis) -> str:
    """Returns the page with the tables of an analysis."""
    before, after = page.split(HERE)
    written = "\n".join(_parts(analysis))
    return f"{before}\n{written}\n{after}"


def _parts(analysis: Analysis) -> Iterator[str]:
    """Yields a sentence on all pairs, and of each model a heading and two tables."""
    pairs = _pairs(analysis.pairs)
    sure = pairs[pairs["corrected"] < ALPHA]
    more = int((sure["only_first"] > sure["only_second"]).sum())
    less = len(sure) - more
    yield f"Of {len(pairs)} pairs, `{FIRST}` wins {more} and loses {less} with a p in bold.\n"
    totals = analysis.summary[analysis.summary["parameter"] == ALL]
    rows = totals.merge(pairs, how="left", on=["measurement", "error_scale", "estimator"])
    for model, title in MODELS.items():
        of_model = rows[rows["measurement"] == model]
        labels = of_model["estimator"].unique()
        names = words("tracker", labels)
        by_scale = {
            f"{scale:g}": group.set_index("estimator").loc[labels]
            for scale, group in of_model.groupby("error_scale")
        }
        yield f"### {title}\n"
        yield markdown(Table("successes", "", "", [names, *_successes(by_scale)]))
        yield markdown(Table("measures", "", "", [names, *_measures(by_scale)]))


def _pairs(pairs: pd.DataFrame) -> pd.DataFrame:
    """Returns the pairs with the first tracker by the other one, with McNemar's p of each, and
    that corrected by Holm over them."""
    names = {"second": "estimator"}
    known = ["measurement", "error_scale", *names, "only_first", "only_second"]
    chosen = pairs.loc[pairs["first"] == FIRST, known].rename(columns=names)
    counts = list(zip(chosen["only_first"], chosen["only_second"], strict=True))
    p = [mcnemar(*both) for both in counts]
    shown = [f"{first} : {second}" for first, second in counts]
    return chosen.assign(pair=shown, p=p, corrected=holm(p))


def _successes(by_scale: Mapping[str, pd.DataFrame]) -> Iterator[Column]:
    """Yields success at each scale, with the pairs and their p."""
    for title, rows in zip(_titles("success", by_scale), by_scale.values(), strict=True):
        yield column(title, rows["success"], _share)
        yield texts("pairs", rows["pair"].fillna(""))
        p = [_p(one) for one in rows["p"]]
        yield Column("p", cells(p, p, rows["corrected"] < ALPHA))


def _measures(by_scale: Mapping[str, pd.DataFrame]) -> Iterator[Column]:
    """Yields what else is measured at each scale."""
    for title, (name, show) in MEASURES.items():
        for head, rows in zip(_titles(title, by_scale), by_scale.values(), strict=True):
            yield column(head, rows[name], show)


def _titles(title: str, scales: Iterable[str]) -> list[str]:
    """Makes the titles of a column at each scale, with its name at the first of them."""
    first, *others = scales
    return [f"{title} at {first}", *others]


def _p(p: float) -> str:
    """Formats the p of a pair; empty where there is none."""
    if math.isnan(p):
        return ""
    return "1" if p == 1 else p_value(p)
