"""Predators and prey: an invariant of the equations, and another integrator."""

import inspect
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from ipe_bench.measurements import LotkaVolterra, lotka_volterra


def draw(model, trials):
    return model.nominal + 3.0 * np.random.default_rng(0).normal(size=(trials, model.n))


def test_the_quantity_that_the_equations_conserve_is_conserved():
    model = LotkaVolterra()
    x = draw(model, 30)
    birth, hunting, death, growth, prey, predators = (x * model.sizes).T[:, :, None]
    u, v = np.moveaxis(model.simulate(x).reshape(30, -1, 2), 2, 0)

    def conserved(u, v):
        return growth * u - death * np.log(u) + hunting * v - birth * np.log(v)

    np.testing.assert_allclose(conserved(u, v), np.broadcast_to(conserved(prey, predators), u.shape), rtol=1e-8)


def test_readings_agree_with_an_adaptive_integrator():
    model = LotkaVolterra()
    x = draw(model, 3)
    for row, z in zip(x, model.simulate(x), strict=True):
        p = row * model.sizes
        solution = solve_ivp(
            lambda t, y, p=p: model.rhs(t, y, p, []),
            (0.0, 20.0),
            p[4:],
            "DOP853",
            t_eval=model.times,
            rtol=1e-12,
            atol=1e-12,
        )
        np.testing.assert_allclose(z.reshape(-1, 2), solution.y.T, atol=1e-6)


def test_the_step_is_short_enough_to_be_seen_in_no_reading():
    model = LotkaVolterra()
    x = model.nominal + np.array([[1.0], [3.0], [10.0]])[:, :, None] * np.random.default_rng(1).normal(size=(3, 20, 6))
    x = x.reshape(-1, 6)
    assert np.abs(model.simulate(x) - replace(model, step=1 / 64).simulate(x)).max() < 1e-6


def test_its_class_is_as_short_as_the_docs_of_ode_promise():
    lines = inspect.getsource(lotka_volterra).splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 30
