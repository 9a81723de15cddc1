"""What rivals book is what they evaluate."""

from collections import Counter

import pytest
from ipe_bench_zoo import LMIEKF, Anderson, EsMda, MultipleShooting, RecursiveUpdate
from ipe_bench_zoo.interval import Interval
from ipe_bench_zoo.multiple_shooting import Pieces
from shared.small_models import Bent
from shared.watched import check_cost

from ipe_bench.measurements import Gins, LotkaVolterra
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.trials.scenario import Scenario


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("estimator", [Anderson(), EsMda(), LMIEKF(), RecursiveUpdate()], ids=str)
def test_the_cost_of_an_estimator_is_what_it_evaluates(estimator, scale):
    check_cost(
        estimator, Scenario(Gins(readings_per_case=6), Quantization(0.02286), error_scale=scale), 2
    )
    check_cost(estimator, Scenario(Bent(0.05), Gaussian(0.1), error_scale=scale), 4)


def test_the_cost_of_multiple_shooting_is_what_its_intervals_take(monkeypatch):
    scenario, seen = Scenario(LotkaVolterra(), Gaussian(0.5)), Counter()

    def watch(name, price):
        inner = getattr(Interval, name)

        def method(model, x):
            seen["cost"] += price(model) * len(x)
            return inner(model, x)

        monkeypatch.setattr(Interval, name, method)

    watch("simulate", lambda model: 1.0)
    watch("jacobian", lambda model: model.jacobian_cost)
    model = scenario.measurement
    whole = len(Pieces.of(scenario.problem, 7, 0.125).grid) - 1  # intervals, of the one case
    for z in scenario.draw(0, 3).z:
        seen.clear()
        found = MultipleShooting(segments=7).estimate(scenario.problem, z[None])
        booked = found.simulations[0] + model.jacobian_cost * found.jacobians[0]
        assert booked == pytest.approx(seen["cost"] / whole, rel=1e-9)
