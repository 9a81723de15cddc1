"""The gimballed inertial navigation system of the paper with gyro drifts that walk."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, NonNegative, Positive
from ipe_bench.measurements import Gins, Parameter
from ipe_bench.states.base import Normal, StateModel

KINEMATIC = 11
"""States of the motion; the parameters follow."""
_SPEED = 457.2
"""The injected velocity of the paper, m/s."""
_DRIFTS = slice(KINEMATIC + 4, KINEMATIC + 7)


@dataclass(frozen=True)
class WalkingGins(StateModel):
    """The paper's four runs of 90 minutes one after another on one platform, whose three gyro
    drifts walk meanwhile.

    The states are the eleven of the motion, which begin anew with each run, and the eleven
    parameters of `Gins` in multiples of their sizes; eight of them stand still. The parameters
    alone are scored. An epoch is a pair of velocities, every three minutes.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.states.WalkingGins(walk=1.0)
    >>> model.epochs, len(model.states)
    (120, 22)
    """

    walk: NonNegative = 0.1
    """By how much a drift walks in an hour: standard deviation, in multiples of the drift's size
    (0.01 deg/h about x and y, 0.1 deg/h about z)."""
    motion: NonNegative = 0.0
    """Standard deviation of further noise on each state of the motion at each reading and at the
    start, in multiples of 457.2 m/s for velocities and of 1 for unit vectors; with 0 covariances
    are singular."""
    deviation: Positive = 0.0066
    """Standard deviation of a reading, m/s: that of rounding to 0.02286 m/s."""
    steps: Count = 4
    """Runge-Kutta steps between two readings."""
    gins: Gins = field(default_factory=Gins)

    @property
    def states(self) -> tuple[Parameter, ...]:
        names = ("vx", "vy", "ux", "uy", "uz", "ex", "ey", "ez", "cx", "cy", "cz")
        return (*(Parameter(name) for name in names), *self.gins.parameters)

    @property
    def scored(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.gins.parameters)

    @property
    def times(self) -> Array:
        epochs = len(self.gins.cases) * self.gins.readings_per_case
        return 60.0 * self.gins.interval_min * np.arange(1, epochs + 1)

    @property
    def _motion(self) -> Array:
        """Standard deviations (11,) of the noise on the motion."""
        sizes = np.repeat([_SPEED, 1.0], [2, KINEMATIC - 2])
        return self.motion * sizes

    @property
    def prior(self) -> Normal:
        variances = np.r_[self._motion**2, np.ones(self.gins.n)]
        return Normal(np.zeros(len(variances)), np.diag(variances))

    def alike(self, k: int) -> int:
        begins = k % self.gins.readings_per_case == 0
        return k if begins else 1

    def transition(self, x: Array, k: int) -> Array:
        g = self.gins
        y = x[..., :KINEMATIC]
        p = list(np.moveaxis(x[..., KINEMATIC:] * g.si_sizes, -1, 0))
        # The motion begins anew with each run, for every state that was before.
        run, within = divmod(k, g.readings_per_case)
        if within == 0:
            y = y * 0.0 + np.array(g.start(p, g.cases[run]))
        h = 60.0 * g.interval_min / self.steps

        def rate(y: Array) -> Array:
            rates = g.rhs(0.0, list(np.moveaxis(y, -1, 0)), p, ())
            return np.stack(rates, axis=-1)

        # The classical Runge-Kutta method of fourth order: y <- y + h (k1 + 2 k2 + 2 k3 + k4) / 6.
        for _ in range(self.steps):
            k1 = rate(y)
            k2 = rate(y + h / 2 * k1)
            k3 = rate(y + h / 2 * k2)
            k4 = rate(y + h * k3)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        # The parameters stand still, but for the drifts' noise.
        return np.concatenate([y, x[..., KINEMATIC:]], axis=-1)

    def observe(self, x: Array, k: int) -> Array:
        return x[..., :2] - self.gins.offset.reshape(-1, 2)[k]

    def gain(self, k: int) -> Array:
        # A drift walks by `walk` times the root of the hours between two readings.
        hours = self.gins.interval_min / 60.0
        motions = KINEMATIC if self.motion else 0
        G = np.zeros((self.n, 3 + motions))
        G[_DRIFTS, :3] = self.walk * np.sqrt(hours) * np.eye(3)
        if self.motion:
            G[:KINEMATIC, 3:] = np.diag(self._motion)
        return G

    def R(self, k: int) -> Array:
        return self.deviation**2 * np.eye(2)
