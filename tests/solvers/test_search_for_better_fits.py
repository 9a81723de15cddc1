"""When `progressive` and `auto` look for a better fit, what they find, and what they may spend on it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.measurements import Formula, LotkaVolterra, Ranging
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.fits import Fit, fit
from ipe_bench.solvers import Auto, Progressive
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block

PEAK = "c + A*exp(-(t-mu)**2/(2*w**2))"
T = np.linspace(0, 10, 60)


def fits(model: Formula, z: NDArray[np.float64], noise, estimator) -> Fit:
    problem = Scenario(model, noise).problem.without_prior()
    return fit(problem, z, {"it": estimator}, noise)[0]


@pytest.mark.parametrize("noise", [Gaussian(0.3), Unknown()], ids=["known level", "unknown level"])
def test_a_noisy_peak_is_found_from_anywhere(noise):
    """From 16 random starts, among flat lines and dips that are minima, too; an unknown level has no test of the fit to
    tell them."""
    rng = np.random.default_rng(7)
    truth = {"c": 1.0, "A": 3.0, "mu": 6.2, "w": 0.5}
    for i in range(16):
        uniform = ((-2, 3), (0.5, 6), (0, 10), (0.1, 3))
        start = {name: float(rng.uniform(*ends)) for name, ends in zip(truth, uniform, strict=True)}
        there = Formula(PEAK, truth, {"t": T.tolist()})
        z = there.simulate(there.nominal[None])[0] + 0.3 * np.random.default_rng(100 + i).standard_normal(60)
        best = fits(there, z, noise, LevenbergMarquardt(max_iterations=500))
        found = fits(Formula(PEAK, start, {"t": T.tolist()}), z, noise, Auto())
        assert np.sum(found.residuals**2) <= np.sum(best.residuals**2) * (1 + 1e-6), start


@pytest.mark.parametrize("noise", [Gaussian(0.05), Unknown()], ids=["known level", "unknown level"])
@pytest.mark.parametrize("start", [(0.01, 500.0), (-1.0, 1.0), (2.0, -5.0), (0.1, 1e3)])
def test_a_saturating_law_is_found_from_a_bad_start(start, noise):
    t = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6]
    truth = Formula("V*t/(K+t)", {"V": 2.0, "K": 3.0}, {"t": t})
    z = truth.simulate(truth.nominal[None])[0] + 0.05 * np.random.default_rng(3).standard_normal(9)
    best = fits(truth, z, noise, LevenbergMarquardt())
    found = fits(Formula("V*t/(K+t)", dict(zip("VK", start, strict=True)), {"t": t}), z, noise, Auto())
    assert found.x == pytest.approx(best.x, rel=1e-4)


ANGLES = np.arange(6) * np.pi / 3
RING = [(1000 * np.cos(a), 1000 * np.sin(a), 16.0 + 14.0 * np.cos(3 * a)) for a in ANGLES]
NEAR_THE_GROUND = Ranging(beacons=(*RING, (0.0, 0.0, 10.0)))
"""Beacons of about one height: a receiver above them has an image below, where the ranges are nearly the same."""


@pytest.mark.parametrize("estimator", [Auto(), Progressive()], ids=["auto", "progressive"])
def test_an_image_below_the_ground_is_not_believed(estimator):
    block = Block.draw(Scenario(NEAR_THE_GROUND, Gaussian(0.1), error_scale=60.0), 0, 150)
    _, scored = block.estimate(estimator)
    assert scored["success"].mean() >= 0.99
    _, plain = block.estimate(LevenbergMarquardt())
    assert plain["success"].mean() < 0.7


@pytest.mark.parametrize(
    ("model", "true", "told", "scale"),
    [(Ranging(), 3.0, 0.1, 10.0), (LotkaVolterra(), 1.0, 0.01, 1.0)],
    ids=["ranging", "lotka_volterra"],
)
@pytest.mark.parametrize("estimator", [Auto(), Progressive()], ids=["auto", "progressive"])
def test_noise_that_is_understated_is_no_reason_for_a_long_search(model, true, told, scale, estimator):
    """Nothing ever fits, and draws lead to the same minimum: some ten to thirty times the first fit."""
    z = Scenario(model, Gaussian(true), error_scale=scale).draw(0, 4).z
    problem = Problem(model, Scenario(model, Gaussian(told)).problem.R)
    with np.errstate(all="ignore"):
        found, first = (e.estimate(problem, z) for e in (estimator, LevenbergMarquardt()))
    cost, least = (e.simulations + model.n * e.jacobians for e in (found, first))
    assert (cost <= 40 * least).all()
    assert (np.abs(found.x - first.x) < 1e-3).all()
    for i in range(4):
        assert "independent draws" in found.messages[i]
        assert "this minimum again" in found.messages[i]


def test_what_fits_is_not_looked_for_again():
    problem = Scenario(Ranging(), Gaussian(0.1), error_scale=10.0).problem
    z = Scenario(Ranging(), Gaussian(0.1), error_scale=10.0).draw(0, 30).z
    found = Progressive().estimate(problem, z)
    assert not found.messages
    assert (found.simulations + 4 * found.jacobians).max() < 60
