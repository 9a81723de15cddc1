"""Levels of the noise that are estimated with the parameters: the likelihood, its intervals, and
what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize as nelder_mead
from scipy.optimize import root
from scipy.special import digamma
from scipy.stats import norm
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt, LinearLSE, MapLM
from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Formula, Nist
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.examined import examine
from ipe_bench.real.fits import fit
from ipe_bench.real.levels import Levelled, maximise_likelihood
from ipe_bench.real.profiles import CONFIDENCE, half_width

LM = {"lm": LevenbergMarquardt(tolerance=1e-10, max_iterations=500)}
TIMES = np.tile(np.linspace(0.2, 8.0, 30), 2)
SECOND = np.repeat([0, 1], 30)
DECAY = Formula(
    "(1 - second)*a*exp(-k*t) + second*a*k/(l - k)*(exp(-k*t) - exp(-l*t))",
    {"a": 10.0, "k": 0.9, "l": 0.3},
    {"t": tuple(TIMES), "second": tuple(SECOND)},
)
"""A substance that decays into another, both read; its parameters at the truth are 1 in multiples
of their sizes."""
NOISES = {
    "by output": (Unknown(by="second"), np.array([0.4, 0.1])),
    "a + b h": (Unknown(sigma="floor + share*h"), np.array([0.1, 0.08])),
}


def decay(x):
    """The same in NumPy, for complex x (3,) too."""
    amount, fast, slow = x * np.array([10.0, 0.9, 0.3])
    first, other = np.exp(-fast * TIMES), np.exp(-slow * TIMES)
    return np.where(SECOND == 0, amount * first, amount * fast / (slow - fast) * (first - other))


def sigma(case, h, levels):
    return levels[SECOND] if case == "by output" else levels[0] + levels[1] * h


def readings(case, seed):
    h = decay(np.ones(3))
    return h + sigma(case, h, NOISES[case][1]) * np.random.default_rng(seed).standard_normal(60)


def fitted(case, z):
    return fit(Problem(DECAY, Covariance(np.ones(60))), z, LM, NOISES[case][0])[0]


def gradient(function, u):
    return np.array([function(u + 1e-30j * e).imag for e in np.eye(len(u))]) / 1e-30


@pytest.mark.oracle(
    "library: SciPy's root of the likelihood's slopes", "parameters and logarithms of levels", 1e-8
)
@pytest.mark.parametrize("case", NOISES)
def test_the_maximum_of_the_likelihood_is_that_of_a_direct_search(case):
    z, noise = readings(case, 3), NOISES[case][0]
    levels = noise.levels_of(DECAY)

    def deviance(u):
        h = decay(u[:3])
        s = sigma(case, h, np.exp(u[3:]))
        return np.sum(((z - h) / s) ** 2 + 2 * np.log(s))

    start = np.concatenate([[1.1, 0.9, 1.05], np.log([0.3, 0.3])])
    near = nelder_mead(
        deviance, start, method="Nelder-Mead", options={"maxiter": 5000, "maxfev": 5000}
    )
    direct = root(lambda u: gradient(deviance, u), near.x, tol=1e-13).x
    assert deviance(direct) <= near.fun
    found = start
    for _ in range(
        2
    ):  # the second from the first, since the logarithm of a level is held a little at its start
        model = Levelled(DECAY, levels, found[3:], np.ones(60))
        minima = maximise_likelihood(
            Problem(model, Covariance(np.full(60, 0.2))), z[None], found[None]
        )
        found = minima.x[0]
    assert_agrees(found, direct, atol=1e-8)
    # Its value is -2 times the log likelihood over that of the deviations that R holds.
    assert minima.chi_square[0] == pytest.approx(deviance(direct) - 60 * 2 * np.log(0.2), rel=1e-9)


@pytest.mark.parametrize("case", NOISES)
def test_fits_are_compared_by_minus_twice_their_log_likelihood(case):
    z = readings(case, 3)
    one = fitted(case, z)
    h = decay(one.inner[:3])
    density = norm(h, sigma(case, h, np.exp(one.inner[3:])))
    exact = -2 * density.logpdf(z).sum() - 60 * np.log(2 * np.pi)
    assert one.deviance == pytest.approx(exact, rel=1e-9)


def test_readings_of_zero_are_met_at_a_level_of_round_off():
    model = Formula("a + b*t", {"a": 0.0, "b": 1.0}, {"t": (1.0, 2.0, 3.0, 4.0)})
    (one,) = fit(Problem(model, Covariance(np.ones(4))), np.zeros(4), LM, Unknown())
    assert one.status is Status.CONVERGED
    np.testing.assert_allclose(one.x, 0.0, atol=1e-12)


@pytest.mark.oracle(
    "published: restricted likelihood of Patterson and Thompson (1971)",
    "logarithms of levels",
    1e-8,
)
def test_levels_of_a_linear_model_maximise_the_restricted_likelihood():
    """Of Patterson and Thompson: that of all contrasts of the readings whose mean is zero."""
    t, group = np.linspace(0.0, 1.0, 15), np.repeat([0, 1, 2], 5)
    line = Formula(
        "a + b*t + 0*group", {"a": 1.0, "b": 1.0}, {"t": tuple(t), "group": tuple(group)}
    )
    z = 1 + 2 * t + np.array([0.1, 0.3, 1.0])[group] * np.random.default_rng(4).standard_normal(15)
    X = np.column_stack([np.ones(15), t])
    contrasts = np.linalg.qr(
        np.column_stack([X, np.random.default_rng(0).standard_normal((15, 13))])
    )[0][:, 2:]
    y = contrasts.T @ z

    def deviance(u):
        V = contrasts.T @ (np.exp(2 * u[group])[:, None] * contrasts)
        return y @ np.linalg.solve(V, y) + np.log(np.linalg.det(V))

    near = nelder_mead(deviance, np.log([0.1, 0.3, 1.0]), method="Nelder-Mead").x
    direct = root(lambda u: gradient(deviance, u), near, tol=1e-13).x
    found = fit(Problem(line, Covariance(np.ones(15))), z, LM, Unknown(by="group"))[0]
    weights = np.exp(-2 * direct[group])
    best = np.linalg.solve(X.T @ (weights[:, None] * X), X.T @ (weights * z))
    assert_agrees(np.log(found.x[2:]), direct, atol=1e-8)
    assert found.x[:2] == pytest.approx(best, abs=1e-8)


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets (Misra1a, Thurber, Chwirut2)",
    "residual standard deviation, parameters and their deviations",
    1e-5,
)
@pytest.mark.parametrize("dataset", ["Misra1a", "Thurber", "Chwirut2"])
def test_a_single_level_is_certified(dataset):
    model = Nist(dataset)
    problem = Problem(model, Covariance(np.ones(model.m)))
    single, old = (
        fit(problem, model.recorded.z, LM, noise)[0] for noise in (Unknown(sigma="s"), Unknown())
    )
    n = model.n
    assert_agrees(single.x[n], model.certified.residual_deviation, rtol=1e-6)
    assert_agrees(single.x[:n], model.certified.parameters, rtol=1e-6)
    assert_agrees(single.standard_errors[:n], model.certified.deviations, rtol=1e-5)
    assert np.array(single.interval())[:, :n] == pytest.approx(np.array(old.interval()), rel=1e-5)
    assert single.normalised == pytest.approx(old.normalised, rel=1e-4, abs=1e-6)


ZERO = pytest.param("a + b h", "by output", marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "data"), [*zip(NOISES, NOISES, strict=True), ZERO])
def test_profile_ends_are_where_the_likelihood_has_risen_by_the_quantile(case, data):
    """In the last case errors do not grow with the readings, and the share of these is zero."""
    z = readings(data, 8)
    one = fitted(case, z)
    found = examine(Problem(DECAY, Covariance(np.ones(60))), z, [one], bootstraps=4)
    spare, best = one.estimated.model.spare, one.estimated.x

    def deviance(u):
        h = decay(u[:3])
        s = sigma(case, h, np.exp(u[3:]))
        return np.sum(((z - h) / s) ** 2 + 2 * spare * np.log(s))

    assert found.least
    assert (found.profiles[0][4] == 0.0) == (case != data)
    for place in (2, 3, 4):
        others = [k for k in range(5) if k != place]
        f = one.estimated.freedom[place]
        q = half_width(CONFIDENCE, f) ** 2
        expected = q if np.isinf(f) else f * np.log1p(q / f)
        for end in np.transpose(found.profiles)[place]:
            if end == 0.0:
                continue
            u = best.copy()
            u[place] = end / DECAY.sizes[place] if place < 3 else np.log(end)

            def held(v, u=u, others=others):
                whole = u.copy()
                whole[others] = v
                return deviance(whole)

            options = {"xatol": 1e-8, "fatol": 1e-10, "maxiter": 5000, "maxfev": 5000}
            # A level of zero is far, in its logarithm, from where it is in the profile of another
            # parameter.
            starts = (best[others], np.maximum(best[others], np.log(0.01)))
            tried = [
                nelder_mead(held, start, method="Nelder-Mead", options=options).fun
                for start in starts
            ]
            assert min(tried) - deviance(best) == pytest.approx(
                expected, rel=1e-2 if case != data else 1e-3
            )


@pytest.mark.parametrize(
    ("trials", "least"),
    [
        pytest.param(150, 0.88, marks=pytest.mark.slow),
        pytest.param(500, 0.93, marks=pytest.mark.campaign),
    ],
)
@pytest.mark.parametrize("case", NOISES)
def test_intervals_hold_the_truth_and_levels_have_no_bias(case, trials, least):
    """By 150 trials, of intervals that should hold 95 %, those that hold 80 % pass once in a
    hundred times; by 500, those that hold 90 % do. The mean of a level's logarithm has a deviation
    of 0.007 by 150 trials."""
    true = np.concatenate([[10.0, 0.9, 0.3], NOISES[case][1]])
    held, excess = np.zeros(5), []
    for seed in range(trials):
        z = readings(case, seed)
        one = fitted(case, z)
        low, high = one.interval()
        held += (low <= true) & (true <= high)
        if case == "by output":
            # What the logarithm of a variance is beyond that of the same errors about the truth,
            # whose mean is known.
            about = np.array([np.mean((z - decay(np.ones(3)))[j == SECOND] ** 2) for j in (0, 1)])
            f = np.bincount(SECOND, one.estimated.model.spare)
            mean = [digamma(v / 2) - np.log(v / 2) for v in (f, 30.0)]
            excess.append(np.log(one.x[3:] ** 2 / about) - (mean[0] - mean[1]))
    assert (held[3:] == 0).all()
    assert (held[:3] >= least * trials).all(), held
    if excess:
        assert np.abs(np.mean(excess, axis=0)).max() < 0.02


@pytest.mark.slow
def test_levels_stand_beside_the_parameters_of_every_estimator():
    answer = ib.estimate(
        DECAY, readings("by output", 1), {**LM, "linear": LinearLSE()}, noise=NOISES["by output"][0]
    )
    assert answer.table()["parameter"].tolist() == ["a", "k", "l", "sigma_0", "sigma_1"] * 2
    shown = str(answer)
    assert "linear: treats its estimated noise levels as exact" in shown
    assert "the size of the residuals cannot test the model" in shown
    assert answer["lm"].fits is None


@pytest.mark.slow
def test_only_the_profile_stands_beside_a_level():
    z = readings("by output", 1)
    answer = ib.estimate(DECAY, z, LM, noise=NOISES["by output"][0])
    found = answer.examination
    for low, high in (
        found.wald,
        (found.bootstrap.low, found.bootstrap.high),
        answer["lm"].interval(),
    ):
        assert (low[:3] < high[:3]).all()
        assert np.isnan([low[3:], high[3:]]).all()
    low, high = found.profiles
    assert (low < found.x).all()
    assert (found.x < high).all()
    assert not found.bent[3:].any()


@pytest.mark.slow
def test_estimates_with_a_prior_have_the_levels_of_their_residuals():
    """A wide prior says next to nothing, so that its estimate is that without one."""
    estimators = {**LM, "map": MapLM(tolerance=1e-10, prior_inflation=1e6)}
    answer = ib.estimate(
        DECAY, readings("by output", 1), estimators, noise=Unknown(by="second"), error_scale=1.0
    )
    assert answer["map"].x == pytest.approx(answer["lm"].x, rel=1e-3)
    assert answer.examination.label == "lm"
    assert "map: treats its estimated noise levels as exact" in str(answer)


def test_a_column_of_standard_deviations_weighs_the_levels(tmp_path):
    z, weight = readings("by output", 1), np.where(SECOND == 0, 4.0, 1.0)
    rows = zip(TIMES.tolist(), SECOND.tolist(), z.tolist(), weight.tolist(), strict=True)
    (tmp_path / "my.csv").write_text(
        "\n".join(["t,second,y,sigma", *(",".join(map(str, row)) for row in rows)])
    )
    model = Formula(DECAY.expression, dict(DECAY.start))
    noise = Unknown(by="second", sigma="s")
    weighted, plain = (
        ib.estimate(model, tmp_path / "my.csv", LM, noise=noise)["lm"],
        fitted("by output", z),
    )
    assert weighted.x * [1, 1, 1, 4, 1] == pytest.approx(plain.x, rel=1e-6)


def test_missing_readings_leave_their_groups_smaller():
    z = readings("by output", 2)
    z[[3, 40, 41]] = np.nan
    kept = np.isfinite(z)
    columns = {"t": tuple(TIMES[kept]), "second": tuple(SECOND[kept])}
    fewer = Formula(DECAY.expression, dict(DECAY.start), columns)
    alone = fit(Problem(fewer, Covariance(np.ones(57))), z[kept], LM, Unknown(by="second"))[0]
    assert fitted("by output", z).x == pytest.approx(alone.x, rel=1e-7)


@pytest.mark.slow
def test_a_parameter_on_its_bound_is_held_there_beside_the_levels():
    model = informed(DECAY, (ParameterInfo("k", lower=1.0, nominal=1.2),))
    z = readings("by output", 1)
    answer = ib.estimate(model, z, LM, noise=Unknown(by="second"))
    found = answer.examination
    fixed = informed(DECAY, (ParameterInfo("k", fixed=1.0),))
    alone = ib.estimate(fixed, z, LM, noise=Unknown(by="second"))["lm"]
    assert answer["lm"].held_at == {1: 1.0}
    for one in (answer, ib.estimate(model, z, LM, noise=Gaussian(0.2))):
        assert "lm: on its bound: k = 1; the readings favour a value beyond." in str(one)
    assert answer["lm"].x[[0, 2, 3, 4]] == pytest.approx(alone.x, rel=1e-6)
    assert np.isnan(np.array(answer["lm"].interval())[:, 1]).all()
    ends = np.array(alone.interval())
    assert np.array(answer["lm"].interval())[:, [0, 2]] == pytest.approx(ends[:, :2], rel=1e-4)
    assert [p.name for p in found.model.physical_parameters] == ["a", "l", "sigma_0", "sigma_1"]
    assert found.on_bounds[0].other > 1.0
    assert found.bootstrap.converged == found.bootstrap.drawn


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sigma": "a0 - b0*h"}, r"noise.sigma=a0 - b0\*h: can be negative .* such as a \+ b\*h"),
        ({"sigma": "0.1*h"}, "has no level to estimate"),
        ({"sigma": "a + b*h"}, "a is a parameter of the model; give the level another name"),
        (
            {"sigma": "a0 + b0*y"},
            r"the readings do not distinguish its levels a0, b0, y;"
            r" leave some out \(h is the reading",
        ),
        ({"sigma": "a*1e400"}, "the readings do not distinguish its levels a;"),
        ({"sigma": "floor + "}, r"noise.sigma: 'floor \+ ' is not a formula"),
        (
            {"by": "output"},
            "noise.by=output: there is no such column of the readings .*row, second, t",
        ),
    ],
)
def test_a_noise_that_cannot_be_is_refused_in_one_line(options, words):
    with pytest.raises(ib.UserError, match=words) as raised:
        ib.estimate(DECAY, readings("by output", 1), LM, noise=Unknown(**options))
    assert "\n" not in str(raised.value)


BY = Unknown(by="second")
FLAT = replace(DECAY, expression="second*(a + k*t) + 0*l")


@pytest.mark.parametrize(
    ("model", "noise", "rows", "value", "words"),
    [
        (
            DECAY,
            BY,
            np.s_[32:],
            np.nan,
            "the 2 readings of 1 are too few to determine sigma in addition to 2 parameters",
        ),
        (FLAT, BY, np.s_[:30], 0.0, "the level of 0 cannot be estimated from residuals of zero"),
        (
            DECAY,
            Unknown(sigma="share*h"),
            np.s_[:1],
            0.0,
            r"noise.sigma=share\*h: is 0 at 1 of 60 readings",
        ),
    ],
)
def test_what_would_make_the_likelihood_infinite_is_refused(model, noise, rows, value, words):
    z = readings("by output", 1)
    z[rows] = value
    with pytest.raises(ib.UserError, match=words):
        fit(Problem(model, Covariance(np.ones(60))), z, LM, noise)


def test_a_formula_of_the_standard_deviation_has_exact_slopes():
    levels = Unknown(
        tuple(np.linspace(1, 2, 60).tolist()), "second", "floor + sqrt(share*h)"
    ).levels_of(DECAY)
    h, theta = np.random.default_rng(0).normal(0, 3, (2, 60)), np.log([[0.5, 0.1, 0.4, 2.0]] * 2)
    _, by_h, by_theta = levels.at(h, theta)
    step = 1e-6
    assert by_h == pytest.approx(
        (levels.at(h + step, theta)[0] - levels.at(h - step, theta)[0]) / (2 * step), rel=1e-4
    )
    for k, e in enumerate(np.eye(4)):
        change = levels.at(h, theta + step * e)[0] - levels.at(h, theta - step * e)[0]
        assert by_theta[:, :, k] == pytest.approx(change / (2 * step), abs=1e-7)
