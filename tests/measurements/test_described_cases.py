"""Differential equations of several cases that a file describes, against their solution in closed
form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit
from shared.oracles import assert_agrees

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Ode
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.measurements.ode.described import packaged
from ipe_bench.noise import Gaussian
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import open_together, write_readings
from ipe_bench.trials.scenario import Scenario
from ipe_bench.workshop.conformance import check_component

FEED, BEGIN = (2.0, 0.0, 5.0), (1.0, 9.0, 4.0)
MODEL = Ode(
    {"y": "feed - k*y"},
    {"k": 0.5, "gain": 1.0},
    {"y": "begin"},
    {"shown": "gain*y"},
    tolerance=1e-11,
)
LM = {"lm": LevenbergMarquardt(tolerance=1e-10, max_iterations=300)}


def solution(case, t, k, gain):
    """y' = feed - k y from y(0) = begin."""
    feed, begin = np.array(FEED)[case], np.array(BEGIN)[case]
    return gain * (feed / k + (begin - feed / k) * np.exp(-k * t))


@pytest.fixture
def file(tmp_path):
    """Three cases, each at times of its own, in no order; and the columns case (from 0), t,
    reading."""
    rng = np.random.default_rng(2)
    case = np.repeat([0, 1, 2], [4, 6, 5])
    t = np.round(rng.uniform(0.1, 6.0, 15), 3)
    z = solution(case, t, 0.37, 1.4) + 0.05 * rng.standard_normal(15)
    order = rng.permutation(15)
    rows = [
        f"{FEED[c]},{float(z[i])!r},{t[i]},{c + 1},{BEGIN[c]},0.05"
        for i in order
        for c in [case[i]]
    ]
    (tmp_path / "a.csv").write_text("\n".join(["feed,reading,time,case,begin [g],sigma", *rows]))
    return tmp_path / "a.csv", case[order], t[order], z[order]


@pytest.mark.oracle("closed form: a linear differential equation", "readings of three cases", 1e-9)
def test_cases_have_inputs_and_initial_states_of_their_own(file):
    path, case, t, z = file
    found = open_together([path], MODEL)
    assert found.z == pytest.approx(z, abs=1e-15)
    x = np.array([[0.9, 1.3], [0.6, 0.8]])
    h = found.model.simulate(x)
    for row, (k, gain) in zip(h, x * [0.5, 1.0], strict=True):
        assert_agrees(row, solution(case, t, k, gain), atol=1e-9)


@pytest.mark.oracle("library: SciPy's curve_fit", "estimates and standard errors", 1e-6)
def test_an_estimate_from_several_cases_is_scipys(file):
    path, case, t, z = file
    result = fit_of(open_together([path], MODEL))
    x, P = curve_fit(
        lambda t, k, gain: solution(case, t, k, gain), t, z, (0.5, 1.0), np.full(15, 0.05), True,
        ftol=1e-15, xtol=1e-15, gtol=1e-15,
    )  # fmt: skip
    assert_agrees(result.x, x, rtol=1e-8)
    assert_agrees(result.standard_errors, np.sqrt(np.diag(P)), rtol=1e-6)
    bounded = fit_of(
        open_together([path], ConstrainedModel(MODEL, (ParameterInfo("k", positive=True),)))
    )
    assert bounded.x == pytest.approx(x, rel=1e-8)


def fit_of(found):
    problem = Scenario(found.model, Gaussian(0.05)).problem
    (result,) = fit(problem, found.z, LM)
    return result


def test_files_of_one_case_each_are_estimated_together(file, tmp_path):
    path, *_ = file
    whole = fit_of(open_together([path], MODEL))
    _heading, *rows = path.read_text().splitlines()
    paths = []
    for case in "123":
        own = [row.split(",") for row in rows if row.split(",")[3] == case]
        paths.append(tmp_path / f"case{case}.csv")
        paths[-1].write_text(
            "\n".join(["feed,reading,time,begin", *(",".join((*r[:3], r[4])) for r in own)])
        )
    together = fit_of(open_together(paths, MODEL))
    assert together.x == pytest.approx(whole.x, rel=1e-7)


def test_a_model_in_the_config_has_its_cases_there(tmp_path):
    model = Ode(
        {"y": "feed - k*y"}, {"k": 0.5, "gain": 1.0}, {"y": "begin"}, {"shown": "gain*y"},
        times=(1.0, 2.0), constants={"feed": FEED, "begin": 1.0},
    )  # fmt: skip
    assert model.index["case"] == [1, 1, 2, 2, 3, 3]
    z = model.simulate(np.array([[1.0, 1.0]]))[0]
    expected = [f / 0.5 + (1 - f / 0.5) * np.exp(-0.5 * t) for f in FEED for t in (1.0, 2.0)]
    assert z == pytest.approx(expected, abs=1e-7)
    assert not [f for f in check_component("ode", model) if f.complaint]
    write_readings(tmp_path / "w.csv", model, z)
    assert (tmp_path / "w.csv").read_text().splitlines()[0] == "case,time,output,feed,begin,reading"
    again = open_together([tmp_path / "w.csv"], MODEL)
    assert again.model.simulate(np.array([[1.0, 1.0]]))[0] == pytest.approx(z, abs=1e-6)


