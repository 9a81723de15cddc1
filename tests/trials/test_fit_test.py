"""The p of the test of fit is uniform where model and noise are right, whatever the noise and the
estimator."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest
from shared.oracles import assert_agrees
from shared.small_models import Bent

from ipe_bench.baselines import EKF, GaussNewton, MapLM
from ipe_bench.basics.linalg import Covariance, information
from ipe_bench.measurements import Formula, Polynomial
from ipe_bench.noise import Colored, Correlated, Gaussian, NoNoise, Outliers, Quantization, StudentT
from ipe_bench.solvers import Newton
from ipe_bench.trials.fit_test import DRAWS, Spread, fit_probability, frozen_spread, prior_spread
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block

NOISES = [
    Gaussian(0.1),
    StudentT(0.1, 5.0),
    StudentT(0.1, 3.0),
    Outliers(0.1, assumed="total"),
    Colored(0.1, assumed="full"),
    Correlated(0.1),
    Quantization(0.3, dither=True),
]


def p_values(model, noise, error_scale, estimator, trials=2000):
    _, columns = Block.draw(Scenario(model, noise, error_scale=error_scale), 0, trials).estimate(
        estimator
    )
    return columns["fit_p"]


QUICK = (Gaussian, Outliers, Quantization)


@pytest.mark.parametrize(
    "noise",
    [pytest.param(n, marks=() if isinstance(n, QUICK) else pytest.mark.slow) for n in NOISES],
    ids=lambda noise: type(noise).__name__,
)
def test_p_is_uniform_for_every_noise_that_states_its_law(noise):
    """With chi-square in its place the test fails for Student's t, outliers and quantisation."""
    assert (
        kstest(p_values(Polynomial(strength=0.01), noise, 1.0, GaussNewton()), "uniform").pvalue
        > 0.01
    )


@pytest.mark.parametrize(
    "estimator",
    [
        MapLM(),
        MapLM(prior_inflation=3.0),
        pytest.param(EKF(engine="batched"), marks=pytest.mark.slow),
    ],
    ids=repr,
)
def test_p_is_uniform_for_estimators_with_a_prior(estimator):
    """The prior is as good as the readings here: m - n degrees are 3 too few of 40."""
    p = p_values(Polynomial(strength=0.001), Gaussian(1.0), 0.2, estimator)
    assert kstest(p, "uniform").pvalue > 0.01
    assert kstest(chi2.sf(chi2.isf(p, 40 - 4), 40), "uniform").pvalue < 1e-3


def test_p_is_about_uniform_with_a_prior_where_the_noise_is_not_normal():
    """Eight readings for six parameters that the prior knows: the residuals have eight degrees of
    freedom and not two, and their sum of squares a spread twice as large as that of least
    squares."""
    t = np.linspace(-1, 1, 8)
    powers = "+".join(f"c{k}*t**{k}" for k in range(6))
    model = Formula(powers, {f"c{k}": 1.0 for k in range(6)}, {"t": t.tolist()})
    p = p_values(model, Quantization(0.3, dither=True), 1e-3, MapLM())
    assert np.mean(p) == pytest.approx(0.5, abs=0.05)
    assert np.std(p) == pytest.approx(1 / np.sqrt(12), abs=0.05)


def test_p_is_uniform_for_the_frozen_root_where_its_projection_is_oblique():
    """m - n degrees of 8 - 3 are too few by a third here, in the median."""
    block = Block.draw(Scenario(Bent(0.3, count=8), Gaussian(0.003), error_scale=1.0), 0, 2000)
    estimates, columns = block.estimate(Newton())
    solved = columns["solved"]
    assert solved.mean() > 0.6
    assert kstest(columns["fit_p"][solved], "uniform").pvalue > 0.01
    squares = np.sum(((block.trials.z - block.readings_at(estimates.x)) / 0.003) ** 2, axis=1)
    assert kstest(chi2.sf(squares[solved], 8 - 3), "uniform").pvalue < 1e-6


def spectrum(T, covariance):
    """The eigenvalues of the covariance of residuals T e, without those that are 0."""
    values = np.linalg.eigvalsh(T @ covariance @ T.T)
    return values[values > 1e-9]


