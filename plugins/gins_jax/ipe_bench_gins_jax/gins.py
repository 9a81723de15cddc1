"""The gimballed INS of `ipe_bench.measurements.gins`, written in vectors and in jax.numpy: on a GPU
where there is one.

What its parameters and readings are is that model's; the equations, their integration and their
derivatives are not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements import Gins, Measurement, Parameter

jax.config.update("jax_enable_x64", True)


@dataclass(frozen=True)
class GinsJax(Measurement):
    """Velocity errors of a gimballed INS over 90 minutes after an injected velocity, in four cases;
    see `Gins`.

    Runge and Kutta's method of fourth order with even steps, so that readings are within 1e-8 m/s
    to an error scale of 100; Jacobians by forward differentiation of all of it. Trials are computed
    in chunks of one size, filled up where there are fewer: a trial's bits do not depend on how many
    others there are, and one compiled program serves all.
    """

    latitude_deg: float = 36.35
    earth_radius: float = 6378137.0
    gravity: float = 9.80665
    earth_rate: float = 7.292115e-5
    interval_min: Positive = 3.0
    readings_per_case: Count = 30
    steps_per_interval: Count = 90
    """Integration steps between two readings."""
    chunk: Count = 8
    """Trials that are computed together, by single trials too; on a GPU take some hundred."""

    reading_unit = "m/s"

    @cached_property
    def twin(self) -> Gins:
        """The model of which this is a second implementation."""
        shared = (
            "latitude_deg",
            "earth_radius",
            "gravity",
            "earth_rate",
            "interval_min",
            "readings_per_case",
        )
        return Gins(**{name: getattr(self, name) for name in shared})

    @property
    def usual_noise(self) -> Any:
        return self.twin.usual_noise

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.twin.parameters

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return self.twin.index

    @property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        return self.twin.epochs

    @cached_property
    def offset(self) -> Array:
        return _in_chunks(_programs(self)[0], np.zeros((1, self.n)), self.chunk)[0]

    def simulate(self, x: Array) -> Array:
        return _in_chunks(_programs(self)[0], x, self.chunk) - self.offset

    def jacobian(self, x: Array) -> Array:
        return _in_chunks(_programs(self)[1], x, self.chunk)

    @property
    def jacobian_cost(self) -> float:
        """Each direction is carried along with the solution."""
        return float(self.n)

    def linearization(self) -> Array:
        """H as the paper builds it: the readings at one unit of each parameter."""
        return np.ascontiguousarray(self.simulate(np.eye(self.n)).T)


def _in_chunks(program: Callable[[Any], Any], x: Array, size: int) -> Array:
    filled = np.zeros((-(-max(len(x), 1) // size) * size, x.shape[1]))
    filled[: len(x)] = x
    parts = [np.asarray(program(filled[i : i + size])) for i in range(0, len(filled), size)]
    return np.ascontiguousarray(np.concatenate(parts)[: len(x)])


@functools.cache
def _programs(model: GinsJax) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """The compiled readings (trials, m), velocities of the error-free system among them, and their
    slopes."""
    si, cases = jnp.asarray(model.twin.si_sizes), jnp.asarray(model.twin.cases)
    h = 60.0 * model.interval_min / model.steps_per_interval
    latitude = np.deg2rad(model.latitude_deg)
    axis = jnp.array([0.0, np.cos(latitude), np.sin(latitude)])

    def slope(y: Any, p: Any) -> Any:
        v, u, e, c = y[:2], y[2:5], y[5:8], y[8:]
        transport = jnp.stack([-v[1], v[0], jnp.zeros_like(v[0])]) / model.earth_radius
        command = model.earth_rate * c + transport
        unbalance = jnp.stack(
            [p[7] * u[0] + p[8] * u[1], p[9] * u[0] + p[10] * u[1], jnp.zeros_like(u[0])]
        )
        platform = command + p[4:7] + unbalance
        coriolis = 2 * model.earth_rate * c[2] * jnp.stack([v[1], -v[0]])
        a = model.gravity * (1 + p[2:4]) * u[:2] + p[:2] + coriolis
        turning = jnp.cross(u, platform - model.earth_rate * e)
        return jnp.concatenate([a, turning, jnp.cross(e, platform), jnp.cross(c, command)])

    def step(y: Any, p: Any) -> Any:
        k1 = slope(y, p)
        k2 = slope(y + h / 2 * k1, p)
        k3 = slope(y + h / 2 * k2, p)
        k4 = slope(y + h * k3, p)
        return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def case(x: Any, velocity: Any) -> Any:
        p = si * x
        start = jnp.concatenate([velocity, jnp.array([0.0, 0.0, 1.0]), axis, axis])

        def interval(y: Any, _: Any) -> Any:
            y = jax.lax.fori_loop(0, model.steps_per_interval, lambda _, y: step(y, p), y)
            return y, y[:2]

        return jax.lax.scan(interval, start, None, length=model.readings_per_case)[1]

    def readings(x: Any) -> Any:
        return jax.vmap(case, (None, 0))(x, cases).ravel()

    return jax.jit(jax.vmap(readings)), jax.jit(jax.vmap(jax.jacfwd(readings)))
