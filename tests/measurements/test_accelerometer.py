"""The accelerometers against the source's matrices, the symmetric form of the same model, and SciPy."""

import numpy as np
import pytest
from scipy.linalg import polar
from scipy.optimize import least_squares

from ipe_bench.baselines import GaussNewton
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Accelerometer, Triad
from ipe_bench.measurements.problem import Problem

GRAVITY = 9.8
BIAS = np.array([33124.0, 33275.0, 32364.0])
K = np.diag([0.00241, 0.00237, 0.00246])
T = np.array([[1.0, -0.0047, 0.0121], [0.0, 1.0, 0.0088], [0.0, 0.0, 1.0]])
"""A triad with the errors of consumer sensors."""


@pytest.fixture
def held():
    """The counts of that triad at rest in 35 attitudes of no particular kind."""
    v = np.random.default_rng(0).normal(size=(35, 3))
    force = GRAVITY * v / np.linalg.norm(v, axis=1)[:, None]
    return force @ np.linalg.inv(T @ K).T + BIAS


def model_of(counts, **options):
    return Accelerometer(counts=tuple(map(tuple, counts.tolist())), gravity=GRAVITY, **options)


def x_of(model, bias, K, T):
    values = [*bias, *(1e6 * (np.diag(K) / model.scale - 1.0)), -1e3 * T[0, 1], 1e3 * T[0, 2], -1e3 * T[1, 2]]
    return np.array(values) / model.sizes


def test_the_true_triad_sees_gravity_in_every_attitude(held):
    model = model_of(held)
    np.testing.assert_allclose(model.simulate(x_of(model, BIAS, K, T)[None]), GRAVITY, rtol=1e-13)


def test_magnitudes_are_those_of_the_matrices_and_of_the_symmetric_form(held):
    model = model_of(held)
    bias, scale = BIAS + np.array([40.0, -20.0, 10.0]), K * np.diag([1.01, 0.98, 1.02])
    z = model.simulate(x_of(model, bias, scale, T)[None])[0]
    np.testing.assert_allclose(z, np.linalg.norm((held - bias) @ (T @ scale).T, axis=1), rtol=1e-13)
    # |M v| = |S v| for M = U S; the triad counts in units in which S is near I.
    S = polar(T @ scale)[1] / 0.0024
    triad = Triad(outputs=tuple(map(tuple, held.tolist())), field=GRAVITY / 0.0024, unit="counts")
    values = np.array([*bias, *(1e6 * (np.diag(S) - 1.0)), *(1e3 * S[[0, 0, 1], [1, 2, 2]])])
    np.testing.assert_allclose(triad.simulate((values / triad.sizes)[None])[0] * 0.0024, z, rtol=1e-12)


def test_a_calibration_with_noise_is_scipys(held):
    counts = held + np.random.default_rng(1).normal(size=held.shape)
    model = model_of(counts)
    problem = Problem(model, Covariance(np.full(model.m, 0.0025)))
    estimates = GaussNewton(start="nominal").estimate(problem, np.full((1, 35), GRAVITY))
    assert estimates.status[0] == 0

    def residuals(p):
        upper = np.array([[1.0, -p[6], p[7]], [0.0, 1.0, -p[8]], [0.0, 0.0, 1.0]]) * p[3:6]
        return np.linalg.norm((counts - 1e4 * p[:3]) @ upper.T * 1e-3, axis=1) - GRAVITY

    start = np.array([3.2768, 3.2768, 3.2768, 2.4, 2.4, 2.4, 0.0, 0.0, 0.0])
    p = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    theirs = x_of(model, 1e4 * p[:3], np.diag(1e-3 * p[3:6]), np.array([[1, -p[6], p[7]], [0, 1, -p[8]], [0, 0, 1]]))
    np.testing.assert_allclose(estimates.x[0], theirs, atol=1e-6)
    # One count is 2.4e-3 m/s^2, and 35 attitudes average it.
    np.testing.assert_allclose((estimates.x[0] * model.sizes)[:3], BIAS, atol=2.0)


def test_the_presumed_triad_of_the_default_sees_gravity():
    model = Accelerometer(misalignment=(0.01, -0.02, 0.005), scale=(0.002, 0.003, 0.0025))
    np.testing.assert_allclose(model.simulate(model.nominal[None]), 9.80665, rtol=1e-13)
