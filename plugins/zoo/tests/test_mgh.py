"""Moré, Garbow and Hillstrom's functions against published sums of squares, and minima against
SciPy."""

import inspect
from math import exp, sqrt

import numpy as np
import pytest
from ipe_bench_zoo import Mgh
from ipe_bench_zoo.mgh import PROBLEMS, score
from scipy.optimize import least_squares
from shared.oracles import agreed, assert_agrees

from ipe_bench.baselines import LevenbergMarquardt, LinearLSE
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import fit
from ipe_bench.workshop.conformance import check_component

# m and n, as the paper states them.
SIZES = {
    "rosenbrock": (2, 2), "freudenstein_roth": (2, 2), "powell_badly_scaled": (2, 2),
    "brown_badly_scaled": (3, 2),
    "beale": (3, 2), "jennrich_sampson": (10, 2), "helical_valley": (3, 3), "bard": (15, 3),
    "gaussian": (15, 3),
    "meyer": (16, 3), "gulf": (99, 3), "box_3d": (10, 3), "powell_singular": (4, 4), "wood": (6, 4),
    "kowalik_osborne": (11, 4), "brown_dennis": (20, 4), "osborne_1": (33, 5),
    "biggs_exp6": (13, 6),
    "osborne_2": (65, 11), "watson": (31, 6), "trigonometric": (10, 10),
    "brown_almost_linear": (10, 10),
    "chebyquad": (8, 8),
}  # fmt: skip

# Norms of the residuals at 1, 10 and 100 times the standard start: the reference values of
# MINPACK's tests (Argonne, March 1980), as they stand in the tests of Apache Commons Math 2.2.
MINPACK_NORMS = {
    "rosenbrock": (sqrt(24.2), sqrt(1795769.0), 11.0 * sqrt(169000121.0)),
    "helical_valley": (50.0, 102.95630140987, 991.261822123701),
    "powell_singular": (14.6628782986152, 1270.9838708654, 126887.903284750),
    "freudenstein_roth": (20.0124960961895, 12432.833948863, 11426454.595762),
    "bard": (6.45613629515967, 36.1418531596785, 384.114678637399),
    "kowalik_osborne": (0.0728915102882945, 2.97937007555202, 29.9590617016037),
    "meyer": (41153.4665543031, 4168216.89130846),
    "watson": (5.47722557505166, 6433.12578950026, 674256.040605213),
    "box_3d": (32.1115837449572,),
    "jennrich_sampson": (64.5856498144943,),
    "brown_dennis": (2815.43839161816, 555073.354173069, 61211252.2338581),
    "chebyquad": (0.196513862833975,),
    "brown_almost_linear": (16.5302162063499, 9765624.00089211, 0.9765625e17),
    "osborne_1": (0.937564021037838,),
    "osborne_2": (1.44686540984712,),
}

# Norms at the standard start that follow by hand.
BY_HAND = {
    "powell_badly_scaled": (sqrt(1.0 + (exp(-1.0) - 1e-4) ** 2),),
    "brown_badly_scaled": (sqrt((1e6 - 1.0) ** 2 + (1.0 - 2e-6) ** 2 + 1.0),),
    "beale": (sqrt(1.5**2 + 2.25**2 + 2.625**2),),
    "wood": (sqrt(19192.0),),
}

# What the paper prints.
PRINTED = {
    "freudenstein_roth": (0.0, 48.9842), "jennrich_sampson": (124.362,),
    "bard": (8.21487e-3, 17.4286),
    "gaussian": (1.12793e-8,), "meyer": (87.9458,), "kowalik_osborne": (3.07505e-4, 1.02734e-3),
    "brown_dennis": (85822.2,), "osborne_1": (5.46489e-5,), "biggs_exp6": (0.0, 5.65565e-3),
    "osborne_2": (4.01377e-2,), "watson": (2.28767e-3,), "trigonometric": (0.0, 2.79506e-5),
    "brown_almost_linear": (0.0, 1.0), "chebyquad": (3.51687e-3,),
}  # fmt: skip

# Other places where the paper says that a function is zero.
ZEROS = {
    "box_3d": [(10.0, 1.0, -1.0), (2.0, 2.0, 0.0)],
    "brown_almost_linear": [(1.0,) * 10],
    "biggs_exp6": [(4.0, 10.0, 3.0, 5.0, 1.0, 1.0)],
}

# Points far out in the directions of minima at infinity.
FAR = {
    ("beale", 1): (-1e7, 1.0 + 111.0 / 112.0 * 1e-7),
    ("jennrich_sampson", 1): (-800.0, 0.331485278480789),
    ("bard", 1): (0.8406666666666667, -1e8, -1e8),
    ("box_3d", 1): (0.6136003545073, 1e4, 1.3199552081726),
    ("kowalik_osborne", 1): (1e9, -14.0758819895, -45.25718538782488e9, -28.23149476816026e9),
}


def sum_of_squares(model, values):
    return float(np.sum(model.simulate(np.asarray(values, dtype=float)[None] / model.sizes) ** 2))


def finite_minima():
    return [
        (f, k)
        for f in PROBLEMS
        for k, m in enumerate(Mgh(f).minima)
        if m.x and np.isfinite(m.x).all()
    ]


def test_23_functions_have_the_dimensions_of_the_paper():
    assert {f: (Mgh(f).m, Mgh(f).n) for f in PROBLEMS} == SIZES
    assert len(SIZES) == 23


