"""Runs in which the levels of the noise are not known: bounds are joint, and estimators are told
the nominal R."""

import numpy as np
import pytest
from rich.console import Console
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.measurements import Formula
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.report.tables.table import terminal
from ipe_bench.report.tables.terminal import summary_tables
from ipe_bench.trials.scoring import Block

TIMES = tuple(np.linspace(0.2, 8.0, 12))
DECAY = Formula("a*exp(-k*t)", {"a": 10.0, "k": 0.9}, {"t": TIMES})
NOISE = Unknown(sigma="floor + share*h", levels=(0.1, 0.08))
SCENARIO = ib.Scenario(DECAY, NOISE, error_scale=0.1)


@pytest.mark.oracle(
    "closed form: information of a normal law (Kay 1993, eq. 3.31)",
    "bounds of parameters beside unknown levels",
    1e-10,
)
def test_the_bound_is_that_of_parameters_and_levels_together():
    """By the information of any normal law, from its mean and covariance (Kay 1993, eq. 3.31)."""
    block = Block.draw(SCENARIO, 0, 3)
    t = np.array(TIMES)
    for x, bound in zip(block.trials.x, block.crlb_deviation, strict=True):
        u = np.concatenate([x, np.log(NOISE.levels)])
        steps = [(u + 1e-30j * e) for e in np.eye(4)]
        h = [10 * v[0] * np.exp(-0.9 * v[1] * t) for v in (u, *steps)]
        variance = [
            (np.exp(v[2]) + np.exp(v[3]) * m) ** 2 for v, m in zip((u, *steps), h, strict=True)
        ]
        dh, dR = (np.array([value.imag for value in a[1:]]) / 1e-30 for a in (h, variance))
        fisher = (dh / variance[0]) @ dh.T + 0.5 * (dR / variance[0] ** 2) @ dR.T
        assert_agrees(bound, np.sqrt(np.diag(np.linalg.inv(fisher)))[:2], rtol=1e-10)


def test_a_level_that_no_reading_depends_on_leaves_the_bound_as_it_is():
    told, untold = Unknown(levels=(0.3,)), Gaussian(0.3)
    known, unknown = (Block.draw(ib.Scenario(DECAY, noise), 0, 2) for noise in (untold, told))
    assert unknown.crlb_deviation == pytest.approx(known.crlb_deviation, rel=1e-12)
    assert unknown.trials.z == pytest.approx(known.trials.z)


def test_estimators_are_told_the_nominal_level_and_marked_so(tmp_path):
    h = 10 * np.exp(-0.9 * np.array(TIMES))
    assert SCENARIO.problem.R.deviations == pytest.approx(0.1 + 0.08 * h)
    frame = ib.run(SCENARIO, {"lm": ib.baselines.LevenbergMarquardt()}, trials=200, output=tmp_path)
    total = frame[frame["parameter"] == "all"].iloc[0]
    assert total["success"] > 0.95
    with (shown := Console(width=200)).capture() as printed:
        shown.print(terminal(summary_tables(frame.to_dict("records"), None, 120), 120))
    assert "every estimator here assumes R with the true levels" in printed.get()


def test_without_levels_a_run_is_refused():
    with pytest.raises(ib.UserError, match="noise=unknown: has no level to simulate with"):
        ib.run(ib.Scenario(DECAY, Unknown()), {"lm": ib.baselines.LevenbergMarquardt()}, trials=2)


def test_levels_that_do_not_suit_are_refused():
    with pytest.raises(
        ib.UserError, match=r"noise.levels: has 1 numbers; give one for each of a0, b0"
    ):
        Unknown(sigma="a0 + b0*h", levels=(1.0,))
    with pytest.raises(ib.UserError, match=r"noise.by: does not go with noise.levels"):
        Unknown(by="t", levels=(1.0,))
