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
