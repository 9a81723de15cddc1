"""f and h of a state model along whole paths, against its own functions by epoch and quotients of
differences."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from shared.by_numpy import by_numpy
from shared.slopes import differentiate
from shared.state_models import CoordinatedTurn, Growth, Steady, bearing

from ipe_bench.basics.errors import UserError
from ipe_bench.engine import compiled
from ipe_bench.measurements import Gins, Parameter
from ipe_bench.states import Formulas, Normal, StateModel, WalkingGins, ekf
from ipe_bench.states.base import widened
from ipe_bench.workshop.conformance import check_component


@dataclass(frozen=True)
class Angles(Steady):
    """A model of Python whose steps differ in form from epoch to epoch, and of which one piece can
    be replaced."""

    count: int = 6
    piece: Any = None

    @property
    def states(self):
        return Parameter("x"), Parameter("y")

    @property
    def prior(self):
        return Normal(np.array([1.0, 2.0]), np.diag([0.2, 0.3]) ** 2)

    def transition(self, x, k):
        new = x.copy()
        new[..., k % 2] += 0.1 * np.sin(x[..., 1 - k % 2]) * self.times[k]
        near = np.where(new[..., 0].real < 1.0, new[..., 0] ** 2, 2 * new[..., 0] - 1.0)
        new[..., 1] = new[..., 1] + 0.01 * near
        return new if self.piece is None else self.piece(new, k)

    def observe(self, x, k):
        return np.stack([bearing(x[..., 0], x[..., 1]), x[..., 0] * 0.0 + 3.0], axis=-1)

    def gain(self, k):
        return 0.1 * np.eye(2)

    def R(self, k):
        return np.eye(2)


DRIVEN = Formulas(
    next={"p": "p + dt*v + push*sin(v)", "v": "0.9*v + cos(k)*w + 0.01*t"},
    readings={"bearing": "arctan2(p, 3 + v*v)", "range": "sqrt(1 + p**2)"},
    noise={"w": 0.1},
    deviation={"bearing": 0.1, "range": 0.2},
    spread={"p": 1.0, "v": 2.0},
    inputs={"dt": 0.5, "push": (0.0, 1.0, -2.0, 0.3)},
    period={"bearing": 2 * np.pi},
    count=4,
)
MODELS = {
    "formulas": DRIVEN,
    "formulas read at the start": Formulas(
        **{n: getattr(DRIVEN, n) for n in ("next", "readings", "noise", "deviation", "spread")},
        inputs=DRIVEN.inputs,
        count=4,
        moved_first=False,
    ),
    "Python": CoordinatedTurn(count=3),
    "Python by epoch": Growth(count=5),
    "Python of two forms": Angles(),
    "one epoch that nothing leads into": replace(
        DRIVEN, count=1, inputs={"dt": 0.5, "push": 1.0}, moved_first=False
    ),
}


def path(model: StateModel, trials: int = 3):
    """True paths (trials, 1 + K, n), from before the first transition."""
    drawn = StateModel.draw(model, 0, trials)
    return np.concatenate([drawn.start[:, None], drawn.x], axis=1)


@pytest.mark.parametrize("name", MODELS)
def test_values_and_slopes_along_paths_are_those_of_each_epoch(name):
    model = MODELS[name]
    x, n = path(model), model.n
    along = model.slopes_along(x)
    f, h = model.values_along(x)
    for k in range(model.epochs):
        before, at = x[:, k], x[:, k + 1]
        if model.moves(k):
            own, slopes = (
                model.transition(before, k),
                differentiate(lambda s, k=k: model.transition(s, k), before, analytic=False),
            )
        else:
            own, slopes = before, np.broadcast_to(np.eye(n), (3, n, n))
        for f_k in (f[:, k], along.f[:, k]):
            np.testing.assert_allclose(f_k, own, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(along.F[:, k], slopes, rtol=1e-6, atol=1e-6)
        own = model.observe(at, k)
        for h_k in (h[:, k], along.h[:, k]):
            np.testing.assert_allclose(h_k, own, rtol=1e-13, atol=1e-13)
        slopes = differentiate(lambda s, k=k: model.observe(s, k), at, analytic=False)
        np.testing.assert_allclose(along.H[:, k], slopes, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_functions_of_any_number_of_states_are_recorded(name):
    assert [one.why for one in MODELS[name].epoch_functions] == ["", ""]


@pytest.mark.parametrize("name", MODELS)
def test_a_path_has_the_same_bits_alone_and_in_a_batch(name):
    model = MODELS[name]
    x = path(model, 7)
    whole = (*model.values_along(x), *model.slopes_along(x))
    for rows in (slice(0, 1), slice(2, 5)):
        part = (*model.values_along(x[rows]), *model.slopes_along(x[rows]))
        for a, b in zip(whole, part, strict=True):
            np.testing.assert_array_equal(a[rows], b)


@pytest.mark.parametrize("columns", [1, 3])
def test_states_of_another_number_are_refused(columns):
    """Compiled code read beyond the array, and gave whatever lay there."""
    f = DRIVEN.transition_into(1)
    x = np.ones((4, columns))
    for run in (f, f.slope):
        with pytest.raises(ValueError, match=f"rows of {columns} numbers, where 2 belong"):
            run(x)


@pytest.mark.parametrize("name", MODELS)
def test_by_numpy_it_is_the_same_to_round_off(name):
    model, x = MODELS[name], path(MODELS[name])
    here = model.slopes_along(x)
    with by_numpy():
        there = model.slopes_along(x)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_random_formulas_have_the_slopes_of_complex_steps(seed):
    rng = np.random.default_rng(seed)

    def formula(noise=""):
        terms = rng.choice(
            [
                "sin(a)*b",
                "exp(-b*b)",
                "a/(2 + b*b)",
                "u*a",
                "cos(t)*b",
                "arctan2(a, 3 + b)",
                "sqrt(4 + a*a)",
                "k*b",
                "2",
            ],
            3,
        )
        signs = rng.choice(["+", "-"], 3)
        return "".join(f"{sign}{term}" for sign, term in zip(signs, terms, strict=True)) + noise

    model = Formulas(
        next={"a": formula("+ w"), "b": f"0.1*({formula()})"},
        readings={"z": formula(), "y": formula()},
        noise={"w": 0.1},
        deviation={"z": 1.0, "y": 1.0},
        spread={"a": 1.0, "b": 1.0},
        inputs={"u": tuple(rng.standard_normal(3))},
        count=3,
    )
    x = rng.standard_normal((4, 2))
    for functions, own in zip(
        model.epoch_functions, (model.transition, model.observe), strict=True
    ):
        assert not functions.why
        for k in range(3):
            value, slope = functions.at[k].slope(x)
            np.testing.assert_allclose(value, own(x, k), rtol=1e-13, atol=1e-13)
            exact = differentiate(lambda s, k=k, own=own: own(s, k), x, analytic=True)
            np.testing.assert_allclose(slope, exact, rtol=1e-12, atol=1e-12)


def _branching(x, k):
    return np.array([row if row[0] > 0 else -row for row in x.reshape(-1, 2)]).reshape(x.shape)


def _random(x, k):
    return x + np.random.default_rng().standard_normal()


def _cast(x, k):
    return x + np.floor(np.asarray(x, dtype=float)) * 0


def _forms(x, k):
    for _ in range(k % 9):
        x = np.sin(x)
    return x


def _long(x, k):
    for _ in range(10**9):
        if type(x) is np.ndarray:
            break
        x = np.sin(x)
    return x


def _mixing(x, k):
    return x - np.mean(x, axis=0)


def _forgets(x, k):
    """Its recording takes the other branch than numbers do."""
    return x if type(x) is np.ndarray else x + 1.0


BY_EPOCH = {
    "a branch on a state": (_branching, "branches on its argument"),
    "numbers alone": (_cast, "plain numbers"),
    "many forms": (_forms, "more than 8 forms"),
    "a loop that is too long": (_long, "more than 20000 operations"),
    "another recording": (_forgets, "its recording has other values"),
}


@pytest.mark.parametrize("name", BY_EPOCH)
def test_what_cannot_be_recorded_runs_epoch_by_epoch_and_check_says_so(name):
    piece, why = BY_EPOCH[name]
    model = Angles(count=10, piece=piece)
    f, h = model.epoch_functions
    assert why in f.why
    assert not h.why
    notes = " ".join(finding.note for finding in check_component("model", model))
    assert "transition runs in Python epoch by epoch, with slopes by" in notes
    assert why in notes
    x = path(model)
    np.testing.assert_array_equal(model.values_along(x)[0][:, 3], model.transition(x[:, 3], 3))


@pytest.mark.parametrize(
    ("piece", "complaint"),
    [
        (_random, "transition: gives other values each time"),
        (_mixing, "transition: gives a row other values among others than alone"),
    ],
)
def test_functions_that_are_random_or_mix_trials_are_refused(piece, complaint):
    model = Angles(count=10, piece=piece)
    with pytest.raises(UserError, match=complaint):
        ekf().track(model, np.zeros((2, 10, 2)))


def _as_floats(x, y):
    z = np.empty((*x.shape, 1))
    z[..., 0] = np.sqrt(x * x + y * y)
    return z


RANGES = {
    "np.hypot": lambda x, y: np.hypot(x, y)[..., None],
    "np.linalg.norm": lambda x, y: np.linalg.norm(np.stack([x, y]), axis=0)[..., None],
    "np.abs": lambda x, y: np.abs(np.sqrt(x * x + y * y))[..., None],
    "the real part": lambda x, y: np.real(np.sqrt(x * x + y * y))[..., None],
    "an array of floats": _as_floats,
}


@dataclass(frozen=True)
class Ranging(Angles):
    """A point at rest whose distance is read, by a function of NumPy."""

    by: str = ""

    def transition(self, x, k):
        return x

    def observe(self, x, k):
        if not self.by:
            return np.sqrt(x[..., :1] ** 2 + x[..., 1:] ** 2)
        return RANGES[self.by](x[..., 0], x[..., 1])

    def R(self, k):
        return 0.01 * np.eye(1)


@pytest.mark.parametrize("by", RANGES)
def test_functions_that_are_not_analytic_have_their_slopes(by):
    """A complex step finds that np.abs has none, and the filter took no reading in."""
    plain = Ranging()
    model = Ranging(by=by)
    z = plain.draw(0, 3).z
    filters = ekf()
    wanted = filters.track(plain, z)
    found = filters.track(model, z)
    np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, wanted.covariance, rtol=1e-6)
    assert bool(model.epoch_functions[1].why_differences) == (by == "an array of floats")


def test_check_names_slopes_by_differences():
    model = Angles(piece=lambda x, k: np.array(x.tolist(), dtype=float))
    notes = " ".join(finding.note for finding in check_component("model", model))
    assert "transition runs in Python epoch by epoch, with slopes by differences, as" in notes


def test_check_finds_epochs_that_are_wrongly_called_alike():
    class Wrong(Angles):
        def alike(self, k):
            return k if k != 7 else 9

    complaints = [finding.complaint for finding in check_component("model", Wrong(count=12))]
    assert any("not as recorded" in complaint for complaint in complaints)


def test_a_copy_has_functions_of_its_own():
    model = Angles()
    assert not model.epoch_functions[0].why
    other = copy.copy(model)
    object.__setattr__(other, "step", 2.0)
    x = path(model)[:, 2]
    np.testing.assert_allclose(other.transition_into(2)(x), other.transition(x, 2), rtol=1e-13)
    wider = widened(model, 3.0)
    assert wider.epoch_functions is not model.epoch_functions
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.transition_into(2)(x), model.transition_into(2)(x))


def test_the_inertial_system_is_recorded_with_its_slopes():
    """Runs begin anew at every fourth epoch here, at other velocities."""
    model = WalkingGins(gins=Gins(readings_per_case=4))
    assert [one.why for one in model.epoch_functions] == ["", ""]
    x = path(model, 2)
    f, h = model.values_along(x)
    along = model.slopes_along(x)
    for k in range(model.epochs):
        own = model.transition(x[:, k], k)
        np.testing.assert_allclose(f[:, k], own, rtol=1e-13, atol=1e-11)
        np.testing.assert_allclose(h[:, k], model.observe(x[:, k + 1], k), rtol=1e-13, atol=1e-11)
        if k in (0, 3, 4, 15):
            exact = differentiate(lambda s, k=k: model.transition(s, k), x[:, k], analytic=True)
            size = np.abs(exact).max(axis=(0, 2))[:, None]
            assert (np.abs(along.F[:, k] - exact) <= 1e-12 * size).all()


def test_trackers_take_the_recorded_functions():
    called = []

    class Watched(Angles):
        def transition(self, x, k):
            called.append(type(x) is np.ndarray)
            return super().transition(x, k)

    model = Watched(count=40)
    z = model.draw(0, 2).z
    assert not model.epoch_functions[0].why
    called.clear()
    ekf().track(model, z)
    # The model's own function is asked at a few epochs, to see whether the recorded one is right.
    assert sum(called) <= 24


@pytest.mark.parametrize("name", ["formulas", "Python"])
def test_other_values_of_options_need_no_other_machine_code(name, monkeypatch):
    """As they are tried by the hundred where constants are looked for in a log."""
    if name == "formulas":
        one, other = (
            replace(
                DRIVEN, constants={"c": value}, readings={"z": "p*c"}, deviation={"z": 1}, period={}
            )
            for value in (2.5, 3.5)
        )
    else:
        one, other = CoordinatedTurn(count=4, step=1.5), CoordinatedTurn(count=4, step=1.6)
    x = path(one)
    made, load = [], compiled.load
    monkeypatch.setattr(compiled, "load", lambda key, *rest: made.append(key) or load(key, *rest))
    one.slopes_along(x)
    before = {*made}
    assert before
    there = other.slopes_along(x)
    assert {*made} == before
    np.testing.assert_allclose(there.f[:, 1], other.transition(x[:, 1], 1), rtol=1e-13)
    np.testing.assert_allclose(there.h[:, 1], other.observe(x[:, 2], 1), rtol=1e-13)


@dataclass(frozen=True)
class Rough(StateModel):
    """A state that moves by its sine, to the tolerance of an integrator where it is large."""

    size: float = 1e-5
    states = (Parameter("a", "m"),)
    times = np.arange(1.0, 9.0)
    prior = Normal(np.array([0.5]), np.diag([0.04]))
    calls: ClassVar[list[int]] = []

    def transition(self, x, k):
        x = np.array([float(a) for a in np.ravel(x)]).reshape(np.shape(x))
        self.calls.append(x.size)
        return np.sin(x) + self.size * np.sin(1e7 * x) * (x > 0.45)

    def observe(self, x, k):
        return x

    def gain(self, k):
        return np.array([[0.05]])

    def R(self, k):
        return 0.01 * np.eye(1)


def test_a_rough_transition_takes_few_calls_for_its_slopes():
    """A value, two for a slope and those of checks for each epoch and trial, and the track of the
    smooth transition."""
    rough = Rough()
    z = rough.draw(0, 3, 1).z
    assert rough.remarks()
    rough.calls.clear()
    tracks = ekf().track(rough, z)
    assert sum(rough.calls) <= 4 * 3 * 8
    smooth = ekf().track(Rough(size=0.0), z)
    np.testing.assert_allclose(tracks.mean, smooth.mean, rtol=1e-3)
