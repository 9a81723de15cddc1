"""A trial that raises costs no other trial anything: what is computed one by one is what is
computed together."""

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ipe_bench as ib
from ipe_bench.basics.batches import take
from ipe_bench.estimators.base import estimate_safely
from ipe_bench.runs.run import compute
from ipe_bench.states.trackers import Tracks
from ipe_bench.trials.paths import block_of, track_safely

TRIALS = 12
OPTIONAL = (
    "covariance",
    "history",
    "alternatives",
    "nis",
    "stage",
    "cost",
    "status",
    "iterations",
    "effective",
)
CONSTANTS = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
WALK = {"next": {"p": "p + w"}, "readings": {"z": "p"}, "noise": {"w": 1.0}}
STATES = ib.StateScenario(
    ib.states.Formulas(**WALK, deviation={"z": 0.5}, spread={"p": 3.0}, count=4)
)
ENDS = [ib.Status.CONVERGED, ib.Status.STALLED, ib.Status.MAX_ITERATIONS, ib.Status.DIVERGED]


def drawn_for(z, *shape):
    """Numbers that each trial has alone and in any batch."""
    seeds = [abs(int(1e6 * row.flat[0])) for row in z]
    return np.array([np.random.default_rng(seed).uniform(1, 9, shape) for seed in seeds])


@dataclass(frozen=True)
class Drawn:
    """Raises if one of these trials is in its batch; reports those of the optional fields that are
    `given`."""

    refused: tuple[float, ...] = ()
    given: tuple[str, ...] = OPTIONAL

    def look_at(self, z) -> dict:
        if np.isin(z.reshape(len(z), -1)[:, 0], self.refused).any():
            raise RuntimeError("not this one")
        whole = drawn_for(z).astype(int)
        known = {"status": np.array(ENDS, np.int8)[whole % len(ENDS)], "iterations": whole}
        known |= {"effective": drawn_for(z, 4), "cost": drawn_for(z)}
        return {name: values for name, values in known.items() if name in self.given}


@dataclass(frozen=True)
class DrawnEstimator(Drawn, ib.Estimator):
    def estimate(self, problem, z, *, history=False):
        known = {"status": np.zeros(len(z), np.int8), **self.look_at(z)}
        n, rows = (
            problem.measurement.n,
            [drawn_for(row[None], 1 + int(abs(row[0]) * 100) % 3, 4)[0] for row in z],
        )
        known |= (
            {"covariance": np.eye(n) * drawn_for(z, 1, 1)} if "covariance" in self.given else {}
        )
        known |= {name: rows for name in ("history", "alternatives") if name in self.given}
        known["extras"] = {name: drawn_for(z) for name in ("nis", "stage") if name in self.given}
        wanted = {field.name for field in fields(ib.Estimates)}
        known = {name: values for name, values in known.items() if name in wanted}
        return ib.Estimates(
            drawn_for(z, n), simulations=drawn_for(z), jacobians=drawn_for(z), **known
        )


@dataclass(frozen=True)
class DrawnTracker(Drawn, ib.states.Tracker):
    def track(self, model, z):
        found = Tracks.empty(model, len(z))
        found.mean[:], found.covariance[:] = drawn_for(z, 4, 1), drawn_for(z, 4, 1, 1)
        found.nis[:], found.innovations[:] = drawn_for(z, 4), drawn_for(z, 4, 1)
        found.degrees[:], found.log_likelihood[:], found.calls[:] = 1.0, drawn_for(z), drawn_for(z)
        return replace(found, **self.look_at(z))


KINDS = {"constants": (CONSTANTS, DrawnEstimator), "states": (STATES, DrawnTracker)}


@cache
def block(kind: str, start: int, stop: int):
    return block_of(KINDS[kind][0], start, stop)


def readings(kind: str):
    whole = block(kind, 0, TRIALS)
    return whole.trials.z if kind == "constants" else whole.paths.z


def of(kind: str, estimator, z) -> dict:
    """Every field of estimates or of tracks, and the messages."""
    if kind == "constants":
        found, messages = estimate_safely(estimator, CONSTANTS.problem, z, history=True), {}
    else:
        found, messages = track_safely(estimator, STATES.assumed, z)
    own = {field.name: getattr(found, field.name) for field in fields(found)}
    left_out = ("seconds", "start", "moves", "predicted", "reads")
    return {"messages": messages} | {
        name: values for name, values in own.items() if name not in left_out
    }


def flat(values) -> dict:
    """Arrays by name: extras each under its own."""
    return {f"extra {k}": v for k, v in values.pop("extras", {}).items()} | values


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=10, deadline=None)
@given(
    refused=st.sets(st.integers(0, TRIALS - 1), max_size=TRIALS - 1),
    given=st.sets(st.sampled_from(OPTIONAL)),
)
def test_every_field_of_the_others_is_what_it_is_without_the_trials_that_raise(
    kind, refused, given
):
    z = readings(kind)
    at = tuple(sorted(refused))
    others = np.setdiff1d(np.arange(TRIALS), at)
    first = z.reshape(TRIALS, -1)[:, 0]
    together = flat(of(kind, KINDS[kind][1](given=tuple(given)), z))
    joined = flat(of(kind, KINDS[kind][1](tuple(first[list(at)]), tuple(given)), z))
    assert joined.pop("messages") == dict.fromkeys(at, "RuntimeError: not this one")
    assert not together.pop("messages")
    assert joined.keys() == together.keys()
    for name, values in together.items():
        if values is None:
            assert joined[name] is None
        elif isinstance(values, list):
            assert all(np.array_equal(joined[name][i], values[i]) for i in others)
            assert all(not len(joined[name][i]) for i in at)
        else:
            np.testing.assert_array_equal(
                take(joined[name], others), take(values, others), err_msg=name
            )
            assert joined[name].dtype == values.dtype


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("given", [OPTIONAL, (), ("iterations", "nis", "status")])
def test_rows_are_the_same_at_every_block_size(kind, given):
    first = readings(kind).reshape(TRIALS, -1)[:, 0]
    estimator = KINDS[kind][1](tuple(first[[0, 5, 6]]), given)
    stored = {}
    for size in (TRIALS, 5, 1):
        edges = range(0, TRIALS, size)
        parts = [block(kind, i, min(i + size, TRIALS)).estimate(estimator)[1] for i in edges]
        names = [name for name in max(parts, key=len) if name not in ("curves", "time_s")]
        # A block whose only trial raised has no extras, which is NaN when it is read.
        assert all(
            [name for name in names if name in part] == [name for name in part if name in names]
            for part in parts
        )
        blocks = [{"extra_nis": [np.nan], "extra_stage": [np.nan]} | part for part in parts]
        stored[size] = {name: np.concatenate([part[name] for part in blocks]) for name in names}
    for size in (5, 1):
        for name, values in stored[TRIALS].items():
            np.testing.assert_array_equal(stored[size][name], values, err_msg=name)
            assert stored[size][name].dtype == values.dtype


def test_blocks_with_and_without_a_trial_that_raises_are_stored_as_one(tmp_path):
    first = readings("states").reshape(TRIALS, -1)[:, 0]
    assert not compute(
        [STATES], {"drawn": DrawnTracker(tuple(first[[0]]))}, TRIALS, tmp_path, block_size=5
    )
    ends = [ib.Status(end).label for end in DrawnTracker().look_at(readings("states"))["status"]]
    assert ib.load(tmp_path)["status"].tolist() == ["error", *ends[1:]]
