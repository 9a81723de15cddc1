"""What everything costs, in one table: `make bench` writes it as Markdown and as JSON to
outputs/bench.

All figures of a row are taken in one process, in turns, as CPU time, and the least of several
rounds is kept: so their ratios hold on a busy machine, too. The Makefile sets one thread for each
library. Whole commands are timed as processes, beside the import of the libraries that they use.
"""

import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import peers
from reach import outcome, scenarios
from scale import TRIALS, WORKERS, Usage, measured, used
from scipy.integrate import solve_ivp

import ipe_bench as ib
from ipe_bench.basics.machine import library_versions
from ipe_bench.engine.rodas import Rodas5P
from ipe_bench.trials.paths import StateScenario
from ipe_bench.trials.scoring import Block

STEP_S = 180.0
BATCH = 250
DYNAMAX = 200
"""Trials beside dynamax."""
LIBRARIES = "import pandas, matplotlib.pyplot, scipy.stats"


@dataclass(frozen=True)
class Row:
    """One comparison: what it costs here, beside what it costs there."""

    part: str
    what: str
    value: float
    unit: str
    beside: str
    other: float

    @property
    def ratio(self) -> float:
        return self.value / self.other


def least(*calls: Callable[[], Any], rounds: int = 5, at_least: float = 0.1) -> list[float]:
    """The least CPU seconds of one call of each, taken in turns."""
    best = [np.inf] * len(calls)
    repeats = []
    for i, call in enumerate(calls):
        call()
        began = time.process_time()
        call()
        best[i] = time.process_time() - began
        repeats.append(max(1, round(at_least / max(best[i], 1e-6))))
    for number in range(rounds):
        for i, (call, count) in enumerate(zip(calls, repeats, strict=True)):
            if count == 1 and not number:
                continue  # a long call, whose first round is above
            began = time.process_time()
            for _ in range(count):
                call()
            best[i] = min(best[i], (time.process_time() - began) / count)
    return best


def scenario(scale: float) -> ib.Scenario:
    return ib.Scenario(
        ib.measurements.Gins(), ib.noise.Quantization(step=0.02286), error_scale=scale
    )


def simulation() -> Iterator[Row]:
    model, x = (
        ib.measurements.Gins(step=STEP_S),
        33.0 * np.random.default_rng(0).normal(size=(BATCH, 11)),
    )
    adaptive = ib.measurements.Gins()
    for batch in (64, 8, 1):
        part = x[:batch]
        ours, whole = least(lambda part=part: model.simulate(part), lambda: model.simulate(x))
        what = f"one simulation, batch {batch}"
        yield Row(
            "simulation", what, 1e6 * ours / batch, "µs", f"batch {BATCH}", 1e6 * whole / BATCH
        )
    ours, fixed = least(lambda: adaptive.simulate(x), lambda: model.simulate(x))
    name = f"one simulation, batch {BATCH}, step by tolerance"
    yield Row(
        "simulation", name, 1e6 * ours / BATCH, "µs", f"steps of {STEP_S:g} s", 1e6 * fixed / BATCH
    )
    what = f"one simulation, batch {BATCH}"
    for beside, simulate in peers.simulators(model, 1):
        if not np.abs(simulate(x) - model.simulate(x)).max() < adaptive.tolerance:
            raise AssertionError(f"{beside}: integrates something else, or less accurately")
        ours, theirs = least(
            lambda: model.simulate(x), lambda simulate=simulate: simulate(x), rounds=3
        )
        yield Row("simulation", what, 1e6 * ours / BATCH, "µs", beside, 1e6 * theirs / BATCH)
    few = x[:2]
    ours, theirs = least(
        lambda: model.simulate(x), lambda: [by_scipy(model, row) for row in few], rounds=2
    )
    yield Row(
        "simulation",
        what,
        1e6 * ours / BATCH,
        "µs",
        "SciPy DOP853, rtol 1e-9",
        1e6 * theirs / len(few),
    )


def by_scipy(model: Any, x: np.ndarray) -> np.ndarray:
    p = (x * model.si_sizes).tolist()
    ends = []
    for case in model.cases.tolist():
        y0 = [float(v) for v in model.start(p, case)]
        found = solve_ivp(
            lambda t, y, case=case: model.rhs(t, y.tolist(), p, case),
            (0.0, model.times[-1]),
            y0,
            method="DOP853",
            rtol=1e-9,
            atol=1e-12,
            t_eval=model.times,
        )
        ends.append(found.y)
    return np.array(ends)


