"""A model that notes what its evaluations cost, and whether an estimator books the same."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from shared.oracles import assert_agrees

from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement, WrappedModel
from ipe_bench.trials.scenario import Scenario


@dataclass(frozen=True)
class Watched(WrappedModel):
    """A model that notes what its evaluations cost: a Jacobian what the model says, the first
    epochs their share."""

    whole: Measurement
    seen: Counter[str] = field(default_factory=Counter, compare=False)

    def __post_init__(self) -> None:
        """No options."""

    @property
    def cost(self) -> float:
        price = {
            "jacobian": self.whole.jacobian_cost,
            "coarse_jacobian": self.whole.coarse_jacobian_cost,
        }
        return sum(count * price.get(name, 1.0) for name, count in self.seen.items())


def _watch(name):
    inner = getattr(WrappedModel, name)

    def method(model, x, *stop):
        share = stop[0] / len(model.whole.epochs) if stop else 1.0
        model.seen[name.removesuffix("_until")] += len(x) * share
        return inner(model, x, *stop)

    setattr(Watched, name, method)


for _name in ("simulate", "coarse_simulate", "jacobian", "coarse_jacobian"):
    for _method in (_name, f"{_name}_until"):
        if _method != "coarse_simulate":
            _watch(_method)


def check_cost(estimator: Estimator, scenario: Scenario, trials: int) -> None:
    model = Watched(scenario.measurement)
    problem = replace(scenario.problem, measurement=model)
    _ = problem.H_plus  # of the problem, and the same for all trials
    for z in scenario.draw(0, trials).z:
        model.seen.clear()
        with np.errstate(all="ignore"):
            found = estimator.estimate(problem, z[None])
        booked = found.simulations[0] + model.jacobian_cost * found.jacobians[0]
        assert_agrees(booked, model.cost, rtol=1e-9)
