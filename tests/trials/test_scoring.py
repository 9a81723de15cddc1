"""What counts as solved, and as a covariance, in the score of a block."""

from dataclasses import dataclass

import numpy as np
import pytest
from shared.oracles import assert_agrees
from shared.small_models import Bent, bock
from shared.synthetic_store import Repeated

import ipe_bench as ib
from ipe_bench import Scenario, run
from ipe_bench.baselines import GaussNewton, LinearLSE, MapLM
from ipe_bench.basics.linalg import information, inverse
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.statistics import analyse
from ipe_bench.trials.scoring import Block
from ipe_bench.trials.thresholds import EXPECTED

SCENARIO = Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior(), 1.0)


@pytest.mark.parametrize("inflation", [0.3, 1.0, 3.0])
def test_map_is_held_to_the_root_of_its_own_prior(inflation):
    _, columns = Block.draw(SCENARIO, 0, 40).estimate(MapLM(prior_inflation=inflation))
    assert columns["solved"].all()


def test_a_prior_that_fixes_a_parameter_leaves_finite_bounds():
    scenario = Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior((1.0, 0.0, 1.0)), 1.0)
    block = Block.draw(scenario, 0, 20)
    _, columns = block.estimate(MapLM())
    assert np.isfinite(block.bayes_information).all()
    assert columns["success"].all()


@pytest.mark.parametrize("mu", [2.0, 20.0])
def test_bounds_of_ill_conditioned_models_are_those_of_their_singular_values(mu):
    """Bock's equations at mu = 20: singular values from 1e10 to .2, of which J'J keeps the largest
    alone."""
    block = Block.draw(Scenario(bock(mu), Gaussian(0.05)), 0, 5)
    J, columns = block.problem.R.whiten_jacobian(block.jacobian), block.truth_columns()
    prior = np.diag(1 / np.asarray(block.problem.prior_deviation))
    below = np.concatenate([J, np.broadcast_to(prior, (5, 3, 3))], axis=1)
    for bound, A in (("crlb", J), ("bayes", below)):
        _, s, right = np.linalg.svd(A, full_matrices=False)
        deviation = np.sqrt(np.sum((right / s[:, :, None]) ** 2, axis=1))
        found = np.stack(
            [columns[f"{bound}_{p.name}"] for p in block.problem.measurement.parameters], axis=1
        )
        np.testing.assert_allclose(found, deviation, rtol=1e-9)
    found = [columns[f"van_trees_{p.name}"][0] for p in block.problem.measurement.parameters]
    truths = block.scenario.truths(0, EXPECTED)
    rows = block.problem.R.whiten_jacobian(block.problem.measurement.jacobian(truths)).reshape(
        -1, 3
    )
    _, s, right = np.linalg.svd(
        np.concatenate([rows / np.sqrt(EXPECTED), prior]), full_matrices=False
    )
    np.testing.assert_allclose(found, np.sqrt(np.sum((right / s[:, None]) ** 2, axis=0)), rtol=1e-8)


def test_residuals_of_angles_are_within_half_a_turn():
    """By a bearing of about pi, whose readings are on both sides of it; more turns of the model
    change nothing."""
    bearing = ib.measurements.Formula(
        "arctan2(b, a - s)",
        {"a": -1.0, "b": 0.001},
        {"s": tuple(np.linspace(0, 5, 40))},
        circular=("y",),
    )
    block = Block.draw(Scenario(bearing, Gaussian(0.1), error_scale=1e-3), 0, 5)
    h = block.readings_at(block.trials.x)
    assert np.abs(block.errors(h)).max() < 0.5
    for turns in (-2, -1, 1, 3):
        np.testing.assert_allclose(block.errors(h + 2 * np.pi * turns), block.errors(h), atol=1e-12)


@dataclass(frozen=True)
class Loud(GaussianPrior):
    """A prior that cannot be drawn from."""

    def draw(self, x0, error_scale, rng):
        raise RuntimeError("no such distribution")


def test_what_fails_is_warned_of_and_not_dropped_silently():
    scenario = Scenario(Bent(0.02), Gaussian(0.1), Loud(), 1.0)
    with pytest.warns(UserWarning, match="no such distribution"):
        run(scenario, {"linear_lse": LinearLSE()}, 4)


@dataclass(frozen=True)
class Beside(Estimator):
    """The least-squares root, moved along one parameter by some deviations of the bound."""

    by: float = 0.0
    equation = "least_squares"

    def estimate(self, problem, z, *, history=False):
        found = GaussNewton(tolerance=1e-10).estimate(problem, z)
        J = problem.measurement.jacobian(found.x)
        found.x[:, 0] += self.by * np.sqrt(inverse(information(J, problem.R))[0][:, 0, 0])
        return found


@pytest.mark.parametrize(
    ("by", "solved"), [(0.0, True), (0.5e-3, True), (2e-3, False), (1.0, False)]
)
def test_another_root_is_one_that_lies_a_thousandth_of_a_deviation_away(by, solved):
    _, columns = Block.draw(SCENARIO, 0, 40).estimate(Beside(by))
    assert (columns["solved"] == solved).all()
    np.testing.assert_allclose(columns["root_distance"], by, rtol=0.05, atol=1e-5)