def jacobians() -> Iterator[Row]:
    for scale in (33.0, 1000.0, 3000.0):
        model, x = ib.measurements.Gins(), scale * np.random.default_rng(0).normal(size=(BATCH, 11))
        calls = (model.simulate, model.jacobian, model.coarse_jacobian)
        simulate, exact, coarse = least(*(partial(call, x) for call in calls), rounds=3)
        for name, seconds in (("exact Jacobian", exact), ("Jacobian inside iterations", coarse)):
            what = f"{name}, scale {scale:g}"
            yield Row(
                "Jacobian",
                what,
                1e6 * seconds / BATCH,
                "µs",
                "own simulation",
                1e6 * simulate / BATCH,
            )


def stiff() -> Iterator[Row]:
    """Robertson's equations to t = 4e5, beside what SciPy has for stiff ones, all with a relative
    tolerance of 1e-8."""
    rates = {"a": "-k1*a + k3*b*c", "b": "k1*a - k3*b*c - k2*b*b", "c": "k2*b*b"}
    times = tuple(np.logspace(0, np.log10(4e5), 20).tolist())
    model = ib.measurements.Ode(rates, {"k1": 0.04, "k2": 3e7, "k3": 1e4}, {"a": 1.0}, times=times)
    method, x = (
        Rodas5P(model.engine.stepped, 1e-8),
        1 + 0.01 * np.random.default_rng(0).normal(size=(BATCH, 3)),
    )

    def scipy(name: str) -> Any:
        p = (x[0] * model.sizes).tolist()
        tolerances = {"rtol": 1e-8, "atol": [1e-12, 1e-16, 1e-12]}
        rhs = partial(model.engine.rhs, p=p, c=())
        return solve_ivp(
            rhs, (0.0, times[-1]), [1.0, 0.0, 0.0], method=name, t_eval=times, **tolerances
        )

    for batch in (1, BATCH):
        for name in ("LSODA", "Radau"):
            ours, theirs = least(
                partial(method.simulate, x[:batch], len(times)), partial(scipy, name), rounds=2
            )
            what = f"Rodas5P on Robertson's equations, batch {batch}"
            yield Row("stiff", what, 1e3 * ours / batch, "ms", f"SciPy {name}", 1e3 * theirs)


def estimation() -> Iterator[Row]:
    s = scenario(33.0)
    block = Block.draw(s, 0, BATCH)
    problem, z, x = s.problem, block.trials.z, block.trials.x
    S, B = ib.solvers, ib.baselines
    estimators = [
        B.LinearLSE(),
        S.FixedPoint(),
        S.Broyden(),
        S.Newton(),
        S.Progressive(),
    ]
    estimators += [B.GaussNewton(), B.LevenbergMarquardt()]
    for estimator in estimators:
        name = type(estimator).__name__
        seconds, once = least(
            lambda e=estimator: e.estimate(problem, z),
            lambda: problem.measurement.simulate(x),
            rounds=3,
        )
        yield Row(
            "estimation", name, 1e6 * seconds / BATCH, "µs", "one simulation", 1e6 * once / BATCH
        )
    few = z[:10]
    seconds, theirs = least(
        lambda: B.LevenbergMarquardt().estimate(problem, z),
        lambda: B.LeastSquares().estimate(problem, few),
        rounds=2,
    )
    yield Row(
        "estimation",
        "LevenbergMarquardt",
        1e6 * seconds / BATCH,
        "µs",
        "SciPy least_squares",
        1e6 * theirs / len(few),
    )

    def scored() -> None:
        # Not the first block, which also holds what is taken of a few trials only.
        fresh = Block.draw(s, BATCH, 2 * BATCH)
        fresh.truth_columns()
        for estimator in (S.FixedPoint(), B.LinearLSE()):
            fresh.estimate(estimator)

    seconds, once = least(scored, lambda: problem.measurement.simulate(x), rounds=3)
    what = "fixed_point and linear_lse with truth and score"
    yield Row("estimation", what, 1e6 * seconds / BATCH, "µs", "one simulation", 1e6 * once / BATCH)


def filters() -> Iterator[Row]:
    B = ib.baselines
    s = scenario(33.0)
    for cls, trials in ((B.EKF, 100), (B.IteratedEKF, 100), (B.UKF, 100), (B.CKF, 100)):
        z = s.draw(0, trials).z
        few = z[:10]
        (batched,) = least(
            lambda cls=cls, z=z: cls(engine="batched").estimate(s.problem, z), rounds=2
        )
        (plain,) = least(lambda cls=cls, few=few: cls().estimate(s.problem, few), rounds=1)
        beside = "filterpy, trial by trial"
        yield Row(
            "filters", cls.__name__, 1e6 * batched / trials, "µs", beside, 1e6 * plain / len(few)
        )


