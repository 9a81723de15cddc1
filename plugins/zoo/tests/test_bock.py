"""Bock's problem against its closed form."""

from dataclasses import replace

import numpy as np
import pytest
from ipe_bench_zoo import Bock
from shared.oracles import assert_agrees
from shared.small_models import bock

from ipe_bench.baselines import MultiscaleLM
from ipe_bench.measurements.problem import Problem
from ipe_bench.workshop.conformance import check_component


def _draw(model, trials=20):
    return model.nominal + np.random.default_rng(0).normal(size=(trials, model.n))


def test_the_model_keeps_the_promises_of_models():
    for model in (Bock(mu=10.0), bock(10.0)):
        assert not [f.complaint for f in check_component("bock", model) if f.complaint]
        x = model.nominal + np.random.default_rng(0).normal(size=(20, model.n))
        assert np.abs(model.simulate(x) - replace(model, step=1 / 640).simulate(x)).max() < 1e-9


@pytest.mark.parametrize("mu", [10.0, 30.0, 60.0])
@pytest.mark.parametrize("make", [bock, lambda mu: Bock(mu=mu)], ids=["initial", "rate"])
def test_bocks_readings_are_those_of_the_closed_form_to_round_off_that_has_grown(mu, make):
    model = make(mu)
    x, t = _draw(model, 10), model.whole.times
    exact, growth = closed_form(x * model.sizes, mu, t), np.repeat(np.cosh(mu * t), 2)
    scale = growth * np.abs(exact).max(axis=1, keepdims=True) / growth[-1]
    assert (np.abs(model.simulate(x) - exact) < 1e-11 * np.maximum(scale, growth)).all()


def test_forward_integration_keeps_bocks_trajectory_for_a_mild_rate_and_loses_it_for_the_classic():
    mild, classic = Bock(mu=10.0), Bock(mu=60.0)
    assert np.abs(mild.simulate(mild.recorded.x[None])[0] - mild.recorded.z).max() < 1e-9
    # Errors of 1e-17 grow by exp(60) = 1e26, and no two steps agree on them.
    assert np.isnan(classic.simulate(classic.recorded.x[None])).all()
    estimates = MultiscaleLM().estimate(Problem(mild, mild.recorded.R), mild.recorded.z[None])
    assert (estimates.x[0] * mild.sizes)[0] == pytest.approx(np.pi, abs=1e-9)


@pytest.mark.oracle("closed form: a sine", "readings of Bock's problem", 1e-14)
def test_bocks_recorded_readings_are_the_sine_and_the_answer_is_pi():
    model = replace(bock(60.0), readings=4, interval=0.25)
    half = np.sqrt(0.5)
    expected = [half, np.pi * half, 1.0, 0.0, half, -np.pi * half, 0.0, -np.pi]
    assert_agrees(model.recorded.z, expected, atol=1e-14)
    np.testing.assert_allclose(model.recorded.x * model.sizes, [np.pi, 0.0, np.pi], rtol=1e-15)
    np.testing.assert_array_equal(model.recorded.R.deviations, np.full(8, 0.05))
    assert replace(model, answer={"p": np.pi}).recorded is None


def closed_form(x, mu, t):
    """x1 = sin(p t) + x1(0) cosh(mu t) + (x2(0) - p) sinh(mu t) / mu and its derivative: (trials, 2
    times)."""
    values = x[:, :, None]
    p = values[:, 0]
    x1, x2 = (values[:, 1], values[:, 2]) if x.shape[1] == 3 else (0.0, np.pi)
    grow, fall = np.cosh(mu * t), np.sinh(mu * t)
    first = np.sin(p * t) + x1 * grow + (x2 - p) * fall / mu
    second = p * np.cos(p * t) + x1 * mu * fall + (x2 - p) * grow
    return np.stack([first, second], axis=2).reshape(len(x), -1)
