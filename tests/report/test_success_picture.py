"""README's picture: letters are read on a phone, names in their colours on both pages, families are
told apart, and what has no room is named."""

from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from report.test_figures import SIGHT, contrast, lab
from report.test_finding import sweep

from ipe_bench.report.figures.headline import (
    FAMILY,
    GREY,
    GROUND,
    INK,
    SOFT,
    chosen,
    draw,
    picture,
)

PHONE = 390
"""Pixels of the width of a phone."""


def view(**counts: tuple[int, ...]) -> Any:
    rows = pd.DataFrame(sweep(**counts)).assign(success_high=1.0)
    families = {"auto": "IPE", "fixed_point": "IPE", "ekf": "filters", "ukf": "filters"}
    kinds = dict.fromkeys(counts, "least squares") | families

    def drawing(figure: Any, name: str, title: str, *caption: str) -> SimpleNamespace:
        return SimpleNamespace(figure=figure, name=name, caption=" ".join(filter(None, caption)))

    scales = sorted(set(rows["error_scale"]))
    return SimpleNamespace(totals=rows, families=kinds, scales=scales, drawing=drawing)


FALLING = {"auto": (200, 200, 200), "ekf": (200, 190, 0), "ukf": (200, 195, 1)}


def test_letters_are_ten_pixels_high_on_a_phone_and_nothing_is_cut():
    figure = picture(view(**FALLING, levenberg_marquardt=(200, 200, 150), linear_lse=(0, 0, 0)))
    (ax,) = figure.axes
    figure.draw_without_rendering()
    texts = [*figure.texts, *ax.texts, *ax.get_xticklabels(), *ax.get_yticklabels(), ax.xaxis.label]
    width = figure.get_figwidth()
    for text in texts:
        if not text.get_text():
            continue
        assert text.get_fontsize() / 72 / width * PHONE >= 10
        box = text.get_window_extent()
        assert box.x0 >= 0, text
        assert box.x1 <= figure.bbox.x1, text
        assert 0 <= box.y0 <= box.y1 <= figure.bbox.y1, text
    # The curves begin below the title.
    assert ax.get_window_extent().y1 < min(text.get_window_extent().y0 for text in figure.texts)


@pytest.mark.parametrize("dark", [False, True])
def test_each_name_has_the_colour_and_the_dash_of_its_curve(dark):
    (ax,) = picture(view(**FALLING), dark=dark).axes
    named = {text.get_text(): text for text in ax.texts}
    assert named.keys() == FALLING.keys()
    leads = {name: text.arrow_patch.get_linestyle() for name, text in named.items()}
    assert leads["ekf"] != leads["ukf"]
    drawn = {line.get_color() for line in ax.lines}
    assert {text.get_color() for text in named.values()} <= drawn
    heights = [named[name].xyann[1] for name in ("auto", "ukf", "ekf")]
    assert heights == sorted(heights, reverse=True)


@pytest.mark.parametrize("dark", [False, True])
def test_families_are_told_apart_and_their_letters_are_read(dark):
    shown = {color[dark] for color in (*FAMILY.values(), GREY, INK)}
    for color in {*shown, SOFT[dark]} - {GREY[dark]}:
        assert contrast(color, GROUND[dark]) >= 4.5
    for sight in SIGHT:
        apart = [np.linalg.norm(lab(a, sight) - lab(b, sight)) for a, b in combinations(shown, 2)]
        assert min(apart) >= 20, sight


def test_of_many_the_best_of_each_family_is_drawn_and_the_others_are_named():
    many = {f"ls{k}": (200, 200 - k, 10) for k in range(8)}
    one = view(**FALLING, **many, fixed_point=(200, 100, 0), linear_lse=(0, 0, 0))
    names = chosen(one.totals, one.families)
    assert len(names) == 8
    assert {"auto", "ls0", "ukf", "ekf", "fixed_point", "linear_lse"} <= set(names)
    (drawing,) = draw(one)
    absent = [name for name in many if name not in names]
    assert drawing.caption.endswith(f"Not drawn: {', '.join(absent)}.")
    assert list(draw(view(auto=(200,)))) == []


def test_curves_are_percents_of_trials_and_no_scale_is_cut_off():
    """The last scale is no power of ten, and has no tick."""
    of_all = view(**FALLING)
    first = of_all.totals[of_all.totals["error_scale"] == 1.0]
    more = [first.assign(error_scale=scale) for scale in (0.1, 300.0)]
    of_all.totals = pd.concat([of_all.totals, *more])
    of_all.scales = [0.1, 1.0, 10.0, 100.0, 300.0]
    (ax,) = picture(of_all).axes
    drawn = [line for line in ax.lines if len(line.get_xdata()) == 5]
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["0.1", "1", "10", "100"]
    low, high = ax.get_xlim()
    assert all(low <= x <= high for line in drawn for x in line.get_xdata())
    heights = {tuple(np.round(sorted(line.get_ydata())[:2], 9)) for line in drawn}
    assert heights == {(100.0, 100.0), (0.0, 95.0), (0.5, 97.5)}


def test_the_title_is_the_finding_without_only():
    figure = picture(view(**FALLING))
    assert figure.texts[0].get_text() == "auto succeeds up to error scale 100"


def test_curves_of_one_colour_differ_in_their_line_or_marker():
    many = {f"e{i}": (10 - i,) * 2 for i in range(8)}
    lines = picture(view(**many)).axes[0].lines
    looks = {(line.get_color(), line.get_marker(), line._unscaled_dash_pattern) for line in lines}
    assert len(looks) == len(lines) == 8
