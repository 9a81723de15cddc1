"""A file of readings is read as it was meant, or refused with the row and the column: never
something in between."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from shared.small_models import Bent

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Bearings, Gins, Ranging
from ipe_bench.real.readings import header, open_together, read_tables, write_readings

MODELS = [Ranging(), Bearings(), Gins(), Bent(count=5)]


def written(folder: Path, model, z) -> Path:
    path = folder / "readings.csv"
    path.unlink(missing_ok=True)
    write_readings(path, model, z)
    return path


def european(path: Path) -> Path:
    """The same file as a spreadsheet of Germany or France saves it."""
    text = path.read_text().replace(",", ";").replace(".", ",")
    path.write_text("﻿" + text.replace("\n", "\r\n"), encoding="utf-8", newline="")
    return path


def with_reading(folder: Path, text: str, separator: str = ",") -> Path:
    """A file of `Bent` whose third reading is that text."""
    rows = [f"{i}{separator}{text if i == 3 else '0.25'}" for i in range(1, 6)]
    path = folder / "readings.csv"
    path.write_text("\n".join([f"number{separator}reading [m]", *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)
def test_what_is_written_is_read_bit_for_bit_with_points_and_with_commas(tmp_path, model):
    z = model.simulate(model.nominal[None])[0] * np.pi
    z[1] = np.nan
    path = written(tmp_path, model, z)
    np.testing.assert_array_equal(open_together([path], model).z, z)
    np.testing.assert_array_equal(open_together([european(path)], model).z, z)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=st.floats(allow_nan=False, allow_infinity=False))
def test_every_number_survives_both_ways_of_writing_it(tmp_path, value):
    path = with_reading(tmp_path, repr(value))
    assert open_together([path], Bent(count=5)).z[2] == value
    assert open_together([european(path)], Bent(count=5)).z[2] == value


@pytest.mark.slow
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(text="0\x1f")
@given(
    text=st.text(st.characters(codec="utf-8", exclude_characters='"\n\r'), min_size=1, max_size=8)
)
def test_no_text_is_read_as_a_number_that_it_does_not_say(tmp_path, text):
    """What is accepted consists of the signs that numbers are written with, and is what Python
    reads."""
    path = with_reading(tmp_path, text)
    try:
        value = open_together([path], Bent(count=5)).z[2]
    except UserError as error:
        lines = str(error).splitlines()
    else:
        lines = []
    if lines:
        assert len(lines) == 1
        return
    text = text.strip()
    assert (np.isnan(value) and not text) or (
        set(text) <= set("0123456789.+-eE") and value == float(text)
    )


def test_labels_are_compared_as_what_they_say(tmp_path):
    path = tmp_path / "readings.csv"
    path.write_text("reading [m],number\n" + "\n".join(f"{i}.5,{i}.0" for i in (5, 3, 1, 2, 4)))
    np.testing.assert_array_equal(open_together([path], Bent(count=5)).z, [1.5, 2.5, 3.5, 4.5, 5.5])
    assert header(Bent(count=5)) == ["number", "reading [m]"]


def test_the_samples_of_the_readme_are_found_in_any_folder(tmp_path, monkeypatch):
    named = Path("ipe_bench/real/samples/oxygen.csv")
    there = read_tables([Path(ib.__file__).parents[1] / named])
    monkeypatch.chdir(tmp_path)
    (found,) = read_tables([named])
    assert found.rows == there[0].rows
    named.parent.mkdir(parents=True)
    named.write_text("t,reading\n1,2\n", encoding="utf-8")  # what is there comes first
    assert [row for _, row in read_tables([named])[0].rows] == [["1", "2"]]
    with pytest.raises(UserError, match="there is no such file"):
        read_tables([named.with_name("other.csv")])


GROWTH = {"x": "a*x", "y": "-b*y"}


def read_as(folder: Path, text: str, **options):
    """Readings of two states as a file has them, by their labels."""
    (folder / "pair.csv").write_text(text, encoding="utf-8")
    model = ib.measurements.Ode(
        rates=GROWTH, start={"a": 0.1, "b": 0.2}, initial={"x": 1, "y": 2}, **options
    )
    found = open_together([folder / "pair.csv"], model)
    labels = zip(found.model.index["time"], found.model.index["output"], strict=True)
    return dict(zip(labels, found.z, strict=True)), found.deviations


LONG = "time,output,reading\n1,x,1.1\n1,y,1.6\n2,x,1.2\n2,y,1.3\n3,y,1.1\n"


@pytest.mark.parametrize(
    "wide",
    [
        "time,x,y\n1,1.1,1.6\n2,1.2,1.3\n3,,1.1\n",
        "y,time,x\n1.6,1,1.1\n1.3,2,1.2\n1.1,3,\n",
        "time;x;y\n1;1,1;1,6\n2;1,2;1,3\n3;;1,1\n",
        "time,x [kg],y [m]\n1,1.1,1.6\n2,1.2,1.3\n3,,1.1\n",
    ],
)
def test_a_column_for_each_output_is_a_row_for_each_reading(tmp_path, wide):
    found, _ = read_as(tmp_path, wide)
    assert np.isnan(found.pop((3.0, "x")))
    assert found == read_as(tmp_path, LONG)[0]


def test_one_of_two_states_is_read_by_its_column_and_the_other_by_none(tmp_path):
    found, _ = read_as(tmp_path, "time,y\n1,1.6\n2,1.3\n3,1.1\n")
    assert found == {(1.0, "y"): 1.6, (2.0, "y"): 1.3, (3.0, "y"): 1.1}


def test_each_output_has_the_deviations_of_its_column(tmp_path):
    wide = "time,x,sigma_x,y,sigma_y\n1,1.1,.1,1.6,3\n2,1.2,.2,1.3,4\n"
    assert read_as(tmp_path, wide)[1].tolist() == [0.1, 3, 0.2, 4]
    shared = "time,x,y,sigma\n1,1.1,1.6,3\n2,1.2,1.3,4\n"
    assert read_as(tmp_path, shared)[1].tolist() == [3, 3, 4, 4]


@pytest.mark.parametrize(
    ("wide", "said"),
    [
        ("time,x,y\n1,1.1,1.6\n2,1.2,one\n3,1,1.1\n", "row 3, column y: 'one' is not a number"),
        ("time,x,sigma_x,y\n1,1,1,1\n2,1,1,1\n", "column sigma_y is missing"),
        ("time,x (m),y,sigma_x (cm),sigma_y\n1,1,1,1,1\n2,1,1,1,1\n", "the unit of x .m.; conv"),
        ("time,x,y,sigma,sigma_x,sigma_y\n1,1,1,1,2,2\n", "has columns sigma and sigma_x; remove"),
        ("time,x,y,z\n1,1,1,1\n2,1,1,1\n", "column z is not understood"),
        ("time,output,reading,y\n1,x,1,1\n2,x,1,1\n", "column y is not understood"),
    ],
)
def test_a_fault_of_such_a_table_is_told_by_its_own_columns(tmp_path, wide, said):
    with pytest.raises(UserError, match=said):
        read_as(tmp_path, wide)


@pytest.mark.parametrize(
    ("unit", "headings", "said"),
    [
        ("", "x (m),y (deg)", "column y .deg.: angles without measurement.unit are in rad; set"),
        ("deg", "x (m),y (rad)", "column y .rad.: the unit must be deg"),
    ],
)
def test_angles_beside_other_outputs_have_the_unit_that_is_stated(tmp_path, unit, headings, said):
    angles = {"circular": ("y",), "unit": unit}
    with pytest.raises(UserError, match=said):
        read_as(tmp_path, f"time,{headings}\n1,1,1\n2,1,1\n", **angles)
    found, _ = read_as(tmp_path, "time,x (m),y\n1,2,3\n2,4,5\n", **angles)
    assert list(found.values()) == [2, 3, 4, 5]


def test_columns_that_differ_by_their_unit_alone_are_told_apart(tmp_path):
    line = ib.measurements.Formula("a + b*t", {"a": 1.0, "b": 1.0}, reading="y")
    path = tmp_path / "both.csv"
    path.write_text("t,y (m),y (ft)\n1,1,3\n2,2,7\n")
    with pytest.raises(UserError, match=r"set ignore_columns=\['y \(ft\)'\]"):
        open_together([path], line)
    with pytest.raises(UserError, match=r"columns y .m. and y .ft. have that name"):
        read_tables([path], ["y"])
    assert open_together([path], line, without=["y (m)"]).z.tolist() == [3, 7]


def test_files_of_several_columns_of_readings_have_the_same_units(tmp_path):
    paths = []
    for name, unit in (("one", "m"), ("two", "cm")):
        paths.append(tmp_path / f"{name}.csv")
        paths[-1].write_text(f"time,x ({unit}),y (s)\n1,1,1\n2,1,1\n")
    model = ib.measurements.Ode(GROWTH, {"a": 0.1, "b": 0.2}, initial={"x": 1, "y": 2})
    with pytest.raises(UserError, match=r"column x .cm.: .*one.csv has it in m; convert"):
        open_together(paths, model)
