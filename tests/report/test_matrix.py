"""The matrix shows what the table says: success as number and colour, and a sign for the
covariance."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
from report.test_finding import row, sweep

from ipe_bench.report.finding import Finding
from ipe_bench.report.style import BLACK, DARK_RAMP, LIGHT, RAMP, WHITE, ink, step
from ipe_bench.report.tables.matrix import Tile, _nearness, matrices
from ipe_bench.report.tables.table import html, latex, markdown, plain_text
from ipe_bench.report.tables.terminal import _MOST_LINES, _shortened
from ipe_bench.report.words import percent, share_text
from ipe_bench.statistics.intervals import clopper_pearson

SEEN = {
    "error_median": 0.98,
    "error_q95": 1.35,
    "nees_mean": 1.04,
    "claims": 100,
    "simulations_median": 21.0,
    "simulations_mean": 30.0,
    "time_mean_s": 2e-3,
    "noise": "gaussian",
}


def rows_of(counts: dict[str, tuple[int, ...]], **more: Any) -> list[dict[str, Any]]:
    return [
        row(label, scale, good, **{**SEEN, "success_high": clopper_pearson(good, 200)[1], **more})
        for label, each in counts.items()
        for scale, good in zip((0.1, 1.0, 10.0, 33.0, 100.0), each, strict=False)
    ]


def brightness(color: str) -> float:
    """Computes the relative luminance as the definition of WCAG 2.1 has it."""
    parts = [int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    r, g, b = (p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def contrast(first: str, second: str) -> float:
    dark, light = sorted((brightness(first), brightness(second)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize(("ramp", "sign"), [(RAMP, -1), (DARK_RAMP, 1)])
def test_every_number_is_legible_and_luminance_follows_success_alone(ramp, sign):
    assert all(contrast(color, ink(color)) >= 4.5 for color in ramp)
    shades = [sign * brightness(color) for color in ramp]
    assert shades == sorted(set(shades))
    shares = [k / 1000 for k in range(1001)]
    places = [step(share) for share in shares]
    assert places == sorted(places)
    assert {step(share) for share in shares} == set(range(len(ramp)))


def test_no_cell_stands_out_more_than_the_winners_name():
    assert min(map(brightness, RAMP)) >= brightness("#16191d")
    assert max(map(brightness, DARK_RAMP)) <= brightness(LIGHT)
    assert {ink(color) for color in (*RAMP, *DARK_RAMP)} == {BLACK, WHITE}


@pytest.mark.parametrize(
    ("share", "text"),
    [
        *((1.0, "100"), (0.0, "0"), (0.9999, ">99.9"), (0.0001, "<0.1"), (0.995, "99.5")),
        *((0.98, "98"), (0.9, "90"), (0.8999, "89.9"), (0.896, "89.6"), (0.775, "77.5")),
        *((0.035, "3.5"), (0.0996, "10"), (0.899999, "89.9"), (0.9994, "99.9")),
        *((0.765, "76.5"), (0.515, "51.5"), (0.0005, "0.1"), (0.0125, "1.3"), (0.1225, "12.3")),
    ],
)
def test_a_number_is_never_rounded_across_a_limit(share, text):
    assert share_text(share) == text
    assert percent(share) == f"{text} %"


def test_the_sign_is_of_the_verdict():
    signs = {}
    for verdict in ("overconfident", "undecided", "-", "consistent", "too cautious"):
        (matrix,) = matrices(rows_of({"a": (200, 200)}, verdict=verdict))
        (tiles,) = matrix.rows
        signs[verdict] = {tile.sign for tile in tiles if isinstance(tile, Tile)}
        assert ("▲" in matrix.notes[-1]) == (signs[verdict] == {"▲"})
    assert signs == {
        "overconfident": {"▲"},
        "undecided": {"?"},
        "-": {"?"},
        "consistent": {""},
        "too cautious": {""},
    }


def test_neighbouring_scales_that_say_the_same_are_one_on_paper():
    rows = rows_of({"a": (200, 200, 200, 200, 196), "b": (200, 200, 20, 20, 0)})
    (matrix,) = matrices(rows)
    assert [column.title for column in matrix.columns[1:]] == ["0.1", "1", "10", "33", "100"]
    assert [column.title for column in matrix.folded().columns] == [
        "error scale →",
        "0.1 to 1",
        "10 to 33",
        "100",
    ]
    assert markdown(matrix).splitlines()[:4] == [
        "| error scale → | 0.1 to 1 | 10 to 33 | 100 |",
        "|:---|---:|---:|---:|",
        "| **a** | 100 | 100 | 98 |",
        "| b | 100 | 10 | 0 |",
    ]
    assert r"\begin{tabular}{@{}lrrr@{}}" in latex(matrix)


def test_eight_estimators_at_seven_scales_fit_eighty_columns():
    counts = {f"levenberg_marquardt_{k}": (200 - k, 199, 198, 20, 0) for k in range(8)}
    rows = rows_of(counts)
    (matrix,) = matrices([*rows, *({**one, "error_scale": 1000.0} for one in rows[::5])])
    lines = plain_text([matrix], 80).splitlines()
    assert max(map(len, lines)) <= 80
    assert "Too narrow" not in "".join(lines)


def test_a_cell_says_all_that_is_known_of_it():
    (matrix,) = matrices(rows_of({"ekf": (68, 0)}, verdict="overconfident"))
    ((_, tile, _),) = matrix.rows
    assert isinstance(tile, Tile)
    assert tile.says == (
        "ekf, error scale 0.1: success 34 % of 200 trials (95 %: 27 to 41); error 0.98 × the"
        " bound, 95 % of trials below 1.35; NEES 1.04 of 100 converged: covariance too"
        " small; cost 21/30, 2.0 ms"
    )
    assert f'title="{tile.says}"' in html([matrix])


@pytest.mark.parametrize(
    ("counts", "bold"),
    [
        ({"a": (200, 200), "b": (200, 200)}, []),
        ({"a": (200, 200), "b": (200, 0)}, ["a"]),
        ({"a": (200, 200), "b": (200, 176), "c": (200, 0)}, ["a", "b"]),
        ({"a": (0, 0), "b": (100, 0)}, []),
    ],
)
def test_names_are_bold_unless_another_one_holds_longer_and_none_where_all_tie(counts, bold):
    (matrix,) = matrices(rows_of(counts))
    assert [name.text for name, *_ in matrix.rows if name.best] == bold
    assert ("Bold:" in matrix.notes[-1]) == bool(bold)
    assert html([matrix]).count('class="best"') == len(bold)


def test_one_scale_has_a_table_and_no_matrix():
    assert matrices(rows_of({"a": (200,), "b": (100,)})) == []


def test_settings_are_columns_with_letters_for_long_names():
    rows = [
        one | {"setting": setting, "error_scale": 33.0}
        for setting in ("-", "truth.platform_misalignment=5")
        for one in rows_of({"a": (200,), "b": (0,)})
    ]
    (matrix,) = matrices(rows)
    assert [column.title for column in matrix.columns] == ["setting →", "A", "B"]
    assert matrix.notes[0] == "A: usual; B: truth.platform_misalignment=5."
    assert [column.title for column in matrix.folded().columns] == ["setting →", "A", "B"]


def test_values_of_one_option_stand_as_they_are_below_its_name():
    values = ("0.05", "0.1", "0.2")
    for option, over in (
        ("noise.deviation", "noise.deviation"),
        ("a=1, noise.deviation", "setting"),
    ):
        rows = [
            one | {"setting": f"{option}={value}", "error_scale": 33.0}
            for value in values
            for one in rows_of({"a": (200,), "b": (0,)})
        ]
        (matrix,) = matrices(rows)
        assert matrix.over == over
        assert bool(matrix.notes[1:]) == (over == "setting")
    assert [column.title for column in matrix.columns[1:]] == ["A", "B", "C"]


def test_settings_that_are_swept_have_a_matrix_each():
    rows = [
        one | {"setting": f"noise={k}"} for k in range(3) for one in rows_of({"a": (200, 20 * k)})
    ]
    found = matrices(rows)
    assert [matrix.title for matrix in found] == ["noise=0", "noise=1", "noise=2"]
    assert "settings" not in found[-1].notes[-1]
    (first,) = matrices(rows, 8)
    assert first.notes[-1].endswith("Of 3 settings 2 are only in the table.")
    assert [[cell.text for cell in each][2] for m in found for each in m.rows] == [
        "0 ",
        "10 ",
        "20 ",
    ]


def test_settings_whose_texts_are_equal_have_a_matrix_each():
    rows = [one | {"setting": "noise=0.1"} for _ in range(2) for one in rows_of({"a": (200, 9)})]
    first, second = matrices(rows)
    assert [len(first.columns), len(second.columns)] == [3, 3]


def test_a_missing_result_is_a_dash_without_colour():
    rows = rows_of({"a": (200, 200), "b": (200,)})
    (matrix,) = matrices(rows)
    missing = list(matrix.rows)[1][2]
    assert (missing.text, missing.style) == ("–", "")
    assert isinstance(missing, Tile)
    assert missing.step is None


@pytest.mark.parametrize(
    "missing", [{("b", 1.0)}, {("b", 0.1), ("b", 1.0)}, {("a", 0.1), ("b", 0.1)}]
)
def test_a_share_of_no_trials_is_a_dash_and_holds_nowhere(missing):
    rows = [
        one | {"success": float("nan"), "success_low": float("nan")}
        if (one["estimator"], one["error_scale"]) in missing
        else one
        for one in rows_of({"a": (200, 200), "b": (200, 200)})
    ]
    matrix = matrices(rows)[0]
    shown = {
        (name.text, scale): cell.text
        for name, *cells in matrix.rows
        for scale, cell in zip((0.1, 1.0), cells, strict=True)
    }
    assert {place for place, text in shown.items() if text == "–"} == missing
    assert "b: undecided" in Finding.of(rows).sentence() or ("a", 0.1) in missing


def test_without_any_share_nobody_is_said_to_hold():
    nothing = {"success": float("nan"), "success_low": float("nan")}
    rows = [one | nothing for one in rows_of({"a": (200, 200), "b": (200, 200)})]
    assert Finding.of(rows).sentence().startswith("Too few trials to rank")


def test_a_colour_is_the_paler_the_farther_from_1_to_either_side():
    ratios = [1.0, 2.0, 0.5, 5.0, 0.2, 10.0, 0.1, 1e9, 0.0, float("inf"), float("nan")]
    near = [_nearness(ratio) for ratio in ratios]
    assert near[0] == 1.0
    assert near[1] == pytest.approx(near[2]) == pytest.approx(1 - math.log10(2))
    assert near[3] == pytest.approx(near[4]) == pytest.approx(1 - math.log10(5))
    assert near[5:] == pytest.approx([0.0] * 6)


def test_a_screen_has_as_many_settings_as_fit_with_their_heads_and_at_least_one():
    rows = sweep(auto=(200,), ekf=(100,))  # of one scale
    settings = {f"setting {i}": rows for i in range(40)}
    kept = _shortened(settings)
    used = sum(len(one) + 4 for one in kept.values())
    assert used <= 0.4 * _MOST_LINES < used + len(rows) + 4
    assert list(_shortened({"long": rows * 100})) == ["long"]


def test_a_notebook_has_the_number_of_every_tile():
    """It showed those of the first column alone."""
    (matrix,) = matrices(rows_of({"a": (200, 190, 0), "b": (150, 90, 10)}))
    shown = re.findall(r'<span class="success t\d+[^"]*">([\d.]+)', html([matrix]))
    assert shown == [tile.number for row in matrix.rows for tile in row[1:]]


def test_rows_that_say_the_same_are_one_where_only_success_is_shown():
    (matrix,) = matrices(rows_of({"a": (200, 100), "b": (200, 100), "c": (200, 100)}))
    assert [cell.text for cell in matrix.folded().columns[0].cells] == ["all 3"]
    assert "all 3" in plain_text([matrix])
    assert html([matrix]).count("<tr data-name") == 1
    for counts in ({"a": (200, 100), "b": (200, 100)}, {"a": (200,), "b": (200,), "c": (199,)}):
        kept = matrices(rows_of({name: (*each, 0) for name, each in counts.items()}))
        assert all(one.joined() is one for one in kept)
