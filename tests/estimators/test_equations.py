"""Eqs. (2), (5), (11) = (19), (15), (17), (18) and (24) as identities, on random systems."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from shared.oracles import assert_agrees
from shared.small_models import Bent

from ipe_bench.baselines import LinearLSE
from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers import FixedPoint, Newton

SIGMA = 0.3
seeds = st.integers(0, 2**32 - 1)
vectors = arrays(float, 3, elements=st.floats(-5, 5))


def problem_of(bend: float = 0.0, seed: int = 7, sigma: float = SIGMA) -> Problem:
    model = Bent(bend, seed)
    return Problem(model, Covariance(np.full(model.m, sigma)), np.ones(3))


@pytest.mark.oracle("library: NumPy's lstsq", "estimates of eq. (2)", 1e-9)
@given(seeds, vectors)
@settings(deadline=None, max_examples=30)
def test_linear_lse_is_the_normal_equation_of_eq_2_and_its_covariance_eq_5(seed, x):
    problem = problem_of(seed=seed)
    A = problem.measurement.A
    z = A @ x + np.random.default_rng(seed).normal(size=len(A))
    estimates = LinearLSE().estimate(problem, z[None])
    assert_agrees(estimates.x[0], np.linalg.lstsq(A, z, rcond=None)[0], atol=1e-9)
    np.testing.assert_allclose(
        estimates.covariance[0], SIGMA**2 * np.linalg.inv(A.T @ A), rtol=1e-8, atol=1e-12
    )


@pytest.mark.oracle(
    "own second implementation: eqs. (11) and (24) by plain matrices", "F of eq. (19)", 1e-8
)
@given(seeds, vectors, st.floats(-0.1, 0.1))
@settings(deadline=None, max_examples=30)
def test_eq_19_is_eq_11_with_the_nonlinear_term_of_eq_24(seed, x, bend):
    problem = problem_of(bend, seed)
    model, A = problem.measurement, problem.measurement.A
    z = np.random.default_rng(seed).normal(size=model.m)
    H_plus = np.linalg.inv(A.T @ A) @ A.T
    N = model.simulate(x[None])[0] - A @ x  # eq. (24)
    expected = x - H_plus @ (z - N)  # eq. (19)
    F = FrozenSystem.at_nominal(problem, z[None]).F(x[None])[0]
    assert_agrees(F, expected, atol=1e-8)


@pytest.mark.oracle("own second implementation: eq. (11) by plain matrices", "root", 1e-11)
def test_a_root_of_F_solves_eq_11():
    problem = problem_of(bend=0.02)
    model, A = problem.measurement, problem.measurement.A
    z = model.simulate(np.array([[1.0, -0.5, 0.8]])) + 0.01
    x = Newton(tolerance=1e-12).estimate(problem, z).x[0]
    N = model.simulate(x[None])[0] - A @ x
    assert_agrees(x, np.linalg.pinv(A) @ (z[0] - N), atol=1e-11)


@pytest.mark.oracle(
    "own second implementation: eqs. (16) and (17) by plain matrices", "iterates", 1e-12
)
def test_fixed_point_iterates_are_those_of_eqs_16_and_17():
    problem = problem_of(bend=0.02)
    model, A = problem.measurement, problem.measurement.A
    z = model.simulate(np.array([[1.0, -0.5, 0.8]]))
    history = FixedPoint().estimate(problem, z, history=True).history[0]
    H_plus = np.linalg.pinv(A)
    x = H_plus @ z[0]
    for iterate in history[:4]:
        assert_agrees(iterate, x, atol=1e-12)
        x = H_plus @ (z[0] - (model.simulate(x[None])[0] - A @ x))


def test_sandwich_is_the_spread_of_the_roots():
    problem = problem_of(bend=0.03, sigma=0.01)
    model, truth = problem.measurement, np.array([[1.0, -0.5, 0.8]])
    rng = np.random.default_rng(3)
    z = model.simulate(truth) + 0.01 * rng.standard_normal((40_000, model.m))
    estimates = Newton().estimate(problem, z)
    assert (estimates.status == Status.CONVERGED).all()
    system = FrozenSystem.at_nominal(problem, model.simulate(truth))
    P = system.sandwich(truth)[0]
    np.testing.assert_allclose(
        np.cov(estimates.x.T), P, atol=4 * np.sqrt(2 / 40_000) * np.abs(P).max()
    )
    assert np.trace(P) > np.trace(system.covariance()[0]) * 0.1


def test_the_reported_covariance_is_that_of_small_errors_of_the_readings():
    """x(z + dz) - x(z) = G dz to first order, so R spreads estimates by G R G'; G by differences of
    estimates."""
    problem = problem_of(bend=0.02)
    z = problem.measurement.simulate(np.array([[2.0, -1.5, 1.0]]))[0]
    step = 1e-5
    rows = np.concatenate([[z], z + step * np.eye(len(z)), z - step * np.eye(len(z))])
    found = Newton(tolerance=1e-12).estimate(problem, rows)
    assert (found.status == Status.CONVERGED).all()
    G = (found.x[1 : len(z) + 1] - found.x[len(z) + 1 :]).T / (2 * step)
    np.testing.assert_allclose(found.covariance[0], SIGMA**2 * G @ G.T, rtol=1e-5, atol=1e-9)
