"""Bock's problem: its closed form, and what forward integration makes of it."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from ipe_bench.baselines import MultiscaleLM
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Bock
from ipe_bench.measurements.problem import Problem
from ipe_bench.plugins.conformance import check_component


def test_the_closed_form_solves_the_equation_as_a_boundary_value_problem():
    """From the ends, where nothing grows, another solver finds between them what the closed form says."""
    model = Bock(mu=10.0, initial=True, readings=20)
    p, x1, x2 = 2.5, 0.1, 2.4
    z = model.exact(np.array([[p, x1, x2]]) / model.sizes).reshape(-1, 2)
    solution = solve_bvp(
        lambda t, y: np.vstack([y[1], 100.0 * y[0] - (100.0 + p**2) * np.sin(p * t)]),
        lambda a, b: np.array([a[0] - x1, b[0] - z[-1, 0]]),
        np.linspace(0, 1, 50),
        np.zeros((2, 50)),
        tol=1e-9,
        max_nodes=100_000,
    )
    assert solution.sol(0.0)[1] == pytest.approx(x2, rel=1e-5)
    np.testing.assert_allclose(solution.sol(model.times), z.T, rtol=1e-5)


@pytest.mark.parametrize("mu", [10.0, 30.0, 60.0])
@pytest.mark.parametrize("initial", [False, True])
def test_integration_agrees_with_the_closed_form_to_round_off_that_has_grown(mu, initial):
    model = Bock(mu=mu, initial=initial)
    x = model.nominal + np.random.default_rng(0).normal(size=(10, model.n))
    growth = np.repeat(np.cosh(mu * model.times), 2)
    scale = growth * np.abs(model.exact(x)).max(axis=1, keepdims=True) / growth[-1]
    assert (np.abs(model.simulate(x) - model.exact(x)) < 1e-11 * np.maximum(scale, growth)).all()


def test_forward_integration_keeps_the_true_trajectory_for_a_mild_rate_and_loses_it_for_the_classic_one():
    def lost(mu):
        model = Bock(mu=mu)
        return np.abs(model.simulate(model.recorded.x[None])[0] - model.recorded.z).max()

    assert lost(10.0) < 1e-9
    # Whatever arithmetic does, errors of 1e-17 have grown by exp(60) = 1e26.
    assert 1e4 < lost(60.0) < 1e14


def test_recorded_readings_are_the_sine_and_the_answer_is_pi():
    model = Bock(readings=4, initial=True)
    half = np.sqrt(0.5)
    expected = [half, np.pi * half, 1.0, 0.0, half, -np.pi * half, 0.0, -np.pi]
    np.testing.assert_allclose(model.recorded.z, expected, atol=1e-14)
    np.testing.assert_allclose(model.recorded.x * model.sizes, [np.pi, 0.0, np.pi], rtol=1e-15)


def test_the_parameter_is_found_where_the_rate_is_mild():
    model = Bock(mu=10.0)
    known = model.recorded
    estimates = MultiscaleLM().estimate(Problem(model, known.R), known.z[None])
    assert (estimates.x[0] * model.sizes)[0] == pytest.approx(np.pi, abs=1e-9)


@pytest.mark.parametrize("initial", [False, True])
def test_it_keeps_the_promises_of_models(initial):
    assert not [f.complaint for f in check_component("bock", Bock(initial=initial)) if f.complaint]


@pytest.mark.parametrize(("field", "value"), [("mu", 0.0), ("readings", 1), ("deviation", 0.0)])
def test_mistakes_are_named(field, value):
    with pytest.raises(UserError, match=rf"^{field}="):
        Bock(**{field: value})
