"""Priors whose parameters depend on each other, against conditional normal distributions in closed form."""

import numpy as np
import pytest
from small_models import Bent

from ipe_bench.baselines import CKF, EKF, IPLF, LMIEKF, UKF, EnKF, EsMda, IteratedEKF, MapLM
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Formula
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.noise import Gaussian
from ipe_bench.plugins.conformance import check_component
from ipe_bench.priors import GaussianPrior, prior_of
from ipe_bench.real.readings import read_covariance
from ipe_bench.trials.fit_test import spread_of
from ipe_bench.trials.posterior import sample_posterior
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block

CORRELATIONS = ((1.0, 0.9, -0.3), (0.9, 1.0, 0.1), (-0.3, 0.1, 1.0))
DEVIATIONS = (2.0, 1.0, 0.5)
SIGMA = 3.0


@pytest.fixture(scope="module")
def bench() -> Scenario:
    """A linear model whose readings say little, so that the prior counts."""
    return Scenario(Bent(), Gaussian(SIGMA), GaussianPrior(DEVIATIONS, CORRELATIONS), error_scale=1.5, seed=4)


def conditional(bench: Scenario, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of x given z, by the joint normal distribution of both and not by least squares."""
    d = 1.5 * np.array(DEVIATIONS)
    P0 = np.array(CORRELATIONS) * np.outer(d, d)
    A = np.asarray(bench.measurement.A)  # type: ignore[attr-defined]
    S = A @ P0 @ A.T + SIGMA**2 * np.eye(len(A))
    return P0 @ A.T @ np.linalg.solve(S, z), P0 - P0 @ A.T @ np.linalg.solve(S, A @ P0)


@pytest.mark.parametrize(
    "estimator",
    [MapLM(tolerance=1e-10), EKF(), EKF(engine="filterpy"), UKF(), CKF(), IteratedEKF(), IPLF(), LMIEKF()],
    ids=lambda e: f"{type(e).__name__}-{getattr(e, 'engine', '')}",
)
def test_estimators_that_are_told_the_prior_find_the_conditional_distribution(bench, estimator):
    z = bench.draw(0, 3).z
    estimates = estimator.estimate(bench.problem, z)
    for k in range(3):
        mean, P = conditional(bench, z[k])
        assert estimates.x[k] == pytest.approx(mean, abs=1e-6)
        assert estimates.covariance[k] == pytest.approx(P, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("ensemble", [EsMda(members=1500, steps=4, first=0.05, polish=0), EnKF(members=1500)])
def test_an_ensemble_is_drawn_with_the_correlations(bench, ensemble):
    z = bench.draw(0, 1).z
    estimates = ensemble.estimate(bench.problem, z)
    mean, P = conditional(bench, z[0])
    assert (np.abs(estimates.x[0] - mean) / np.sqrt(np.diag(P))).max() < 0.15
    assert estimates.covariance[0] == pytest.approx(P, rel=0.15, abs=0.1)


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


def test_a_covariance_is_of_the_parameters_in_their_own_units_and_logarithms():
    model = informed(
        Formula("a*exp(-b*t)", {"a": 8.0, "b": 0.2}, {"t": (0.0, 1.0, 2.0)}), (ParameterInfo("b", positive=True),)
    )
    P = np.array([[0.25, 0.006], [0.006, 0.0004]])
    problem = Scenario(model, Gaussian(1.0), prior_of(model, P)).problem
    inner = problem.prior_covariance().matrix()  # type: ignore[union-attr]
    # x is a / 8, and (ln b - ln 0.2) / (0.2 / 0.2): db = 0.2 dx.
    assert inner == pytest.approx(P / np.outer([8.0, 0.2], [8.0, 0.2]), rel=1e-12)


REFUSED = {
    "not symmetric": ([[1, 0.5], [0.4, 1]], r"is not symmetric; row 1, column 2 is 0.5, and row 2, column 1 is 0.4"),
    "not definite": ([[1, 1.1], [1.1, 1]], r"is not positive definite; the least eigenvalue of its correlations"),
    "singular": ([[1, 1], [1, 1]], r"is not positive definite"),
    "a variance of nothing": ([[1, 0], [0, 0]], r"row 2, column 2 is 0; a variance is above 0"),
    "a variance below nothing": ([[-1, 0], [0, 1]], r"row 1, column 1 is -1"),
    "too small": ([[1]], r"is 1 x 1; give a row and a column for each of 2 \(a, b\)"),
    "too large": (np.eye(3).tolist(), r"is 3 x 3; give a row and a column for each of 2"),
    "not square": ([[1, 0, 0], [0, 1, 0]], r"row 1 has 3 numbers and there are 2 rows"),
    "not numbers": ([[1, "x"], [0, 1]], r"row 1 has 'x', which is not a number"),
    "no matrix": (3, r"prior_covariance=3: give a matrix"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_covariance_is_refused_in_a_line(case):
    given, expected = REFUSED[case]
    model = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": (0.0, 1.0)})
    with pytest.raises(UserError, match=expected):
        prior_of(model, read_covariance(given, ["a", "b"]))


FILES = {
    "names in another order": ("b,a\n0.25,-0.9\n-0.9,4\n", None),
    "names of rows": ("parameter,a,b\nb,-0.9,0.25\na,4,-0.9\n", None),
    "decimal commas": ("a;b\n4;-0,9\n-0,9;0,25\n", None),
    "another parameter": ("a,c\n1,0\n0,1\n", r"column c: .*parameter that is estimated"),
    "a parameter less": ("a\n1\n", r"has no column b"),
    "a row less": ("a,b\n1,0\n", r"has 1 rows and 2 parameters"),
    "an empty cell": ("a,b\n1,\n0,1\n", r"row 2, column b: is empty"),
    "no number": ("a,b\n1,x\n0,1\n", r"row 2, column b: 'x' is not a number"),
    "a name twice": ("parameter,a,b\na,1,0\na,0,1\n", r"row 2, column parameter: 'a' is not the name of one"),
}


@pytest.mark.parametrize("case", FILES)
def test_a_small_file_holds_it_by_name(tmp_path, case):
    text, refused = FILES[case]
    (tmp_path / "p.csv").write_text(text)
    if refused:
        with pytest.raises(UserError, match=rf"prior_covariance=.*p.csv: {refused}"):
            read_covariance(str(tmp_path / "p.csv"), ["a", "b"])
    else:
        assert read_covariance(str(tmp_path / "p.csv"), ["a", "b"]).tolist() == [[4.0, -0.9], [-0.9, 0.25]]
