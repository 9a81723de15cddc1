"""Share of successes against error scale."""

from __future__ import annotations

from collections.abc import Iterator

from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View
from ipe_bench.report.words import percent, plain


def draw(view: View) -> Iterator[Drawing]:
    totals = view.totals
    if totals.empty:
        return
    look = view.with_look(totals["estimator"])
    rooted = {label: one for label, one in look.items() if view.equations[label] is not None}
    fig, axes = common.panels(2 if rooted else 1, look, height=3.0)
    for ax, column, title, seen in zip(
        axes,
        ("success", "solved"),
        ("success: inside the gate", "solved: the right root"),
        (look, rooted),
        strict=False,
    ):
        common.shares(ax, "share of all trials")
        interval = ("success_low", "success_high") if column == "success" else None
        common.curves(ax, totals, column, seen, view.scales, interval=interval, trials="trials")
        common.shares(ax, "share of all trials")
        ax.set_title(title)
    common.legend_below(fig, axes, look)
    top = common.at_scale(totals, view.scales[-1]).sort_values("success", ascending=False, kind="stable")
    ranked = [f"{e} {percent(v)}" for e, v in zip(top["estimator"], top["success"], strict=True)]
    caption = common.sentence(
        "Left: share of trials whose error lies inside the chi-square gate of the bound's ellipsoid, with"
        " Clopper-Pearson 95 % intervals.",
        "Right: share that ended at the root belonging to the truth, of those that solve an equation."
        if rooted
        else "",
        common.UPON,
        f"At scale {plain(view.scales[-1])} succeed: {common.enumerate_few(ranked, 20)}. {view.label}.",
    )
    title = "Success against error scale" if len(view.scales) > 1 else f"Success at error scale {plain(view.scales[0])}"
    yield Drawing(f"success_against_scale{view.suffix}", title, caption, fig)


FIGURE = Figure(draw, ("summary",))
