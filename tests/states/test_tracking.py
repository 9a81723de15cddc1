"""State models on trial: what is stored, pooled and shown of tracks, against direct computation and
closed forms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2
from shared.oracles import agreed
from shared.state_models import ConstantVelocity, CoordinatedTurn, Growth, Pendulum

import ipe_bench as ib
from ipe_bench.cli.session import jobs_of, session
from ipe_bench.cli.words import read
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import composed, options
from ipe_bench.report.page.headline import headline
from ipe_bench.states import (
    Bootstrap,
    Cubature,
    Formulas,
    IteratedSmoother,
    Smoother,
    Tracker,
    ckf,
    ekf,
    ukf,
)
from ipe_bench.states.algebra import root
from ipe_bench.statistics import analyse
from ipe_bench.statistics.certified import published_table
from ipe_bench.statistics.collect import collect
from ipe_bench.trials.paths import PathBlock, StateScenario, packed, unpacked

LINEAR = ConstantVelocity(count=30, spread=3.0)


def row(table, estimator, parameter="all"):
    (found,) = table[(table["estimator"] == estimator) & (table["parameter"] == parameter)].to_dict(
        "records"
    )
    return found


def test_a_run_says_what_direct_computation_says(tmp_path):
    model = Pendulum(count=40, start=(0.5, 0.0), spread=0.2)
    trackers = {"ekf": ekf(), "rts": Smoother(ukf())}
    table = ib.run(StateScenario(model, seed=3), trackers, 60, block_size=25, output=tmp_path)
    paths = model.draw(0, 60, 3)
    for label, tracker in trackers.items():
        tracks = tracker.track(model, paths.z)
        e = tracks.mean - paths.x
        nees = np.einsum("tki,tkij,tkj->tk", e, np.linalg.inv(tracks.covariance), e)
        found = row(table, label, "angle")
        assert found["path_rmse_solved"] == pytest.approx(
            np.sqrt(np.mean(e[..., 0] ** 2)), rel=1e-12
        )
        assert found["rmse_solved"] == pytest.approx(np.sqrt(np.mean(e[:, -1, 0] ** 2)), rel=1e-12)
        assert found["path_nees_solved"] == pytest.approx(nees.mean() / 2, rel=1e-9)
        assert found["nees_solved"] == pytest.approx(
            np.mean(e[:, -1, 0] ** 2 / tracks.covariance[:, -1, 0, 0]), rel=1e-9
        )
        curve = analyse([tmp_path]).tracks.query(f"estimator == '{label}' and parameter == 'rate'")
        size = np.abs(e[..., 1])
        np.testing.assert_allclose(curve["median"], np.median(size, axis=0), rtol=1e-6)
        np.testing.assert_allclose(curve["q90"], np.quantile(size, 0.9, axis=0), rtol=1e-6)
        np.testing.assert_allclose(curve["nees_solved"], nees.mean(axis=0) / 2, rtol=1e-9)
        np.testing.assert_array_equal(curve["at"], model.times)
    tracks = ekf().track(model, paths.z)
    assert row(table, "ekf")["path_nis"] == pytest.approx(tracks.nis.mean(), rel=1e-12)
    assert row(table, "ekf")["log_likelihood"] == pytest.approx(
        tracks.log_likelihood.mean(), rel=1e-12
    )
    assert np.isnan(row(table, "rts")["path_nis"])


@pytest.mark.slow
def test_a_sweep_of_states_opens_with_who_holds(tmp_path):
    for scale in (1.0, 10.0):
        ib.run(
            StateScenario(LINEAR, error_scale=scale),
            {"ekf": ekf(), "ukf": ukf()},
            40,
            output=tmp_path,
        )
    states = "ekf and ukf succeed up to error scale 10 (100 % of 40 trials)"
    assert str(headline(analyse([tmp_path]))[0]).startswith(states)
    ib.run(
        ib.Scenario(ib.measurements.Polynomial()),
        {"newton": ib.solvers.Newton()},
        5,
        output=tmp_path,
    )
    constants, *_, of_states, _, _ = headline(analyse([tmp_path]))
    assert "newton" in str(constants)
    assert of_states == states


def test_sums_that_another_version_stored_are_left_out():
    own, older = np.arange(20.0).reshape(4, 5), np.arange(12.0).reshape(4, 3)
    texts = np.concatenate([packed(3, [own[:, :2], own[:, 2:]]), packed(2, [older])])
    np.testing.assert_array_equal(unpacked(texts, 4, 5), [own])
    assert unpacked(texts, 4, 2).shape == (0, 4, 2)


@pytest.mark.slow
def test_the_mean_nis_of_several_readings_an_epoch_is_that_of_one():
    model, scenario = CoordinatedTurn(), StateScenario(CoordinatedTurn(), seed=3)
    z = model.draw(0, 20, 3).z
    tracks = ckf().track(model, z)
    each = tracks.nis.sum(axis=1) / np.isfinite(z).sum(axis=(1, 2))
    found = row(ib.run(scenario, {"ckf": ckf()}, 20), "ckf")
    assert found["path_nis"] == pytest.approx(each.mean(), rel=1e-9)
    assert z.shape[2] == 2


def test_the_kalman_filter_attains_both_bounds_on_its_own_model():
    table = ib.run(StateScenario(LINEAR), {"kf": ekf(), "rts": Smoother(ekf())}, 400)
    found = row(table, "kf")
    assert row(table, "rts")["path_rmse_solved"] == pytest.approx(1.0, abs=0.06)
    assert row(table, "rts")["path_success"] == found["path_success"] == 1.0
    assert found["success"] == 1.0
    assert found["path_rmse_solved"] == pytest.approx(1.0, abs=0.06)
    assert {found[name] for name in ("verdict", "path_verdict", "nis_verdict")} == {"consistent"}
    assert found["path_nees_solved"] == pytest.approx(1.0, abs=0.06)
    assert found["path_nis"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / (400 * 30)))
    assert found["error_median"] == pytest.approx(np.sqrt(np.log(2)), abs=0.1)
    smoothed = Smoother(ekf()).track(LINEAR, LINEAR.draw(0, 1).z).covariance[0]
    P = ekf().track(LINEAR, LINEAR.draw(0, 1).z).covariance[0]
    for i, name in enumerate(("position", "velocity")):
        one = row(table, "kf", name)
        for column in ("van_trees", "bayes_bound", "linear_bound", "reported"):
            assert one[column] == pytest.approx(np.sqrt(P[-1, i, i]), rel=1e-8)
        assert one["path_bound"] == pytest.approx(np.sqrt(P[:, i, i].mean()), rel=1e-8)
        assert row(table, "rts", name)["path_bound"] == pytest.approx(
            np.sqrt(smoothed[:, i, i].mean()), rel=1e-8
        )


@pytest.mark.slow
def test_an_error_scale_widens_the_prior_of_truth_and_trackers(tmp_path):
    trackers = {"ckf": ckf(), "rts": Smoother(ekf())}
    for scale, name in ((1.0, "one"), (3.0, "three")):
        ib.run(LINEAR, trackers, 20, error_scale=scale, output=tmp_path / name)
        ib.run(
            replace(LINEAR, spread=3.0 * scale), trackers, 20, output=tmp_path / f"{name} written"
        )
        one, other = (ib.load(tmp_path / each) for each in (name, f"{name} written"))
        drop = ["time_s", "error_scale", "spread"]
        frames = [each.drop(columns=drop, errors="ignore") for each in (one, other)]
        pd.testing.assert_frame_equal(*frames, check_exact=scale == 1.0, rtol=1e-12)
    both = [StateScenario(LINEAR, error_scale=scale) for scale in (1.0, 3.0)]
    table = ib.run(both, trackers, 20)
    assert sorted(table["error_scale"].unique()) == [1.0, 3.0]
    stored = construct(
        composed(next(o for o in options("state_model") if o.name == "pendulum_book")),
        "state_model",
    )
    with pytest.raises(ib.UserError, match=r"error_scale=10: state_model=.* has stored paths"):
        StateScenario(stored, error_scale=10.0)
    with pytest.raises(
        ib.UserError, match="error_scale=: is part of the state model or its scenario"
    ):
        ib.run(both[0], trackers, 3, error_scale=2.0)


def test_only_the_states_that_are_named_are_scored():
    model = Formulas(
        next={"x": "x + c + w", "c": "c"},
        readings={"z": "x"},
        noise={"w": 0.1},
        deviation={"z": 1.0},
        spread={"x": 1.0, "c": 1.0},
        scored=("c",),
        count=20,
    )
    table = ib.run(model, {"kf": ekf()}, 30)
    tracks, paths = ekf().track(model, model.draw(0, 30).z), model.draw(0, 30)
    e = tracks.mean[:, -1, 1] - paths.x[:, -1, 1]
    assert set(table["parameter"]) == {"c", "all"}
    assert row(table, "kf", "c")["rmse_solved"] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-12)
    with pytest.raises(ib.UserError, match="scored: d: there is no such state"):
        StateScenario(replace(model, scored=("d",)))


@pytest.mark.slow
def test_trackers_that_are_named_are_all_that_an_experiment_runs():
    def chosen(*more):
        with session():
            return (
                jobs_of(read("run", ["+experiment=states", *more]), multirun=True)
                .specs[0]
                .estimators
            )

    assert list(chosen("tracker=[ekf,ipls]")) == ["ekf", "ipls"]
    assert len(chosen()) == 12
    assert chosen()["ipls"] == IteratedSmoother(ukf(), Cubature())


@dataclass(frozen=True)
class Deceived(Tracker):
    """The Kalman filter with another process noise than the states have."""

    assumed: ConstantVelocity

    def track(self, model, z):
        return ekf().track(self.assumed, z)


def test_innovations_are_white_where_the_filter_is_right_and_nowhere_else(tmp_path):
    table = ib.run(
        StateScenario(LINEAR),
        {
            "kf": ekf(),
            "told": Deceived(replace(LINEAR, density=0.05 * LINEAR.density)),
            "rts": Smoother(ekf()),
        },
        600,
        output=tmp_path,
    )
    right, wrong = row(table, "kf"), row(table, "told")
    assert right["not_white"] == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 600))
    assert right["not_white_low"] < 0.05 < right["not_white_high"]
    assert wrong["not_white_low"] > 0.2
    assert np.isnan(row(table, "rts")["not_white"])
    p = ib.load(tmp_path).query("estimator == 'kf'").set_index("trial")["white_p"]
    (e,) = ekf().track(LINEAR, LINEAR.draw(7, 8).z).innovations[..., 0]
    r = [e[k:] @ e[: len(e) - k] / (e @ e) for k in range(1, 7)]
    Q = 30 * 32 * sum(r[k - 1] ** 2 / (30 - k) for k in range(1, 7))
    assert p[7] == pytest.approx(chi2.sf(Q, 6), rel=1e-9)


def test_blocks_and_further_trials_change_no_trial(tmp_path):
    scenario, trackers = StateScenario(LINEAR, seed=1), {"ckf": ckf(), "particles": Bootstrap(50)}
    for trials, size in ((7, 3), (20, 50)):
        ib.run(scenario, trackers, trials, block_size=size, output=tmp_path / "parts")
    ib.run(scenario, trackers, 20, output=tmp_path / "whole")
    parts, whole = (ib.load(tmp_path / name).drop(columns="time_s") for name in ("parts", "whole"))
    order = ["estimator", "trial"]
    assert "log_likelihood" in parts.columns
    assert not [name for name in parts.columns if "curves" in name]
    assert (
        parts.sort_values(order)
        .reset_index(drop=True)
        .equals(whole.sort_values(order).reset_index(drop=True))
    )


@dataclass(frozen=True)
class Brittle(Tracker):
    """The Kalman filter, which raises where a reading is large and is lost where one is very
    negative."""

    def track(self, model, z):
        if (z > 1e5).any():
            raise ArithmeticError("a reading is beyond 1e5")
        tracks = ekf().track(model, z)
        tracks.mean[(z < -1e5).any(axis=(1, 2)), 5:] = np.nan
        return tracks


def test_a_tracker_that_fails_in_one_trial_fails_in_that_alone():
    paths = LINEAR.draw(0, 6)
    paths.z[2, 9], paths.z[4, 9] = 1e6, -1e6
    block = PathBlock(StateScenario(LINEAR), 0, paths)
    estimates, columns = block.estimate(Brittle())
    assert columns["status"].tolist() == ["converged"] * 2 + [
        "error",
        "converged",
        "nonfinite",
        "converged",
    ]
    assert "a reading is beyond 1e5" in columns["message"][2]
    assert columns["message"][4] == "the track is not finite from epoch 6 on"
    alone = ekf().track(LINEAR, paths.z)
    np.testing.assert_array_equal(estimates.x[[0, 1, 3, 5]], alone.mean[[0, 1, 3, 5], -1])
    assert columns["success"].tolist() == [True, True, False, True, False, True]
    np.testing.assert_array_equal(
        columns["first_bad_epoch"], [np.nan, np.nan, 1, np.nan, 6, np.nan]
    )


@dataclass(frozen=True)
class Astray(Tracker):
    """The states themselves, but for the epochs `where`, at which the position is `by` deviations
    of the bound off."""

    block: PathBlock
    where: slice
    by: float

    def track(self, model, z):
        tracks = ekf().track(model, z)
        tracks.mean = self.block.paths.x.copy()
        tracks.mean[:, self.where, 0] += self.by * np.sqrt(self.block.variances[:, self.where, 0])
        return tracks


@pytest.mark.parametrize(
    ("where", "by", "success"),
    [
        (slice(4, 5), 25.0, True),
        (slice(4, 5), 30.0, False),
        (slice(None), 5.0, True),
        (slice(None), 5.5, False),
    ],
)
def test_a_path_succeeds_if_its_mean_square_error_is_within_the_gate(where, by, success):
    """The gate of two states is at 27.6: 25^2 / 30 and 5^2 are inside, 30^2 / 30 and 5.5^2 are
    not."""
    block = PathBlock.draw(StateScenario(LINEAR), 0, 3)
    assert (block.estimate(Astray(block, where, by))[1]["path_success"] == success).all()


def test_the_posterior_bound_tells_its_own_error():
    """The scatter of the bound over 40 seeds, each with paths of its own, is known to 1 / sqrt(80),
    11 %."""
    found = []
    for seed in range(40):
        columns = PathBlock.draw(
            StateScenario(Pendulum(count=2, spread=0.5), seed=seed), 0, 1
        ).truth_columns()
        found.append([columns["van_trees_angle"][0], columns["van_trees_error_angle"][0]])
    bounds, errors = np.array(found).T
    assert bounds.std() > 0
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(bounds.std(ddof=1), rel=0.4)


def test_filters_of_constants_and_of_states_are_told_apart():
    with pytest.raises(
        ib.UserError, match=r"estimators\.ekf: estimates constants; a state model takes trackers"
    ):
        ib.run(StateScenario(LINEAR), {"ekf": ib.baselines.EKF()}, 3)
    constant = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    with pytest.raises(ib.UserError, match=r"estimators\.ekf: tracks states that move"):
        ib.run(constant, {"ekf": ekf()}, 3)


@dataclass(frozen=True)
class Odd(ConstantVelocity):
    """A model of which one part is wrong."""

    part: str = ""

    @property
    def times(self):
        return super().times[::-1] if self.part == "times" else super().times

    def Q(self, k):
        wrong = {
            "size": np.eye(3),
            "skew": np.array([[1.0, 0.5], [0.0, 1.0]]),
            "negative": -np.eye(2),
        }
        return wrong.get(self.part, super().Q(k))

    def observe(self, x, k):
        return x if self.part == "reading" else super().observe(x, k)

    def R(self, k):
        return np.zeros((1, 1)) if self.part == "noise" else super().R(k)


@pytest.mark.parametrize(
    ("part", "complaint"),
    [
        ("times", "its times decrease from one epoch to the next"),
        ("size", r"Q of epoch 1 has shape \(3, 3\), where \(2, 2\) belongs"),
        ("skew", "Q of epoch 1 is not symmetric"),
        ("negative", "Q of epoch 1 has a negative eigenvalue"),
        ("reading", r"h has shape \(1, 2\), where \(1, 1\) belongs"),
        ("noise", "R of epoch 1 is singular"),
    ],
)
def test_a_model_whose_parts_do_not_suit_one_another_is_refused(part, complaint):
    StateScenario(Odd())
    with pytest.raises(ib.UserError, match=f"state_model=odd: {complaint}"):
        StateScenario(Odd(part=part))


@pytest.mark.slow
def test_nees_of_the_kalman_filter_lies_within_its_limits_as_often_as_is_said():
    """1,000 studies of 40 trials: the mean NEES at the last epoch, and the verdict on the whole
    path."""
    table = ib.run([StateScenario(LINEAR, seed=s) for s in range(2)], {"kf": ekf()}, 20)
    found = row(table, "kf")
    low, high = found["nees_solved_low_if_honest"], found["nees_solved_high_if_honest"]
    paths = LINEAR.draw(0, 40_000)
    tracks = ekf().track(LINEAR, paths.z)
    e = (tracks.mean - paths.x)[:, -1]
    nees = (
        np.einsum("ti,tij,tj->t", e, np.linalg.inv(tracks.covariance[:, -1]), e)
        .reshape(1000, 40)
        .mean(axis=1)
        / 2
    )
    assert np.mean((low < nees) & (nees < high)) >= 0.93


@pytest.mark.parametrize(
    "ours",
    [Pendulum(), Growth(), ConstantVelocity(), CoordinatedTurn()],
    ids=lambda model: model.name,
)
def test_models_by_formulas_are_those_written_in_python(ours):
    theirs = construct(
        next(o for o in options("state_model") if o.name == ours.name).config, "state_model"
    )
    x = ours.draw(0, 6).x[:, 50]
    for k in (0, 7):
        np.testing.assert_allclose(theirs.transition(x, k), ours.transition(x, k), rtol=1e-12)
        np.testing.assert_allclose(theirs.observe(x, k), ours.observe(x, k), rtol=1e-11)
        np.testing.assert_allclose(theirs.Q(k), ours.Q(k), rtol=1e-12)
        np.testing.assert_allclose(theirs.R(k), ours.R(k), rtol=1e-12)
    np.testing.assert_array_equal(theirs.times, ours.times)
    np.testing.assert_allclose(theirs.prior.covariance, ours.prior.covariance, rtol=1e-12)
    z = ours.draw(0, 4).z
    means = [Smoother(ukf()).track(model, z).mean for model in (ours, theirs)]
    np.testing.assert_allclose(means[1], means[0], atol=1e-8)


WALK = {
    "next": {"x": "x + h*v", "v": "v + w"},
    "readings": {"z": "x"},
    "noise": {"w": 0.3},
    "deviation": {"z": 1.0},
    "spread": {"x": 1.0, "v": 1.0},
    "constants": {"h": 1.0},
}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"next": {"x": "x + y", "v": "v + w"}}, r"next\.x: y: there is no such name"),
        ({"next": {"x": "x +", "v": "v"}}, r"next\.x: 'x \+' is not a formula"),
        ({"next": {"x": "x", "v": "v + w*w"}}, "next: depends on w by more than a factor"),
        (
            {"next": {"x": "x", "v": "v"}},
            r"noise\.w: is in no formula of next; add it to one, or remove it",
        ),
        ({"readings": {}}, "readings: is empty"),
        (
            {"constants": {"h": 1.0, "x": 2.0}},
            r"next\.x: two of states, noise, constants, inputs, k and t have",
        ),
        ({"readings": {"z": "x + w"}}, r"readings\.z: w: there is no such name"),
        ({"spread": {"x": 1.0}}, r"spread\.v: is required"),
        (
            {"readings": {"z": "x", "y": "v"}, "deviation": {"z": "1 + x**2"}},
            r"deviation\.y: is required",
        ),
        ({"deviation": {"z": -1.0}}, r"deviation\.z=-1\.0: give a number from 0 up"),
    ],
)
def test_formulas_that_make_no_model_are_refused(changes, complaint):
    StateScenario(Formulas(**WALK))
    with pytest.raises(ib.UserError, match=complaint):
        Formulas(**WALK | changes)


@pytest.mark.oracle(
    "published: Särkkä and Svensson, Bayesian Filtering and Smoothing (2023), notebooks",
    "four RMSE of the pendulum in a report",
    1e-10,
)
@pytest.mark.slow
def test_published_errors_stand_beside_those_found(tmp_path):
    """Four of the twelve; the others take the same path through +experiment=pendulum_book."""
    model = construct(
        composed(next(o for o in options("state_model") if o.name == "pendulum_book")),
        "state_model",
    )
    trackers = {"ekf": ekf(), "ukf": ukf(), "ckf": ckf(), "ckf_rts": Smoother(ckf())}
    ib.run(StateScenario(model), trackers, 1, output=tmp_path)
    table = published_table(collect([tmp_path]))
    assert table["estimator"].tolist() == list(trackers)
    agreed(table["difference"].abs(), 1e-10)
    with pytest.raises(ib.UserError, match="has one path; set trials=1"):
        StateScenario(model).draw(0, 2)


@dataclass(frozen=True)
class Masking(Tracker):
    """A filter whose first trial is masked, or all of it at the last epoch."""

    where: tuple = (0,)
    degrees: int = 1

    def track(self, model, z):
        tracks, mask = ekf().track(model, z), np.zeros(z.shape[:2], dtype=bool)
        mask[self.where] = True
        tracks.mean = np.ma.masked_array(
            tracks.mean, np.broadcast_to(mask[:, :, None], tracks.mean.shape)
        )
        tracks.degrees = tracks.degrees[:, : model.epochs // self.degrees]
        return tracks


def test_masked_states_are_unknown_and_a_wrong_shape_is_refused():
    block = PathBlock.draw(StateScenario(LINEAR), 0, 3)
    estimates, columns = block.estimate(Masking((0,)))
    assert columns["status"].tolist() == ["nonfinite", "converged", "converged"]
    assert np.isnan(estimates.x[0]).all()
    assert np.isfinite(estimates.x[1:]).all()
    assert not block.estimate(Masking((slice(None), -1)))[1]["success"].any()
    with pytest.raises(
        ValueError,
        match=r"Masking.track returns degrees of shape \(3, 15\), where \(3, 30\) belongs",
    ):
        block.estimate(Masking((0,), degrees=2))


def test_a_track_with_a_gap_has_failed_in_pairs_too(tmp_path):
    trackers = {"kf": ekf(), "gap": Masking((0, 3))}
    ib.run(StateScenario(LINEAR, seed=1), trackers, 8, output=tmp_path)
    found = analyse([tmp_path])
    (pair,) = found.pairs.to_dict("records")
    assert found.summary["success"].unique().tolist() == [1.0, 7 / 8]
    assert (pair["only_first"], pair["only_second"]) == (1, 0)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_the_root_of_a_covariance_has_as_many_columns_as_that_has_rank(size):
    rng = np.random.default_rng(10)
    for rank in (*range(8), *[3] * 50):
        A = rng.normal(size=(8, rank))
        G = root(size * A @ A.T)
        assert G.shape == (8, rank)
        np.testing.assert_allclose(G @ G.T, size * A @ A.T, rtol=1e-12, atol=1e-13 * size)
    # A variance that is small beside the others is one all the same.
    assert root(size * np.diag([1.0, 1e-14, 0.0])).shape == (3, 2)


def test_states_of_other_units_keep_their_deviations_in_what_is_drawn():
    """A bias of mm beside a position of 1000 km: variances of 1e-6 and 1e12, and one that is
    known."""
    P = np.diag([1e12, 0.0, 1e-6, 1e-6])
    P[2, 3] = P[3, 2] = 5e-7
    G = root(P)
    assert G.shape == (4, 3)
    np.testing.assert_allclose(G @ G.T, P, rtol=1e-14, atol=1e-20)
