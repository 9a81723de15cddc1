"""What is said of answers that cannot all be right, and of parameters that the readings do not
determine."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import f as f_law
from scipy.stats import norm
from scipy.stats import t as t_law
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.baselines import GaussNewton, LevenbergMarquardt
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators import Estimates, Estimator
from ipe_bench.measurements import Formula
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.estimation import nearer_starts
from ipe_bench.real.examination import Examination
from ipe_bench.report.page.answer import estimate_content, write_page
from ipe_bench.solvers import Auto
from ipe_bench.trials.thresholds import FIT_LEVEL

T = np.linspace(0, 10, 41)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [Gaussian(0.85), Unknown()], ids=["known level", "unknown level"])
def test_of_two_minima_far_apart_the_worse_does_not_fit(noise):
    """A wave in so much noise that a wrong frequency passes the test of the fit by itself."""
    z = np.sin(2.0 * T) + 0.9 * np.random.default_rng(1).standard_normal(41)
    near, far = (Formula("a*sin(w*t)", {"w": w, "a": 0.5}, {"t": T.tolist()}) for w in (2.0, 5.0))
    wrong, right = (
        ib.estimate(m, z, {"lm": LevenbergMarquardt()}, noise=noise)["lm"] for m in (far, near)
    )
    w = [p.name for p in right.model.parameters].index("w")
    assert abs(wrong.x[w] - right.x[w]) > 20 * right.standard_errors[w]
    assert noise.estimated or wrong.p_value > FIT_LEVEL
    assert wrong.white_p > FIT_LEVEL
    assert (wrong.beaten_by, wrong.fits, wrong.passes) == ("search", False, False)
    assert right.passes
    answer = ib.estimate(
        far, z, {"lm": LevenbergMarquardt(), "auto": ib.solvers.Auto()}, noise=noise
    )
    assert answer["auto"].x == pytest.approx(right.x, rel=1e-4)
    assert (answer["auto"].passes, answer["lm"].passes) == (True, False)
    assert answer["lm"].beaten_by == "auto"
    assert "lm: auto found a significantly better fit" in str(answer)
    assert "lm: auto found a significantly better fit" in answer._repr_html_()


def test_parameters_that_the_readings_do_not_tell_apart_are_named():
    """Two lengths on parallel axes count by their sum alone, and an offset of nothing does not
    count at all."""
    model = Formula(
        "(d2+d3)*cos(t)+a*sin(t)+0*k", {"d2": 0.4, "d3": 0.1, "a": 1.0, "k": 2.0}, {"t": T.tolist()}
    )
    z = 0.52 * np.cos(T) + 0.9 * np.sin(T) + 0.01 * np.random.default_rng(1).standard_normal(41)
    answer = ib.estimate(
        model, z, {"lm": LevenbergMarquardt(), "gn": GaussNewton()}, noise=Gaussian(0.01)
    )
    for one in answer:
        assert set(one.undetermined) == {"d2 - d3", "k"}
    for text in (str(answer), answer._repr_html_()):
        assert "The readings do not determine" in text
        assert "k" in text
    sure = Formula("d2*cos(t)+a*sin(t)", {"d2": 0.4, "a": 1.0}, {"t": T.tolist()})
    answer = ib.estimate(sure, z, {"lm": LevenbergMarquardt()}, noise=Gaussian(0.01))
    assert answer["lm"].undetermined == ()
    assert "do not determine" not in str(answer)


@pytest.mark.parametrize(("offset", "spread"), [(1e6, 1.0), (-4e4, 1.0), (0.0, 1.0), (1e6, 1e6)])
def test_a_start_far_from_the_readings_is_named_with_a_nearer_one(offset, spread):
    """Only a shift of all readings alike can be far from them: c, but neither a nor w."""
    z = offset + spread * np.sin(1.3 * T)
    model = Formula("a*sin(w*t)+2*c", {"a": 1.0, "w": 1.0, "c": 1.0}, {"t": T.tolist()})
    found = nearer_starts(model, z)
    if abs(offset) <= spread:
        assert found == {}
        return
    assert list(found) == ["c"]
    assert 2 * found["c"] == pytest.approx(offset, abs=10)
    stating = {"one": Stating((1.0, 1.0, 1.0))}
    lost = ib.estimate(model, z + 0.1 * T**2, stating, noise=Gaussian(0.01))
    assert f"try measurement.start.c={found['c']:.2g}" in str(lost)
    missing = np.where(np.arange(len(z)) < 3, np.nan, z)
    assert nearer_starts(model, missing)["c"] == pytest.approx(found["c"], abs=10)


@dataclass(frozen=True)
class Stating(Estimator):
    """An estimator that has one answer to everything."""

    answer: tuple[float, ...] = ()

    def estimate(self, problem, z, *, history=False):
        x = np.repeat(np.array(self.answer)[None], len(z), axis=0)
        return Estimates(
            x,
            np.full(len(z), Status.CONVERGED, np.int8),
            np.repeat(np.eye(x.shape[1])[None], len(z), 0),
        )


LINE = Formula("a+b*t+c*t**2", {"a": 1.0, "b": 1.0, "c": 1.0}, {"t": T[:12].tolist()})
A = np.column_stack([np.ones(12), T[:12], T[:12] ** 2])


@pytest.mark.parametrize(("share", "beaten"), [(0.97, ""), (1.03, "lm")])
def test_with_an_unknown_level_the_joint_region_of_the_best_is_that_of_snedecors_f(share, beaten):
    z = A @ [1.0, 1.2, 0.8] + 0.3 * np.random.default_rng(2).standard_normal(12)
    best = np.linalg.lstsq(A, z, rcond=None)[0]
    variance = np.sum((z - A @ best) ** 2) / 9
    along = np.array([1.0, -2.0, 0.5])
    reach = np.sqrt(3 * f_law.isf(1e-3, 3, 9) * variance / np.sum((A @ along) ** 2))
    away = Stating(tuple((best + np.sqrt(share) * reach * along).tolist()))
    answer = ib.estimate(
        LINE, z, {"lm": LevenbergMarquardt(tolerance=1e-10), "away": away}, noise=Unknown()
    )
    assert answer["away"].beaten_by == beaten


@dataclass(frozen=True)
class Seeking(Stating):
    """One that says of its answer that it is a minimum."""

    equation = "least_squares"


@pytest.mark.parametrize("noise", [Gaussian(0.3), Unknown()], ids=["known level", "unknown level"])
@pytest.mark.parametrize(("excess", "lower"), [(0.5, "lm"), (1e-5, "")])
def test_a_later_column_that_fits_better_is_named_and_quoted(noise, excess, lower):
    z = A @ [1.0, 1.2, 0.8] + 0.3 * np.random.default_rng(2).standard_normal(12)
    best = np.linalg.lstsq(A, z, rcond=None)[0]
    along = np.array([1.0, -2.0, 0.5])
    away = tuple((best + 0.3 * np.sqrt(excess) / np.linalg.norm(A @ along) * along).tolist())
    estimators = {
        "first": Seeking(away),
        "stated": Stating(away),
        "lm": LevenbergMarquardt(tolerance=1e-10),
    }
    answer = ib.estimate(LINE, z, estimators, noise=noise)
    assert all(one.passes for one in answer)
    assert [one.lower_at for one in answer] == [lower, "", ""]
    said = "first: lm found a lower minimum; use that answer." in " ".join(str(answer).split())
    assert said == bool(lower)
    assert "by lm" in answer.finding() or not lower


CURVED = 0.4 * np.sin(2 * T)
"""What a straight line leaves of readings, so that neighbours resemble each other."""
STRAIGHT = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": T.tolist()})


def answered(deviation, beyond=0.0, factor=1.0, seed=0):
    """Answers to readings of 2 + t, where errors have a deviation of 0.3 times a factor."""
    errors = factor * 0.3 * np.random.default_rng(seed).standard_normal(41)
    noise = deviation and Gaussian(deviation)
    return ib.estimate(STRAIGHT, 2 + T + beyond + errors, {"lm": LevenbergMarquardt()}, noise=noise)


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ({"deviation": 0.3}, "by lm, which passes every test"),
        ({"deviation": None}, "by lm"),
        ({"deviation": 0.3, "factor": 3.0}, "no estimate both converged and fits"),
        (
            {"deviation": 0.45, "beyond": CURVED},
            "by lm, in doubt, because successive residuals resemble each other",
        ),
        (
            {"deviation": None, "beyond": CURVED},
            "by lm, in doubt, because successive residuals resemble each other",
        ),
        (
            {"deviation": 30.0},
            "by lm, which passes every test, though the stated noise is too large",
        ),
    ],
)
def test_the_title_of_an_answer_has_its_numbers_and_how_they_were_tested(truth, said):
    answer = answered(**truth)
    fit = answer["lm"]
    title = answer.finding()
    assert title.endswith(said)
    assert bool(title.startswith("a = ")) == fit.passes
    numbers = re.findall(r"(\w) = (\S+) ± (\S+?),? ", title)
    for (name, value, error), x, deviation in zip(
        numbers, fit.x, fit.standard_errors, strict=False
    ):
        assert name in "ab"
        assert float(value) == pytest.approx(x, abs=0.1 * deviation)
        assert float(error) == pytest.approx(deviation, rel=0.05)
    assert len(numbers) == 2 * fit.passes
    # The sentences below say no more than the title.
    assert ("every test" in answer.sentences()[0]) == ("every test" in title)
    first = answer.sentences()[0]
    assert ("in doubt" in first.lower()) == ("in doubt" in title)
    assert ("the size of residuals is not tested" in first) == (said == "by lm")
    told = " ".join(str(answer).split())
    assert ("standard errors are too small" in told) == ("in doubt" in title)


def test_an_estimate_that_has_not_converged_is_no_answer_though_it_fits():
    z = np.sin(T) + 0.1 * np.random.default_rng(0).standard_normal(41)
    wave = Formula("a*sin(w*t)", {"a": 1.0, "w": 1.0}, {"t": T.tolist()})
    hasty = LevenbergMarquardt(max_iterations=1, tolerance=1e-14)
    answer = ib.estimate(wave, z, {"lm": hasty}, noise=Gaussian(0.1))
    assert (answer["lm"].fits, answer["lm"].passes) == (True, False)
    assert answer.finding() == "no estimate both converged and fits"
    assert "Values in parentheses were rejected" in str(answer)
    assert "do not fit" not in str(answer)


def test_a_title_names_what_readings_leave_open_and_other_answers():
    two = Formula("(a+b)*t", {"a": 1.0, "b": 1.0}, {"t": T.tolist()})
    square = Formula("c**2*t", {"c": 1.0}, {"t": T.tolist()})
    z = 2 * T + 0.3 * np.random.default_rng(0).standard_normal(41)
    lm = {"lm": LevenbergMarquardt()}
    assert ib.estimate(two, z, lm, noise=Gaussian(0.3)).finding() == (
        "the readings do not determine a - b"
    )
    title = ib.estimate(square, z, lm, noise=Gaussian(0.3)).finding()
    assert title.endswith("which passes every test, but other parameters fit equally well")


def test_a_page_of_a_nonlinear_model_opens_with_the_intervals_that_it_recommends(tmp_path):
    """Bates and Watts (1988), data of example 4.4: readings of oxygen demand."""
    t = [1.0, 2.0, 3.0, 4.0, 5.0, 7.0]
    z = np.array([8.3, 10.3, 19.0, 16.0, 15.6, 19.8])
    model = Formula("b1*(1-exp(-b2*t))", {"b1": 20.0, "b2": 0.5}, {"t": t})
    answer = ib.estimate(model, z, {"lm": LevenbergMarquardt()})
    assert answer.by_profile
    ends = re.findall(r"\((\S+) … (\S+)\)", answer.finding())
    np.testing.assert_allclose(
        np.array(ends, dtype=float), np.transpose(answer.examination.profiles), rtol=0.01
    )
    assert "±" not in answer.finding()
    assert "profile intervals" in answer.lead()
    # The page says so once.
    assert not any("profile" in sentence for sentence in answer.sentences())
    write_page(tmp_path, answer, {}, figures=False)
    page = (tmp_path / "estimate.html").read_text(encoding="utf-8")
    assert page.index('id="table-intervals"') < page.index('class="folds"')
    assert page.index('class="folds"') < page.index('id="table-estimates"')
    line = answered(0.3)
    assert not line.by_profile
    assert "±" in line.lead()


@pytest.mark.parametrize(
    "number",
    [pytest.param(150, marks=pytest.mark.slow), pytest.param(500, marks=pytest.mark.campaign)],
)
@pytest.mark.parametrize(
    ("truth", "false"),
    [({}, 0.02), ({"factor": 2.0}, 0.004), ({"beyond": CURVED, "factor": 0.4}, 0.004)],
)
def test_titles_of_answers_are_false_as_seldom_as_their_tests_say(truth, false, number):
    """Two tests at 1 in 1000 of readings by the model, or by none such; one may be false by
    chance."""
    titles = [answered(0.3, **truth, seed=seed).finding() for seed in range(number)]
    passes = sum("passes every test" in title for title in titles)
    assert (passes if truth else number - passes) <= max(1, false * number)


def far_overstated(deviation):
    z = A @ [1.0, 1.2, 0.8] + 0.01 * np.random.default_rng(2).standard_normal(12)
    return ib.estimate(
        LINE, z, {"lm": LevenbergMarquardt()}, noise=deviation and Gaussian(deviation)
    )


def test_noise_that_is_far_overstated_ends_an_estimate_before_its_intervals(monkeypatch):
    for name in ("profiles", "bootstrap"):
        monkeypatch.setattr(Examination, name, property(lambda _, name=name: pytest.fail(name)))
    answer = far_overstated(1.0)
    text = " ".join(str(answer).split())
    assert re.search(r"the residuals are up to \d\d+ times smaller than the stated noise", text)
    assert "no intervals are computed" in text
    assert "choose noise=unknown" in text
    assert answer["lm"].passes
    told = estimate_content(answer)["examination"]
    assert told["remarks"] == []
    assert told.keys() == {"estimator", "estimates", "remarks"}


@pytest.mark.parametrize("deviation", [0.05, None], ids=["five times", "unknown, as advised"])
def test_noise_that_is_less_overstated_or_estimated_has_intervals(deviation):
    answer = far_overstated(deviation)
    assert "95 % intervals of lm" in str(answer)
    assert estimate_content(answer)["examination"].keys() >= {"profile95", "bootstrap95"}


@pytest.mark.oracle("closed form: Student's t of a left-out reading", "normalised residuals", 1e-4)
def test_with_an_unknown_level_a_normalised_residual_is_as_probable_as_its_error_of_prediction():
    """The reading, foretold by a fit to all others, is off by so many of its errors: Student's t
    with m - n - 1."""
    z = A @ [1.0, 1.2, 0.8] + 0.3 * np.random.default_rng(3).standard_normal(12)
    z[5] += 4.0
    found = ib.estimate(LINE, z, {"lm": LevenbergMarquardt(tolerance=1e-12)}, noise=Unknown())["lm"]
    for i in range(12):
        kept = np.arange(12) != i
        x, rest = (np.linalg.lstsq(A[kept], z[kept], rcond=None)[k] for k in (0, 1))
        spread = np.sqrt(rest[0] / 8 * (1 + A[i] @ np.linalg.solve(A[kept].T @ A[kept], A[i])))
        deviate = norm.ppf(t_law.cdf((z[i] - A[i] @ x) / spread, 8))
        assert_agrees(found.normalised[i], deviate, rtol=1e-4)
    assert np.flatnonzero(found.outliers).tolist() == [5]


@pytest.mark.parametrize(("excess", "as_good"), [(5.0, True), (9.0, False)])
def test_with_an_unknown_level_another_minimum_is_as_good_within_snedecors_region(excess, as_good):
    """Of y = c^2 t + b, c has two minima, which a small odd term tells apart; n F of the 95 %
    region is 6.9 here."""
    rng, t = np.random.default_rng(4), np.linspace(-1, 1, 23)
    s = rng.standard_normal(23)
    s -= (
        np.column_stack([np.ones(23), t])
        @ np.linalg.lstsq(np.column_stack([np.ones(23), t]), s, rcond=None)[0]
    )
    s /= np.linalg.norm(s)
    noise = rng.standard_normal(23)
    for column in (np.ones(23), t, s):
        noise -= column * (column @ noise) / (column @ column)
    noise *= np.sqrt(21 / (noise @ noise))  # a level of 1
    odd = np.sqrt(excess) / 2
    z = 100 * t + odd * s + noise
    columns = {"t": t.tolist(), "s": s.tolist()}
    model = Formula(f"c**2*t+b+{odd:.12f}*(c/10)*s", {"c": 9.0, "b": 1.0}, columns)
    found = ib.estimate(
        model, z, {"lm": LevenbergMarquardt(tolerance=1e-10)}, noise=Unknown()
    ).examination
    other = next(one for one in found.minima if one.x[0] < 0)
    assert other.chi_square - found.minima[0].chi_square == pytest.approx(excess, rel=0.02)
    assert 2 * f_law.isf(0.05, 2, 21) == pytest.approx(6.93, abs=0.01)
    assert other.as_good == as_good


def test_an_estimate_at_which_the_model_has_no_readings_is_in_brackets():
    model = Formula("sqrt(a - t)", {"a": 20.0}, {"t": T.tolist()})
    z = np.sqrt(10.5 - T) + 0.01 * np.random.default_rng(1).standard_normal(41)
    for noise in (Unknown(), Gaussian(0.01)):
        answer = ib.estimate(
            model, z, {"bad": Stating(answer=(0.1,)), "lm": LevenbergMarquardt()}, noise=noise
        )
        assert not answer["bad"].passes
        assert answer["bad"].fits is False
        assert "bad: the model is not finite at this estimate" in str(answer)
        assert answer["lm"].message == ""
        assert "(2)" in str(answer)


def test_intervals_are_those_of_the_first_column_that_passes():
    z = A @ [1.0, 2.0, 3.0] + 0.1 * np.random.default_rng(1).standard_normal(12)
    columns = {
        "stated": Stating(answer=(9.0, 9.0, 9.0)),
        "gn": GaussNewton(),
        "lm": LevenbergMarquardt(),
    }
    for order in (["stated", "gn", "lm"], ["lm", "stated", "gn"]):
        found = ib.estimate(
            LINE, z, {label: columns[label] for label in order}, noise=Gaussian(0.1)
        ).examination
        assert found.label == next(label for label in order if label != "stated")


EXCHANGED = r"The readings are exactly the same at a = (2\.0|1\.9)\d*, b = 0\.(29|30)\d*\."
MIRRORED = r"The readings are exactly the same at c = (4\.0|3\.9)\d*, w = -1\.(19|20)\d*\."


@pytest.mark.parametrize(
    ("expression", "truth", "said"),
    [
        ("exp(-a*t)+exp(-b*t)", {"a": 0.3, "b": 2.0}, EXCHANGED),
        ("exp(-(t-c)**2/(2*w**2))", {"c": 4.0, "w": 1.2}, MIRRORED),
    ],
)
def test_answers_of_one_curve_are_told_apart_from_ambiguous_ones(expression, truth, said):
    model = Formula(expression, truth, {"t": T.tolist()})
    z = model.simulate(model.nominal[None])[0] + 0.01 * np.random.default_rng(2).standard_normal(41)
    answer = ib.estimate(model, z, {"lm": LevenbergMarquardt()}, noise=Gaussian(0.01))
    assert answer.passes
    assert str(answer).count("exactly the same") == 1
    assert re.search(said, str(answer))
    assert "AMBIGUOUS" not in str(answer)


def test_answers_of_different_curves_are_ambiguous():
    """Readings at whole numbers do not tell a frequency from one that is 2 pi larger but for a
    short interval. One that fits better by no more than chance explains does not refuse the
    other."""
    t = np.arange(12.0)
    t[3] += 0.02
    model = Formula("sin(w*t)", {"w": 1.0}, {"t": t.tolist()})
    z = model.simulate(model.nominal[None])[0] + 0.1 * np.random.default_rng(2).standard_normal(12)
    answer = ib.estimate(
        model, z, {"lm": LevenbergMarquardt()}, noise=Gaussian(0.1), error_scale=6.0
    )
    assert "AMBIGUOUS: the readings fit as well" in str(answer)
    assert "exactly the same" not in str(answer)
    found = answer.examination
    assert found.minima[0].chi_square < found.chi_square - 1.0
    assert answer[0].x == pytest.approx([1.0], abs=0.02)
    assert answer.passes


def test_turns_of_a_phase_are_told_by_their_values():
    """-a sin(b t + c) is a sin(b t + c + pi), and a sin(-b t + pi - c)."""
    model = Formula("a*sin(b*t+c)", {"a": 2.0, "b": 1.0, "c": 0.5}, {"t": T.tolist()})
    z = model.simulate(model.nominal[None])[0] + 0.01 * np.random.default_rng(2).standard_normal(41)
    answer = ib.estimate(model, z, {"lm": LevenbergMarquardt()}, noise=Gaussian(0.01))
    (said,) = (one for one in answer.sentences() if "exactly the same" in one)
    numbers = re.findall(r"(?:a|b|c) = (-?[\d.]+\d)", said)
    told = np.reshape(numbers, (-1, 3)).astype(float)
    assert 1 <= len(told) <= 3
    fitted = z - answer["lm"].residuals
    assert model.simulate(told / model.sizes) == pytest.approx(
        np.tile(fitted, (len(told), 1)), abs=1e-2
    )


@pytest.mark.slow
def test_the_first_line_is_of_the_answer_and_not_of_a_misfit():
    """Where Levenberg and Marquardt's steps end, the readings tell nothing of a; at the answer they
    tell all (the data of a question on curve_fit, drawn anew)."""
    x = np.linspace(60, 3060, 200)
    model = Formula("(a-c)*exp(-x/b)+c", {"a": 1.0, "b": 1.0, "c": 1.0}, {"x": tuple(x.tolist())})
    noise = 0.2 * np.random.default_rng(3).standard_normal(200)
    z = 80 * np.exp(-x / 400) + 20 + noise
    answer = ib.estimate(model, z, {"auto": Auto(), "lm": LevenbergMarquardt()})
    assert answer["lm"].undetermined
    assert answer["auto"].x == pytest.approx([100.0, 400.0, 20.0], rel=0.01)
    assert answer.finding().startswith("a = 100.")
    first, *_ = str(answer).splitlines()
    assert "do not determine" not in first
    assert "(lm: where it ended, the readings do not determine a.)" in str(answer)
