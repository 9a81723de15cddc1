"""The epidemic against what its equations conserve, its final size, another integrator and a recorded outbreak."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, curve_fit

from ipe_bench.baselines import MultiscaleLM
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Sir
from ipe_bench.measurements.problem import Problem
from ipe_bench.plugins.conformance import check_component

# Boys confined to bed, 22 January to 4 February 1978 (British Medical Journal, 4 March 1978, p. 587).
IN_BED = np.array([3, 8, 26, 76, 225, 298, 258, 233, 189, 128, 68, 29, 14, 4], dtype=float)


def draw(model, trials=20, scale=3.0):
    return scale * np.random.default_rng(0).normal(size=(trials, model.n))


def epidemic(t, beta, gamma, infected, population=763.0):
    """(S, I) by an adaptive integrator."""
    return solve_ivp(
        lambda t, y: [-beta * y[0] * y[1] / population, beta * y[0] * y[1] / population - gamma * y[1]],
        (0.0, t[-1]),
        [population - infected, infected],
        "DOP853",
        t_eval=t,
        rtol=1e-12,
        atol=1e-12,
    ).y


def physical(model, x):
    """beta, gamma and I(0), each (trials,), from x (trials, 3)."""
    beta, gamma, odds = np.array([1.66, 0.44, 1.0 / 762.0])[:, None] * np.exp(x * model.sizes).T
    return beta, gamma, 763.0 * odds / (1.0 + odds)


def test_the_quantity_that_the_equations_conserve_is_conserved():
    model = Sir(observed=("susceptible", "infected", "removed"))
    x = draw(model)
    beta, gamma, infected = (value[:, None] for value in physical(model, x))
    S, I, R = np.moveaxis(model.simulate(x).reshape(len(x), -1, 3), 2, 0)  # noqa: E741
    conserved = S + I - 763.0 * gamma / beta * np.log(S)
    start = 763.0 - 763.0 * gamma / beta * np.log(763.0 - infected)
    np.testing.assert_allclose(conserved, np.broadcast_to(start, S.shape), rtol=1e-8)
    np.testing.assert_allclose(S + I + R, 763.0, rtol=1e-14)


def test_an_epidemic_that_is_over_has_its_final_size():
    model = Sir(observed=("susceptible",), days=200)
    final = brentq(lambda s: np.log(s / 762.0) - 1.66 / 0.44 / 763.0 * (s - 763.0), 1e-6, 500.0)
    assert model.simulate(np.zeros((1, 3)))[0, -1] == pytest.approx(final, rel=1e-8)


def test_readings_agree_with_an_adaptive_integrator():
    model = Sir()
    x = draw(model, 5)
    for z, *values in zip(model.simulate(x), *physical(model, x), strict=True):
        np.testing.assert_allclose(z, epidemic(model.times, *values)[1], atol=1e-6)


def test_every_draw_is_an_epidemic():
    model = Sir(observed=("susceptible", "infected", "removed"))
    z = model.simulate(np.vstack([draw(model, 200, scale=10.0), [[0.0, 0.0, 40.0], [0.0, 0.0, -40.0]]]))
    # People, to the accuracy of the integration at rates up to e^3 times the presumed ones.
    assert ((z > -1e-3) & (z < 763.001)).all()


def test_the_boarding_school_is_estimated_as_scipy_estimates_it():
    model = Sir()
    estimates = MultiscaleLM().estimate(Problem(model, Covariance(np.full(14, 20.0))), IN_BED[None])
    assert estimates.status[0] == 0
    theirs, _ = curve_fit(lambda t, *p: epidemic(t, *np.exp(p))[1], model.times, IN_BED, np.log([1.66, 0.44, 1.0]))
    np.testing.assert_allclose(np.ravel(physical(model, estimates.x)), np.exp(theirs), rtol=1e-4)
    residuals = IN_BED - model.simulate(estimates.x)[0]
    assert 15.0 < np.sqrt(residuals @ residuals / 11) < 25.0


def test_the_step_is_short_enough_to_be_seen_in_no_reading():
    model = Sir()
    x = draw(model)
    assert np.abs(model.simulate(x) - replace(model, step=1 / 32).simulate(x)).max() < 1e-6


@pytest.mark.parametrize("observed", [("infected",), ("removed", "infected")])
def test_it_keeps_the_promises_of_models(observed):
    assert not [f.complaint for f in check_component("sir", Sir(observed=observed)) if f.complaint]


@pytest.mark.parametrize(
    ("field", "value"), [("infection", -1.0), ("infected", 800.0), ("observed", ("dead",)), ("days", 3)]
)
def test_mistakes_are_named(field, value):
    with pytest.raises(UserError, match=rf"^{field}(\[0\])?="):
        Sir(**{field: value})
