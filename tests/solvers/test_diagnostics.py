"""Diagnostics against systems whose answers are known in closed form."""

from __future__ import annotations

import numpy as np
from small_models import Bent

from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Gins, Polynomial
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import FixedPoint, Newton
from ipe_bench.statistics.theory import (
    convergence,
    covariances,
    false_roots,
    fixed_point_bound,
    order_of_convergence,
    quadratic_constant,
)
from ipe_bench.trials.contraction import contraction
from ipe_bench.trials.roots import frozen_root
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block


def test_a_linear_model_contracts_at_once():
    problem = Problem(Bent(), Covariance(np.full(12, 0.3)), None)
    found = contraction(problem, np.random.default_rng(0).normal(size=(5, 3)))
    for values in (found.K, found.infinity_norm, found.spectral_radius):
        np.testing.assert_allclose(values, 0.0, atol=1e-12)


def test_the_three_contractions_stand_in_order():
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 33.0)
    trials = scenario.draw(0, 30)
    found = contraction(scenario.problem, trials.x)
    assert (found.spectral_radius <= found.infinity_norm * (1 + 1e-12)).all()
    assert (found.infinity_norm <= found.K * (1 + 1e-12)).all()
    # K says nothing here, and all trials converge.
    assert np.median(found.K) > 1
    assert (found.spectral_radius < 1).all()
    assert (FixedPoint().estimate(scenario.problem, trials.z).status == Status.CONVERGED).all()


def test_eq_18_holds_with_the_k_that_the_print_lost():
    """g(x) = x/2 has K = 1/2 and |x_k| = 2^-k, where the bound is 2^-k as well: sharp."""
    iterates = 0.5 ** np.arange(12)[:, None]
    found = fixed_point_bound(iterates, np.zeros(1), 0.5)
    np.testing.assert_allclose(found.bound, found.error, rtol=1e-12)
    assert found.holds
    assert not fixed_point_bound(iterates, np.zeros(1), 0.4).holds
    assert np.isinf(fixed_point_bound(iterates, np.zeros(1), 1.5).bound).all()


def test_eq_18_holds_on_gins_at_scale_1():
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 1.0)
    trials = scenario.draw(0, 10)
    histories = FixedPoint(tolerance=1e-9).estimate(scenario.problem, trials.z, history=True).history
    root = frozen_root(scenario.problem, trials.z, trials.x)
    for iterates, x in zip(histories, root, strict=True):
        K = 1.05 * contraction(scenario.problem, iterates).K.max()
        assert K < 1
        bound = fixed_point_bound(iterates, x, K)
        assert (bound.error[:3] <= bound.bound[:3]).all()


def test_orders_of_sequences_are_recovered():
    linear = 0.3 ** np.arange(10)[:, None]
    quadratic = 0.5 ** (2.0 ** np.arange(6))[:, None]
    assert abs(order_of_convergence(linear, np.zeros(1)).order - 1) < 1e-9
    assert abs(order_of_convergence(linear, np.zeros(1)).rate - 0.3) < 1e-9
    assert abs(order_of_convergence(quadratic, np.zeros(1)).order - 2) < 1e-9
    assert np.isnan(order_of_convergence(linear[:2], np.zeros(1)).order)


def test_orders_on_gins_are_linear_and_quadratic():
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 100.0)
    trials = scenario.draw(0, 20)
    problem = scenario.problem
    root = frozen_root(problem, trials.z, trials.x)
    deviation = np.sqrt(np.diagonal(covariances(problem, trials.x, trials.x, np.ones(20, bool)).linear))
    orders = {}
    for solver in (FixedPoint(), Newton()):
        histories = solver.estimate(problem, trials.z, history=True).history
        found = [order_of_convergence(h, x, deviation, 1e-5) for h, x in zip(histories, root, strict=True)]
        orders[type(solver)] = np.nanmedian([f.order for f in found])
    assert 0.8 < orders[FixedPoint] < 1.2
    assert 1.7 < orders[Newton] < 2.3


def test_the_constant_of_eq_23_is_that_of_a_quadratic():
    """h(x) = A x + b (A x)^2 with one parameter: F'' = 2 b H+ A^2 and F' = H+ (A + 2 b A^2 x)."""
    scenario = Scenario(Polynomial(unknowns=1, strength=0.1), Gaussian(0.01), GaussianPrior(), 1.0)
    problem, trials = scenario.problem, scenario.draw(0, 1)
    root = frozen_root(problem, trials.z, trials.x)[0]
    iterates = Newton(start="nominal").estimate(problem, trials.z, history=True).history[0]
    found = quadratic_constant(problem, iterates, root)
    u, s = root[0], 0.1
    np.testing.assert_allclose(found.M, (s + s**2 * u) / (1 + s * u + s**2 * u**2 / 2), rtol=1e-5)
    assert 0.5 * found.M < found.observed < 2 * found.M


def test_covariances_of_a_mild_model_agree():
    scenario = Scenario(Polynomial(strength=0.002), Gaussian(0.1), GaussianPrior(), 1.0)
    trials = scenario.draw(0, 3000)
    estimates = Newton().estimate(scenario.problem, trials.z)
    solved = estimates.status == Status.CONVERGED
    found = covariances(scenario.problem, estimates.x, trials.x, solved)
    assert found.trials == 3000
    for P in (found.sandwich, found.crlb, found.monte_carlo, found.compensation):
        np.testing.assert_allclose(np.diag(P), np.diag(found.linear), rtol=0.12)
    # At one point the sandwich is never below the Cramer-Rao bound.
    here = covariances(scenario.problem, trials.x, trials.x, solved)
    assert np.linalg.eigvalsh(here.sandwich - here.crlb).min() > -1e-15


def test_false_roots_are_those_that_converged_elsewhere():
    x = np.array([[0.0], [1.0], [1.0], [0.0]])
    status = np.array([Status.CONVERGED, Status.CONVERGED, Status.DIVERGED, Status.CONVERGED], np.int8)
    reference = np.array([[0.0], [0.0], [0.0], [np.nan]])
    found = false_roots(x, status, reference, np.full((4, 1), 0.5))
    assert found.trials.tolist() == [False, True, False, True]
    assert found.distance[1] == 2.0
    assert found.share == 0.5


def test_a_convergence_curve_keeps_what_has_finished():
    histories = [np.array([[4.0], [2.0]]), np.array([[8.0], [4.0], [1.0]]), np.array([[4.0], [4.0], [4.0]])]
    found = convergence(histories, np.zeros((3, 1)), np.array([2.0]))
    assert found.iteration.tolist() == [0, 1, 2]
    assert found.median.tolist() == [2.0, 2.0, 1.0]


def test_stored_contraction_is_that_of_the_model_at_the_truth():
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.01), GaussianPrior(), 1.0)
    block = Block.draw(scenario, 0, 5)
    columns = block.truth_columns()
    model = scenario.measurement
    slope = np.eye(4) - np.linalg.pinv(model.matrix) @ model.jacobian(block.trials.x)
    np.testing.assert_allclose(columns["contraction_K"], 4 * np.abs(slope).max(axis=(1, 2)), rtol=1e-9)
    np.testing.assert_allclose(columns["contraction_norm"], np.abs(slope).sum(axis=2).max(axis=1), rtol=1e-9)
    radius = [np.abs(np.linalg.eigvals(s)).max() for s in slope]
    np.testing.assert_allclose(columns["contraction_radius"], radius, rtol=1e-7)