def trackers() -> Iterator[Row]:
    """A pendulum of 500 epochs, all trials at once, beside filterpy's filters trial by trial and
    epoch by epoch, and beside dynamax, compiled and batched, where that is installed."""
    from filterpy import kalman

    S, step, gravity = ib.states, 0.01, 9.81
    noise = {"angle": f"{step}*sqrt({step}/3)*v", "rate": f"sqrt(3*{step})/2*v + sqrt({step})/2*w"}
    model = S.Formulas(
        next={
            "angle": f"angle + {step}*rate + {noise['angle']}",
            "rate": f"rate - {step}*{gravity}*sin(angle) + {noise['rate']}",
        },
        readings={"sine": "sin(angle)"},
        noise={"v": 0.1, "w": 0.1},
        deviation={"sine": np.sqrt(0.1)},
        spread={"angle": 1.0, "rate": 1.0},
        count=500,
        step=step,
    )

    def moved(x: Any, dt: float) -> Any:
        return np.array([x[0] + step * x[1], x[1] - step * gravity * np.sin(x[0])])

    def seen(x: Any) -> Any:
        return np.sin(x[:1])

    def prepared(other: Any, x: Any) -> Any:
        other.x, other.P, other.Q, other.R = x, np.eye(2), model.Q(0), model.R(0)
        return other

    def extended(z: Any) -> None:
        other = prepared(kalman.ExtendedKalmanFilter(2, 1), np.zeros(2))
        for reading in z:
            other.F = np.array([[1.0, step], [-step * gravity * np.cos(other.x[0]), 1.0]])
            x = moved(other.x, step)
            other.predict()
            other.x = x
            other.update(reading, lambda x: np.array([[np.cos(x[0]), 0.0]]), seen)

    def unscented(z: Any) -> None:
        points = kalman.MerweScaledSigmaPoints(2, alpha=1.0, beta=0.0, kappa=1.0)
        other = prepared(kalman.UnscentedKalmanFilter(2, 1, step, seen, moved, points), np.zeros(2))
        for reading in z:
            other.predict()
            other.update(reading)

    z = model.draw(0, BATCH).z
    for name, ours, theirs in (("EKF", S.ekf(), extended), ("UKF", S.ukf(), unscented)):
        (batch,) = least(lambda ours=ours: ours.track(model, z), rounds=2)
        (plain,) = least(lambda theirs=theirs: theirs(z[0]), rounds=2)
        what = f"{name} of states, {BATCH} trials of 500 epochs"
        yield Row(
            "trackers", what, 1e3 * batch / BATCH, "ms", "filterpy, trial by trial", 1e3 * plain
        )
    yield beside_dynamax(model, step, gravity, z[:DYNAMAX])


def beside_dynamax(model: Any, step: float, gravity: float, z: np.ndarray) -> Row:
    """Our extended filter beside dynamax's; without a figure there if it is not installed."""

    def moved(x: Any) -> Any:
        import jax.numpy as jnp

        return jnp.stack([x[0] + step * x[1], x[1] - step * gravity * jnp.sin(x[0])])

    def seen(x: Any) -> Any:
        import jax.numpy as jnp

        return jnp.sin(x[:1])

    # dynamax begins at the first reading: one transition after the prior, whose mean is 0.
    F = np.array([[1.0, step], [-step * gravity, 1.0]])
    first = ib.states.Normal(np.zeros(2), F @ F.T + model.Q(1))
    dynamax = peers.extended_filter(moved, seen, first, model.Q(1), model.R(0))
    ours = partial(ib.states.ekf().track, model, z)
    what = f"EKF of states, {len(z)} trials of 500 epochs"
    if dynamax is None:
        (batch,) = least(ours, rounds=2)
        beside = "dynamax, not installed: PEERS=1"
        return Row("trackers", what, 1e3 * batch / len(z), "ms", beside, np.nan)
    # It adds to diagonals, so that it agrees to some digits only.
    np.testing.assert_allclose(dynamax(z), ours().mean, atol=1e-3)
    batch, theirs = least(ours, partial(dynamax, z), rounds=3)
    scale = 1e3 / len(z)
    return Row("trackers", what, scale * batch, "ms", "dynamax", scale * theirs)


def paths() -> Iterator[Row]:
    """Smoothers of whole paths beside the extended filter, at the batches that their goals name."""
    S = ib.states
    cases = (
        ("bearings_only", 30.0),
        ("coordinated_turn", 10.0),
        ("coordinated_turn", 100.0),
        ("pendulum", 4.0),
        ("walking_gins", 100.0),
    )
    ours = {"lm_ieks": S.LevenbergMarquardtSmoother(), "auto": S.AutoTracker()}
    for name, scale in cases:
        model = StateScenario(ib.component(f"state_model/{name}"), error_scale=scale).assumed
        for trials in (50,) if name == "walking_gins" else (50, 200):
            z = model.draw(0, trials).z
            with np.errstate(all="ignore"):
                calls = [partial(one.track, model, z) for one in (S.ekf(), *ours.values())]
                extended, *found = least(*calls, rounds=2)
            for label, seconds in zip(ours, found, strict=True):
                what = f"{label}, {name} at {scale:g}, {trials} trials"
                yield Row(
                    "paths", what, 1e3 * seconds / trials, "ms", "EKF", 1e3 * extended / trials
                )


