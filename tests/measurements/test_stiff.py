"""Stiff equations: published digits, exact solutions, SciPy's Radau, and which method a model is
given."""

import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from shared.oracles import assert_agrees
from shared.slopes import differentiate

from ipe_bench.engine.rodas import _REACH, SHAPE, Rodas5P, _sums
from ipe_bench.measurements import Ode, OdeMeasurement, Parameter

# fmt: off
HIRES = {
    "y1": "-1.71*y1+0.43*y2+8.32*y3+0.0007", "y2": "1.71*y1-8.75*y2",
    "y3": "-10.03*y3+0.43*y4+0.035*y5",
    "y4": "8.32*y2+1.71*y3-1.12*y4", "y5": "-1.745*y5+0.43*y6+0.43*y7",
    "y6": "-k*y6*y8+0.69*y4+1.71*y5-0.43*y6+0.69*y7", "y7": "k*y6*y8-1.81*y7",
    "y8": "-k*y6*y8+1.81*y7",
}
# fmt: on


def robertson(*times):
    rates = {"a": "-k1*a + k3*b*c", "b": "k1*a - k3*b*c - k2*b*b", "c": "k2*b*b"}
    return Ode(
        rates=rates, start={"k1": 0.04, "k2": 3e7, "k3": 1e4}, initial={"a": 1.0}, times=times
    )


def van_der_pol(mu, end):
    rates = {"u": "v", "v": "mu*(1-u*u)*v - u"}
    return Ode(
        rates=rates,
        start={"mu": mu},
        initial={"u": 2.0},
        times=tuple(np.linspace(end / 20, end, 20)),
    )


def hires():
    return Ode(
        rates=HIRES, start={"k": 280.0}, initial={"y1": 1.0, "y8": 0.0057}, times=(321.8122,)
    )


def follower(**options):
    """A state that follows exp(-t / 100) with a time constant of 1 / k."""
    rates, outputs = {"w": "-0.01*w", "y": "-k*(y-w)"}, {"y": "y"}
    options = {
        "rates": rates,
        "start": {"k": 100.0},
        "times": tuple(np.arange(0.0, 241.0, 10.0)),
    } | options
    return Ode(outputs=outputs, initial={"w": 1.0}, **options)


# F. Mazzia and C. Magherini, Test Set for Initial Value Problem Solvers, release 2.4, Bari, 2008.
@pytest.mark.oracle(
    "published: Mazzia and Magherini, Test Set for Initial Value Problem Solvers (2008)",
    "end of Robertson's problem, Van der Pol's oscillator and HIRES",
    2e-8,
)
@pytest.mark.parametrize(
    ("model", "expected", "left"),
    [
        pytest.param(
            *(
                robertson(1e11),
                (0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050),
                5e-9,
            ),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            van_der_pol(1000.0, 2000.0),
            (1.706167732170469, -0.8928097010248125e-3),
            2e-8,
            marks=pytest.mark.slow,
        ),
        (
            hires(),
            (
                *(
                    0.7371312573325668e-3,
                    0.1442485726316185e-3,
                    0.5888729740967575e-4,
                    0.1175651343283149e-2,
                ),
                *(
                    0.2386356198831331e-2,
                    0.6238968252742796e-2,
                    0.2849998395185769e-2,
                    0.2850001604814231e-2,
                ),
            ),
            5e-9,
        ),
    ],
    ids=["robertson", "van der pol", "hires"],
)
def test_the_digits_of_the_test_set(model, expected, left):
    z = Rodas5P(model.engine.stepped, 1e-8).simulate(model.nominal[None], len(model.times))[0]
    assert_agrees(z[-len(expected) :], expected, rtol=left)


@pytest.mark.oracle("closed form: a state that follows an exponential", "readings and slopes", 1e-8)
def test_a_stiff_model_is_found_and_is_within_its_tolerance():
    model = follower()
    t, k = np.array(model.times), 100.0
    exact = k / (k - 0.01) * (np.exp(-0.01 * t) - np.exp(-k * t))
    assert model.engine.stiff
    (said,) = model.remarks(model.nominal)
    assert said.startswith("the equations are stiff: an explicit method would need ")
    assert "measurement.method=" in said
    assert replace(model, method="implicit").remarks(model.nominal) == ()
    assert_agrees(model.simulate(np.array([[1.0]]))[0], exact, atol=1e-8)
    slope = -0.01 / (k - 0.01) ** 2 * (np.exp(-0.01 * t) - np.exp(-k * t)) + k / (
        k - 0.01
    ) * t * np.exp(-k * t)
    assert_agrees(model.jacobian(np.array([[1.0]]))[0, :, 0], k * slope, atol=1e-8)


