"""Charts of the page hold the numbers of the summary, whoever's names they bear, and can be read on dark ground."""

from __future__ import annotations

import json
import math
import re
from html import unescape

import numpy as np
import pytest
from shared.reports import HOSTILE, fill

from ipe_bench.report.figures.views import views
from ipe_bench.report.html import charts, render_page
from ipe_bench.report.style import COLORS, ON_DARK
from ipe_bench.report.tables import all_tables
from ipe_bench.statistics import analyse


def drawn(analysis):
    return {chart["name"]: json.loads(chart["data"]) for chart in charts(views(analysis)[0])}


def test_every_number_is_that_of_the_summary_whatever_the_names(synthetic):
    fill(synthetic, labels=("linear_lse", HOSTILE, "a\"b'c&amp;</div>"))
    scenario = synthetic.scenario(error_scale=1.0)
    synthetic.add(scenario, "lost", np.full((80, 3), np.nan), status="error", solved=False)
    analysis = analyse([synthetic.directory])
    total = analysis.summary[analysis.summary["parameter"] == "all"].set_index(["estimator", "error_scale"])
    page = render_page(analysis, all_tables(analysis), [])
    (data,) = [json.loads(unescape(text)) for text in re.findall(r'data-chart="([^"]*)"', page)]
    assert {"explore": data} == drawn(analysis)
    assert [series["name"] for series in data["series"]] == ["linear_lse", HOSTILE, "a\"b'c&amp;</div>", "lost"]
    compared = 0
    for series in data["series"]:
        values = series["values"]
        assert values["error_scale"] == ([1] if series["name"] == "lost" else [1, 10, 100])
        for column in values.keys() - {"error_scale"}:
            told = [math.nan if v is None else v for v in values[column]]
            expected = [total.loc[(series["name"], scale), column] for scale in values["error_scale"]]
            assert told == pytest.approx([v if np.isfinite(v) else math.nan for v in expected], rel=5e-5, nan_ok=True)
            compared += 1
    assert compared >= 4 * 9
    # JSON has no NaN.
    assert "NaN" not in json.dumps(data)


def test_with_one_scale_a_chart_is_against_cost_and_ten_estimators_at_seven_scales_take_little_room(synthetic):
    labels = [f"estimator_{i}" for i in range(10)]
    fill(synthetic, labels=labels, scales=(1.0,), trials=20)
    assert drawn(analyse([synthetic.directory]))["explore"]["x"][0]["column"] == "simulations_median"
    fill(synthetic, labels=labels, scales=[10.0**k for k in range(1, 7)], trials=20)
    (chart,) = charts(views(analyse([synthetic.directory]))[0])
    assert json.loads(chart["data"])["x"][0]["column"] == "error_scale"
    assert len(chart["data"]) < 40_000


def _luminance(color: str) -> float:
    """Relative luminance (WCAG 2.1)."""
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_colors_show_on_the_dark_ground(synthetic):
    """A contrast of 3 at least, as WCAG 2.1 asks of graphics; the ground is the one that the page has."""
    fill(synthetic)
    analysis = analyse([synthetic.directory])
    style = render_page(analysis, all_tables(analysis), []).partition("</style>")[0]
    dark = style[style.index("prefers-color-scheme: dark") :]
    ground, ink, soft = (re.search(rf"--{name}: (#\w+)", dark)[1] for name in ("ground", "ink", "soft"))

    def contrast(color: str) -> float:
        return (_luminance(color) + 0.05) / (_luminance(ground) + 0.05)

    assert set(COLORS) <= set(ON_DARK)
    assert min(contrast(color) for color in ON_DARK.values()) > 3
    assert len(set(ON_DARK.values())) == len(ON_DARK)
    assert min(contrast(ink), contrast(soft)) > 4.5


def test_the_page_says_which_commands_computed_what_it_shows(synthetic):
    """One entry for the jobs of a sweep; none for a run that found everything stored."""
    fill(synthetic)
    record = json.loads(next((synthetic.directory / "runs").glob("*.json")).read_text(encoding="utf-8"))
    record = {k: v for k, v in record.items() if k not in ("schema", "file", "run", "digest")}
    for name, command, blocks in (
        ("b", "ipe-bench run -m error_scale=1,10", 2),
        ("c", "ipe-bench run -m error_scale=1,10", 1),
        ("d", "ipe-bench run that finds it all", 0),
        ("e", None, 3),
    ):
        synthetic.store.write_run(name, record | {"command": command, "blocks": blocks})
    analysis = analyse([synthetic.directory])
    page = render_page(analysis, all_tables(analysis), [])
    assert page.count('<details class="run">') == 3
    assert page.count("<code>ipe-bench run -m error_scale=1,10</code>") == 2
    assert "finds it all" not in page
    assert page.count("from Python") == 1
