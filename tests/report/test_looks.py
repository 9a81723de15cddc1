"""Pages of every kind are read: letters on white and on a dark page, and on a phone."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import resources
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from shared.reports import fill
from shared.state_models import ConstantVelocity
from shared.synthetic_store import Synthetic

import ipe_bench as ib
from ipe_bench.api import run
from ipe_bench.questions.audit.figure import draw_audit
from ipe_bench.questions.compare.figure import draw_pairs
from ipe_bench.questions.design.answer import _draw_design
from ipe_bench.questions.posterior.answer import sampled
from ipe_bench.questions.posterior.figure import draw_marginals
from ipe_bench.report.figures import drawings
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.log import draw_log
from ipe_bench.report.figures.svg import LEAST_LETTERS
from ipe_bench.report.page.answer import _drawings
from ipe_bench.report.style import COLORS, DARK, FACES, dark, house_style, looks
from ipe_bench.states import Smoother, ekf
from ipe_bench.statistics import analyse
from ipe_bench.trials.paths import StateScenario
from ipe_bench.trials.scenario import Scenario

PHONE = 390 - 2 * 12
"""Pixels between the margins of a page on a phone."""
LEGIBLE = 4.5
"""Contrast of letters by WCAG 2, level AA."""
SEEN = 3.0
"""Contrast of lines and marks, there too."""


def luminance(color: str) -> float:
    """By WCAG 2."""
    c = np.array(to_rgb(color))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(np.array([0.2126, 0.7152, 0.0722]) @ linear)


def contrast(first: str, second: str) -> float:
    low, high = sorted(map(luminance, (first, second)))
    return (high + 0.05) / (low + 0.05)


def estimate(tmp_path) -> list[Drawing]:
    t = np.arange(12.0)
    model = ib.measurements.Formula("a*exp(-b*t)", {"a": 1.0, "b": 0.1}, {"t": t.tolist()})
    z = 2 * np.exp(-0.2 * t) + 0.05 * np.random.default_rng(0).standard_normal(12)
    return list(_drawings(ib.estimate(model, z)))


def log(tmp_path) -> list[Drawing]:
    model = ConstantVelocity(count=30)
    found = ib.estimate(model, model.draw(3, 4).z[0], {"kf": ekf(), "rts": Smoother(ekf())})
    return list(draw_log(found.log, found.tracks))


def audit(tmp_path) -> list[Drawing]:
    errors = np.random.default_rng(0).normal(0, 0.3, (100, 2))
    named = {"x_error": errors[:, 0], "y_error": errors[:, 1], "x_std": 0.1, "y_std": 0.3}
    return list(draw_audit(ib.audit(pd.DataFrame(named))))


def compare(tmp_path) -> list[Drawing]:
    e = 0.03 * np.random.default_rng(0).standard_normal((200, 3))
    for name, factor in (("a", 1.0), ("b", 1.5)):
        store = Synthetic(tmp_path / name)
        store.add(store.scenario(), "it", factor * e, simulations=4 * factor)
    return list(draw_pairs(ib.compare(tmp_path / "a", tmp_path / "b")))


def design(tmp_path) -> list[Drawing]:
    found = ib.design(ib.measurements.Ranging(), noise=ib.noise.Gaussian(0.1), error_scale=10.0)
    return list(_draw_design(found))


def posterior(tmp_path) -> list[Drawing]:
    bench = Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    found = sampled(bench, {"lse": ib.baselines.LinearLSE()}, 1, 80)
    return list(draw_marginals(bench.measurement, found))


def constants(tmp_path) -> list[Drawing]:
    store = Synthetic(tmp_path)
    fill(store, labels=("linear_lse", "auto", "ekf"), scales=(1.0, 10.0), trials=30)
    return list(drawings(analyse([store.directory]), "main"))


def states(tmp_path) -> list[Drawing]:
    trackers = {"ekf": ekf(), "ekf_rts": Smoother(ekf())}
    run(StateScenario(ConstantVelocity(count=6)), trackers, 25, output=tmp_path)
    return list(drawings(analyse([tmp_path]), "main"))


KINDS: list[Callable[[Any], list[Drawing]]] = [
    estimate,
    log,
    audit,
    compare,
    design,
    posterior,
    constants,
    states,
]


def rules(css: str) -> dict[str, str]:
    return dict(re.findall(r"\.(s[0-9a-f]+)\{([^}]*)\}", css))


def fills(style: dict[str, str], names: Sequence[str]) -> list[str]:
    found = [re.search(r"fill: (#[0-9a-f]{6})", style[name]) for name in names]
    return [one[1] for one in found if one]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_letters_of_figures_are_read_on_white_on_a_dark_page_and_on_a_phone(kind, tmp_path):
    with house_style():
        drawn = kind(tmp_path)
        pages = {one.name: one.html() for one in drawn}
    assert pages
    for name, page in pages.items():
        light, night = (
            page.split("@media", 1)[0],
            page.split("@media", 1)[1].partition("</style>")[0],
        )
        styles = {"#ffffff": rules(light), DARK: rules(night)}
        letters = re.findall(r'<text[^>]*? class="(s[0-9a-f]+)"', page)
        assert letters, name
        for ground, style in styles.items():
            # Letters in cells of a matrix are of another ground, and tested there.
            if name.startswith(("matrix", "success", "digits")):
                continue
            colors = fills(style, letters)
            assert colors, name
            for color in colors:
                assert contrast(color, ground) >= LEGIBLE, (name, color, ground)
        for panel in re.findall(r"<svg viewBox=.*?</svg>", page, re.DOTALL):
            least = re.search(r'"--least:(\d+)px"', panel)
            if least is None:
                continue
            _, _, width, _ = map(float, re.findall(r'viewBox="([^"]*)"', panel)[0].split())
            classes = re.findall(r'<text[^>]*? class="(s[0-9a-f]+)"', panel)
            sizes = re.findall(
                r"font(?:-size)?: ([\d.]+)px", " ".join(map(rules(light).get, classes))
            )
            smallest = min(map(float, sizes)) * max(PHONE, float(least[1])) / width
            assert smallest >= LEAST_LETTERS - 0.1, name


@pytest.mark.parametrize("color", sorted({*COLORS, *(one.color for one in FACES.values())}))
def test_lines_of_any_colour_are_seen_on_a_dark_page(color):
    assert contrast(dark(color), DARK) >= SEEN


def test_words_of_a_page_are_read_on_each_of_its_grounds():
    css = (resources.files("ipe_bench.report.page") / "templates" / "report.css").read_text()
    roots = re.findall(r":root \{([^}]*)\}", css)
    assert len(roots) == 3  # white, dark, in print
    for root in roots:
        colors = dict(re.findall(r"--(\w+): (#[0-9a-f]{3,6})", root))
        for ground in ("ground", "tint", "alarm"):
            for letters in ("ink", "soft", "mark", "warn"):
                found = contrast(colors[letters], colors[ground])
                assert found >= LEGIBLE, (letters, ground, found)
    # What is fainter is lines and shades.
    assert not re.search(r"[{; ]color: var\(--(faint|line)\)", css)
    sizes = [16 * float(size) for size in re.findall(r"font-size: (\d*\.\d+)rem", css)]
    assert min(sizes) >= LEAST_LETTERS


def test_a_label_has_its_own_colour_although_it_has_a_face() -> None:
    own = {"ekf": ("#123456", None)}
    assert looks(["ekf", "ekf (1)"], own={**own, "ekf (1)": ("#654321", None)}) == {
        "ekf": replace(FACES["ekf"], color="#123456"),
        "ekf (1)": replace(looks(["ekf (1)"])["ekf (1)"], color="#654321"),
    }


def test_more_variants_than_there_are_looks_share_some() -> None:
    found = looks([f"ekf (a={i})" for i in range(50)])
    assert len(set(map(repr, found.values()))) == 44
