"""Every model under every estimator that it admits: at small error scale the efficient ones reach
the bound."""

import pytest
from omegaconf import OmegaConf
from scipy.stats import norm

from ipe_bench.api import run
from ipe_bench.cli.session import jobs_of, session
from ipe_bench.cli.words import read
from ipe_bench.estimators.base import Estimator
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.trials.scenario import Scenario

EXPERIMENTS = ("paper", "ranging", "bearings", "polynomial", "lotka_volterra")
TRIALS = 200
EFFICIENT = ("least_squares", "map")
"""Estimating equations whose root reaches the bound at first order whatever the error scale."""
SLOW_TO_CONVERGE = {("paper", "multiscale_lm")}
"""Stops at its limit of iterations in most trials, after minutes; the other models have it."""


def scenario(experiment: str) -> Scenario:
    """The model of an experiment with the experiment's noise, at error scale 0.1; GINS with white
    noise, since quantisation at that scale is none."""
    words = [f"+experiment={experiment}", "error_scale=0.1"]
    if experiment == "paper":
        words.append("noise=gaussian")
    with session():
        return jobs_of(read("run", words), multirun=True).specs[0].scenario


def every_estimator(experiment: str, scenario: Scenario) -> dict[str, Estimator]:
    """All that come with the bench and have what they need."""
    own = plugins.sources()[0]
    found = {}
    for option in (o for group in plugins.ESTIMATOR_GROUPS for o in plugins.options(group)):
        if option.source == own:
            config = OmegaConf.to_container(OmegaConf.load(option.path), resolve=True)
            estimator = construct(config, f"estimators.{option.name}")
            if (
                not estimator.hindrance(scenario.problem)
                and (experiment, option.name) not in SLOW_TO_CONVERGE
            ):
                found[option.name] = estimator
    return found


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_efficient_estimators_reach_the_bound(experiment):
    """The 95 % interval of the row `all`, widened for as many models as there are, contains the
    Cramér-Rao bound, or for estimators with a prior the Bayesian one. Its upper end is taken to be
    as many times the value as that is of the lower one: the errors of efficient estimators are
    nearly normal, so none is rare and large."""
    one = scenario(experiment)
    estimators = every_estimator(experiment, one)
    table = run(one, estimators, TRIALS)
    rows = table[table["parameter"] == "all"].set_index("estimator")
    wider = norm.isf(0.01 / (2 * len(EXPERIMENTS))) / norm.isf(0.025)
    failed = {}
    for label, estimator in estimators.items():
        row = rows.loc[label]
        bound = row["bayes_bound"] if "prior" in estimator.needs else row["crlb"]
        low = row["rmse_solved"] - wider * (row["rmse_solved"] - row["rmse_solved_low"])
        high = row["rmse_solved"] * (1 + wider * (row["rmse_solved"] / row["rmse_solved_low"] - 1))
        efficient = estimator.equation in EFFICIENT
        if efficient and not (row["converged"] == 1 and low <= bound <= high):
            failed[label] = (
                f"converged {row['converged']}, rmse {low:.4g} to {high:.4g}, bound {bound:.4g}"
            )
    assert not failed, failed
    assert sum(e.equation in EFFICIENT for e in estimators.values()) >= 6