@pytest.mark.oracle(
    "closed form: one normal reading of a normal parameter", "Cramér-Rao and Bayesian bounds", 1e-9
)
def test_the_bayesian_bound_has_the_prior_in_it_and_so_has_its_gate():
    """Linear, one reading of each parameter: the variance is 1 / (1 / sigma^2 + 1 / d^2), sigma = d
    = 1."""
    scenario = Scenario(Repeated(names=("a", "b"), repeats=1), Gaussian(1.0), GaussianPrior(), 1.0)
    block = Block.draw(scenario, 0, 4)
    columns = block.truth_columns()
    assert_agrees(
        [columns["crlb_a"], columns["bayes_a"]], [[1.0] * 4, [np.sqrt(0.5)] * 4], rtol=1e-9
    )

    @dataclass(frozen=True)
    class Off(Estimator):
        needs = frozenset({"prior"})

        def estimate(self, problem, z, *, history=False):
            x = block.trials.x + np.array([[3.0, 0.0], [3.5, 0.0], [3.9, 0.0], [5.5, 0.0]])
            return Estimates(x, np.zeros(4, np.int8))

    # The gate is at sqrt(chi2_2(1 - 1e-6)) = 5.26 deviations: 3.72 of the Bayesian bound, 5.26 of
    # the other.
    assert block.estimate(Off())[1]["success"].tolist() == [True, True, False, False]


@pytest.mark.oracle(
    "closed form: one normal reading of a normal parameter", "Van Trees's bound", 1e-9
)
def test_van_trees_bound_is_that_of_the_mean_information():
    """In closed form where h is linear, the same at every truth; and below the mean of the local
    bounds where it is not, as Jensen's inequality has it."""
    linear = Scenario(Repeated(names=("a", "b"), repeats=1), Gaussian(1.0), GaussianPrior(), 1.0)
    columns = Block.draw(linear, 0, 4).truth_columns()
    assert_agrees(columns["van_trees_a"][0], np.sqrt(0.5), rtol=1e-9)
    assert columns["van_trees_error_a"][0] == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(columns["van_trees_a"][1:]).all()
    assert np.isnan(Block.draw(linear, 4, 8).truth_columns()["van_trees_a"]).all()
    bent = Scenario(Bent(0.3), Gaussian(0.1), GaussianPrior(), 1.0)
    whole, part = (Block.draw(bent, 0, stop).truth_columns() for stop in (EXPECTED, 3))
    for name in ("a", "b", "c"):
        local = np.mean(whole[f"bayes_{name}"] ** 2)
        assert whole[f"van_trees_{name}"][0] ** 2 <= local
        # Whatever the block, it is the same bound.
        assert whole[f"van_trees_{name}"][0] == part[f"van_trees_{name}"][0]


def test_van_trees_bound_tells_its_own_error():
    """The scatter of the bound over 60 seeds, each with truths of its own, is known to 1 /
    sqrt(120), 9 %."""
    found = []
    for seed in range(60):
        columns = Block.draw(
            Scenario(Bent(0.3), Gaussian(0.1), GaussianPrior(), 1.0, seed), 0, 1
        ).truth_columns()
        found.append([columns["van_trees_a"][0], columns["van_trees_error_a"][0]])
    bounds, errors = np.array(found).T
    assert 0.01 < bounds.std() / bounds.mean() < 0.2
    assert np.isfinite(errors).mean() > 0.9
    assert np.sqrt(np.nanmean(errors**2)) == pytest.approx(bounds.std(ddof=1), rel=0.25)


def test_van_trees_bound_tells_no_error_where_few_truths_carry_it():
    """Rates of decay that scatter as widely as they are large: intervals would hold the bound in .6
    of cases."""
    decay = ib.measurements.Formula(
        "a*exp(-b*t)", {"a": 2.0, "b": 0.7}, {"t": tuple(np.linspace(0.5, 5, 10))}
    )
    columns = Block.draw(Scenario(decay, Gaussian(0.1), GaussianPrior(), 1.0), 0, 1).truth_columns()
    assert np.isfinite(columns["van_trees_a"][0])
    assert np.isnan(columns["van_trees_error_a"][0])


@dataclass(frozen=True)
class Gap(Bent):
    """Has readings where the first parameter is above 0 alone."""

    analytic, nominal = False, np.array([0.5, 0.0, 0.0])  # type: ignore[assignment]

    def simulate(self, x):
        return np.where(x[:, :1] > 0.0, super().simulate(x), np.nan)


def test_trials_whose_truth_has_no_readings_are_told_apart_from_failures_of_estimators(tmp_path):
    block = Block.draw(Scenario(Gap(), Gaussian(0.1)), 0, 20)
    _, columns = block.estimate(LinearLSE())
    assert ((columns["status"] == "no_readings") == (block.trials.x[:, 0] <= 0.0)).all()
    table = run(
        Scenario(Gap(), Gaussian(0.1)),
        {"lse": LinearLSE(), "map": MapLM()},
        trials=20,
        output=tmp_path,
    )
    lost = int((columns["status"] == "no_readings").sum())
    assert 0 < lost < 20
    assert (ib.load(tmp_path)["status"] == "no_readings").sum() == 2 * lost
    overall = table[table["parameter"] == "all"]
    assert overall["trials"].tolist() == [20 - lost] * 2
    assert overall["no_readings"].tolist() == [lost] * 2
    assert (
        overall["success"].iloc[0] == columns["success"][columns["status"] != "no_readings"].mean()
    )
    endings = analyse([tmp_path]).endings
    endings = endings[endings["status"] == "no_readings"]
    assert endings["trials"].tolist() == [lost] * 2
    assert endings["share"].tolist() == [lost / 20] * 2