@pytest.mark.parametrize("m", [4, 5, 6, 9])
def test_residuals_of_the_frozen_root_scatter_as_their_projection_says(m):
    """Of few readings the directions that both ranges share are spent, and the most oblique ones
    are left."""
    rng, n = np.random.default_rng(m), 3
    H, J = rng.normal(size=(2, m, n))
    spread = frozen_spread(J[None], H, Covariance(np.ones(m)))
    plus = np.linalg.pinv(H)
    T = np.eye(m) - J @ np.linalg.inv(plus @ J) @ plus
    assert np.sort([*[1.0] * spread.ones, *spread.others[0]]) == pytest.approx(
        spectrum(T, np.eye(m))
    )


@pytest.mark.parametrize("inflation", [0.3, 1.0, 3.0])
def test_residuals_of_an_inflated_prior_scatter_as_its_gain_says(inflation):
    rng, m, n = np.random.default_rng(1), 5, 2
    J, factor = rng.normal(size=(m, n)), np.array([0.5, 2.0])
    P = np.diag((inflation * factor) ** 2)
    T = np.eye(m) - J @ P @ J.T @ np.linalg.inv(J @ P @ J.T + np.eye(m))
    spread = prior_spread((J.T @ J)[None], m, factor, inflation)
    readings = J @ np.diag(factor**2) @ J.T + np.eye(m)
    assert np.sort([*[1.0] * spread.ones, *spread.others[0]]) == pytest.approx(
        spectrum(T, readings)
    )


@pytest.mark.oracle("library: SciPy's chi2", "p of the test of fit", 1e-12)
def test_least_squares_and_normal_noise_is_chi_square():
    H = np.random.default_rng(0).normal(size=(12, 3))
    squares = np.array([0.0, 3.0, 9.0, 40.0, np.inf, np.nan])
    p = fit_probability(
        squares, Spread(9, np.empty((6, 0))), Gaussian(1.0), H, Covariance(np.ones(12))
    )
    assert_agrees(p[:5], chi2.sf(squares[:5], 9), rtol=1e-12)
    assert np.isnan(p[5])


def test_a_simulated_law_has_a_floor_and_ends_at_nothing():
    H = np.random.default_rng(0).normal(size=(12, 3))
    squares = np.array([0.0, 1e9, np.inf, np.nan])
    spread = Spread(9, np.empty((4, 0)))
    p = fit_probability(squares, spread, Quantization(1.0), H, Covariance(np.ones(12)))
    assert p[0] == 1.0
    assert p[1] == 1 / (DRAWS + 1)
    assert p[2] == 0.0
    assert np.isnan(p[3])


def test_nothing_to_spare_is_nothing_to_test():
    H = np.eye(3)
    p = fit_probability(
        np.zeros(2), Spread(0, np.empty((2, 0))), Gaussian(1.0), H, Covariance(np.ones(3))
    )
    assert np.isnan(p).all()


def test_no_noise_fits_perfectly():
    assert (p_values(Polynomial(), NoNoise(0.1), 1.0, GaussNewton(), 20) > 0.999).all()


@pytest.mark.oracle(
    "own second implementation: traces of plain matrices",
    "mean and spread of the sum of squared residuals",
    1e-8,
)
@pytest.mark.parametrize("m", [15, 6])
def test_spreads_are_the_eigenvalues_of_the_residuals_covariance(m):
    rng, n = np.random.default_rng(1), 4
    H, J = rng.normal(size=(m, n)), rng.normal(size=(3, m, n))
    R = Covariance(np.linalg.cholesky(np.cov(rng.normal(size=(m, 60)))))
    d = rng.uniform(0.1, 2.0, n)
    frozen, prior = frozen_spread(J, H, R), prior_spread(information(J, R), m, d, 1.7)
    Hw = R.whiten_jacobian(H)
    for i, slope in enumerate(J):
        Jw = R.whiten_jacobian(slope)
        plus = np.linalg.pinv(Hw)
        B = Jw @ np.linalg.solve(plus @ Jw, plus)
        A = (np.eye(m) - B).T @ (np.eye(m) - B)
        assert_agrees(
            [frozen.mean[i], frozen.squares[i]], [np.trace(A), np.trace(A @ A)], rtol=1e-8
        )
        S = np.linalg.inv(Jw.T @ Jw + np.diag((1.7 * d) ** -2))
        left = np.eye(m) - Jw @ S @ Jw.T
        C = left @ (Jw @ np.diag(d**2) @ Jw.T + np.eye(m)) @ left.T
        assert_agrees([prior.mean[i], prior.squares[i]], [np.trace(C), np.trace(C @ C)], rtol=1e-8)
