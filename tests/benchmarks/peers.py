"""Other people's integrators on the equations of a model by differential equations, batched as each
does it best, and their filters of states.

They come with the extra `peers`; an integrator that is not installed has no row. Each is told an
accuracy at which its readings are within the tolerance that ours hold, which the caller checks
before it takes the time.
"""

import importlib
import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine.equations import Recording
from ipe_bench.engine.tableaus import DOP853
from ipe_bench.engine.trace import Program
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.states.base import Normal

Simulate = Callable[[Array], Array]
_FUSED = {
    "fma": lambda a, b, c: a * b + c,
    "fms": lambda a, b, c: a * b - c,
    "fnma": lambda a, b, c: c - a * b,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
}


def simulators(model: OdeMeasurement, steps: int) -> Iterator[tuple[str, Simulate]]:
    """Whatever is installed, by name; those of fixed steps take so many between readings."""
    if importlib.util.find_spec("heyoka"):
        yield "heyoka, Taylor series, 8 lanes, tolerance 1e-10", _by_heyoka(model, 1e-10)
    if importlib.util.find_spec("jax"):
        yield "JAX, the same formula and steps by scan", _by_jax(model, steps)


def one_thread() -> None:
    """For XLA, which must be told before it is loaded."""
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    )


def _run(program: Program, inputs: list[Any], library: Any) -> list[Any]:
    """The program on values of another library."""
    values = list(inputs)
    for name, *numbers in program.operations:
        if name == "constant":
            values.append(numbers[0])
        else:
            apply = _FUSED.get(name) or getattr(library, name)
            values.append(apply(*(values[i] for i in numbers)))
    return [values[i] for i in program.outputs]


def _programs(model: OdeMeasurement) -> tuple[Program, Program, Program]:
    """From p and c: the first state and what stays fixed; from t, the state and that: its slope,
    and what is read."""
    tape = Recording(model.equations)
    fixed = tape.fixed(*tape.slope, *tape.shown)
    along = [tape.t, *tape.y, *fixed]
    begin = Program.of([*tape.start, *fixed], [*tape.p, *tape.c])
    return begin, Program.of(tape.slope, along), Program.of(tape.shown, along)


def _begun(model: OdeMeasurement, begin: Program, x: Array) -> Array:
    """What begins each problem, (states + fixed, problems), trial by trial and case by case."""
    p = np.repeat(x * model.si_sizes, len(model.cases), axis=0)
    c = np.tile(model.cases, (len(x), 1))
    values = _run(begin, [*p.T, *c.T], np)
    return np.array(np.broadcast_arrays(*values, p[:, 0])[:-1], dtype=float)


def _shown(model: OdeMeasurement, shown: Program, y: Array, fixed: Array) -> Array:
    """Readings (trials, m) of states y (times, states, problems)."""
    t = model.times[:, None]
    z = np.stack(np.broadcast_arrays(*_run(shown, [t, *y.swapaxes(0, 1), *fixed], np)), axis=-1)
    problems, outputs = y.shape[2], len(model.outputs)
    z = z.swapaxes(0, 1).reshape(
        problems // len(model.cases), len(model.cases) * len(model.times) * outputs
    )
    return z - model.offset


def _by_heyoka(model: OdeMeasurement, tolerance: float) -> Simulate:
    hy: Any = __import__("heyoka")
    begin, slope, shown = _programs(model)
    states, lanes = model.states, 8
    names = [f"y{i}" for i in range(states)]
    held = slope.inputs - states - 1
    rates = _run(slope, [hy.time, *hy.make_vars(*names), *(hy.par[i] for i in range(held))], hy)
    system = [
        (hy.expression(name), hy.expression(rate)) for name, rate in zip(names, rates, strict=True)
    ]
    integrator = hy.taylor_adaptive_batch(
        system,
        np.zeros((states, lanes)),
        tol=tolerance,
        pars=np.zeros((held, lanes)),
        compact_mode=False,
    )
    grid = np.repeat(np.concatenate([[0.0], model.times])[:, None], lanes, axis=1)

    def simulate(x: Array) -> Array:
        first = _begun(model, begin, x)
        problems = first.shape[1]
        padded = np.pad(first, ((0, 0), (0, -problems % lanes)), mode="edge")
        y = np.empty((len(model.times), states, padded.shape[1]))
        for group in range(0, padded.shape[1], lanes):
            integrator.set_time(0.0)
            integrator.state[:] = padded[:states, group : group + lanes]
            integrator.pars[:] = padded[states:, group : group + lanes]
            y[:, :, group : group + lanes] = integrator.propagate_grid(grid)[1][1:]
        return _shown(model, shown, y[:, :, :problems], first[states:])

    return simulate


def _by_jax(model: OdeMeasurement, steps: int) -> Simulate:
    readings = jax_readings(model, steps)
    jax: Any = __import__("jax")
    batched = jax.jit(jax.vmap(readings))
    return lambda x: np.asarray(batched(x))


def jax_readings(model: OdeMeasurement, steps: int) -> Callable[[Any], Any]:
    """z (m,) of x (n,) in JAX, by steps of the formula that ours takes."""
    jax = _jax()
    jnp = jax.numpy
    begin, slope, shown = _programs(model)
    h = np.diff(np.concatenate([[0.0], model.times])) / steps
    t = np.concatenate([[0.0], model.times[:-1]])

    def of_case(p: Any, c: Any) -> Any:
        values = [jnp.asarray(v, dtype=float) for v in _run(begin, [*p, *c], jnp)]
        start, fixed = values[: model.states], values[model.states :]

        def slopes(t: Any, y: list[Any]) -> list[Any]:
            return _run(slope, [t, *y, *fixed], jnp)

        def step(y: list[Any], now: Any) -> Any:
            t, h = now
            for _ in range(steps):
                k: list[list[Any]] = []
                for s in range(DOP853.stages):
                    k.append(slopes(t + DOP853.C[s] * h, _moved(y, h, DOP853.A[s], k)))
                y, t = _moved(y, h, DOP853.B, k), t + h
            return y, jnp.stack(_run(shown, [t, *y, *fixed], jnp))

        return jax.lax.scan(step, start, (t, h))[1]

    def readings(x: Any) -> Any:
        p = x * model.si_sizes
        return jax.vmap(lambda c: of_case(p, c))(model.cases).reshape(model.m) - model.offset

    return readings


def _moved(y: list[Any], h: Any, weights: Sequence[float], k: list[list[Any]]) -> list[Any]:
    terms = [(w, slope) for w, slope in zip(weights, k, strict=False) if w]
    return [
        v + h * sum(w * slope[i] for w, slope in terms) if terms else v for i, v in enumerate(y)
    ]


def extended_filter(
    step: Callable[[Any], Any], seen: Callable[[Any], Any], first: Normal, Q: Array, R: Array
) -> Callable[[Array], Array] | None:
    """Makes the extended filter of dynamax, readings (trials, K, m) to means (trials, K, n), of
    functions that are written for JAX and states that are `first` at the first reading; None if it
    is not installed."""
    if not importlib.util.find_spec("dynamax"):
        return None
    jax = _jax()
    ssm: Any = importlib.import_module("dynamax.nonlinear_gaussian_ssm")
    model = ssm.ParamsNLGSSM(first.mean, first.covariance, step, Q, seen, R)
    batched = jax.jit(jax.vmap(lambda z: ssm.extended_kalman_filter(model, z).filtered_means))
    return lambda z: np.asarray(batched(z))


def _jax() -> Any:
    jax: Any = __import__("jax")
    jax.config.update("jax_enable_x64", True)
    return jax
