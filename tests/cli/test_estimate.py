"""`estimate` as people with readings of their own type it: the command, its exit code, and the
numbers it leaves."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import curve_fit

import ipe_bench as ib
from ipe_bench.cli import shorts
from ipe_bench.cli.single import single
from ipe_bench.measurements import Nist
from ipe_bench.real.estimation import Question
from ipe_bench.real.readings import write_readings

MISRA = Nist("Misra1a")
SATURATION = (
    "measurement=formula",
    "measurement.expression=b1*(1-exp(-b2*t))",
    "measurement.start.b1=250",
    "measurement.start.b2=5e-4",
)
LM = ("solver=[]", "baseline=[levenberg_marquardt]")


@pytest.fixture
def estimate(ipe_bench):
    """Runs `estimate` in an empty folder; the exit code, what it printed, and its JSON file where
    it left one.

    Figures are drawn where the command says so.
    """

    def run(*words: str) -> tuple[int, str, dict]:
        code, out, error = ipe_bench(
            "estimate", *([] if "figures=all" in words else ["figures=none"]), *words
        )
        files = sorted(
            Path().glob("outputs/*/estimate.json"), key=lambda path: path.stat().st_mtime_ns
        )
        return code, out + error, json.loads(files[-1].read_text()) if files and code != 2 else {}

    return run


@pytest.fixture
def misra(tmp_path) -> tuple[np.ndarray, np.ndarray]:
    """NIST's Misra1a as a file t, y, and with a column sigma, and its columns."""
    (t,), y = MISRA.predictors, MISRA.readings
    rows = [f"{a!r},{b!r}" for a, b in zip(t.tolist(), y.tolist(), strict=True)]
    (tmp_path / "my.csv").write_text("\n".join(["t,y", *rows]))
    sigma = [f"{row},{0.05 + 0.01 * k}" for k, row in enumerate(rows)]
    (tmp_path / "weighted.csv").write_text("\n".join(["t,y,sigma", *sigma]))
    return t, y


def of(answer: dict, key: str, label: str = "levenberg_marquardt") -> dict:
    return answer["estimators"][label][key]


def curve(t, b1, b2):
    return -b1 * np.expm1(-b2 * t)


def test_a_formula_and_a_file_are_enough_where_nobody_knows_the_noise(estimate, misra):
    """Certified values and standard deviations, without a word about noise, and three estimators
    unless others are chosen."""
    code, printed, answer = estimate(*SATURATION, "readings=my.csv", "figures=all")
    assert code == 0, printed
    assert list(Path("outputs").rglob("*.png"))
    assert list(answer["estimators"]) == ["auto", "linear_lse", "levenberg_marquardt"]
    assert "The noise level is estimated from the residuals" in printed
    # Chi-square is the degrees of freedom where the level is estimated: the level is told instead.
    (heading,) = [line.split() for line in printed.splitlines() if line.startswith(" estimator  ")]
    assert heading == ["estimator", "status", "fits", "dof", "white", "p", "outliers", "deviation"]
    certified = MISRA.certified
    assert list(of(answer, "estimates").values()) == pytest.approx(certified.parameters, rel=1e-6)
    assert list(of(answer, "standard_errors").values()) == pytest.approx(
        certified.deviations, rel=1e-5
    )
    assert of(answer, "p") is None
    assert of(answer, "fits") is None


@pytest.mark.parametrize(
    ("words", "absolute"),
    [((), True), (("noise=unknown",), False)],
    ids=["weights", "relative weights"],
)
def test_a_column_of_deviations_weighs_the_readings(estimate, misra, words, absolute):
    t, y = misra
    sigma = 0.05 + 0.01 * np.arange(len(t))
    code, printed, answer = estimate(*SATURATION, *LM, "readings=weighted.csv", *words)
    assert code == 0, printed
    assert not list(Path("outputs").rglob("*.png"))
    x, P = curve_fit(curve, t, y, (250, 5e-4), sigma, absolute, ftol=1e-14, xtol=1e-14, gtol=1e-14)
    assert list(of(answer, "estimates").values()) == pytest.approx(x, rel=1e-6)
    assert list(of(answer, "standard_errors").values()) == pytest.approx(
        np.sqrt(np.diag(P)), rel=1e-5
    )


