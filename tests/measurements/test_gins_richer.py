"""Truths richer than the GINS model: exact, of their own draws, and seen or not seen by the test of the fit."""

import numpy as np
import pytest
from gins_reference import velocities

from ipe_bench.baselines import GaussNewton
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Gins, Polynomial, RicherGins
from ipe_bench.noise import NoNoise, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario

NOISE = Quantization(0.02286)


def scenario(scale: float = 33.0, **errors: float) -> Scenario:
    return Scenario(Gins(), NOISE, GaussianPrior(), scale, truth=RicherGins(**errors))


def test_without_its_errors_it_is_gins():
    model, rich = Gins(), RicherGins()
    x = 33.0 * np.random.default_rng(0).normal(size=(3, 11))
    z = rich.simulate(np.pad(x, ((0, 0), (0, len(rich.nuisance_deviation)))))
    np.testing.assert_allclose(z, model.simulate(x), atol=1e-9)
    assert (rich.simulate(x) == model.simulate(x)).all()


def test_a_constant_walk_is_a_drift():
    """An increment at the start of a case and none after it is that drift in this case."""
    model, rich = Gins(), RicherGins()
    extra = np.zeros((1, len(rich.nuisance_deviation)))
    walk = extra[:, 7:].reshape(4, 30, 3)
    walk[:, 0, 1] = 5.0 * model.si_sizes[5]
    z = rich.simulate(np.concatenate([np.zeros((1, 11)), extra], axis=1))
    drift = np.zeros((1, 11))
    drift[0, 5] = 5.0
    np.testing.assert_allclose(z, model.simulate(drift), atol=1e-9)


@pytest.mark.parametrize("scale", [33.0, 3000.0])
def test_a_random_walk_keeps_the_tolerance_of_gins(scale):
    """Beside SciPy, from reading to reading."""
    rich = RicherGins(gyro_random_walk=0.05)
    rng = np.random.default_rng(5)
    increments = rich.nuisance_deviation * rng.normal(size=367)
    x = np.concatenate([scale * rng.normal(size=11), increments])[None]
    walk = np.cumsum(increments[7:].reshape(1, 4, 30, 3), axis=2)
    reference = velocities(x[:, :11], walk) - velocities(np.zeros((1, 11)))
    assert np.abs(rich.simulate(x) - reference).max() < 1e-6
    assert (rich.simulate_until(x, 7) == rich.simulate(x)[:, rich.rows(7)]).all()


def test_the_parameters_of_a_trial_are_those_of_the_plain_scenario():
    plain = Scenario(Gins(), NOISE, GaussianPrior(), 33.0).draw(0, 5)
    rich = scenario(gyro_random_walk=0.01).draw(0, 5)
    assert (rich.x == plain.x).all()
    assert not (rich.z == plain.z).all()


def test_nuisances_do_not_scale_with_the_errors():
    """Twice the error scale doubles the parameters' readings, not those of the random walk."""
    noiseless = [
        Scenario(Gins(), NoNoise(0.0066), GaussianPrior(), s, truth=RicherGins(gyro_random_walk=0.01)).draw(0, 20).z
        for s in (1e-6, 1e-3)
    ]
    assert abs(noiseless[0].std() / noiseless[1].std() - 1) < 0.01


def test_who_is_noticed():
    """Drifts that walk leave residuals; an initial tilt looks like a bias and leaves none, however wrong the bias."""
    found = {}
    for name, errors in {
        "none": {},
        "walk": {"gyro_random_walk": 0.001},
        "tilt": {"platform_misalignment": 5.0},
    }.items():
        given = scenario(**errors)
        trials = given.draw(0, 60)
        estimates = GaussNewton().estimate(given.problem, trials.z)
        deviation = np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2))
        rms = np.sqrt(np.mean(((estimates.x - trials.x) / deviation) ** 2))
        found[name] = rms, np.mean(estimates.extras["fit_p"] < 1e-3)
    assert found["none"][0] < 1.2
    assert found["none"][1] < 0.05
    assert found["walk"][0] > 5
    assert found["walk"][1] > 0.95
    assert found["tilt"][0] > 30
    assert found["tilt"][1] < 0.1


def test_a_truth_of_another_model_is_refused():
    with pytest.raises(UserError, match=r"^truth_measurement="):
        Scenario(Gins(), NOISE, GaussianPrior(), 1.0, truth=Polynomial())
