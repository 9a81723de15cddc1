"""Noise that depends on the states, and states that come round: augmented loops, quadrature, Monte
Carlo, refusals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from shared.families import slow_if
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity

import ipe_bench as ib
from ipe_bench.measurements import Parameter
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import composed, options
from ipe_bench.real.logs import _numbers
from ipe_bench.states import (
    Bootstrap,
    Filter,
    Formulas,
    GaussHermite,
    Grid,
    Normal,
    Smoother,
    StateModel,
    Taylor,
    posterior_bounds,
    ukf,
)
from ipe_bench.states.algebra import triangular
from ipe_bench.states.trackers import filtered
from ipe_bench.trials.paths import PathBlock, StateScenario
from ipe_bench.workshop.conformance import check_component

TRACKERS = {o.name: construct(composed(o), o.package or o.group) for o in options("tracker")}
ALONG, TURN = 0.3, 0.1
"""Standard deviations of a step along the heading, per unit of its length, and of a turn in rad."""


@dataclass(frozen=True)
class Rover(StateModel):
    """A vehicle whose steps err along its heading, read by range and bearing, the range worse from
    far away."""

    count: int = 12
    moved_first: bool = True

    @property
    def states(self):
        return tuple(Parameter(name) for name in ("x", "y", "heading"))

    @property
    def times(self):
        return np.arange(1.0, self.count + 1)

    @property
    def prior(self):
        return Normal(np.array([5.0, 3.0, 0.5]), np.diag([0.3, 0.2, 0.4]) ** 2)

    @property
    def periods(self):
        return 0.0, 2 * np.pi

    def transition(self, x, k):
        px, py, heading = np.moveaxis(x, -1, 0)
        return np.stack([px + np.cos(heading), py + np.sin(heading), heading + 0.2], axis=-1)

    def observe(self, x, k):
        px, py = x[..., 0], x[..., 1]
        half = (np.sqrt(px * px + py * py) - px) / py  # tan of half the angle, which is analytic
        return np.stack([np.sqrt(px * px + py * py), 2 * np.arctan(half)], axis=-1)

    def gain_at(self, x, k):
        c, s, zero = np.cos(x[..., 2]), np.sin(x[..., 2]), np.zeros(x.shape[:-1])
        rows = [[ALONG * c, zero], [ALONG * s, zero], [zero, zero + TURN]]
        return np.moveaxis(np.array(rows), (0, 1), (-2, -1))

    def R_at(self, x, k):
        deviations = np.stack(
            [0.05 + 0.05 * np.hypot(x[..., 0], x[..., 1]), np.full(x.shape[:-1], 0.02)], axis=-1
        )
        return deviations[..., None] ** 2 * np.eye(2)


ROVER = Rover()
WRITTEN = {
    "next": {
        "x": "x + (1 + along)*cos(heading)",
        "y": "y + (1 + along)*sin(heading)",
        "heading": "heading + .2 + turn",
    },
    "readings": {"range": "hypot(x, y)", "bearing": "arctan2(y, x)"},
    "noise": {"along": ALONG, "turn": TURN},
    "deviation": {"range": "0.05 + b*hypot(x, y)", "bearing": 0.02},
    "constants": {"b": 0.05},
    "start": {"x": 5.0, "y": 3.0, "heading": 0.5},
    "spread": {"x": 0.3, "y": 0.2, "heading": 0.4},
    "period": {"bearing": 2 * np.pi},
    "count": 12,
}


def unscented(n):
    """The points (2 n + 1, n) and weights that the UKF takes by default."""
    kappa = max(3 - n, 0)
    s = np.sqrt(n + kappa) * np.vstack([np.zeros(n), np.eye(n), -np.eye(n)])
    return s, np.r_[kappa, np.full(2 * n, 0.5)] / (n + kappa)


def augmented(rule, g, G, m, P):
    """Mean, covariance and cross covariance with x of g(x) + G(x) w for x ~ N(m, P) and w ~ N(0,
    I): by tangents in the augmented state (x, w), or by points of it, those of the unscented rule
    in x, each with the cubature points in w."""
    n, q = len(m), G(m).shape[1]
    if isinstance(rule, Taylor):
        F = np.array([g(m + step).imag for step in 1e-20j * np.eye(n)]).T / 1e-20
        J = np.hstack([F, G(m)])
        joint = np.block([[P, np.zeros((n, q))], [np.zeros((q, n)), np.eye(q)]])
        return g(m), J @ joint @ J.T, P @ F.T
    s, weights = unscented(n)
    points = m + s @ np.linalg.cholesky(P).T
    w = np.sqrt(q) * np.vstack([np.eye(q), -np.eye(q)])
    values = np.array([g(x) + G(x) @ one for x in points for one in w])
    x, weights = np.repeat(points, 2 * q, axis=0), np.repeat(weights / (2 * q), 2 * q)
    y = weights @ values
    d = (values - y) * weights[:, None]
    return y, (values - y).T @ d, (x - m).T @ d


def loop(rule, model, z):
    """Means and covariances of a filter of one trial by an augmented prediction and an augmented
    update."""
    m, P = model.prior
    means, covariances = [], []
    for k, reading in enumerate(z):
        m, P, _ = augmented(
            rule, lambda x, k=k: model.transition(x, k), lambda x, k=k: model.gain_at(x, k), m, P
        )
        y, S, C = augmented(
            rule, lambda x, k=k: model.observe(x, k), lambda x, k=k: np.sqrt(model.R_at(x, k)), m, P
        )
        K = C @ np.linalg.inv(S)
        m, P = m + K @ (reading - y), P - K @ S @ K.T
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances)


@pytest.mark.oracle(
    "own second implementation: loops over an augmented state", "means and covariances", 1e-9
)
@pytest.mark.parametrize("rule", [Taylor(), ukf().rule], ids=["ekf", "ukf"])
def test_extended_and_unscented_filters_are_those_of_an_augmented_state(rule):
    z = ROVER.draw(0, 4).z
    tracks = Filter(rule).track(ROVER, z)
    for trial in range(4):
        means, covariances = loop(rule, ROVER, z[trial])
        assert_agrees(tracks.mean[trial], means, atol=1e-9)
        assert_agrees(tracks.covariance[trial], covariances, atol=1e-9)


def test_a_step_has_the_mean_and_the_covariance_of_many_draws():
    """Start, noise and reading drawn, against rules that integrate them; Q of the mean alone is 10
    errors off."""
    rng, (m, P), N = np.random.default_rng(3), ROVER.prior, 300_000
    rule, blind = GaussHermite(5), np.full((1, 1, 2), np.nan)
    before = rng.multivariate_normal(m, P, N)
    moved = ROVER.transition(before, 0) + np.einsum(
        "tij,tj->ti", ROVER.gain_at(before, 0), rng.normal(size=(N, 2))
    )
    predicted = filtered(replace(ROVER, count=1), blind, rule)
    x = Normal(predicted.mean[:, 0], predicted.covariance[:, 0])
    near = rng.multivariate_normal(x.mean[0], x.covariance[0], N)
    deviations = np.sqrt(np.einsum("tii->ti", ROVER.R_at(near, 0)))
    read = ROVER.observe(near, 0) + deviations * rng.normal(size=(N, 2))
    A, b, W = rule.linearise(lambda x: ROVER.observe(x, 0), *x)
    S = (
        A @ x.covariance @ A.swapaxes(1, 2)
        + W
        + rule.mean(lambda x: ROVER.R_at(x, 0), x.mean, triangular(x.covariance))
    )
    for draws, mean, covariance in ((moved, x.mean, x.covariance), (read, x.mean @ A[0].T + b, S)):
        d = draws - mean
        products = d[:, :, None] * d[:, None, :]
        error = products.std(axis=0) / np.sqrt(N)
        assert (np.abs(d.mean(axis=0)) < 4 * d.std(axis=0) / np.sqrt(N)).all()
        assert (np.abs(products.mean(axis=0) - covariance[0]) < 4 * error).all()
        if draws is moved:
            at_mean = (
                covariance[0]
                - rule.mean(lambda x: ROVER.Q_at(x, 0), m[None], triangular(P[None]))[0]
                + ROVER.Q_at(m, 0)
            )
            assert (np.abs(products.mean(axis=0) - at_mean) / error)[0, 1] > 10


def test_paths_are_drawn_with_the_noise_of_their_states():
    paths = replace(ROVER, count=2).draw(0, 3000)
    before = np.stack([paths.start, paths.x[:, 0]], axis=1)
    for k in range(2):
        e = paths.x[:, k] - ROVER.transition(before[:, k], k)
        heading = before[:, k, 2]
        along = e[:, 0] * np.cos(heading) + e[:, 1] * np.sin(heading)
        np.testing.assert_allclose(
            e[:, 0] * np.sin(heading) - e[:, 1] * np.cos(heading), 0.0, atol=1e-14
        )
        assert along.std() == pytest.approx(ALONG, rel=0.06)
        r = paths.z[:, k, 0] - ROVER.observe(paths.x[:, k], k)[:, 0]
        assert (r / np.sqrt(ROVER.R_at(paths.x[:, k], k)[:, 0, 0])).std() == pytest.approx(
            1.0, rel=0.06
        )


def test_a_model_by_formulas_is_the_one_in_python():
    written = Formulas(**WRITTEN)
    assert written.gain_by_state
    assert written.R_by_state
    x = ROVER.draw(0, 3).x
    for k in (0, 5):
        np.testing.assert_allclose(
            written.gain_at(x, k), ROVER.gain_at(x, k), rtol=1e-14, atol=1e-16
        )
        np.testing.assert_allclose(written.R_at(x, k), ROVER.R_at(x, k), rtol=1e-14)
    z = ROVER.draw(0, 2).z
    for label in ("iterated_ekf", "ckf_rts", "bootstrap"):
        tracker = Smoother(TRACKERS["ckf"]) if label == "ckf_rts" else TRACKERS[label]
        means = [tracker.track(model, z).mean for model in (ROVER, written)]
        np.testing.assert_allclose(means[1], means[0], atol=1e-9)
    assert not [one for one in check_component("rover", ROVER) if one.complaint]
    assert not Formulas(**WRITTEN | {"deviation": {"range": "b*k", "bearing": 0.02}}).R_by_state
    assert Formulas(**WRITTEN | {"deviation": {"range": "b*k", "bearing": 0.02}}).R(3)[
        0, 0
    ] == pytest.approx(0.04)
    assert ("deviation", "range") not in _numbers(written)


@pytest.mark.slow
@pytest.mark.parametrize("label", ["ekf", "ukf_rts", "ipls", "bootstrap"])
def test_trackers_are_calibrated_and_give_a_trial_the_same_bits_alone(label):
    tracker = {"ipls": replace(TRACKERS["ipls"], iterations=3)}.get(label, TRACKERS[label])
    block = PathBlock.draw(StateScenario(ROVER), 0, 30)
    columns = block.estimate(tracker)[1]
    assert (columns["status"] == "converged").all()
    assert np.mean(columns["path_nees"]) / 3 == pytest.approx(1.0, abs=0.25)
    alone = tracker.track(ROVER, block.paths.z[7:8])
    np.testing.assert_array_equal(alone.mean[0], tracker.track(ROVER, block.paths.z[6:8]).mean[1])


SCALAR = {
    "next": {"x": "x + w"}, "readings": {"z": "x"}, "noise": {"w": 1.0}, "deviation": {"z": 1.0},
    "spread": {"x": 1.0},
    "count": 3,
}  # fmt: skip
VOLATILITY = Formulas(
    next={"logvar": "0.95*logvar + 0.3*w"},
    readings={"gain": "0*logvar"},
    noise={"w": 1.0},
    deviation={"gain": "0.6*exp(logvar/2)"},
    spread={"logvar": 1.0},
    count=15,
)
GROWING = Formulas(
    next={"x": "0.9*x + sqrt(0.1 + 0.2*x**2)*w"},
    readings={"z": "x"},
    noise={"w": 1.0},
    deviation={"z": "sqrt(0.1 + 0.04*x**2)"},
    spread={"x": 1.0},
    count=15,
)


def quadrature(model, z):
    """Filtered means (K,) and log likelihood of a scalar model, by the trapezoidal rule on one grid
    of 1,201 points."""
    g = np.linspace(-9.0, 9.0, 1201)
    Q, R = (
        np.broadcast_to(at(g[:, None], 0)[..., 0, 0], g.shape) for at in (model.Q_at, model.R_at)
    )
    kernel = np.exp(-0.5 * (g[:, None] - model.transition(g[:, None], 0)[:, 0]) ** 2 / Q) / np.sqrt(
        2 * np.pi * Q
    )
    p, step, total, means = np.exp(-0.5 * g**2) / np.sqrt(2 * np.pi), g[1] - g[0], 0.0, []
    for reading in z[:, 0]:
        p = kernel @ p * step
        p *= np.exp(-0.5 * (reading - model.observe(g[:, None], 0)[:, 0]) ** 2 / R) / np.sqrt(
            2 * np.pi * R
        )
        total, p = total + np.log(p.sum() * step), p / (p.sum() * step)
        means.append(np.sum(g * p) * step)
    return np.array(means), total


@pytest.mark.oracle(
    "own second implementation: quadrature on one grid",
    "means and log likelihood by the grid",
    1e-5,
)
@pytest.mark.parametrize("model", [VOLATILITY, GROWING], ids=["stochastic volatility", "growing"])
def test_grid_and_particles_agree_with_quadrature(model):
    z = model.draw(0, 2).z
    grid, particles = Grid(800).track(model, z), Bootstrap(5_000).track(model, z)
    for trial in range(2):
        means, total = quadrature(model, z[trial])
        assert_agrees(grid.mean[trial, :, 0], means, atol=1e-5)
        assert_agrees(grid.log_likelihood[trial], total, atol=1e-5)
        np.testing.assert_allclose(particles.mean[trial, :, 0], means, atol=0.1)
        assert particles.log_likelihood[trial] == pytest.approx(total, abs=0.2)


@pytest.mark.oracle(
    "own second implementation: loops over an augmented state", "covariances at the truth", 1e-9
)
def test_the_bound_at_the_truth_takes_the_noise_of_the_true_states():
    paths = ROVER.draw(0, 1)
    P = PathBlock.draw(StateScenario(ROVER), 0, 1).bound[0]
    covariance = ROVER.prior.covariance
    x = np.vstack([paths.start, paths.x[0]])
    for k in range(ROVER.count):
        _, moved, _ = augmented(
            Taylor(),
            lambda x: ROVER.transition(x, 0),
            lambda x: ROVER.gain_at(x, 0),
            x[k],
            covariance,
        )
        _, S, C = augmented(
            Taylor(),
            lambda x: ROVER.observe(x, 0),
            lambda x: np.sqrt(ROVER.R_at(x, 0)),
            x[k + 1],
            moved,
        )
        covariance = moved - C @ np.linalg.inv(S) @ C.T
        assert_agrees(P[k], covariance, atol=1e-9)
    with pytest.raises(
        ib.UserError, match="state_model=rover: R depends on the states; what takes R"
    ):
        posterior_bounds(ROVER, paths)


def test_what_takes_fixed_noise_refuses_before_any_work(tmp_path):
    for label in ("ieks", "lm_ieks", "ipe_fixed_point", "ipe_newton"):
        fixed = (
            f"trackers.{label}: takes noise that does not depend on the states; in rover it does;"
            " leave it out"
        )
        with pytest.raises(ib.UserError, match=fixed):
            ib.run(StateScenario(ROVER), {label: TRACKERS[label]}, 1, output=tmp_path / "out")
    for label in ("ukf_rts", "ipls"):
        mean = (
            f"trackers.{label}: takes in readings by their mean, which in formulas no state"
            " changes; choose boot"
        )
        with pytest.raises(ib.UserError, match=mean):
            ib.estimate(VOLATILITY, np.zeros((15, 1)), {label: TRACKERS[label]})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        (
            {"next": WRITTEN["next"] | {"x": "x + sin(along)"}},
            r"next: depends on along by more than a factor; write FACTOR",
        ),
        (
            {"deviation": {"range": "0.05 + c*x", "bearing": 0.02}},
            r"deviation\.range: c: there is no such name",
        ),
        (
            {"deviation": {"range": -1, "bearing": 0.02}},
            r"deviation\.range=-1: give a number from 0 up or a text",
        ),
        ({"state_period": {"bearing": 6.0}}, r"state_period\.bearing: there is no such state|name"),
    ],
)
def test_formulas_of_noise_that_make_no_model_are_refused(changes, complaint):
    with pytest.raises(ib.UserError, match=complaint):
        Formulas(**WRITTEN | changes)


def test_a_state_known_exactly_may_change_the_noise_all_the_same():
    assert Formulas(**WRITTEN | {"spread": {"x": 0.3, "y": 0.2, "heading": 0.0}}).gain_by_state


def test_noise_without_a_value_at_the_mean_of_the_prior_is_refused():
    for changes, what in (
        ({"next": {"x": "x + w/x"}}, "Q"),
        ({"deviation": {"z": "sqrt(x - 1)"}}, "R"),
    ):
        with pytest.raises(
            ib.UserError, match=f"{what} of epoch 1 is not finite at the mean of the prior"
        ):
            StateScenario(Formulas(**SCALAR | changes))


def test_particles_at_which_readings_have_no_density_are_a_reason():
    model = Formulas(**SCALAR | {"deviation": {"z": "0.5 + 0.5*sign(x - 1)"}, "start": {"x": 3.0}})
    columns = PathBlock.draw(StateScenario(model), 0, 2).estimate(TRACKERS["bootstrap"])[1]
    said = [message.partition(": ")[2][:65] for message in columns["message"]]
    assert said == ["the readings of epoch 1 have no density at some states: f, h or a"] * 2


def test_a_grid_is_of_no_model_with_readings_without_noise():
    model = Formulas(**SCALAR | {"deviation": {"z": "0.5 + 0.5*sign(x - 1)"}, "start": {"x": 3.0}})
    assert TRACKERS["grid"].hindrance(model) == (
        "needs noise in every reading of formulas; leave it out"
    )


def test_a_model_without_noise_is_refused():
    class Noiseless(ConstantVelocity):
        R = StateModel.R

    with pytest.raises(
        ib.UserError,
        match=r"it has no R; write R\(k\), or R_at\(x, k\) if it depends on the states",
    ):
        StateScenario(Noiseless())


TURNING = Formulas(
    next={"x": "x + cos(a)", "y": "y + sin(a)", "a": "a + 0.7 + w"},
    readings={"east": "x", "north": "y", "compass": "a"},
    noise={"w": 0.1},
    deviation={"east": 0.5, "north": 0.5, "compass": 0.3},
    start={"a": 2.0},
    spread={"x": 1.0, "y": 1.0, "a": 0.5},
    period={"compass": 2 * np.pi},
    count=12,
)
"""A vehicle that turns by 480 degrees."""


@pytest.mark.parametrize(
    "label",
    slow_if(
        lambda label: label in ("iplf", "ukf_rts", "ieks", "ipls", "lm_ieks"),
        ["ekf", "iplf", "ukf_rts", "ieks", "ipls", "lm_ieks", "ipe_newton", "bootstrap"],
    ),
)
def test_a_heading_that_is_kept_within_half_a_turn_is_tracked_as_one_that_is_not(label):
    """Only the branch differs, of the heading's true path, its transition and what the compass
    shows."""
    wrapped = replace(
        TURNING,
        next={**TURNING.next, "a": "mod(a + 0.7 + pi, 2*pi) - pi + w"},
        readings={**TURNING.readings, "compass": "mod(a + pi, 2*pi) - pi"},
        state_period={"a": 2 * np.pi},
    )
    paths, inside = TURNING.draw(0, 2), wrapped.draw(0, 2)
    assert np.abs(inside.x[..., 2]).max() < 4.0
    assert paths.x[:, -1, 2].min() > 9.0
    tracker = TRACKERS[label]
    if label in ("ieks", "ipls"):
        tracker = replace(tracker, iterations=3)
    with np.errstate(all="ignore"):
        free, kept = tracker.track(TURNING, paths.z), tracker.track(wrapped, inside.z)
    apart = wrapped.nearest_state(kept.mean - free.mean, np.zeros(3))
    if label == "bootstrap":  # whose random numbers are those of its readings
        assert np.abs(apart).max() < 0.5
        np.testing.assert_allclose(kept.covariance, free.covariance, atol=0.1)
    else:
        np.testing.assert_allclose(apart, 0.0, atol=1e-7)
        np.testing.assert_allclose(kept.covariance, free.covariance, atol=1e-7)
    columns = PathBlock(StateScenario(wrapped), 0, inside).estimate(tracker)[1]
    if columns["status"][0] == "converged":
        assert max(columns["path_a"]) < 0.6
        assert np.abs(columns["error_a"]).max() < 1.0


def test_a_transition_that_jumps_by_a_turn_is_told_to_state_its_period():
    model = replace(TURNING, next={**TURNING.next, "a": "mod(a + 0.7 + pi, 2*pi) - pi + w"})
    found = [one.complaint for one in check_component("turning", model) if one.complaint]
    assert len(found) == 1
    assert found[0].startswith("state 3 jumps by 6.28: it is an angle; state its period")
    assert (
        Grid()
        .hindrance(replace(VOLATILITY, state_period={"logvar": 1.0}))
        .startswith("has no place for a periodic state")
    )


def test_a_finite_answer_is_kept_where_points_have_no_noise_level() -> None:
    """The root of a negative number is none: the points of a wide prior lie on both sides of 0."""
    model = Formulas(
        next={"x": "x"},
        readings={"y": "x"},
        noise={},
        deviation={"y": "0.05*sqrt(x)"},
        start={"x": 1.0},
        spread={"x": 1.5},
        count=6,
    )
    z = 3.0 + np.arange(6.0)[None, :, None]
    tangents = Smoother(Filter(Taylor())).track(model, z)
    assert np.isnan(ukf().track(model, z).mean).all()
    np.testing.assert_array_equal(TRACKERS["auto"].track(model, z).mean, tangents.mean)
    assert np.isfinite(tangents.mean).all()