def test_a_fixed_parameter_is_named_and_costs_no_degree_of_freedom(estimate, misra):
    code, printed, answer = estimate(*SATURATION, *LM, "readings=my.csv", "parameters.b1.fixed=240")
    assert code == 0, printed
    assert answer["fixed"] == {"b1": 240.0}
    assert of(answer, "degrees_of_freedom") == 13
    t, y = misra
    x, P = curve_fit(
        lambda t, b2: curve(t, 240.0, b2), t, y, (5e-4,), ftol=1e-14, xtol=1e-14, gtol=1e-14
    )
    assert of(answer, "estimates")["b2"] == pytest.approx(x[0], rel=1e-7)
    assert of(answer, "standard_errors")["b2"] == pytest.approx(np.sqrt(P[0, 0]), rel=1e-5)


def test_exit_code_1_where_no_estimator_has_an_answer_that_passes(estimate, misra):
    """A straight line through a curve, with deviations that are known: converged, and no answer."""
    line = (
        "measurement=formula",
        "measurement.expression=a+b*t",
        "measurement.start.a=1",
        "measurement.start.b=1",
    )
    code, printed, answer = estimate(*line, *LM, "readings=my.csv", "noise.deviation=0.1")
    assert code == 1
    assert of(answer, "status") == "converged"
    assert not answer["passes"]
    assert "levenberg_marquardt: MISFIT" in printed
    assert "±" not in printed.split("Does the model fit?")[0].split("standard error", 1)[1]


def test_what_is_known_of_all_parameters_stands_in_small_files(estimate, misra, tmp_path):
    """Starts, and a prior of both together, against SciPy with both as readings of a covariance."""
    (tmp_path / "known.yaml").write_text(
        "b1: {nominal: 240, deviation: 1}\nb2: {nominal: 5.5e-4, deviation: 1e-5}\n"
    )
    words = ("solver=[]", "baseline=[map_lm]", "readings=weighted.csv", "parameters=known.yaml")
    code, printed, answer = estimate(*SATURATION, *words, "prior.correlations=[[1,-0.9],[-0.9,1]]")
    assert code == 0, printed
    t, y = misra
    sigma = 0.05 + 0.01 * np.arange(len(t))
    V = np.zeros((16, 16))
    V[:14, :14], V[14:, 14:] = np.diag(sigma**2), [[1.0, -9e-6 * 1e4], [-9e-6 * 1e4, 1e-10 * 1e8]]
    x, P = curve_fit(
        lambda _, b1, b2: np.append(curve(t, b1, 1e-4 * b2), [b1, b2]), np.append(t, [0.0, 0.0]),
        np.append(y, [240.0, 5.5]), (240.0, 5.5), V, True, ftol=1e-14, xtol=1e-14, gtol=1e-14,
    )  # fmt: skip
    assert list(of(answer, "estimates", "map_lm").values()) == pytest.approx(
        x * [1, 1e-4], rel=1e-6
    )
    errors = np.sqrt(np.diag(P)) * [1, 1e-4]
    assert list(of(answer, "standard_errors", "map_lm").values()) == pytest.approx(errors, rel=1e-4)


def test_columns_are_left_out_on_purpose(estimate, misra, tmp_path):
    rows = (tmp_path / "my.csv").read_text().splitlines()
    remarks = ["remark", *(f"n{k}" for k in range(14))]
    (tmp_path / "odd.csv").write_text(
        "\n".join(f"{row},{r}" for row, r in zip(rows, remarks, strict=True))
    )
    code, printed, _ = estimate(*SATURATION, *LM, "readings=odd.csv")
    assert code == 2
    assert "ignore_columns=[remark]" in printed
    code, printed, answer = estimate(*SATURATION, *LM, "readings=odd.csv", "ignore_columns=remark")
    assert code == 0, printed
    # Short forms leave out columns, too, which is nobody's purpose.
    assert "Left out: columns remark." in printed
    assert answer["left_out"] == "remark"
    _, _, whole = estimate(*SATURATION, *LM, "readings=my.csv")
    assert of(answer, "estimates") == of(whole, "estimates")
    # Another command, so another folder.
    assert (tmp_path / "outputs/estimate-formula-2/estimate.json").is_file()


