"""Trials: the same whatever the block, with truths from the prior and readings from the model."""

from dataclasses import dataclass

import numpy as np
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Gins, Polynomial, Ranging
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Colored, Gaussian, NoNoise, Quantization, StudentT
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario


@pytest.mark.parametrize(
    ("model", "noise"),
    [
        *(
            (Ranging(), n)
            for n in (
                Gaussian(0.1),
                StudentT(0.1),
                Colored(0.1, 0.5),
                Quantization(0.1, dither=True),
            )
        ),
        (Gins(), Quantization(0.02286)),
    ],
    ids=str,
)
def test_a_trial_is_the_same_in_every_block(model, noise):
    scenario = Scenario(model, noise, GaussianPrior(), 2.0, seed=3)
    whole = scenario.draw(0, 40)
    for bounds in ((0, 1), (7, 20), (39, 40)):
        part = scenario.draw(*bounds)
        assert (part.x == whole.x[slice(*bounds)]).all()
        assert (part.z == whole.z[slice(*bounds)]).all()
        assert (part.start, part.stop) == bounds


def test_seeds_and_trials_are_independent():
    draws = [
        Scenario(Polynomial(), Gaussian(1.0), GaussianPrior(), 1.0, seed).draw(0, 500)
        for seed in (1, 2)
    ]
    joined = np.column_stack(
        [*(d.x for d in draws), *((d.z - Polynomial().simulate(d.x))[:, :4] for d in draws)]
    )
    assert np.abs(np.corrcoef(joined.T) - np.eye(16)).max() < 5 / np.sqrt(500)


def test_truths_are_normal_about_the_nominal_point_with_the_error_scale():
    scenario = Scenario(Ranging(position=(100.0, 0.0, 0.0)), Gaussian(0.1), GaussianPrior(), 5.0)
    u = (scenario.draw(0, 2000).x - scenario.problem.x0) / 5.0
    assert np.abs(u.mean(axis=0)).max() < 5 / np.sqrt(2000)
    np.testing.assert_allclose(u.std(axis=0), 1.0, rtol=0.07)


def test_one_seed_gives_the_same_draws_at_every_scale_in_units_of_it():
    small, large = (
        Scenario(Polynomial(), Gaussian(1.0), GaussianPrior(), s).draw(0, 5).x / s
        for s in (0.5, 64.0)
    )
    np.testing.assert_allclose(small, large, rtol=1e-15)


def test_the_prior_may_differ_by_parameter():
    prior = GaussianPrior((1.0, 2.0, 0.0, 1.0))
    assert prior.deviation(4, 10.0).tolist() == [10.0, 20.0, 0.0, 10.0]
    x = Scenario(Polynomial(), Gaussian(1.0), prior, 1.0).draw(0, 100).x
    assert (x[:, 2] == 0.0).all()


@dataclass(frozen=True)
class Short(Polynomial):
    nominal = np.array([5.0])  # type: ignore[assignment]


def test_a_nominal_point_of_another_length_is_refused():
    for make in (
        lambda: Scenario(Short(), Gaussian(1.0)),
        lambda: Problem(Short(), Gaussian(1.0).covariance(21)),
    ):
        with pytest.raises(
            UserError, match=r"^measurement=short: nominal has shape \(1,\); let it return \(4,\)"
        ):
            make()


def test_a_truth_of_its_own_simulates_the_readings():
    own, truth = Polynomial(strength=0.0), Polynomial(strength=0.1)
    scenario = Scenario(own, NoNoise(1.0), GaussianPrior(), 1.0, truth=truth)
    trials = scenario.draw(0, 3)
    assert (trials.z == truth.simulate(trials.x)).all()
    assert scenario.problem.measurement is own


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_impossible_error_scales_are_named(scale):
    with pytest.raises(UserError, match=r"^error_scale="):
        Scenario(Polynomial(), Gaussian(1.0), GaussianPrior(), scale)