@pytest.mark.oracle(
    "published: reference values of MINPACK's tests (Argonne 1980), and by hand",
    "norms of residuals at the starts",
    1e-12,
)
@pytest.mark.parametrize("function", NORMS := MINPACK_NORMS | BY_HAND)
def test_residuals_at_the_starts_have_known_norms(function):
    for start, norm in zip((1.0, 10.0, 100.0), NORMS[function], strict=False):
        model = Mgh(function, start)
        assert_agrees(np.linalg.norm(model.simulate(model.nominal[None])), norm, rtol=1e-12)


@pytest.mark.oracle(
    "published: Moré, Garbow and Hillstrom, ACM TOMS 7(1) (1981)",
    "sums of squares of the minima of 23 functions",
    1e-5,
)
@pytest.mark.parametrize("function", PROBLEMS)
def test_minima_are_those_that_the_paper_prints(function):
    values = [m.sum_of_squares for m in Mgh(function).minima]
    printed = PRINTED.get(function, (0.0,))
    # Six digits, some of them cut and not rounded.
    assert_agrees(values[: len(printed)], printed, rtol=1e-5)
    assert values[0] == min(values)


@pytest.mark.parametrize(("function", "which"), finite_minima())
def test_a_minimiser_has_its_sum_of_squares_and_no_gradient(function, which):
    model, minimum = Mgh(function), Mgh(function).minima[which]
    x = np.array(minimum.x) / model.sizes
    assert sum_of_squares(model, minimum.x) == pytest.approx(
        minimum.sum_of_squares, rel=1e-11, abs=1e-20
    )
    r, J = model.simulate(x[None])[0], model.jacobian(x[None])[0]
    # Residuals of 1e-12 are round-off, whatever their sign.
    assert (
        np.abs(J.T @ r) <= 1e-10 * np.linalg.norm(J, axis=0) * max(np.linalg.norm(r), 1e-2)
    ).all()


@pytest.mark.parametrize("function", PROBLEMS)
def test_scipy_finds_nothing_lower_beside_the_least_minimum(function):
    model = Mgh(function)
    least = np.array(model.minima[0].x)
    scale = np.where(least == 0, 1.0, np.abs(least))
    found = least_squares(
        lambda x: model.simulate(x[None] / model.sizes)[0],
        least + 0.01 * scale * np.random.default_rng(0).standard_normal(model.n),
        x_scale=scale,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    assert 2 * found.cost >= model.minima[0].sum_of_squares * (1 - 1e-9)
    assert score(model, found.x / model.sizes).solved


@pytest.mark.oracle(
    "published: Moré, Garbow and Hillstrom, ACM TOMS 7(1) (1981)",
    "sums of squares where they print zeros",
    1e-28,
)
@pytest.mark.parametrize(
    ("function", "zero"), [(f, zero) for f, zeros in ZEROS.items() for zero in zeros]
)
def test_every_printed_zero_is_a_solution(function, zero):
    model = Mgh(function)
    agreed(sum_of_squares(model, zero), 1e-28)
    assert score(model, np.array(zero) / model.sizes).solved


@pytest.mark.parametrize(("function", "which"), FAR)
def test_minima_at_infinity_are_approached_and_recognised(function, which):
    model = Mgh(function)
    attained = score(model, np.array(FAR[function, which]) / model.sizes)
    assert attained.sum_of_squares == pytest.approx(model.minima[which].sum_of_squares, rel=1e-6)
    assert (attained.solved, attained.minimum) == (False, which)


def test_the_middle_minimum_of_biggs_is_a_saddle():
    model = Mgh("biggs_exp6")
    x = np.array(model.minima[1].x)
    lower = min(sum_of_squares(model, x + e * np.array([1, 0, 0, 0, -1, 0])) for e in (-0.01, 0.01))
    assert lower < model.minima[1].sum_of_squares


def test_starts_are_multiples_of_the_standard_start_and_watsons_as_in_minpack():
    assert (Mgh("wood", 10.0).nominal * Mgh("wood", 10.0).sizes).tolist() == [-30, -10, -30, -10]
    assert (Mgh("box_3d", 100.0).nominal * Mgh("box_3d", 100.0).sizes).tolist() == [0, 1000, 2000]
    assert [Mgh("watson", s).start_values[0] for s in (1.0, 10.0, 100.0)] == [0, 10, 100]


@pytest.mark.parametrize("function", PROBLEMS)
def test_models_keep_the_promises_of_models(function):
    complaints = [f.complaint for f in check_component("mgh", Mgh(function)) if f.complaint]
    square = SIZES[function][0] == SIZES[function][1]
    # A square system has no reading to spare, which its docstring says.
    assert all(square and "too few" in complaint for complaint in complaints)
    if square:
        assert inspect.getdoc(Mgh).count("(m = n)") == 1


def test_what_is_no_minimum_is_none():
    model = Mgh("rosenbrock")
    assert score(model, model.nominal).minimum is None
    assert score(model, np.full(2, np.nan)).sum_of_squares == np.inf
    nearly = model.minima[0].x / model.sizes * (1 + 1e-5)
    assert not score(model, nearly).solved
    local = Mgh("freudenstein_roth")
    assert score(local, np.array(local.minima[1].x) / local.sizes).minimum == 1


def test_with_as_many_readings_as_parameters_nothing_is_tested_but_a_worse_answer_is_none():
    model = Mgh("rosenbrock")
    problem = Problem(model, model.recorded.R)
    good, bad = fit(
        problem,
        model.recorded.z,
        {"lm": LevenbergMarquardt(tolerance=1e-9, max_iterations=500), "linear": LinearLSE()},
    )
    assert (good.fits, bad.fits) == (None, False)
    assert np.isnan(good.p_value)
    assert np.isnan(good.white_p)
