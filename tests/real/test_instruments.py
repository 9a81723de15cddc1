"""Estimates from files as instruments give them, against SciPy's solution of the same problem."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from shared.instruments import EXACT, SATURATION, START, estimate, simulated, solution
from shared.oracles import assert_agrees

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Formula, Gins, LotkaVolterra, Sir
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.noise import Gaussian, Quantization, Unknown
from ipe_bench.priors import GaussianPrior
from ipe_bench.real.readings import open_together
from ipe_bench.trials.scenario import Scenario


@pytest.mark.oracle("library: SciPy's least_squares", "estimates and standard errors", 1e-8)
@pytest.mark.parametrize(
    "known",
    [
        (ParameterInfo("b1", lower=100.0, upper=300.0), ParameterInfo("b2", positive=True)),
        (ParameterInfo("b1", upper=260.0), ParameterInfo("b2", lower=1e-5)),
        (
            ParameterInfo("b1", nominal=200.0),
            ParameterInfo("b2", nominal=8e-4, lower=0.0, upper=1e-3),
        ),
    ],
)
def test_bounds_move_neither_a_minimum_inside_of_them_nor_its_standard_errors(tmp_path, known):
    path, columns = simulated(tmp_path / "a.csv", 240.0, 3)
    t, y, sigma = columns.T
    result = estimate(open_together([path], ConstrainedModel(Formula(SATURATION, START), known)))
    x, deviations = solution(lambda p: (p[0] * (1 - np.exp(-p[1] * t)) - y) / sigma, [250, 5e-4])
    assert result.status is Status.CONVERGED
    assert_agrees(result.x, x, rtol=1e-8)
    assert_agrees(result.standard_errors, deviations, rtol=1e-8)
    for one, low, high in zip(known, *result.interval(0.999999), strict=True):
        assert one.bounds[0] <= low < high <= one.bounds[1]


@pytest.mark.oracle("library: SciPy's least_squares within bounds", "estimates on a bound", 1e-5)
@pytest.mark.parametrize("unknown", [False, True])
@pytest.mark.parametrize("upper", [220.0, 231.0])
def test_an_estimate_on_its_bound_is_the_minimum_within_the_bounds(tmp_path, upper, unknown):
    """Against SciPy's bounded solution; what is on the bound has no error, and the others' are with
    it held there."""
    path, columns = simulated(tmp_path / "a.csv", 240.0, 3)
    t, y, sigma = columns.T
    known = (
        ParameterInfo("b1", nominal=200.0, lower=100.0, upper=upper),
        ParameterInfo("b2", positive=True),
    )
    result = estimate(
        open_together([path], ConstrainedModel(Formula(SATURATION, START), known)),
        noise=Unknown() if unknown else Gaussian(1.0),
    )
    bounded = least_squares(
        lambda p: (p[0] * 100 * (1 - np.exp(-p[1] * 1e-4 * t)) - y) / sigma,
        [2.0, 5.0],
        bounds=([1, 0], [upper / 100, np.inf]),
        **EXACT,
    )
    assert result.status is Status.CONVERGED
    assert result.held_at == {0: upper}
    assert_agrees(result.x, bounded.x * [100, 1e-4], rtol=1e-5)
    x, deviations = solution(lambda p: (upper * (1 - np.exp(-p[0] * t)) - y) / sigma, [5e-4])
    assert result.x[1] == pytest.approx(x[0], rel=1e-8)
    assert result.degrees_of_freedom == len(t) - 1
    level = (
        np.sqrt(np.sum(((upper * (1 - np.exp(-x[0] * t)) - y) / sigma) ** 2) / (len(t) - 1))
        if unknown
        else 1.0
    )
    assert np.isnan(result.standard_errors[0])
    assert result.standard_errors[1] == pytest.approx(level * deviations[0], rel=1e-6)


def test_a_minimum_near_a_bound_but_inside_is_not_on_it(tmp_path):
    path, columns = simulated(tmp_path / "a.csv", 240.0, 3)
    t, y, sigma = columns.T
    x, deviations = solution(lambda p: (p[0] * (1 - np.exp(-p[1] * t)) - y) / sigma, [250, 5e-4])
    known = (ParameterInfo("b1", nominal=200.0, upper=x[0] * 1.0005),)
    result = estimate(open_together([path], ConstrainedModel(Formula(SATURATION, START), known)))
    assert result.held_at == {}
    assert result.x == pytest.approx(x, rel=1e-8)
    assert result.standard_errors == pytest.approx(deviations, rel=1e-8)


def test_draws_of_a_positive_parameter_are_log_normal_and_of_a_bounded_one_inside():
    model = ConstrainedModel(
        LotkaVolterra(),
        (
            ParameterInfo("birth", positive=True, deviation=0.3),
            ParameterInfo("death", lower=0.5, upper=1.0),
        ),
    )
    scenario = Scenario(model, Gaussian(0.5), GaussianPrior(model.prior_deviations), 1.0)
    values = model.physical(
        np.stack(
            [
                scenario.prior.draw(model.nominal, 1.0, rng)
                for rng in map(np.random.default_rng, range(2000))
            ]
        )
    )
    birth, death = values[:, 0], values[:, 2]
    assert (birth > 0).all()
    assert np.log(birth).std() == pytest.approx(0.3 / 0.55, rel=0.06)
    assert np.median(birth) == pytest.approx(0.55, rel=0.05)
    assert ((death > 0.5) & (death < 1.0)).all()


def test_every_coordinate_of_a_known_parameter_leads_back_to_its_value():
    known = (ParameterInfo("b1", lower=-3.0, upper=300.0), ParameterInfo("b2", upper=2e-3))
    model = ConstrainedModel(Formula(SATURATION, START, {"t": (1.0, 2.0, 3.0)}), known)
    x = np.random.default_rng(0).normal(size=(50, 2))
    assert model.inner(model.physical(x)) == pytest.approx(x, abs=1e-9)
    h = 1e-6
    for k in range(2):
        step = h * np.eye(2)[k]
        difference = (model.physical(x + step) - model.physical(x - step))[:, k] / (2 * h)
        assert model.physical_slope(x)[:, k] == pytest.approx(difference, rel=1e-6, abs=1e-6)


def test_every_model_with_a_noise_of_its_own_is_simulated_with_it():
    assert Scenario(Gins()).noise == Quantization(step=0.02286)
    assert Scenario(Sir()).noise == Gaussian(20.0)
    with pytest.raises(
        UserError, match=r"measurement=formula names no noise of its own; set noise.deviation"
    ):
        Scenario(Formula("a*t", {"a": 1.0}, {"t": (1.0, 2.0)}))