@pytest.mark.oracle("closed form: a state that is 0, of large ones that cancel", "its size", 1e-9)
def test_a_state_that_holds_only_the_round_off_of_large_ones_takes_no_short_steps():
    rates = {"d": "100*(a-b) - k*d", "a": "-0.1*k*a", "b": "-0.1*(b*k*7)/7"}
    initial = {"a": 1000.0, "b": 1000.0}
    times = (1.0, 5.0)
    model = Ode(rates=rates, start={"k": 0.7}, initial=initial, times=times, method="implicit")
    method = Rodas5P(model.engine.stepped, 1e-8)
    d, a, _ = method.simulate(model.nominal[None], 2)[0].reshape(2, 3).T
    assert_agrees(d, np.zeros(2), atol=1e-9)
    assert_agrees(a, 1000.0 * np.exp(-0.07 * np.array(times)), rtol=1e-10)
    assert method.measured(model.nominal[None])[1].steps < 100


def test_sums_over_a_step_have_the_same_bits_alone_and_among_others():
    values = np.random.default_rng(0).normal(size=(2, 64, 5))
    together = _sums(values)
    for lane in range(5):
        assert (_sums(values[:, :, lane : lane + 1])[:, 0] == together[:, lane]).all()


@pytest.mark.oracle("closed form: an exponential", "readings that are exact at the start", 2e-6)
@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_a_tolerance_may_grow_from_0_at_the_start(method):
    times = (0.0, 1.0, 2.0)
    options = {"times": times, "tolerance": "1e-6*t", "method": method}
    model = Ode(rates={"y": "-k*y"}, start={"k": 1.0}, initial={"y": 1.0}, **options)
    assert_agrees(model.simulate(np.array([[1.0]]))[0], np.exp(-np.array(times)), atol=2e-6)


@pytest.mark.parametrize("divisors", [3, 60, 130])
def test_the_sign_of_each_of_many_divisors_tells_a_pole(divisors):
    rates = {"y": "+".join(f"k/(y-{i})" for i in range(1, divisors + 1))}
    model = Ode(rates=rates, start={"k": 1.0}, times=(1.0,))
    y = np.arange(divisors + 1) + 0.5
    (side,) = Rodas5P(model.engine.stepped, SHAPE)._programs["side"]([0.0, y, 1.0])
    assert len(set(side)) == divisors + 1


def test_steps_of_an_explicit_method_are_counted_along_the_solution_alone():
    """The Jacobian's spectral radius is k throughout, also where a pulse makes steps be refused."""
    pulse = {"w": "-0.01*w", "y": "-k*(y-w) + 5000*exp(-((t-77)/0.5)**2)"}
    model = follower(rates=pulse)
    _, effort = Rodas5P(model.engine.stepped, SHAPE).measured(model.nominal[None])
    assert effort.steps > 60
    assert effort.explicit == pytest.approx(100.0 * 240.0 / _REACH, rel=1e-9)


@pytest.mark.oracle("library: SciPy's Radau", "readings of Robertson's problem", 1e-7)
@pytest.mark.slow
def test_readings_beside_radau_and_slopes_beside_differences():
    model = robertson(*np.logspace(0, 3, 4))
    x = model.nominal * np.array([[1.0, 1.0, 1.0], [1.1, 0.9, 1.05]])
    z, J = model.simulate(x), model.jacobian(x)
    for row, p in zip(z, x * model.sizes, strict=True):

        def rhs(t, y, p=p):
            return model.engine.rhs(t, y, p, ())

        solved = solve_ivp(
            rhs, (0, 1e3), [1.0, 0.0, 0.0], "Radau", model.times, rtol=1e-10, atol=1e-16
        )
        assert_agrees(row.reshape(-1, 3), solved.y.T, rtol=1e-7)
    by_differences = differentiate(model.simulate, x, analytic=False)
    np.testing.assert_allclose(J, by_differences, atol=1e-7 * np.abs(by_differences).max())


