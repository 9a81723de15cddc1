"""Several files of a model whose parameters are fixed, bounded or one file's own, against SciPy;
and what is left out of a file on purpose, against a file without it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from shared.instruments import EXACT, SATURATION, START, estimate, simulated, solution
from shared.oracles import assert_agrees
from shared.small_models import Bent

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Formula, Sir
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.noise import Gaussian, ModelNoise
from ipe_bench.real.readings import Readings, open_together

OWN = Formula(SATURATION, START, own=("b1",))
LM = {"lm": LevenbergMarquardt(tolerance=1e-10, max_iterations=300)}


@pytest.fixture
def files(tmp_path) -> tuple[list[Path], list[np.ndarray]]:
    """Two files of one rate and two amplitudes, 240 and 180, and their columns t, y, sigma."""
    found = [
        simulated(tmp_path / f"{b1}.csv", float(b1), k, 12 + k) for k, b1 in enumerate((240, 180))
    ]
    return [path for path, _ in found], [columns for _, columns in found]


def together(paths: list[Path], *known: ParameterInfo) -> Readings:
    """The files with what is known of the parameters that they have together."""
    return open_together(paths, OWN, known)


def residuals(data, p, q, rate):
    parts = [
        (b1 * (1 - np.exp(-rate * t)) - y) / sigma
        for b1, (t, y, sigma) in zip((p, q), [c.T for c in data], strict=True)
    ]
    return np.concatenate(parts)


def of(result, values) -> dict[str, float]:
    return dict(zip([p.name for p in result.model.physical_parameters], values, strict=True))


def test_a_parameter_of_one_file_may_be_known_there(files):
    paths, data = files
    result = estimate(
        together(paths, ParameterInfo("b1", lower=0.0), ParameterInfo("b1_2", fixed=181.0))
    )
    x, deviations = solution(lambda p: residuals(data, p[0], 181.0, p[1]), [250, 5e-4])
    assert of(result, result.x) == pytest.approx({"b1_1": x[0], "b2": x[1]}, rel=1e-8)
    assert of(result, result.standard_errors) == pytest.approx(
        {"b1_1": deviations[0], "b2": deviations[1]}, rel=1e-8
    )
    assert result.model.fixed == {"b1_2": 181.0}
    assert result.degrees_of_freedom == sum(map(len, data)) - 2


def test_the_epochs_of_files_are_those_of_one_after_those_of_another():
    one, other = Bent(count=6), Bent(count=9)
    rows = [part.tolist() for part in Joint((one, other)).epochs or ()]
    assert rows == [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11], [12, 13, 14]]


@pytest.mark.oracle(
    "library: SciPy's least_squares within bounds", "standard errors of two files together", 1e-6
)
def test_a_bound_acts_in_the_file_that_it_is_of(files):
    """On the bound in one file and free in the other, where SciPy's bounded minimum is."""
    paths, data = files
    known = (
        ParameterInfo("b1", lower=100.0, upper=300.0),
        ParameterInfo("b1_2", nominal=160.0, upper=176.0),
    )
    result = estimate(together(paths, *known))
    bounded = least_squares(
        lambda p: residuals(data, 100 * p[0], 100 * p[1], 1e-4 * p[2]),
        [2.0, 1.6, 5.0],
        bounds=([1, 1, 0], [3, 1.76, np.inf]),
        **EXACT,
    )
    expected = dict(zip(("b1_1", "b1_2", "b2"), bounded.x * [100, 100, 1e-4], strict=True))
    assert of(result, result.x) == pytest.approx(expected, rel=1e-5)
    assert [result.model.physical_parameters[k].name for k in result.held_at] == ["b1_2"]
    _x, deviations = solution(lambda p: residuals(data, p[0], 176.0, p[1]), [250, 5e-4])
    errors = of(result, result.standard_errors)
    assert np.isnan(errors["b1_2"])
    assert_agrees((errors["b1_1"], errors["b2"]), deviations, rtol=1e-6)


def test_the_noise_of_a_model_is_that_of_its_files_in_whatever_order_they_are(tmp_path):
    """Rows of an epidemic that are no grid, alone and with another file: the level is known, and
    not estimated."""
    rows = ["11,65", "3,26", "4.5,140", "6,293", "7.25,285", "9,190"]
    for name, own in (("a", rows), ("b", rows[::-1])):
        (tmp_path / f"{name}.csv").write_text("\n".join(["time [day],reading [people]", *own]))
    for paths in ([tmp_path / "a.csv"], [tmp_path / "a.csv", tmp_path / "b.csv"]):
        for model in (Sir(), ConstrainedModel(Sir(), (ParameterInfo("ln_gamma", lower=-0.9),))):
            found = open_together(paths, model)
            assert ModelNoise().of(found.model) == Gaussian(20.0)
            (result,) = ib.estimate(model, list(paths), LM, examine=False)
            assert result.level is None


def test_a_file_may_have_fewer_readings_than_the_model_has_parameters(tmp_path):
    first, _columns = simulated(tmp_path / "a.csv", 240.0, 5)
    (tmp_path / "b.csv").write_text("t,y,sigma\n400,36.2,0.5\n")
    result = estimate(open_together([first, tmp_path / "b.csv"], OWN))
    assert {p.name for p in result.model.physical_parameters} == {"b1_1", "b1_2", "b2"}
    alone = estimate(open_together([first], OWN))
    # One reading and one parameter more: the first file's answer is its own.
    assert of(result, result.x)["b1_1"] == pytest.approx(alone.x[0], rel=1e-7)


# What is left out on purpose


def test_columns_are_left_out_with_their_units_or_without(tmp_path):
    line = Formula("a+b*t", {"a": 1.0, "b": 1.0})
    (tmp_path / "a.csv").write_text("t,remark,T [C],y,sigma\n0,x,20,1,1\n1,,21,2,9\n2,y,22,4,1\n")
    found = open_together([tmp_path / "a.csv"], line, without=("remark", "T", "sigma"))
    assert found.z.tolist() == [1.0, 2.0, 4.0]
    assert found.deviations is None
    assert (
        open_together([tmp_path / "a.csv"], line, without=("remark", "T [C]")).deviations
        is not None
    )


@pytest.mark.parametrize(
    ("known", "without", "expected"),
    [
        (
            ParameterInfo("b1_3", fixed=1.0),
            (),
            r"parameters.b1_3: there is no such parameter; did you mean b1_2",
        ),
        (ParameterInfo("b1_2", upper=200.0), (), r"parameters.b1_2: its start, 250, is not inside"),
        (None, ("u",), r"ignore_columns=u: there is no such column \(there are: sigma, t, y\)"),
        (None, ("t",), r"column t is missing"),
        (None, ("y",), r"column y of the readings is missing"),
    ],
)
def test_what_is_not_there_is_neither_known_nor_left_out(files, known, without, expected):
    with pytest.raises(UserError, match=expected):
        open_together(files[0], OWN, () if known is None else (known,), without)


def test_fewer_readings_than_parameters_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("t,y\n1,2\n2,\n3,\n")
    with pytest.raises(UserError, match=r"readings=.*a.csv: 1 reading is too few for 2 parameters"):
        open_together([tmp_path / "a.csv"], OWN)


def test_an_array_has_no_columns():
    with pytest.raises(UserError, match="ignore_columns: are columns of a file"):
        ib.estimate(ib.measurements.Polynomial(), np.zeros(40), LM, ignore_columns=["u"])