def test_a_unit_as_it_stands_and_a_row_without_a_reading_that_is_predicted(estimate, tmp_path):
    (tmp_path / "a.csv").write_text("t [s],y [m/s^2]\n0,0.8\n1,2.3\n2,2.9\n3,4.2\n20,\n")
    line = (
        "measurement=formula",
        "measurement.expression=a+b*t",
        "measurement.start.a=1",
        "measurement.start.b=1",
    )
    code, printed, answer = estimate(
        *line, *LM, "readings=a.csv", "measurement.unit=m/s^2", "noise.deviation=0.5"
    )
    assert code == 0, printed
    assert answer["reading_unit"] == "m/s^2"
    rows = (tmp_path / "outputs/estimate-formula/residuals.csv").read_text().splitlines()
    last = dict(zip(rows[0].split(","), rows[-1].split(","), strict=True))
    assert last["reading [m/s^2]"] == last["residual [m/s^2]"] == ""
    assert float(last["fitted [m/s^2]"]) == pytest.approx(22.53, abs=1e-6)
    # 0.5 sqrt(1/4 + 18.5^2 / 5), and with the 0.5 of a reading
    assert float(last["fitted_error [m/s^2]"]) == pytest.approx(4.144272, rel=1e-5)
    assert float(last["prediction_error [m/s^2]"]) == pytest.approx(4.174326, rel=1e-5)


# fmt: off
MISTAKES = {
    "noise twice": (("readings=weighted.csv", "noise.deviation=0.3"),
                    "noise: is given, and the readings have a column"),
    "unknown parameter": (("readings=my.csv", "parameters.b3.fixed=1"), "parameters.b3: "),
    "all fixed": (("readings=my.csv", "parameters.b1.fixed=1", "parameters.b2.fixed=1"),
                  "parameters: all are fixed"),
    "no start": (("readings=my.csv", "~measurement.start.b2"), "start"),
    "one file twice": (("readings=[my.csv,my.csv]",), "lists a file twice"),
    "a number for a column": (("readings=my.csv", "ignore_columns=[3]"), "ignore_columns"),
    "no such file": (("readings=my.csv", "parameters=no.yaml"),
                     "parameters=no.yaml: cannot be read"),
    "a key twice": (("readings=my.csv", "parameters=twice.yaml"),
                    "is not YAML that can be read (the key b1 is there twice)"),
    "an alias": (("readings=my.csv", "parameters=alias.yaml"),
                 "an alias (*NAME); write out what is meant"),
    "deviations too few": (("readings=my.csv", "noise.deviation=[1,2]"),
                           "has 2 numbers; give one for each of 14"),
}
# fmt: on


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_one_line_with_the_key(estimate, misra, case, tmp_path):
    words, expected = MISTAKES[case]
    (tmp_path / "twice.yaml").write_text("b1: {fixed: 1}\nb1: {fixed: 2}\n")
    (tmp_path / "alias.yaml").write_text("b1: &one {nominal: 1}\nb2: *one\n")
    code, printed, _ = estimate(*SATURATION, *LM, *words)
    assert code == 2
    assert expected in printed
    assert len(printed.strip().splitlines()) == 1


@pytest.fixture
def ranges(tmp_path):
    """A file of ranges whose truth was drawn at error scale 3, and its readings."""
    scenario = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=3.0)
    z = scenario.draw(0, 1).z[0]
    write_readings(tmp_path / "ranges.csv", scenario.measurement, z)
    return z


@pytest.mark.parametrize("label", ["ekf", "map_lm"])
def test_a_prior_that_nobody_states_is_refused_by_command_and_python_alike(
    estimate, ranges, tmp_path, label
):
    estimator = {"ekf": ib.baselines.EKF(), "map_lm": ib.baselines.MapLM()}[label]
    words = (
        "measurement=ranging",
        "readings=ranges.csv",
        "solver=[]",
        f"baseline=[{label}]",
        "noise.deviation=0.1",
    )
    code, printed, _ = estimate(*words)
    assert code == 2
    with pytest.raises(ib.UserError) as refused:
        ib.estimate(
            ib.measurements.Ranging(),
            "ranges.csv",
            {label: estimator},
            noise=ib.noise.Gaussian(0.1),
        )
    assert printed.strip() == f"ipe-bench: {refused.value}"
    assert "give error_scale=X" in printed
    assert "leave it out" not in printed
    code, printed, answer = estimate(*words, "error_scale=3")
    assert code in (0, 1), printed
    options = {"noise": ib.noise.Gaussian(0.1), "error_scale": 3.0}
    (fit,) = ib.estimate(ib.measurements.Ranging(), "ranges.csv", {label: estimator}, **options)
    assert list(of(answer, "estimates", label).values()) == fit.x.tolist()


