"""An estimation bench: which estimator to trust with nonlinear measurements.

    import ipe_bench as ib

    noise = ib.noise.Quantization(step=0.02286)
    bench = ib.Scenario(ib.measurements.Gins(), noise, error_scale=33.0)
    newton = ib.solvers.Newton(max_iterations=20)
    table = ib.run(bench, {"newton": newton, "ekf": ib.baselines.EKF()}, trials=200)
    fits = ib.estimate(ib.measurements.Gins(), "my.csv", noise=noise)
    ib.load("outputs/paper").groupby(["estimator", "error_scale"])["nees"].mean()

The import is quick, because each name is loaded when it is first used.
"""

# ruff: noqa: F401
import importlib
import itertools
from typing import TYPE_CHECKING, Any

__version__ = "0.4.0"

if TYPE_CHECKING:
    from ipe_bench import baselines, measurements, noise, priors, solvers, states
    from ipe_bench.api import (
        audit,
        check,
        compare,
        component,
        design,
        estimate,
        load,
        posterior,
        report,
        run,
        status,
    )
    from ipe_bench.baselines.sequential import ConstantFilter, Sequential
    from ipe_bench.basics.errors import UserError
    from ipe_bench.basics.statuses import Status
    from ipe_bench.estimators.base import Estimates, Estimator
    from ipe_bench.estimators.ipe import IPE, State, System
    from ipe_bench.measurements.base import Measurement, Parameter
    from ipe_bench.measurements.ode.model import OdeMeasurement
    from ipe_bench.measurements.problem import Problem
    from ipe_bench.noise.base import Noise
    from ipe_bench.trials.paths import StateScenario
    from ipe_bench.trials.scenario import Scenario

_HOMES = {
    "api": (
        "audit",
        "check",
        "compare",
        "component",
        "design",
        "estimate",
        "load",
        "posterior",
        "report",
        "run",
        "status",
    ),
    "baselines.sequential": ("Sequential", "ConstantFilter"),
    "basics.errors": ("UserError",),
    "basics.statuses": ("Status",),
    "estimators.base": ("Estimates", "Estimator"),
    "estimators.ipe": ("IPE", "State", "System"),
    "measurements.base": ("Measurement", "Parameter"),
    "measurements.ode.model": ("OdeMeasurement",),
    "measurements.problem": ("Problem",),
    "noise.base": ("Noise",),
    "trials.scenario": ("Scenario",),
    "trials.paths": ("StateScenario",),
}
"""Public names, by the module that they are in."""
_ROOMS = ("baselines", "measurements", "noise", "priors", "solvers", "states")
__all__ = sorted(["__version__", *_ROOMS, *itertools.chain(*_HOMES.values())])  # pyright: ignore[reportUnsupportedDunderAll]

# The room of the report is imported first, so that its name stands for the function `report` from
# then on.
importlib.import_module(f"{__name__}.report")
del globals()["report"]


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"{__name__}.{name}")
    for module, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
