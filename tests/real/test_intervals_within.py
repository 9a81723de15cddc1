"""Intervals of estimates on a bound, or near one, against closed forms and by their coverage."""

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares
from scipy.stats import linregress, norm, t
from shared.oracles import assert_agrees
from shared.synthetic_store import Repeated

from ipe_bench.baselines import GaussNewton, LevenbergMarquardt, MapLM
from ipe_bench.measurements import Formula
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.examined import examine
from ipe_bench.real.fits import fit
from ipe_bench.real.profiles import profiles, wald_interval
from ipe_bench.trials.scenario import Scenario

Q = norm.isf(0.025)
LM = {"lm": LevenbergMarquardt(tolerance=1e-10, max_iterations=300)}
T = np.arange(10.0)
A = np.column_stack([np.ones(10), T])
LINE = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": tuple(T)})


def examined(model, z, deviation: float, *known: ParameterInfo):
    """The examination of readings z, with what is known of the parameters."""
    problem = Scenario(ConstrainedModel(model, known), Gaussian(deviation)).problem
    found = examine(problem, z, fit(problem, z, LM))
    assert found is not None
    return found


@pytest.mark.oracle(
    "closed form: chi-square of a linear parameter", "end of the interval, in standard errors", 1e-3
)
@pytest.mark.parametrize("beyond", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_interval_of_a_linear_parameter_on_its_bound_is_known(beyond, side):
    """Chi-square about an unbounded estimate e deviations beyond the bound has risen by q^2 at -e +
    sqrt(e^2 + q^2) inside of it."""
    s = 0.7 * np.sqrt(np.linalg.inv(A.T @ A)[1, 1])
    bound = 5 - side * (beyond * s + 1e-9)  # the unbounded estimate is 5
    known = ParameterInfo("b", nominal=5 - 9 * side, **{"upper" if side > 0 else "lower": bound})
    (one,) = examined(LINE, 2 + 5 * T, 0.7, known).on_bounds
    assert (one.parameter.name, one.bound) == ("b", bound)
    expected = bound - side * s * (-beyond + np.sqrt(beyond**2 + Q**2))
    assert_agrees(one.other / s, expected / s, atol=1e-3)


@pytest.mark.parametrize("sizes", [(1.0, 10.0), (-2.0, 0.1), (-1.0, -3.0)])
def test_the_interval_of_a_linear_parameter_has_its_ends_in_order_in_any_unit(sizes):
    """Four readings of each, of deviation .4 in its unit: plus or minus 1.96 times .2, whatever
    sign the unit has."""
    model, x = Repeated(names=("a", "b"), sizes_given=sizes), np.array([3.0, 7.0])
    z = np.tile(x, 4) + 0.1 * np.array([-1, 2, -1, 2, 1, -2, 1, -2])
    low, high = profiles(Scenario(model, Gaussian(0.4)).problem, z, x, 0.04 * np.eye(2))
    reach = 0.2 * Q * np.abs(sizes)
    np.testing.assert_allclose([low, high], [x * sizes - reach, x * sizes + reach], rtol=1e-4)


@pytest.mark.oracle(
    "library: SciPy's linregress", "half-widths of the intervals of a line, relative", 1e-6
)
def test_the_profiles_of_a_line_are_those_of_linear_regression(monkeypatch):
    """Known at once of a model that is known to be linear, and searched for of any other."""
    z = 2 + 5 * T + np.random.default_rng(5).normal(0.0, 0.3, 10)
    known = linregress(T, z)
    reach = t.isf(0.025, 8) * np.array([known.intercept_stderr, known.stderr])
    problem = Scenario(LINE, Unknown()).problem
    for linear in (True, False):
        monkeypatch.setattr(Formula, "linear", linear)
        found = examine(problem, z, fit(problem, z, LM, Unknown()))
        assert found is not None
        low, high = found.profiles
        assert_agrees((high - low) / 2 / reach, np.ones(2), rtol=1e-6)
        assert_agrees((high + low) / 2, [known.intercept, known.slope], rtol=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_profiles_of_the_others_let_a_parameter_leave_its_bound_inwards(side):
    """Of an intercept whose slope is on its bound, against the quadratic form: the bound acts to
    one side only."""
    P = 0.49 * np.linalg.inv(A.T @ A)
    sa, sb, c = *np.sqrt(np.diag(P)), P[0, 1]
    bound = 5 - side * 0.8 * sb
    known = ParameterInfo("b", nominal=5 - 9 * side, **{"upper" if side > 0 else "lower": bound})
    found = examined(LINE, 2 + 5 * T, 0.7, known)

    def rise(a: float) -> float:
        b = 5 + c / sa**2 * (a - 2)
        b = min(b, bound) if side > 0 else max(b, bound)
        e = np.array([a - 2, b - 5])
        return float(e @ np.linalg.solve(P, e)) - 0.8**2

    least = 2 + c / sb**2 * (bound - 5)
    assert found.x[0] == pytest.approx(least, abs=1e-9)
    ends = [
        brentq(lambda a: rise(a) - Q**2, least + s * 1e-9, least + s * 20 * sa) for s in (-1, 1)
    ]
    assert np.ravel(found.profiles) == pytest.approx(ends, abs=2e-3 * sa)
    # Held on its bound, the slope would leave far shorter an interval to one side.
    longer, shorter = sorted((least - ends[0], ends[1] - least), reverse=True)
    assert longer > 1.2 * shorter


@pytest.mark.oracle(
    "library: SciPy's least_squares and brentq", "end of the interval, in its width", 1e-3
)
def test_the_interval_on_a_bound_is_where_scipys_profile_rises():
    rng = np.random.default_rng(8)
    t = np.linspace(50, 700, 14)
    z = -240 * np.expm1(-5.6e-4 * t) + 0.1 * rng.standard_normal(14)
    model = Formula("b1*(1-exp(-b2*t))", {"b1": 200.0, "b2": 5e-4}, {"t": tuple(t)})
    found = examined(model, z, 0.1, ParameterInfo("b1", upper=235.0))

    def chi_square(b1: float) -> float:
        def residuals(p):
            return (-b1 * np.expm1(-1e-4 * p[0] * t) - z) / 0.1

        return 2 * float(least_squares(residuals, [5.0], xtol=1e-15, ftol=1e-15, gtol=1e-15).cost)

    least = chi_square(235.0)
    expected = float(brentq(lambda b1: chi_square(b1) - least - Q**2, 150.0, 235.0))  # type: ignore[arg-type]
    assert_agrees(
        found.on_bounds[0].other / (235.0 - expected), expected / (235.0 - expected), atol=1e-3
    )


def test_an_interval_ends_at_the_other_bound_where_the_readings_say_nothing():
    found = examined(LINE, 2 + 5 * T, 60.0, ParameterInfo("b", nominal=0.5, lower=0.0, upper=1.0))
    assert (found.on_bounds[0].bound, found.on_bounds[0].other) == (1.0, 0.0)


TIMES = np.linspace(0, 6, 25)


def decay_above_zero(c: float, seed: int, bootstraps: int = 500):
    """A decay to c, which cannot be negative, read 25 times with errors of .05."""
    model = Formula("a*exp(-b*t)+c", {"a": 1.0, "b": 0.5, "c": 0.1}, {"t": tuple(TIMES)})
    problem = Scenario(
        ConstrainedModel(model, (ParameterInfo("c", lower=0.0),)), Gaussian(0.05)
    ).problem
    z = 2 * np.exp(-0.7 * TIMES) + c + 0.05 * np.random.default_rng(seed).standard_normal(25)
    fits = fit(problem, z, LM)
    return fits[0], examine(problem, z, fits, bootstraps=bootstraps)


@pytest.mark.parametrize(
    ("seed", "drawn"), [(0, 500), (2, 60)], ids=["estimate inside", "estimate on the bound"]
)
def test_simulated_sets_are_minimised_within_the_bounds_as_the_readings_were(seed, drawn):
    """Each once more by SciPy; about half are on the bound, and without those 0 would not be in the
    interval."""
    one, found = decay_above_zero(0.0, seed, bootstraps=drawn)
    assert found is not None
    assert one.held_at == ({} if seed == 0 else {2: 0.0})
    assert found.bootstrap.converged == found.bootstrap.drawn == drawn
    sets = one.x[0] * np.exp(-one.x[1] * TIMES) + one.x[2]
    sets = sets + 0.05 * np.random.Generator(np.random.Philox(0)).standard_normal((drawn, 25))

    def residuals(p, z):
        return p[0] * np.exp(-p[1] * TIMES) + p[2] - z

    bounds = ([-np.inf, -np.inf, 0.0], np.inf)
    x = np.array(
        [least_squares(residuals, one.x, bounds=bounds, xtol=1e-10, args=(z,)).x for z in sets]
    )
    assert drawn / 6 < (x[:, 2] < 1e-6).sum() < 5 * drawn / 6
    low, high = np.quantile(x, [0.025, 0.975], axis=0)
    free = len(found.bootstrap.low)  # of one on its bound no interval is drawn
    assert free == (3 if seed == 0 else 2)
    assert found.bootstrap.low == pytest.approx(low[:free], abs=1e-4)
    assert found.bootstrap.high == pytest.approx(high[:free], abs=1e-4)


def test_intervals_end_on_the_bound_that_they_reach():
    """The estimate is .005, a tenth of a standard error above the bound. In the logarithm of c its
    standard errors reach from 1e-12 to millions; in c they end on the bound, as the profile
    does."""
    one, found = decay_above_zero(0.0, 0)
    assert found is not None
    assert 0 < one.x[2] < 0.01
    low, high = np.transpose(found.profiles)[2]
    assert low == 0.0
    reach = one.x[2] + Q * one.standard_errors[2]
    for ends in (found.wald, one.interval()):
        assert [end[2] for end in ends] == pytest.approx([0.0, reach])
    assert high == pytest.approx(reach, rel=0.1)


@pytest.mark.parametrize(
    ("error", "symmetric"), [(0.6, True), (0.9, True), (1.1, True), (0.3, False)]
)
def test_an_interval_is_symmetric_in_the_parameter_if_three_half_widths_reach_its_bound(
    error, symmetric
):
    """The estimate is 2 above 0, and 1.96 standard errors are the half-width."""
    model = ConstrainedModel(LINE, (ParameterInfo("a", lower=0.0),))
    x = model.nominal + np.array([np.log(2.0), 0.0])
    assert model.physical(x[None])[0, 0] == pytest.approx(2.0)
    low, high = (end[0] for end in wald_interval(model, x, np.array([error / 2.0, 1.0]), Q))
    if symmetric:
        assert (low, high) == (
            pytest.approx(max(0.0, 2.0 - Q * error)),
            pytest.approx(2.0 + Q * error),
        )
    else:
        assert np.log([low / 2.0, high / 2.0]) == pytest.approx([-Q * error / 2.0, Q * error / 2.0])


def test_standard_errors_of_what_is_far_from_its_bound_are_of_its_logarithm():
    one, _ = decay_above_zero(1.0, 1)
    (c, s), (low, high) = (one.x[2], one.standard_errors[2]), (end[2] for end in one.interval())
    assert np.log([low / c, high / c]) == pytest.approx([-Q * s / c, Q * s / c])


@pytest.mark.campaign
@pytest.mark.parametrize("c", [0.0, 0.02])
def test_1000_truths_on_and_near_a_bound_are_in_every_interval(c):
    """Profile and standard error, and the bootstrap in 200 of them, hold c in .93 of cases or more,
    up to 2 standard errors; beside it their median widths."""
    studies, drawn = 1000, 200
    inside, widths = np.zeros(3), []
    for seed in range(studies):
        one, found = decay_above_zero(c, seed, bootstraps=100 if seed < drawn else 4)
        assert found is not None
        if one.held_at:
            ends = [(found.on_bounds[0].bound, found.on_bounds[0].other)] * 3
        else:
            bootstrap = found.bootstrap
            ends = [
                [end[2] for end in both]
                for both in (found.profiles, found.wald, (bootstrap.low, bootstrap.high))
            ]
        held = [low <= c <= high for low, high in ends]
        inside += held if seed < drawn else [*held[:2], False]
        widths.append([high - low for low, high in ends])
    covered = inside / [studies, studies, drawn]
    print(
        f"c = {c}: covered {covered} (profile, standard error, bootstrap), widths"
        f" {np.median(widths, axis=0)}"
    )
    assert (covered >= 0.93 - 2 * np.sqrt(0.07 * 0.93 / np.array([studies, studies, drawn]))).all()


@pytest.mark.campaign
@pytest.mark.parametrize("rate", [0.0, 0.02, 0.04])
def test_truths_near_a_bound_are_in_the_intervals_at_least_as_often_as_they_say(rate):
    """A decay that is hardly one, with a rate that cannot be negative: on its bound or off it."""
    t, trials = np.arange(1.0, 7.0), 1000
    model = Formula("a*exp(-b*t)", {"a": 5.0, "b": 0.1}, {"t": tuple(t)})
    problem = Scenario(model, Gaussian(0.5)).problem
    z = 5 * np.exp(-rate * t) + 0.5 * np.random.default_rng(9).standard_normal((trials, 6))
    free = GaussNewton(tolerance=1e-9).estimate(problem, z)
    assert (free.status == 0).all()
    assert free.covariance is not None
    off, inside = free.x[:, 1] > 0, []
    for row, x, P in zip(z, free.x, free.covariance, strict=True):
        if x[1] > 0:
            low, high = profiles(problem, row, x, P, places=(1,))
        else:
            x = np.array([row.mean() / 5.0, 0.0])
            J = problem.R.whiten_jacobian(model.jacobian(x[None]))[0]
            low, high = profiles(problem, row, x, np.linalg.inv(J.T @ J), places=(1,), signs=(1,))
        inside.append(low[0] <= rate <= high[0])
    assert 50 < (~off).sum() < 600
    assert np.mean(inside) >= 0.95 - 2 * np.sqrt(0.95 * 0.05 / trials)


def test_a_prior_keeps_an_estimate_off_a_bound_that_readings_would_push_it_to():
    """The density of the prior is 0 on the bound: the largest posterior density lies inside,
    however near."""
    slope = ParameterInfo("b", nominal=0.5, upper=1.0)
    problem = Scenario(ConstrainedModel(LINE, (slope,)), Gaussian(0.01)).problem
    (one,) = fit(problem, 1.0 + 3.0 * T, {"map": MapLM(max_iterations=200)})
    assert 0.99 < one.x[1] < 1.0
    assert not one.held_at
    assert (one.standard_errors > 0).all()
