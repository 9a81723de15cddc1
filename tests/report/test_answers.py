"""The pages and pictures of single questions: what was asked and read stands on them, and the curve's band is right."""

from __future__ import annotations

import hashlib

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t as student

import ipe_bench as ib
from ipe_bench.cli.main import main
from ipe_bench.report.figures.answers import draw_fit, draw_residuals
from ipe_bench.report.style import house_style
from ipe_bench.report.words import ends_in_percent, public


def test_a_page_states_command_version_and_file_and_no_path_of_this_machine(tmp_path, capsys):
    file = tmp_path / "runs.csv"
    error = np.random.default_rng(0).normal(0, 0.3, 200)
    pd.DataFrame({"x_error": error, "x_std": 0.1}).to_csv(file, index=False)
    assert main(["audit", str(file), f"output={tmp_path / 'out'}"]) == 1
    page = (tmp_path / "out" / "audit.html").read_text(encoding="utf-8")
    for words in ("ipe-bench audit …/runs.csv output=…/out", f"ipe-bench {ib.__version__}", "How to cite", "<figure"):
        assert words in page
    assert hashlib.sha256(file.read_bytes()).hexdigest()[:16] in page
    assert str(tmp_path) not in page
    found = ib.audit(file)
    assert found.sentences[0] in page
    assert "table-audit" in found._repr_html_()


def test_the_band_of_a_straight_line_is_the_textbooks_and_equal_residuals_are_drawn_once():
    """Draper and Smith, Applied Regression Analysis, 3rd ed., 1998, eq. (1.4.7)."""
    x = np.array([1.0, 2.0, 3.0, 5.0, 8.0])
    z = 1 + 2 * x + np.array([0.1, -0.2, 0.15, 0.05, -0.1])
    found = ib.estimate(ib.measurements.Formula("a + b*x", {"a": 0.0, "b": 1.0}, {"x": x.tolist()}), z)
    with house_style():
        (fit,) = draw_fit(found.examination, z)
        (residuals,) = draw_residuals(found.model, found.fits)
    assert sum(bool(ax.get_title()) for ax in residuals.figure.axes) == 1
    band = fit.figure.axes[0].collections[0].get_paths()[0].vertices
    s = np.sqrt(np.sum((z - np.polyval(np.polyfit(x, z, 1), x)) ** 2) / 3)
    for at in (1.0, 8.0):
        half = student.ppf(0.975, 3) * s * np.sqrt(1 / 5 + (at - x.mean()) ** 2 / np.sum((x - x.mean()) ** 2))
        ends = band[np.isclose(band[:, 0], at)][:, 1]
        assert np.ptp(ends) == pytest.approx(2 * half, rel=1e-4)


def test_certified_readings_have_a_curve_over_their_input():
    found = ib.estimate(ib.measurements.Nist("Misra1a"))
    with house_style():
        (fit,) = draw_fit(found.examination, found.z)
    assert fit.figure.axes[0].get_xlabel() == "x"


@pytest.mark.parametrize(
    ("low", "high", "ends"),
    [(0.9963, 1, ("99.6", "100")), (0, 0.0037, ("0", "0.4")), (0.93, 1, ("93", "100")), (1, 1, ("100", "100"))],
)
def test_ends_of_a_narrow_interval_have_decimals(low, high, ends):
    assert ends_in_percent(low, high) == ends


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("run output=/home/me/a/b 'solver=[/x/y]'", "run output=…/b 'solver=[…/y]'"),
        ("estimate measurement.expression=a/b*c/d", "estimate measurement.expression=a/b*c/d"),
    ],
)
def test_absolute_paths_are_shortened_and_formulas_are_not(text, shown):
    assert public(text) == shown
