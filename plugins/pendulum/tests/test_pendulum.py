"""The pendulum swings as Jacobi's functions say, and decays as a linear oscillator where it swings
little."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipj

sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_pendulum import Pendulum

import ipe_bench as ib
from ipe_bench.noise import Gaussian
from ipe_bench.solvers import Progressive
from ipe_bench.workshop.conformance import check_component


def test_keeps_its_promises():
    assert not [
        finding
        for finding in check_component("pendulum", Pendulum(readings=12))
        if finding.complaint
    ]


@pytest.mark.parametrize("angle", [0.1, 1.2, 3.0])
def test_swings_without_damping_as_jacobis_elliptic_functions(angle):
    model = Pendulum(angle=angle, damping=0.0, gravity=9.81, length=0.7)
    k = np.sin(angle / 2)
    _, cn, dn, _ = ellipj(np.sqrt(9.81 / 0.7) * model.times, k**2)
    assert np.allclose(
        model.simulate(model.nominal[None])[0], 2 * np.arcsin(k * cn / dn), rtol=0, atol=2e-8
    )


def test_swings_little_as_a_damped_oscillator():
    model = Pendulum(angle=1e-4, damping=0.5, length=2.0)
    b, w = 0.25, np.sqrt(model.gravity / 2.0 - 0.25**2)
    t = model.times
    exact = 1e-4 * np.exp(-b * t) * (np.cos(w * t) + b / w * np.sin(w * t))
    assert np.allclose(model.simulate(model.nominal[None])[0], exact, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_many_swings_are_too_many_for_gauss_newton_but_not_for_progressive():
    bench = ib.Scenario(Pendulum(), Gaussian(0.01), error_scale=10.0)
    drawn = bench.draw(0, 8)
    errors = {}
    for name, estimator in {"gn": ib.baselines.GaussNewton(), "progressive": Progressive()}.items():
        with np.errstate(all="ignore"):  # Gauss-Newton runs away to where numbers end
            found = estimator.estimate(bench.problem, drawn.z).x
        errors[name] = np.abs(found - drawn.x)[:, 0] * bench.measurement.length_size
    assert (errors["progressive"] < 2e-3).all()
    assert (errors["gn"] > 0.05).sum() >= 3
