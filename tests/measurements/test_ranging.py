"""Ranging against the closed form of the same problem."""

import numpy as np
import pytest

from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Ranging
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers import Newton


def bancroft(beacons, pseudoranges):
    """Position and clock bias (4,) from pseudoranges, algebraically (Bancroft 1985); the root that fits better."""
    B = np.column_stack([beacons, pseudoranges])
    lorentz = np.array([1.0, 1.0, 1.0, -1.0])
    a = (B**2) @ lorentz / 2
    u, v = np.linalg.lstsq(B, np.column_stack([np.ones(len(B)), a]), rcond=None)[0].T
    inner = [u @ (lorentz * u), 2 * (u @ (lorentz * v) - 1), v @ (lorentz * v)]
    solutions = [lorentz * (root * u + v) for root in np.real(np.roots(inner))]

    def misfit(s):
        return np.abs(np.linalg.norm(beacons - s[:3], axis=1) + s[3] - pseudoranges).max()

    return min(solutions, key=misfit)


@pytest.fixture
def trials():
    model = Ranging(rounds=1)
    x = model.nominal + 3.0 * np.random.default_rng(4).normal(size=(20, 4))
    return model, x, model.simulate(x)


def test_bancrofts_closed_form_inverts_the_model(trials):
    model, x, z = trials
    for truth, ranges in zip(x, z, strict=True):
        solution = bancroft(np.array(model.beacons), ranges)
        np.testing.assert_allclose(solution, truth * model.sizes, atol=1e-6)


def test_the_iterated_estimate_is_bancrofts_where_readings_are_exact(trials):
    model, _, z = trials
    estimates = Newton(tolerance=1e-9).estimate(Problem(model, Covariance(np.full(model.m, 0.1))), z)
    assert (estimates.status == 0).all()
    closed = np.stack([bancroft(np.array(model.beacons), ranges) for ranges in z])
    np.testing.assert_allclose(estimates.x * model.sizes, closed, atol=1e-6)


def test_a_clock_bias_adds_to_every_range_and_rounds_repeat():
    model = Ranging(rounds=2)
    z = model.simulate(np.array([[0.0, 0, 0, 0], [0.0, 0, 0, 1.5]]))
    np.testing.assert_allclose(z[1] - z[0], 15.0, atol=1e-12)
    assert z[0, 0] == np.hypot(1000.0, 300.0)
    assert (z[:, :7] == z[:, 7:]).all()
    assert [len(rows) for rows in model.epochs] == [7, 7]
