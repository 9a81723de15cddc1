"""Every estimator of the package, and checks that all pass, those of the zoo too."""

import numpy as np
from shared.small_models import Bent

from ipe_bench import solvers
from ipe_bench.baselines import (
    CKF,
    EKF,
    IPLF,
    UKF,
    EnKF,
    GaussNewton,
    IteratedEKF,
    LeastSquares,
    LevenbergMarquardt,
    MapLM,
    MultiscaleLM,
    Multistart,
)
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers import (
    Auto,
    Broyden,
    DampedNewton,
    FixedPoint,
    Newton,
    Progressive,
    Relinearized,
)
from ipe_bench.trials.scenario import Scenario

SOLVERS: list[Estimator] = [
    *(
        FixedPoint(),
        Newton(),
        Broyden(),
        Broyden("identity"),
        DampedNewton(),
        solvers.SteepestDescent(),
    ),
    *(Relinearized(), Relinearized(Newton()), Progressive(), Progressive(use_prior=False), Auto()),
]
LEAST_SQUARES: list[Estimator] = [
    *(
        GaussNewton(),
        GaussNewton(damping=1e-3),
        LevenbergMarquardt(),
        LevenbergMarquardt(geodesic=True),
        MapLM(),
    ),
    *(LeastSquares(method=method) for method in ("trf", "lm", "dogbox")),
    *(Multistart(starts=4), MultiscaleLM()),
]
FILTERS: list[Estimator] = [
    *(kind(engine=e) for kind in (EKF, IteratedEKF, UKF, CKF) for e in ("filterpy", "batched")),
    EnKF(members=30),
    IPLF(),
]
ALL = [*SOLVERS, *LEAST_SQUARES, *FILTERS]


def check_bits(estimator: Estimator, scenario: Scenario, trials: int) -> None:
    problem, z = scenario.problem, scenario.draw(0, trials).z
    with np.errstate(all="ignore"):
        together = estimator.estimate(problem, z[::-1], history=True)
        alone = [estimator.estimate(problem, row[None], history=True) for row in z[::-1]]
    for name in ("x", "status", "covariance", "iterations", "simulations", "jacobians"):
        np.testing.assert_array_equal(
            getattr(together, name), np.concatenate([getattr(a, name) for a in alone]), name
        )
    for name, values in together.extras.items():
        np.testing.assert_array_equal(values, np.concatenate([a.extras[name] for a in alone]), name)
    assert together.messages == {i: a.messages[0] for i, a in enumerate(alone) if a.messages}
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(together.history[i], one.history[0])


class Raising(Bent):
    """Raises far from the start."""

    def simulate(self, x: Array) -> Array:
        if (np.abs(np.real(x[:, 0])) > 200).any():
            raise ArithmeticError("too far\nsecond line")
        return super().simulate(x)


def check_failures(estimator: Estimator) -> None:
    problem = Problem(Raising(0.01), Covariance(np.full(12, 0.1)), np.array([10.0, 10.0, 10.0]))
    z = Bent(0.01).simulate(np.random.default_rng(2).normal(size=(6, 3)))
    bad = z.copy()
    bad[1, 4] = np.nan
    bad[3] = Bent().simulate(np.array([[1e7, 0.0, 0.0]]))[0]
    with np.errstate(all="ignore"):
        alone, mixed = (estimator.estimate(problem, readings) for readings in (z, bad))
    others = [0, 2, 4, 5]
    np.testing.assert_array_equal(mixed.x[others], alone.x[others])
    np.testing.assert_array_equal(mixed.status[others], alone.status[others])
    assert mixed.status[1] == Status.NONFINITE
    assert mixed.status[3] == Status.ERROR
    assert mixed.messages[3] == "ArithmeticError: too far"