def test_the_digest_is_of_the_bytes_that_were_estimated(estimate, misra, tmp_path, monkeypatch):
    """A file that changes while the estimators are at work is not what they saw."""
    before = hashlib.sha256((tmp_path / "my.csv").read_bytes()).hexdigest()
    fitted = Question.fitted

    def changed(self, *watching, **asked):
        (tmp_path / "my.csv").write_text("t,y\n1,2\n")
        return fitted(self, *watching, **asked)

    monkeypatch.setattr(Question, "fitted", changed)
    code, printed, answer = estimate(*SATURATION, *LM, "readings=my.csv")
    assert code == 0, printed
    assert answer["readings"] == [{"file": "my.csv", "sha256": before}]


@pytest.mark.slow
def test_noise_that_is_overstated_is_said_and_rounded_intervals_hold_the_estimate(estimate):
    """A standard deviation of 3 where errors are .03, and .4: 100 times too large, and 7 times."""
    t = np.linspace(0, 6, 25)
    decay = ("measurement=formula", "measurement.expression=a*exp(-b*t)+c", "measurement.start.a=1")
    start = ("measurement.start.b=0.5", "measurement.start.c=0.1")

    def printed(error):
        z = 2 * np.exp(-0.7 * t) + 0.3 + error * np.random.default_rng(0).standard_normal(25)
        rows = [f"{a},{b},3" for a, b in zip(t.tolist(), z.tolist(), strict=True)]
        Path("sig.csv").write_text("\n".join(["t,reading,sigma", *rows]), encoding="utf-8")
        code, out, _ = estimate(*decay, *start, "readings=sig.csv", f"name=of-{error}")
        assert code == 0, out
        return " ".join(out.split())

    far = printed(0.03)
    assert "the residuals are up to 1.1e+02 times smaller than the stated noise" in far
    assert "The stated noise is far too large, so no intervals are computed" in far
    assert "95 % intervals" not in far
    less = printed(0.4)
    # A straight line, with b near zero and a as large as one likes to both sides, is within the
    # stated noise.
    assert "a -2.34 … 6.70 −∞ … ∞" in less
    # The least minima of b cannot all be followed below, which a dash says.
    assert re.search("b -3.12 … 4.78 (−∞|-) … ∞", less)
    assert (
        "c -1.92 … 2.53 −∞ … ∞ -10.52 … 1.61" in less
    )  # to tens, as the width is, the upper end would be 0


@pytest.mark.parametrize(
    ("words", "title", "folder"),
    [
        (["oxygen.py", "oxygen.csv"], "demand", "estimate-demand"),
        (["b1*(1-exp(-b2*t))", "oxygen.csv"], "b1*(1-exp(-b2*t))", "estimate-formula"),
        (["car.yaml", "log.csv"], "car", "estimate-car"),
        (["decay.yaml", "pair.csv"], "decay", "estimate-decay"),
    ],
)
def test_an_answer_has_the_name_that_its_user_gave_to_the_model(
    words, title, folder, tmp_path, monkeypatch
):
    function = "import numpy as np\ndef demand(t, b1=20.0, b2=0.5):\n"
    (tmp_path / "oxygen.py").write_text(f"{function}    return b1 * (1 - np.exp(-b2 * t))\n")
    readings = zip((1, 2, 3, 4, 5, 7), (8.3, 10.3, 19.0, 16.0, 15.6, 19.8), strict=True)
    rows = [f"{day},{reading}" for day, reading in readings]
    (tmp_path / "oxygen.csv").write_text("\n".join(["t,reading", *rows]))
    yaml = "next: {x: x + w}\nreadings: {gps: x}\nnoise: {w: 0.1}\ndeviation: {gps: 1}\n"
    (tmp_path / "car.yaml").write_text(f"{yaml}spread: {{x: 1}}\n")
    (tmp_path / "decay.yaml").write_text("rates: {x: -k*x}\nstart: {k: 1}\ninitial: {x: 1}\n")
    (tmp_path / "pair.csv").write_text("time,reading\n1,0.4\n2,0.2\n")
    (tmp_path / "log.csv").write_text("gps\n" + "\n".join(map(str, [0.3, -0.2, 1.1, 0.4])) + "\n")
    monkeypatch.chdir(tmp_path)
    asked = single("estimate", shorts.read("estimate", words).in_full)
    assert asked.title == title
    with asked.folder("estimate", {}) as place:
        assert place.as_posix() == f"outputs/{folder}"
