"""The paper's theory against systems whose answers are known in closed form, and as it stands in a
report."""

import numpy as np
import pytest
from shared.oracles import assert_agrees
from shared.small_models import Bent

from ipe_bench.baselines import LinearLSE
from ipe_bench.basics.linalg import Covariance, information, inverse, pseudo_inverse
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements import Gins, Polynomial
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.runs.run import compute
from ipe_bench.solvers import FixedPoint, Newton
from ipe_bench.statistics import analyse
from ipe_bench.statistics.formulas import fixed_point_bound, observed_constant
from ipe_bench.statistics.sample import orders_of
from ipe_bench.trials.roots import frozen_root
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import CURVED, Block
from ipe_bench.trials.theory import contraction, curvature, second_derivatives


def contracting(problem, x):
    H_plus, _ = pseudo_inverse(problem.H[None], problem.R)
    return contraction(np.matmul(H_plus, problem.measurement.jacobian(x)))


def test_a_linear_model_contracts_at_once():
    problem = Problem(Bent(), Covariance(np.full(12, 0.3)), None)
    for values in contracting(problem, np.random.default_rng(0).normal(size=(5, 3))):
        np.testing.assert_allclose(values, 0.0, atol=1e-12)


def test_the_three_contractions_stand_in_order():
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 33.0)
    trials = scenario.draw(0, 30)
    K, norm, radius = contracting(scenario.problem, trials.x)
    assert (radius <= norm * (1 + 1e-12)).all()
    assert (norm <= K * (1 + 1e-12)).all()
    # K says nothing here, and all trials converge.
    assert np.median(K) > 1
    assert (radius < 1).all()
    assert (FixedPoint().estimate(scenario.problem, trials.z).status == Status.CONVERGED).all()


@pytest.mark.oracle("closed form: a sequence that halves", "error over the bound of eq. (18)", 1e-9)
def test_eq_18_holds_with_the_k_that_the_print_lost():
    """g(x) = x/2 has K = 1/2 and |x_k| = 2^-k, where the bound is 2^-k as well: sharp."""
    iterates = np.append(0.5 ** np.arange(12), 0.0)[:, None]
    holds, largest = fixed_point_bound(iterates, 0.5)
    assert holds
    assert_agrees(largest, 1.0, rtol=1e-9)
    assert not fixed_point_bound(iterates, 0.4)[0]


def test_eq_18_holds_on_gins_at_scale_1():
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 1.0)
    trials = scenario.draw(0, 10)
    histories = (
        FixedPoint(tolerance=1e-9).estimate(scenario.problem, trials.z, history=True).history
    )
    root = frozen_root(scenario.problem, trials.z, trials.x)
    for iterates, x in zip(histories, root, strict=True):
        K = 1.05 * contracting(scenario.problem, iterates)[0].max()
        assert K < 1
        assert fixed_point_bound(np.vstack([iterates[:3], x]), K)[0]


@pytest.mark.oracle("closed form: derivatives of a quadratic", "constant of eq. (23)", 1e-5)
def test_the_constant_of_eq_23_is_that_of_a_quadratic():
    """h(x) = A x + b (A x)^2 with one parameter: F'' = 2 b H+ A^2 and F' = H+ (A + 2 b A^2 x)."""
    scenario = Scenario(Polynomial(unknowns=1, strength=0.1), Gaussian(0.01), GaussianPrior(), 1.0)
    problem, trials = scenario.problem, scenario.draw(0, 1)
    root = frozen_root(problem, trials.z, trials.x)
    iterates = Newton(start="nominal").estimate(problem, trials.z, history=True).history[0]
    model = problem.measurement
    M = curvature(model.jacobian(root), second_derivatives(model, root), problem.H_plus[None])[0]
    u, s = root[0, 0], 0.1
    assert_agrees(M, (s + s**2 * u) / (1 + s * u + s**2 * u**2 / 2), rtol=1e-5)
    assert 0.5 * M < observed_constant(np.vstack([iterates, root])) < 2 * M


@pytest.mark.oracle("closed form: derivatives of two polynomials", "constant of eq. (23)", 1e-12)
def test_eq_23_takes_the_largest_second_derivative_over_all_pairs():
    """A square model whose second derivatives are known: h = (x + x y, y + 3 y^2) at 0 has the
    largest, 6, in y, y."""
    J, second = np.eye(2)[None], np.array([[[[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 6.0]]]])
    assert_agrees(curvature(J, second, np.eye(2)[None]), 6.0, rtol=1e-12)


@pytest.mark.oracle("closed form: geometric and quadratic sequences", "order of convergence", 1e-9)
def test_orders_of_sequences_are_recovered():
    linear = 0.3 ** np.arange(10)
    assert_agrees(orders_of(linear)[-1], 1.0, atol=1e-9)
    assert_agrees(orders_of(0.5 ** (2.0 ** np.arange(6)))[-1], 2.0, atol=1e-9)
    assert len(orders_of(linear[:2])) == 0


