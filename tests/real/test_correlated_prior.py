"""Priors whose parameters depend on each other, against conditional normal distributions in closed
form."""

import numpy as np
import pytest
from shared.oracles import assert_agrees
from shared.small_models import Bent

from ipe_bench.baselines import CKF, EKF, IPLF, UKF, EnKF, IteratedEKF, MapLM
from ipe_bench.basics.errors import UserError
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.questions.posterior.maths import sample_posterior
from ipe_bench.trials.fit_test import spread_of
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block
from ipe_bench.workshop.conformance import check_component

CORRELATIONS = ((1.0, 0.9, -0.3), (0.9, 1.0, 0.1), (-0.3, 0.1, 1.0))
DEVIATIONS = (2.0, 1.0, 0.5)
SIGMA = 3.0


@pytest.fixture(scope="module")
def bench() -> Scenario:
    """A linear model whose readings say little, so that the prior counts."""
    return Scenario(
        Bent(), Gaussian(SIGMA), GaussianPrior(DEVIATIONS, CORRELATIONS), error_scale=1.5, seed=4
    )


def conditional(bench: Scenario, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of x given z, by the joint normal distribution of both and not by least
    squares."""
    d = 1.5 * np.array(DEVIATIONS)
    P0 = np.array(CORRELATIONS) * np.outer(d, d)
    A = np.asarray(bench.measurement.A)  # type: ignore[attr-defined]
    S = A @ P0 @ A.T + SIGMA**2 * np.eye(len(A))
    return P0 @ A.T @ np.linalg.solve(S, z), P0 - P0 @ A.T @ np.linalg.solve(S, A @ P0)


@pytest.mark.oracle(
    "closed form: conditional normal distribution", "estimates by seven estimators", 1e-6
)
@pytest.mark.parametrize(
    "estimator",
    [MapLM(tolerance=1e-10), EKF(), EKF(engine="filterpy"), UKF(), CKF(), IteratedEKF(), IPLF()],
    ids=lambda e: f"{type(e).__name__}-{getattr(e, 'engine', '')}",
)
def test_estimators_that_are_told_the_prior_find_the_conditional_distribution(bench, estimator):
    z = bench.draw(0, 3).z
    estimates = estimator.estimate(bench.problem, z)
    for k in range(3):
        mean, P = conditional(bench, z[k])
        assert_agrees(estimates.x[k], mean, atol=1e-6)
        assert estimates.covariance[k] == pytest.approx(P, rel=1e-5, abs=1e-7)


def test_an_ensemble_is_drawn_with_the_correlations(bench):
    z = bench.draw(0, 1).z
    estimates = EnKF(members=1500).estimate(bench.problem, z)
    mean, P = conditional(bench, z[0])
    assert (np.abs(estimates.x[0] - mean) / np.sqrt(np.diag(P))).max() < 0.15
    assert estimates.covariance[0] == pytest.approx(P, rel=0.15, abs=0.1)


@pytest.mark.slow
def test_the_posterior_has_the_correlations(bench):
    z = bench.draw(0, 1).z[0]
    found = sample_posterior(bench.problem, z, particles=600)
    mean, P = conditional(bench, z)
    assert (np.abs(found.mean - mean) / np.sqrt(np.diag(P))).max() < 0.15
    assert found.deviation == pytest.approx(np.sqrt(np.diag(P)), rel=0.08)
    correlation = found.covariance / np.outer(found.deviation, found.deviation)
    assert correlation == pytest.approx(P / np.outer(*[np.sqrt(np.diag(P))] * 2), abs=0.06)


def test_draws_and_bounds_have_them_too(bench):
    x = bench.truths(0, 4000)
    assert np.corrcoef(x.T) == pytest.approx(np.array(CORRELATIONS), abs=0.05)
    bound = np.linalg.inv(Block.draw(bench, 0, 1).bayes_information[0])
    assert bound == pytest.approx(conditional(bench, np.zeros(12))[1], rel=1e-9)
    assert not [f for f in check_component("prior", bench.prior) if f.complaint]


def test_residuals_of_the_maximum_a_posteriori_scatter_as_is_said(bench):
    """The mean of chi-square of MAP residuals, by simulation."""
    drawn = bench.draw(0, 1500)
    estimates = MapLM(tolerance=1e-10).estimate(bench.problem, drawn.z)
    r = bench.problem.R.whiten(drawn.z - bench.measurement.simulate(estimates.x))
    spread = spread_of(MapLM(), bench.problem, bench.measurement.jacobian(drawn.x[:1]))
    assert np.mean(np.sum(r**2, axis=1)) == pytest.approx(spread.mean[0], rel=0.03)


REFUSED = {
    "not symmetric": (
        ((1, 0.5), (0.4, 1)),
        r"is not symmetric; row 1, column 2 is 0.5, and row 2, column 1 is 0.4",
    ),
    "not definite": (((1, 1.1), (1.1, 1)), r"is not positive definite; the least eigenvalue"),
    "singular": (((1, 1), (1, 1)), r"is not positive definite"),
    "not square": (((1, 0, 0), (0, 1, 0)), r"row 1 has 3 numbers; give a square matrix"),
    "nothing": ((), r"is empty; give a square matrix"),
    "no correlations": (((4, 0), (0, 1)), r"has a diagonal that is not 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_correlation_is_refused_in_a_line(case):
    given, expected = REFUSED[case]
    with pytest.raises(UserError, match=f"correlations: {expected}"):
        GaussianPrior(correlations=given)


def test_correlations_of_another_number_of_parameters_are_refused():
    with pytest.raises(
        UserError, match=r"prior.correlations: has 2 rows; give one for each of 3 parameters"
    ):
        _ = Scenario(
            Bent(), Gaussian(1.0), GaussianPrior(correlations=((1.0, 0.0), (0.0, 1.0)))
        ).problem
