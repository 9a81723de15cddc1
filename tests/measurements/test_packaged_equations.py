"""The models that are described in the configs, against closed forms, invariants and other
integrators."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, curve_fit
from scipy.special import expi
from shared.oracles import assert_agrees

from ipe_bench.baselines import MultiscaleLM
from ipe_bench.basics.linalg import Covariance
from ipe_bench.cli.session import jobs_of, session
from ipe_bench.cli.words import read
from ipe_bench.measurements import FallingBody, LotkaVolterra, Ode, Sir
from ipe_bench.measurements.problem import Problem
from ipe_bench.workshop.conformance import check_component

FOOT = 0.3048
# Boys confined to bed, 22 January to 4 February 1978 (British Medical Journal, 4 March 1978, p.
# 587).
IN_BED = np.array([3, 8, 26, 76, 225, 298, 258, 233, 189, 128, 68, 29, 14, 4], dtype=float)
COUNTED = {"susceptible": "S", "infected": "I", "removed": "population - S - I"}
PAPER = np.array([0.0, 0.0, 1.0])
"""The true falling body of both papers, in units of error from the presumed one."""
MODELS = {
    "sir": (
        Sir(),
        Sir(population=763.0, outputs={"removed": "population-S-I", "infected": "I"}),
        1 / 32,
        1e-6,
    ),
    "falling_body": (FallingBody(), FallingBody(density_decay=1.7e-4, altitude=9e4), 1 / 16, 1e-5),
    "lotka_volterra": (LotkaVolterra(), LotkaVolterra(birth=0.6), 1 / 64, 1e-6),
}


def draw(model, trials=20, scale=1.0):
    return model.nominal + scale * np.random.default_rng(0).normal(size=(trials, model.n))


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_that_of_its_config_and_keeps_the_promises_of_models(name):
    model, other, step, tolerance = MODELS[name]
    with session():
        (spec,) = jobs_of(read("run", [f"measurement={name}", "trials=4"]), multirun=False).specs
    assert spec.scenario.measurement.name == model.name == name
    assert spec.scenario.measurement == model
    assert isinstance(other, Ode)
    assert other != model
    assert not [
        f.complaint for one in (model, other) for f in check_component(name, one) if f.complaint
    ]
    x = draw(model, scale=3.0 if name == "sir" else 1.0)
    assert np.abs(model.simulate(x) - replace(model, step=step).simulate(x)).max() < tolerance


def epidemic(t, beta, gamma, infected, population=763.0):
    """(S, I) by an adaptive integrator."""
    return solve_ivp(
        lambda t, y: [
            -beta * y[0] * y[1] / population,
            beta * y[0] * y[1] / population - gamma * y[1],
        ],
        (0.0, t[-1]),
        [population - infected, infected],
        "DOP853",
        t_eval=t,
        rtol=1e-12,
        atol=1e-12,
    ).y


def epidemics(model, x):
    """beta, gamma and I(0), each (trials,), from x (trials, 3)."""
    beta, gamma, odds = np.array([1.66, 0.44, 1.0 / 762.0])[:, None] * np.exp(x * model.sizes).T
    return beta, gamma, 763.0 * odds / (1.0 + odds)


@pytest.mark.oracle("closed form: first integral of the SIR equations", "what is conserved", 1e-8)
def test_an_epidemic_conserves_what_its_equations_conserve_whatever_is_drawn():
    model = Sir(outputs=COUNTED)
    x = draw(model, scale=3.0)
    beta, gamma, infected = (value[:, None] for value in epidemics(model, x))
    S, I, R = np.moveaxis(model.simulate(x).reshape(len(x), -1, 3), 2, 0)  # noqa: E741
    start = 763.0 - 763.0 * gamma / beta * np.log(763.0 - infected)
    assert_agrees(
        S + I - 763.0 * gamma / beta * np.log(S), np.broadcast_to(start, S.shape), rtol=1e-8
    )
    np.testing.assert_allclose(S + I + R, 763.0, rtol=1e-14)
    far = np.vstack([draw(model, 200, scale=10.0), [[0.0, 0.0, 40.0], [0.0, 0.0, -40.0]]])
    z = model.simulate(far)
    # People, to the accuracy of the integration at rates up to e^3 times the presumed ones.
    assert ((z > -1e-3) & (z < 763.001)).all()


@pytest.mark.oracle("library: SciPy's DOP853", "infected people of 763", 1e-6)
def test_an_epidemic_that_is_over_has_its_final_size_and_another_is_that_of_scipy():
    final = brentq(lambda s: np.log(s / 762.0) - 1.66 / 0.44 / 763.0 * (s - 763.0), 1e-6, 500.0)
    over = Sir(outputs={"susceptible": "S"}, readings=200)
    assert over.simulate(np.zeros((1, 3)))[0, -1] == pytest.approx(final, rel=1e-8)
    model = Sir()
    x = draw(model, 5, scale=3.0)
    for z, *values in zip(model.simulate(x), *epidemics(model, x), strict=True):
        assert_agrees(z, epidemic(model.whole.times, *values)[1], atol=1e-6)


@pytest.mark.oracle(
    "library: SciPy's curve_fit", "estimates from the boys in bed of a boarding school (1978)", 1e-4
)
def test_the_boarding_school_is_estimated_as_scipy_estimates_it():
    model = Sir()
    estimates = MultiscaleLM().estimate(Problem(model, Covariance(np.full(14, 20.0))), IN_BED[None])
    assert estimates.status[0] == 0
    days = np.arange(1.0, 15.0)
    theirs, _ = curve_fit(
        lambda t, *p: epidemic(t, *np.exp(p))[1], days, IN_BED, np.log([1.66, 0.44, 1.0])
    )
    assert_agrees(np.ravel(epidemics(model, estimates.x)), np.exp(theirs), rtol=1e-4)
    residuals = IN_BED - model.simulate(estimates.x)[0]
    assert 15.0 < np.sqrt(residuals @ residuals / 11) < 25.0


def altitude(t, h0, v0, b, gamma):
    """With u = exp(-gamma h): gamma v0 t = exp(-a u0) (Ei(a u) - Ei(a u0)), a = b / gamma, by
    separation."""
    a, u0 = b / gamma, np.exp(-gamma * h0)
    time = lambda u: np.exp(-a * u0) * (expi(a * u) - expi(a * u0)) / (gamma * v0) - t  # noqa: E731
    return -np.log(brentq(time, u0, 700.0 / a, xtol=1e-18, rtol=1e-14)) / gamma


@pytest.mark.oracle("closed form: separated equation, by the exponential integral", "ranges", 1e-9)
def test_ranges_of_a_falling_body_are_those_of_the_closed_form():
    model = FallingBody(readings=20)
    x = np.vstack([model.nominal + PAPER, draw(model, 4)])
    for row, z in zip(x, model.simulate(x), strict=True):
        h0, v0, log_b = row * model.sizes
        b = 3e-5 / FOOT * np.exp(log_b)
        h = np.array([altitude(t, h0, v0, b, 5e-5 / FOOT) for t in range(1, 21)])
        assert_agrees(z, np.hypot(1e5 * FOOT, h - 1e5 * FOOT), rtol=1e-9)


@pytest.mark.oracle("library: SciPy's Radau", "ranges, m", 1e-3)
@pytest.mark.parametrize(
    "ln_ballistic", [*(pytest.param(far, marks=pytest.mark.slow) for far in (10.0, 17.0)), 18.0]
)
def test_a_body_that_is_stopped_at_once_is_followed_as_well(ln_ballistic):
    """With steps of half a second the ranges are off by 13.5 m at 17, by 297 m at 17.4, and no
    numbers at 18."""
    model = FallingBody()
    x = model.nominal + np.array([0.0, 0.0, ln_ballistic]) / model.sizes
    b, gamma = 3e-5 / FOOT * np.exp(ln_ballistic), 5e-5 / FOOT
    solution = solve_ivp(
        lambda t, y: [-y[1], -b * np.exp(-gamma * y[0]) * y[1] ** 2],
        (0.0, 60.0),
        [3e5 * FOOT, 2e4 * FOOT],
        "Radau",
        t_eval=np.arange(1.0, 61.0),
        rtol=1e-11,
        atol=1e-9,
    )
    ranges = np.hypot(1e5 * FOOT, solution.y[0] - 1e5 * FOOT)
    assert_agrees(model.simulate(x[None])[0], ranges, atol=1e-3)


@pytest.mark.oracle("library: SciPy's DOP853", "prey and predators", 1e-6)
def test_predators_and_prey_conserve_what_their_equations_conserve_and_agree_with_scipy():
    model = LotkaVolterra()
    x = draw(model, 30, scale=3.0)
    birth, hunting, death, growth, prey, predators = (x * model.sizes).T[:, :, None]
    u, v = np.moveaxis(model.simulate(x).reshape(30, -1, 2), 2, 0)

    def conserved(u, v):
        return growth * u - death * np.log(u) + hunting * v - birth * np.log(v)

    np.testing.assert_allclose(
        conserved(u, v), np.broadcast_to(conserved(prey, predators), u.shape), rtol=1e-8
    )
    for row, z in zip(x[:3], model.simulate(x[:3]), strict=True):
        b, m, d, g, u0, v0 = row * model.sizes
        solution = solve_ivp(
            lambda t, y, b=b, m=m, d=d, g=g: [
                b * y[0] - m * y[0] * y[1],
                g * y[0] * y[1] - d * y[1],
            ],
            (0.0, 20.0),
            [u0, v0],
            "DOP853",
            t_eval=np.arange(1.0, 21.0),
            rtol=1e-12,
            atol=1e-12,
        )
        assert_agrees(z.reshape(-1, 2), solution.y.T, atol=1e-6)
