"""Theory beside experiment: closed forms of curvature, bias and error under a wrong model, and
Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from shared.oracles import assert_agrees
from shared.small_models import Bent, Written

import ipe_bench as ib
from ipe_bench.basics.linalg import Array, Covariance, information
from ipe_bench.measurements import Gins, Measurement, RicherGins
from ipe_bench.measurements.problem import Problem
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.runs.run import compute
from ipe_bench.statistics import analyse
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scoring import CURVED, Block
from ipe_bench.trials.theory import box_bias, misspecified, relative_curvatures, second_derivatives

RADIUS = 1.959964
"""The 95 % region of one parameter, in deviations."""


def curvatures(model: Measurement, x: Array, sigma: float = 1.0) -> tuple[Array, Array]:
    R = Covariance(np.full(model.m, sigma))
    return relative_curvatures(model.jacobian(x), second_derivatives(model, x), R)


@pytest.mark.oracle(
    "closed form: curvature of a circle (Bates and Watts 1980)", "intrinsic curvature", 1e-5
)
def test_a_circle_bends_by_its_radius_and_runs_evenly():
    model = Written(lambda t: (5 * np.cos(t), 5 * np.sin(t)))
    intrinsic, parametric = curvatures(model, np.array([[0.3], [2.0]]), sigma=0.5)
    assert_agrees(intrinsic, RADIUS * 0.5 / 5, rtol=1e-5)
    np.testing.assert_allclose(parametric, 0.0, atol=1e-6)


@pytest.mark.oracle("closed form: a cubic scale on a line", "curvature of the parameter", 1e-5)
def test_a_bent_scale_on_a_straight_line_is_all_parameter_effects():
    model = Written(lambda t: (3 * t**3, 4 * t**3))
    intrinsic, parametric = curvatures(model, np.array([[2.0]]))
    # h = 5 t^3 along a line: h'' / h'^2.
    assert_agrees(parametric, RADIUS * 30 * 2 / (15 * 4) ** 2, rtol=1e-5)
    np.testing.assert_allclose(intrinsic, 0.0, atol=1e-8)


@pytest.mark.oracle("closed form: curvature of a sphere", "intrinsic curvature", 1e-4)
def test_a_sphere_bends_alike_in_all_directions():
    model = Written(
        lambda a, b: (7 * np.cos(a) * np.cos(b), 7 * np.sin(a) * np.cos(b), 7 * np.sin(b)), 2, 3
    )
    intrinsic, _ = curvatures(model, np.array([[0.4, 0.3]]))
    assert_agrees(intrinsic, np.sqrt(5.991465) / 7, rtol=1e-4)


@pytest.mark.oracle("closed form: second order of a logarithm (Box 1971)", "bias", 1e-5)
def test_the_bias_of_a_logarithm_is_half_its_variance():
    """z = exp(t) + v is fitted by log z: -sigma^2 exp(-2 t) / 2 to second order."""
    model = Written(lambda t: (np.exp(t),), count=1)
    x = np.array([[0.0], [1.0]])
    found = box_bias(model.jacobian(x), second_derivatives(model, x), Covariance(np.array([0.1])))
    assert_agrees(found[:, 0], -(0.1**2) * np.exp(-2 * x[:, 0]) / 2, rtol=1e-5)


@pytest.mark.slow
def test_the_mean_error_of_least_squares_is_the_bias_of_box():
    model = Bent(bend=0.3)
    R = Covariance(np.full(12, 0.12))
    x = np.broadcast_to([0.4, -0.3, 0.2], (30_000, 3)).copy()
    z = model.simulate(x) + 0.12 * np.random.default_rng(0).normal(size=(30_000, 12))
    error = least_squares_root(Problem(model, R), z, x, prior=None) - x
    error = error[np.isfinite(error).all(axis=1)]
    (expected,) = box_bias(model.jacobian(x[:1]), second_derivatives(model, x[:1]), R)
    spread = error.std(axis=0) / np.sqrt(len(error))
    assert len(error) > 29_900
    assert (np.abs(expected) > 5 * spread).any()  # there is something to find
    np.testing.assert_allclose(error.mean(axis=0), expected, atol=4 * spread.max(), rtol=0.15)


@pytest.mark.oracle(
    "closed form: least squares of a linear model", "bias under a wrong model", 1e-9
)
def test_under_a_wrong_linear_model_the_bias_is_h_plus_times_what_is_left_out():
    model, R = Bent(), Covariance(np.full(12, 0.3))
    x, left_out = np.zeros((2, 3)), np.random.default_rng(1).normal(size=(2, 12))
    bias, deviation = misspecified(
        Problem(model, R),
        left_out,
        x,
        least_squares_root(Problem(model, R), left_out, x, prior=None),
    )
    assert_agrees(bias, left_out @ np.linalg.pinv(model.A).T, atol=1e-9)
    crlb = np.sqrt(np.diag(np.linalg.inv(information(model.A, R))))
    np.testing.assert_allclose(deviation, np.broadcast_to(crlb, (2, 3)), rtol=1e-9)


def test_where_residuals_remain_the_scatter_is_the_sandwich_and_not_the_bound():
    model, R, sigma = Bent(bend=0.3), Covariance(np.full(12, 0.05)), 0.05
    x = np.array([[0.4, -0.3, 0.2]])
    h = model.simulate(x) + 0.5 * np.sin(3.0 * np.arange(12))
    problem = Problem(model, R)
    bias, deviation = misspecified(problem, h, x, least_squares_root(problem, h, x, prior=None))
    trials = 8000
    z = h + sigma * np.random.default_rng(0).normal(size=(trials, 12))
    error = least_squares_root(problem, z, np.repeat(x + bias, trials, axis=0), prior=None) - x
    error = error[np.isfinite(error).all(axis=1)]
    assert len(error) > 0.99 * trials
    np.testing.assert_allclose(error.mean(axis=0), bias[0], atol=4 * sigma / np.sqrt(trials) + 2e-3)
    np.testing.assert_allclose(error.std(axis=0), deviation[0], rtol=0.04)
    naive = np.sqrt(np.diag(np.linalg.inv(information(model.jacobian(x + bias)[0], R))))
    assert (np.abs(naive / error.std(axis=0) - 1) > 0.1).any()


RICHER = {
    "nothing": {},
    "quadratic": {"accelerometer_quadratic": 500.0},
    "walk": {"gyro_random_walk": 0.001},
    "misaligned": {"accelerometer_misalignment": 20.0, "platform_misalignment": 20.0},
    "platform": {"platform_misalignment": 5.0},
}


@pytest.mark.parametrize("errors", RICHER.values(), ids=RICHER)
def test_the_mismatch_experiment_comes_out_as_theory_says(errors):
    """In each trial the error less the predicted bias scatters as predicted, in every parameter."""
    bench = replace(scenario(Gins(), 33.0), truth=RicherGins(**errors))
    block = Block.draw(bench, 0, 80)
    estimates, scores = block.estimate(ib.baselines.GaussNewton())
    assert scores["solved"].all()
    columns = block.truth_columns()
    names = [p.name for p in bench.measurement.parameters]
    bias, deviation = (
        np.stack([columns[f"{k}_{n}"] for n in names], axis=1)
        for k in ("pseudo_bias", "misspecified")
    )
    left = (estimates.x - block.trials.x - bias) / deviation
    # 80 trials: a root mean square of 1 with a deviation of 0.08.
    assert np.abs(np.sqrt(np.mean(left**2, axis=0)) - 1).max() < 0.32
    assert np.sqrt(np.mean(left**2)) == pytest.approx(1.0, abs=0.08)
    if errors:
        assert np.sqrt(np.mean((bias / block.crlb_deviation) ** 2)) > 1.5


def scenario(model: Measurement, scale: float) -> ib.Scenario:
    return ib.Scenario(model, ib.noise.Quantization(), error_scale=scale)


def test_columns_do_not_depend_on_the_block():
    bench = replace(scenario(Gins(), 33.0), truth=RicherGins(platform_misalignment=5.0))
    whole, part = Block.draw(bench, 0, 6).truth_columns(), Block.draw(bench, 4, 6).truth_columns()
    for name in (
        "pseudo_bias_bx",
        "misspecified_bx",
        "box_bias_bx",
        "curvature_intrinsic",
        "curvature_parameter",
    ):
        assert np.array_equal(whole[name][4:], part[name])
    late = Block.draw(scenario(Gins(), 33.0), CURVED, CURVED + 2).truth_columns()
    assert np.isnan(late["box_bias_bx"]).all()
    assert "pseudo_bias_bx" not in late


@pytest.mark.slow
def test_summary_and_table_have_theory_for_least_squares_alone(tmp_path):
    bench = ib.Scenario(Bent(bend=0.2), ib.noise.Gaussian(0.05), error_scale=0.3)
    wrong = replace(bench, truth=Bent(bend=0.25))
    estimators = {"gn": ib.baselines.GaussNewton(), "newton": ib.solvers.Newton()}
    assert compute([bench, wrong], estimators, 300, tmp_path) == ()
    found = analyse([tmp_path])
    rows = found.summary.set_index("estimator")
    assert rows.loc["newton", "predicted_rmse"].isna().all()
    gn = rows.loc["gn"]
    assert gn["predicted_rmse"].notna().all()
    np.testing.assert_allclose(gn["rmse_solved"], gn["predicted_rmse"], rtol=0.15)
    # Under the wrong model the bound is no longer what happens.
    mistaken = gn[gn["truth"].astype(str) != "nan"] if "truth" in gn else gn
    assert (mistaken["predicted_rmse"] > 1.05 * mistaken["crlb"]).any()
    assert "theory" in [table.name for table in all_tables(found)]
