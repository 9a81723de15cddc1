"""The reference posterior: closed forms, integration on a grid, and estimators held against it."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from shared.oracles import agreed, assert_agrees
from shared.small_models import Bent, Written

import ipe_bench as ib
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates
from ipe_bench.measurements import Gins
from ipe_bench.measurements.problem import Problem
from ipe_bench.questions.posterior.answer import (
    CHANCE,
    SAME_LAW,
    adequate_word,
    finding,
    sampled,
    write_posteriors,
)
from ipe_bench.questions.posterior.maths import (
    Divergence,
    Posterior,
    _kl,
    divergence,
    reference,
    sample_posterior,
)

PRIOR = np.array([1.0, 0.5, 2.0])


def exact(problem: Problem, z: Array) -> tuple[Array, Array, float]:
    """Mean, covariance and evidence of a linear model's posterior; the evidence less the constant
    of R."""
    A, R, D = problem.measurement.A, problem.R.matrix(), np.diag(problem.prior_deviation**2)
    P = np.linalg.inv(A.T @ np.linalg.inv(R) @ A + np.linalg.inv(D))
    whole = R + A @ D @ A.T
    evidence = -0.5 * (
        z @ np.linalg.inv(whole) @ z + np.linalg.slogdet(whole)[1] - np.linalg.slogdet(R)[1]
    )
    return P @ A.T @ np.linalg.inv(R) @ z, P, evidence


def held(found: Posterior, x: Array, P: Array | None) -> Divergence:
    """A Gaussian against a posterior."""
    converged = np.array([Status.CONVERGED], dtype=np.int8)
    return divergence(found, Estimates(x[None], converged, None if P is None else P[None]))


@pytest.fixture(scope="module", params=[0.5, 1e-4], ids=["wide", "narrow"])
def linear(request):
    problem = Problem(Bent(), Covariance(np.full(12, request.param)), PRIOR)
    rng = np.random.default_rng(0)
    z = problem.measurement.simulate(PRIOR * rng.normal(size=(1, 3)))[
        0
    ] + request.param * rng.normal(size=12)
    return problem, z, sample_posterior(problem, z, particles=2000)


@pytest.mark.oracle(
    "closed form: posterior of a linear model", "mean of 2000 draws, in standard deviations", 0.08
)
def test_on_a_linear_model_it_is_the_closed_form(linear):
    problem, z, found = linear
    mean, P, evidence = exact(problem, z)
    deviation = np.sqrt(np.diag(P))
    agreed(np.abs((found.mean - mean) / deviation), 0.08)
    np.testing.assert_allclose(found.deviation, deviation, rtol=0.06)
    np.testing.assert_allclose(
        found.covariance / np.outer(deviation, deviation),
        P / np.outer(deviation, deviation),
        atol=0.1,
    )
    assert found.settled
    # Two populations of 1000 draws know a mean to 1 / sqrt(1000) or worse, as their draws depend on
    # each other.
    assert 1e-4 < found.noise < 0.05
    assert len(found.modes) == 1
    np.testing.assert_allclose((found.modes[0] - mean) / deviation, 0.0, atol=1e-4)
    # The normalising constant, which only a sound resampling and tempering gets right.
    np.testing.assert_allclose(found.evidence, evidence, atol=0.5)


def test_the_exact_gaussian_does_not_diverge_and_a_wrong_one_does_as_computed(linear):
    problem, z, found = linear
    mean, P, _ = exact(problem, z)
    right = held(found, mean, P)
    assert adequate_word(right, found) == "yes"
    assert right.kl < 0.05
    assert right.energy < 0.01
    assert right.width == pytest.approx(1.0, abs=0.05)
    # Twice too confident, and off by three deviations in the first parameter.
    confident = held(found, mean, P / 4)
    shifted = held(found, mean + 3 * P[:, 0] / np.sqrt(P[0, 0]), P)
    assert confident.kl == pytest.approx(0.5 * 3 * (4 - 1 - np.log(4)), rel=0.1)
    assert confident.width == pytest.approx(0.5, abs=0.03)
    assert shifted.kl == pytest.approx(4.5, rel=0.1)
    assert shifted.shift == pytest.approx(3 / np.sqrt(3), rel=0.06)
    assert shifted.energy > 50 * max(right.energy, 1e-3)
    assert held(found, mean, None).kl == np.inf
    assert held(found, np.full(3, np.nan), P).kl == np.inf
    assert adequate_word(shifted, found) == "NO"
    divergences = {"exact": right, "half": confident, "shifted": shifted}
    one: Any = SimpleNamespace(posterior=found, divergences=divergences)
    agreeing = (
        "the Gaussian represents the posterior: exact in {0} of {1}; half, shifted in 0 of {1}"
    )
    assert finding([one]) == agreeing.format(1, "1 trial")
    assert finding([one, one]) == agreeing.format(2, "2 trials")


@pytest.mark.parametrize(("n", "draws"), [(1, 400), (3, 400), (6, 400)])
def test_a_quarter_of_the_noise_is_the_chance_in_the_divergence_of_the_right_gaussian(n, draws):
    rng = np.random.default_rng(n)
    noises, chances = [], []
    for _ in range(100):
        parts = rng.standard_normal((2, draws, n))
        (first, S), (second, P), (both, whole) = (
            (x.mean(axis=0), np.atleast_2d(np.cov(x.T))) for x in (*parts, parts.reshape(-1, n))
        )
        noises.append(_kl(second - first, P, S))
        chances.append(_kl(both, np.eye(n), whole))
    assert np.mean(chances) / np.mean(noises) == pytest.approx(CHANCE, rel=0.2)


@pytest.mark.parametrize(
    ("kl", "noise", "word"),
    [
        *((0.09, 0.01, "yes"), (0.12, 0.01, "NO"), (0.12, 0.16, "yes"), (0.3, 0.16, "NO")),
        *((0.19, 0.5, "?"), (1.0, 0.5, "NO"), (np.inf, 0.01, "-")),
    ],
)
def test_what_is_adequate_allows_for_chance_and_not_for_more(kl, noise, word):
    sampled_ones: Any = SimpleNamespace(modes=[0], noise=noise)
    one: Any = SimpleNamespace(kl=kl, energy=0.0)
    assert adequate_word(one, sampled_ones) == word


def test_a_gaussian_of_the_right_moments_is_not_adequate_for_another_law():
    sampled_ones: Any = SimpleNamespace(modes=[0], noise=0.0)
    found: list[Any] = [
        SimpleNamespace(kl=0.0, energy=energy) for energy in (0.0, 0.5 * SAME_LAW, 2 * SAME_LAW)
    ]
    words = [adequate_word(one, sampled_ones) for one in found]
    assert words == ["yes", "yes", "NO"]


def test_a_page_says_nothing_of_posteriors_whose_populations_differ(tmp_path):
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    found = sampled(bench, {"lse": ib.baselines.LinearLSE()}, 1, 80)
    one: Any = SimpleNamespace(posterior=SimpleNamespace(settled=False), divergences={"lse": None})
    assert finding([one]) == "the posterior cannot be relied on in any trial; take more particles"
    assert finding([one, *found]) == finding(found)
    write_posteriors(tmp_path, "polynomial", "polynomial", bench.measurement, found)
    page = (tmp_path / "posterior.html").read_text(encoding="utf-8")
    assert f"<h1>polynomial: {finding(found)}</h1>" in page.replace("\u200b", "").replace(
        "<wbr>", ""
    )


def test_every_number_and_word_of_a_table_of_posteriors_is_defined_below_it():
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    (table,) = sampled(bench, {"lse": ib.baselines.LinearLSE()}, 1, 80).parts()
    titles = [column.title for column in table.columns]
    named = {"trial", "modes", "estimator", "status"}
    undefined = [one for one in titles if one not in named and f"{one}: " not in table.notes[0]]
    assert not undefined


def square(tilt: float = 0.0) -> Written:
    """Readings x^2 and `tilt` x: two modes where tilt is 0, of unequal weight where it is small."""
    return Written(lambda x: (x**2, tilt * x))


@pytest.mark.oracle(
    "own second implementation: integration on a grid", "share of one of two modes", 0.08
)
@pytest.mark.parametrize("tilt", [0.0, 0.01])
def test_two_modes_are_found_with_their_weights(tilt):
    """Beside integration on a grid."""
    model = square(tilt)
    problem = Problem(model, Covariance(np.full(2, 0.05)), np.array([2.0]))
    z = model.simulate(np.array([[1.5]]))[0]
    found = sample_posterior(problem, z, particles=4000)
    grid = np.linspace(-4, 4, 40_001)
    log = (
        -0.5 * np.sum(((z - model.simulate(grid[:, None])) / 0.05) ** 2, axis=1)
        - 0.5 * (grid / 2) ** 2
    )
    weight = np.exp(log - log.max())
    right = weight[grid > 0].sum() / weight.sum()
    assert_agrees(np.mean(found.x > 0), right, atol=0.08)
    assert len(found.modes) == 2
    np.testing.assert_allclose(np.sort(found.modes[:, 0]), [-1.5, 1.5], atol=0.02)
    assert found.shares.sum() == pytest.approx(1.0)
    step = grid[1] - grid[0]
    expected = np.log(weight.sum() * step / np.sqrt(2 * np.pi * 4)) + log.max()
    np.testing.assert_allclose(found.evidence, expected, atol=0.3)


def test_one_gaussian_cannot_stand_for_two_modes():
    problem = Problem(square(), Covariance(np.full(2, 0.05)), np.array([2.0]))
    found = sample_posterior(problem, square().simulate(np.array([[1.5]]))[0], particles=1000)
    at_one = held(found, np.array([1.5]), np.array([[(0.05 / 3) ** 2]]))
    over_both = held(found, found.mean, found.covariance)
    assert at_one.kl > 100
    assert at_one.energy > 0.5
    assert over_both.kl < 1e-6  # the moments are right
    assert over_both.energy > 0.1
    assert (adequate_word(at_one, found), adequate_word(over_both, found)) == ("NO", "NO")


def test_the_same_trial_gives_the_same_draws(linear):
    problem, z, _ = linear
    first, second, other = (
        sample_posterior(problem, z, particles=100, seed=seed) for seed in (1, 1, 2)
    )
    assert (first.x == second.x).all()
    assert not np.array_equal(first.x, other.x)


def test_a_model_that_fails_in_places_is_sampled_where_it_does_not():
    @dataclass(frozen=True)
    class Broken(Bent):
        def simulate(self, x: Array) -> Array:
            return np.where(x[:, :1] > 0.5, np.nan, super().simulate(x))

    problem = Problem(Broken(), Covariance(np.full(12, 0.5)), PRIOR)
    found = sample_posterior(problem, np.zeros(12), particles=400)
    assert np.isfinite(found.x).all()
    assert (found.x[:, 0] <= 0.5).all()


@pytest.mark.slow
def test_on_gins_gauss_newton_knows_and_the_ekf_does_not():
    """Error scale 300: the covariance of Gauss and Newton is the posterior's, and the EKF's
    Gaussian is elsewhere."""
    bench = ib.Scenario(Gins(), ib.noise.Quantization(), error_scale=300.0)
    found = reference(bench, {"gn": ib.baselines.GaussNewton(), "ekf": ib.baselines.EKF()}, 0, 240)
    assert found.posterior.settled
    assert len(found.posterior.modes) == 1
    P = found.estimates["gn"].covariance
    assert P is not None
    np.testing.assert_allclose(found.posterior.deviation, np.sqrt(np.diag(P[0])), rtol=0.15)
    assert found.divergences["gn"].kl < 0.3
    assert found.divergences["ekf"].kl > 50
    assert found.divergences["ekf"].width == pytest.approx(
        1.0, abs=0.15
    )  # as sure as if it were right