@pytest.mark.slow
def test_a_trial_and_a_prefix_have_the_same_bits_alone_and_in_a_batch():
    model = robertson(0.1, 0.3, 1.0, 3.0)
    x = model.nominal + 0.1 * np.random.default_rng(0).standard_normal((7, 3))
    assert np.array_equal(model.simulate(x)[4:5], model.simulate(x[4:5]))
    assert np.array_equal(model.jacobian(x)[4:5], model.jacobian(x[4:5]))
    assert np.array_equal(model.simulate_until(x, 3), model.simulate(x)[:, :9])


@pytest.mark.parametrize(
    ("mu", "stiff"),
    [(3.0, False), (30.0, False), pytest.param(300.0, True, marks=pytest.mark.slow)],
)
def test_the_rule_tells_stiff_oscillators_from_others(mu, stiff):
    assert van_der_pol(mu, 2 * mu).engine.stiff == stiff


def test_a_stiff_model_that_was_used_goes_to_worker_processes():
    model = follower(times=(10.0, 20.0))
    x = model.nominal[None] * 1.1
    z, J = model.simulate(x), model.jacobian(x)
    again = pickle.loads(pickle.dumps(model))
    assert np.array_equal(again.simulate(x), z)
    assert np.array_equal(again.jacobian(x), J)


SHOWN = {
    "y": lambda y: y,
    "y/(0.5+y)": lambda y: y / (0.5 + y),
    "tanh(y)": np.tanh,
    "exp(-y)": lambda y: np.exp(-y),
    "1/(1+exp(-y))": lambda y: 1 / (1 + np.exp(-y)),
    "max(y,0)": lambda y: np.maximum(y, 0.0),
    "y**4/(0.5**4+y**4)": lambda y: y**4 / (0.5**4 + y**4),
    "exp(0.2*y)": lambda y: np.exp(0.2 * y),
    "1/(1+y**2)": lambda y: 1 / (1 + y * y),
    "sin(y)": np.sin,
}
GRIDS = (tuple(np.arange(0.5, 6.5, 0.5)), (2.0,), (0.0, 0.1, 0.7, 3.0, 10.0))
RATES = (60.0, 300.0, 3e3, 1e5)
FAST = [(shown, rate, times) for shown in SHOWN for rate in RATES for times in GRIDS]
FAST_THIRD = [
    (shown, rate, GRIDS[(i + j) % 3])
    for i, shown in enumerate(SHOWN)
    for j, rate in enumerate(RATES)
]


def check_fast(shown, rate, times):
    """y follows k (1.2 + sin t) with a time constant of 1 / rate, which an explicit step leaves for
    1e30; where a reading saturates, one such state reads as another."""
    model = Ode(
        {"y": "-L*(y-(1.2+sin(t))*k)"},
        {"k": 0.5},
        {"y": 0.2},
        {"z": shown},
        times,
        constants={"L": rate},
    )
    assert not model.hindrance(model.nominal)
    x = model.nominal + np.array([[0.0], [0.3], [-0.3], [1.0], [3.0]])
    k, t = 0.5 * x, np.array(times)
    mean, left = 1.2 + rate * (rate * np.sin(t) - np.cos(t)) / (rate**2 + 1), np.exp(-rate * t)
    slope = 0.5 * (mean - (1.2 - rate / (rate**2 + 1)) * left)
    y = 2 * k * slope + 0.2 * left
    assert_agrees(model.simulate(x), SHOWN[shown](y), atol=1e-7)
    turned = (SHOWN[shown](y + 1e-6) - SHOWN[shown](y - 1e-6)) / 2e-6
    assert_agrees(model.jacobian(x)[:, :, 0], turned * slope, atol=1e-6)


@pytest.mark.oracle(
    "closed form: a fast state that follows a sine",
    "readings and slopes of saturating outputs",
    1e-6,
)
@pytest.mark.parametrize(("shown", "rate", "times"), FAST[::40])
def test_a_reading_that_saturates_is_that_of_the_solution(shown, rate, times):
    check_fast(shown, rate, times)


@pytest.mark.slow
def test_readings_that_saturate_in_any_way_are_those_of_the_solution():
    """A third, in which each output meets each rate and each grid, and each rate each grid."""
    for case in FAST_THIRD:
        check_fast(*case)