def test_a_constant_of_the_config_stands_for_a_column(tmp_path):
    (tmp_path / "a.csv").write_text("time,reading,begin\n1,2,1\n2,3,1\n3,3,1\n")
    model = Ode(
        {"y": "feed - k*y"},
        {"k": 0.5, "gain": 1.0},
        {"y": "begin"},
        {"s": "gain*y"},
        constants={"feed": 2.0},
    )
    h = open_together([tmp_path / "a.csv"], model).model.simulate(np.array([[1.0, 1.0]]))[0]
    assert h == pytest.approx([4 - 3 * np.exp(-0.5 * t) for t in (1, 2, 3)], abs=1e-6)


# fmt: off
REFUSED = {
    "two numbers of a case": ("case,time,feed,begin,reading\n1,1,2,1,3\n1,2,3,1,3\n",
                              "case=1: feed is 2 in one row and 3"),
    "no column of cases": ("time,feed,begin,reading\n1,2,1,3\n2,3,1,3\n",
                           "number the cases in a column case"),
    "a case left out": ("case,time,feed,begin,reading\n1,1,2,1,3\n3,2,3,1,3\n",
                        "case=3: cases are numbered 1, 2 and so"),
    "a column left out": ("time,begin,reading\n1,2,3\n2,2,3\n",
                          "column feed is missing; there are time, begin, reading"),
    "times of another name": ("t,feed,begin,reading\n1,2,2,3\n2,2,2,3\n",
                              "column time is missing; there are t, feed, begin, reading; call the"
                              " times `time`"),
}
# fmt: on


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_file_is_refused(tmp_path, case):
    text, expected = REFUSED[case]
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(UserError, match=expected):
        open_together([tmp_path / "a.csv"], MODEL)


def test_a_file_that_does_not_say_which_state_was_read_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("time,reading\n1,2\n2,3\n")
    model = Ode({"angle": "speed", "speed": "-k*angle"}, {"k": 0.5})
    said = (
        "column output is missing; 2 states are read; name the one that is:"
        " measurement.outputs.angle=angle"
    )
    with pytest.raises(UserError, match=said):
        open_together([tmp_path / "a.csv"], model)


def test_a_misspelt_parameter_is_told_of_with_both_remedies():
    model = Ode({"y": "-kk*y"}, {"y0": 1.0}, {"y": "y0"}, times=(1.0, 2.0))
    with pytest.raises(
        UserError, match=r"kk is not known; give it a start, measurement.start.kk=1, .*constants.kk"
    ):
        model.simulate(np.ones((1, 1)))


EPIDEMIC = "1,3\n2,8\n3,26\n4,76\n5,225\n6,298\n7,258\n"


def test_one_case_needs_times_and_readings_alone(tmp_path):
    """What a packaged model knows of its case is in no file, and a heading without its unit is no
    other unit."""
    path, model = tmp_path / "flu.csv", packaged("sir")()
    for heading, remedy in {
        "time,reading [people]": "column time: has no unit; call it time .day. if that is the unit",
        "time [day],reading": "column reading: has no unit; call it reading .people. if",
        "time [h],reading [people]": "column time .h.: the unit must be the unit of time .day.;"
        " convert",
        "t,reading [people]": "there are t, reading .people.; call the times `time .day.`",
    }.items():
        path.write_text(f"{heading}\n{EPIDEMIC}")
        with pytest.raises(UserError, match=remedy):
            open_together([path], model)
    path.write_text(f"time [day],reading [people]\n{EPIDEMIC}")
    found = open_together([path], model)
    assert found.model.index["time [day]"] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert found.z.tolist() == [3.0, 8.0, 26.0, 76.0, 225.0, 298.0, 258.0]


def test_the_column_of_the_readings_has_the_name_that_is_stated(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,conc\n1,.9\n2,.8\n3,.73\n")
    decay = Ode({"y": "-k*y"}, {"k": 0.1}, {"y": 1.0})
    with pytest.raises(
        UserError, match=r"column reading of.* is missing.*set measurement.reading=conc"
    ):
        open_together([path], decay)
    assert open_together([path], replace(decay, reading="conc")).z.tolist() == [0.9, 0.8, 0.73]
    with pytest.raises(UserError, match="conc: is a column of every readings file"):
        Ode({"y": "-k*y*conc"}, {"k": 0.1}, {"y": 1.0}, reading="conc")


@pytest.mark.parametrize(
    ("shown", "named"), [("y if t < q else 0", "q"), ("floor(4*y)+q", "k"), ("max(y,0.4)+q", "")]
)
def test_parameters_of_which_outputs_are_constant_in_pieces_are_named(shown, named):
    model = Ode({"y": "-k*y"}, {"k": 0.5, "q": 3.3}, {"y": "1"}, {"z": shown}, (1.0, 2.0, 3.0, 4.0))
    said = [text.partition(", but")[0] for text in model.remarks(model.nominal)]
    assert said == ([f"readings do not change with small changes of {named}"] if named else [])


def test_readings_that_begin_at_a_year_are_refused_and_those_from_a_start_are_not(tmp_path):
    model = Ode({"y": "-k*y"}, {"k": 0.5}, {"y": 3.0})
    path = tmp_path / "years.csv"
    path.write_text("time,reading\n1900,2\n1901,1.5\n1905,1\n")
    with pytest.raises(UserError, match=r"begin at 1900 and last 5, .*; subtract 1900 from the"):
        open_together([path], model)
    path.write_text("time,reading\n0,\n1900,2\n1901,1.5\n1905,1\n")
    assert np.isfinite(open_together([path], model).z).sum() == 3
    path.write_text("time,reading\n90,2\n95,1.5\n100,1\n")
    assert len(open_together([path], model).z) == 3