@pytest.mark.oracle(
    "own second implementation: norms and eigenvalues by NumPy",
    "contraction of eq. (15) and spectral radius",
    1e-7,
)
def test_stored_contraction_is_that_of_the_model_at_the_truth():
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.01), GaussianPrior(), 1.0)
    block = Block.draw(scenario, 0, CURVED + 3)
    columns = block.truth_columns()
    model = scenario.measurement
    slope = np.eye(4) - np.linalg.pinv(model.matrix) @ model.jacobian(block.trials.x)
    assert_agrees(columns["contraction_K"], 4 * np.abs(slope).max(axis=(1, 2)), rtol=1e-9)
    assert_agrees(columns["contraction_norm"], np.abs(slope).sum(axis=2).max(axis=1), rtol=1e-9)
    radius = [np.abs(np.linalg.eigvals(s)).max() for s in slope]
    assert_agrees(columns["contraction_radius"], radius, rtol=1e-7)
    # M is stored for the first trials of the scenario, whatever the block.
    assert np.isfinite(columns["curvature_M"]).tolist() == [True] * CURVED + [False] * 3
    later = Block.draw(scenario, CURVED - 1, CURVED + 3).truth_columns()
    assert np.array_equal(
        later["curvature_M"], columns["curvature_M"][CURVED - 1 :], equal_nan=True
    )


@pytest.fixture(scope="module")
def analysis(tmp_path_factory):
    folder = tmp_path_factory.mktemp("theory")
    scenarios = [
        Scenario(Polynomial(strength=0.02), Gaussian(0.1), GaussianPrior(), 1.0),
        Scenario(Polynomial(strength=0.02), Gaussian(0.1), GaussianPrior(), 5.0),
    ]
    estimators = {"linear_lse": LinearLSE(), "fixed_point": FixedPoint(), "newton": Newton()}
    assert compute(scenarios, estimators, 400, folder) == ()
    return analyse([folder])


def test_eq_14_and_the_sandwich_stand_beside_what_happened(analysis):
    """Eq. (14) is H+ R H+' + E[c c'] with c = H+ (N(x) - N(x^)); the same from the model's own
    values."""
    total = analysis.summary[analysis.summary["parameter"] == "all"].set_index(
        ["estimator", "error_scale"]
    )
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.1), GaussianPrior(), 5.0)
    block = Block.draw(scenario, 0, 400)
    estimates, columns = block.estimate(Newton())
    solved = columns["solved"]
    problem, x, truth = scenario.problem, estimates.x[solved], block.trials.x[solved]
    H_plus, _ = pseudo_inverse(problem.H[None], problem.R)
    model = problem.measurement
    dN = model.simulate(truth) - model.simulate(x) - (truth - x) @ problem.H.T
    c = dN @ H_plus[0].T
    system = FrozenSystem.at_nominal(problem, block.trials.z)
    linear = np.diagonal(system.covariance()[0])
    expected = np.sqrt(np.mean((linear + np.mean(c**2, axis=0)) / linear))
    newton = total.loc[("newton", 5.0)]
    assert newton["eq_14"] == pytest.approx(expected, rel=1e-4)
    assert newton["eq_14"] > 1.01
    sandwich = np.diagonal(system.sandwich(estimates.x)[solved].mean(axis=0))
    assert newton["reported"] == pytest.approx(np.sqrt(np.mean(sandwich / linear)), rel=1e-9)
    crlb = np.diagonal(inverse(information(model.jacobian(truth), problem.R))[0].mean(axis=0))
    assert newton["crlb"] == pytest.approx(np.sqrt(np.mean(crlb / linear)), rel=1e-9)
    # To first order the sandwich is what happens; eq. (14) is not.
    assert newton["reported"] == pytest.approx(newton["rmse_solved"], rel=0.08)
    assert np.isnan(total.loc[("linear_lse", 5.0), "eq_14"])


def test_how_iterations_converge_is_in_the_report(analysis):
    """Newton's iteration converges quadratically, eq. (23), the fixed point's linearly, eq.
    (18)."""
    orders = analysis.scores.set_index(["estimator", "error_scale"])["order_median"]
    assert orders["newton", 5.0] == pytest.approx(2.0, abs=0.4)
    assert orders["fixed_point", 5.0] == pytest.approx(1.0, abs=0.2)
    scores = analysis.scores.set_index(["estimator", "error_scale"])
    fixed, newton = scores.loc[("fixed_point", 1.0)], scores.loc[("newton", 5.0)]
    assert fixed["eq_18_trials"] > 0
    assert fixed["eq_18_holds"] == 1.0
    assert 0 < fixed["eq_18_error_over_bound"] < 1
    assert newton["eq_23_M"] > 0
    assert newton["eq_18_trials"] == 0
    names = [t.name for t in all_tables(analysis) if t.appendix]
    assert {"contraction", "covariances", "iterations"} <= set(names)


def test_false_roots_say_how_far_off_they_are(synthetic):
    e = 0.1 * np.random.default_rng(0).normal(size=(60, 3))
    solved = np.arange(60) >= 20
    synthetic.add(
        synthetic.scenario(), "one", e, solved=solved, root_distance=np.where(solved, 0.0, 7.0)
    )
    total = analyse([synthetic.directory]).summary.iloc[-1]
    assert total["false_root"] == pytest.approx(1 / 3)
    assert total["false_root_distance"] == 7.0