@pytest.mark.oracle(
    "closed form: a fast state that follows a sine",
    "readings and slopes of saturating outputs, 120 models",
    1e-6,
)
@pytest.mark.campaign
def test_every_reading_that_saturates_is_that_of_the_solution():
    assert len(FAST) == 120
    for case in FAST:
        check_fast(*case)


@dataclass(frozen=True)
class Saturating(OdeMeasurement):
    """A fast state in a reading that saturates, without a second method to fall back on."""

    rate: float
    tolerance = 1e-8
    states, outputs = 1, ("z",)
    parameters, nominal = (Parameter("k"),), np.ones(1)  # type: ignore[assignment]
    times = np.array([1.0, 2.0])  # type: ignore[assignment]

    def start(self, p, c):
        return (0.2,)

    def rhs(self, t, y, p, c):
        return (-self.rate * (y[0] - p[0]),)

    def read(self, t, y, p, c):
        return (np.tanh(y[0]),)


def test_a_solution_that_no_step_follows_has_no_readings_however_they_saturate():
    x = np.array([[1.0], [0.5]])
    followed, lost = Saturating(300.0), Saturating(1e5)
    np.testing.assert_allclose(followed.simulate(x), np.tanh(x) * np.ones(2), atol=1e-8)
    assert not followed.hindrance(x[0])
    for _ in range(2):  # found, then remembered
        assert np.isnan(lost.simulate(x)).all()
    assert "the equations need steps of 5e-05 s" in lost.hindrance(x[0])


@pytest.mark.oracle("library: SciPy's Radau", "readings", 2e-8)
def test_a_fast_state_that_saturates_in_another_rate_leaves_no_error_there():
    rates = {"fast": "-300*(fast-k*t)", "slow": "1/(1+fast**2)"}
    model = Ode(rates, {"k": 1.0}, outputs={"slow": "slow"}, times=(1.0, 2.0, 3.0))
    solved = solve_ivp(
        lambda t, y: (-300 * (y[0] - t), 1 / (1 + y[0] ** 2)),
        *((0, 3), [0.0, 0.0], "Radau", model.times),
        rtol=1e-11,
        atol=1e-13,
    )
    assert_agrees(model.simulate(model.nominal[None])[0], solved.y[1], atol=2e-8)


@pytest.mark.oracle("closed form: a fast state that follows a sine", "readings", 1e-8)
def test_two_levels_that_agree_on_what_is_wrong_are_found_out_by_the_implicit_method():
    """Beside 6e23 molecules, both leave the fast state at what may be rounding."""
    rates = {"n": "-0.001*n", "y": "-60*(y-(1.2+sin(t))*k)"}
    model = Ode(rates, {"k": 0.5}, {"n": 6e23, "y": 0.2}, {"z": "tanh(y)"}, times=(0.5,))
    mean = 0.5 * (1.2 + 60 * (60 * np.sin(0.5) - np.cos(0.5)) / 3601)
    assert_agrees(model.simulate(model.nominal[None])[0, 0], np.tanh(mean), atol=1e-8)
    (said,) = model.remarks(model.nominal)
    assert said.startswith("the explicit method misses what happens: ")
    assert np.isnan(replace(model, method="explicit").simulate(model.nominal[None])).all()


def test_readings_at_the_start_alone_need_no_step():
    model = Ode({"y": "-k*y"}, {"k": 0.5}, {"y": "2*k"}, times=(0.0,))
    np.testing.assert_array_equal(model.simulate(np.array([[1.0], [3.0]])), [[1.0], [3.0]])
    np.testing.assert_array_equal(model.jacobian(model.nominal[None]), [[[1.0]]])
    assert not model.hindrance(model.nominal)


@pytest.mark.oracle("closed form: a fast state that follows a sine", "readings", 1e-8)
@pytest.mark.slow
def test_equations_that_the_shortest_explicit_steps_do_not_follow_are_integrated_implicitly():
    model = Ode({"y": "-280*(y-k*sin(3*t))"}, {"k": 1.0}, outputs={"z": "tanh(y)"}, times=(20.0,))
    lag = 280 * (280 * np.sin(60.0) - 3 * np.cos(60.0)) / (280**2 + 9)
    assert not model.hindrance(model.nominal)
    assert_agrees(model.simulate(model.nominal[None])[0, 0], np.tanh(lag), atol=1e-8)
    (said,) = model.remarks(model.nominal)
    assert said.startswith(
        "the shortest steps of the explicit method are too long for these equations; they are"
    )