def loop() -> Iterator[Row]:
    """Whole commands as a user sees them, with bytecode kept."""
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as folder:
        runs: dict[str, list[Usage]] = {}
        for attempt in range(3):
            run = [
                sys.executable,
                "-m",
                "ipe_bench",
                "run",
                "trials=2",
                f"output={folder}/{attempt}",
            ]
            for name, command in (
                ("libraries", [sys.executable, "-c", LIBRARIES]),
                ("run trials=2, all figures", run),
                ("the same with nothing to do", run),
            ):
                runs.setdefault(name, []).append(used(command))
    beside = runs.pop("libraries")
    for name, found in runs.items():
        for unit, seconds in (("s wall", lambda one: one.wall_s), ("s CPU", lambda one: one.cpu_s)):
            yield Row(
                "loop", name, min(map(seconds, found)), unit, LIBRARIES, min(map(seconds, beside))
            )


def scale() -> Iterator[Row]:
    """Many trials with their report, beside a tenth of them; not among the parts unless it is asked
    for."""
    few, many = measured(TRIALS // 10), measured(TRIALS)
    what, tenth = f"{TRIALS:,} trials, two estimators", f"{few.trials:,} trials"
    for name, a, b in (
        ("run with report", many.run, few.run),
        ("report alone", many.report, few.report),
    ):
        yield Row("scale", f"{what}: {name}", a.wall_s, "s wall", tenth, b.wall_s)
        yield Row("scale", f"{what}: {name}", a.cpu_s, "s CPU", tenth, b.cpu_s)
        yield Row("scale", f"{what}: {name}, its own peak", a.own_mb, "MB", tenth, b.own_mb)
    yield Row(
        "scale",
        f"{what}: largest of {WORKERS} workers",
        many.run.others_mb,
        "MB",
        tenth,
        few.run.others_mb,
    )
    yield Row(
        "scale",
        f"{what}: all processes at once",
        many.run.together_mb,
        "MB",
        tenth,
        few.run.together_mb,
    )
    yield Row(
        "scale", f"{what}: on disk", many.bytes_stored / 1e6, "MB", tenth, few.bytes_stored / 1e6
    )
    yield Row("scale", f"{what}: on disk", many.files, "files", tenth, few.files)


def reach() -> Iterator[Row]:
    """What `auto` reaches on problems that its constants were not chosen on."""
    for name, problem in scenarios():
        where = f"{name}, error scale {problem.error_scale:g}"
        ours = outcome(problem, ib.solvers.Auto())
        other = outcome(problem, ib.solvers.Progressive())
        beside = "progressive"
        yield Row("reach", f"{where}: solved", 100 * ours.solved, "%", beside, 100 * other.solved)
        told = f"{where}: solved, or told"
        yield Row("reach", told, 100 * ours.told, "%", beside, 100 * other.told)
        yield Row("reach", f"{where}: cost", ours.cost, "sim.", beside, other.cost)


PARTS = {
    f.__name__: f
    for f in (simulation, jacobians, stiff, estimation, reach, filters, trackers, paths, loop)
}
LONG = {"scale": scale}
"""Takes minutes: only where it is asked for."""


def markdown(facts: dict[str, Any], rows: list[Row]) -> str:
    head = ", ".join(f"{k} {v}" for k, v in facts.items())
    lines = [
        head,
        "",
        "| part | what | here | beside | there | ratio |",
        "|---|---|--:|---|--:|--:|",
    ]
    lines += [
        f"| {r.part} | {r.what} | {r.value:.3g} {r.unit} | {r.beside} | {r.other:.3g} |"
        f" {r.ratio:.3g} |"
        for r in rows
    ]
    return "\n".join(lines) + "\n"


def main(folder: Path, parts: list[str]) -> None:
    peers.one_thread()
    rows = []
    facts = {"system": platform.platform(), "cores": os.cpu_count(), **library_versions()}
    for part in parts or list(PARTS):
        for row in (PARTS | LONG)[part]():
            rows.append(row)
            print(
                f"{row.part:11s} {row.what:52s} {row.value:9.3g} {row.unit:7s} x{row.ratio:<8.3g}"
                f" {row.beside}"
            )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.md").write_text(markdown(facts, rows), encoding="utf-8")
    content = {"machine": facts, "rows": [asdict(row) | {"ratio": row.ratio} for row in rows]}
    (folder / "bench.json").write_text(
        json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    print(f"\n{folder / 'bench.md'}\n{folder / 'bench.json'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
