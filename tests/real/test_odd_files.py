"""More than 200 files as instruments, spreadsheets and people write them: each is read as it was
meant, or refused with the row and the column, and none is read as something else."""

import gzip
import io
import itertools
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Formula, Measurement, Ranging, Sir
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import open_together, write_readings

LINE = Formula("a+b*t", {"a": 1.0, "b": 1.0})
T = [0.5, 1.25, 2.0, 3.5, 5.0, 8.0]
Y = [-1.25, 2.5, 1017.0, 0.001, 4e-7, 12345.678]
SIGMA = [0.1, 0.25, 1.0, 2.0, 0.5, 3.0]
COLUMNS = {"t": T, "y": Y, "sigma": SIGMA}


@dataclass(frozen=True)
class Case:
    """A file, and what is to come of it: refusal by these words, or the columns above."""

    name: str
    content: bytes
    refusal: str = ""
    suffix: str = ".csv"
    model: Measurement = LINE
    missing: tuple[int, ...] = ()
    """Rows without a reading."""


def lines(columns=COLUMNS, *, separator=",", cell=repr) -> list[str]:
    rows = zip(*columns.values(), strict=True)
    return [separator.join(columns), *(separator.join(cell(v) for v in row) for row in rows)]


def ways_of_writing() -> Iterator[Case]:
    separators = {"commas": (",", "."), "semicolons": (";", "."), "decimal commas": (";", ",")}
    ends = {"unix": "\n", "windows": "\r\n", "old mac": "\r"}
    for order, (how, (separator, point)), (end, newline), marked in itertools.product(
        itertools.permutations(COLUMNS), separators.items(), ends.items(), (False, True)
    ):
        text = lines(
            {k: COLUMNS[k] for k in order},
            separator=separator,
            cell=lambda v, p=point: repr(v).replace(".", p),
        )
        content = newline.join(text).encode("utf-8-sig" if marked else "utf-8")
        yield Case(f"{'-'.join(order)} {how} {end}{' marked' * marked}", content)


def with_cell(column: str, text: str) -> bytes:
    """The file with that text in the third row of data, the fourth of the file."""
    rows = [line.split(",") for line in lines()]
    rows[3][list(COLUMNS).index(column)] = text
    return "\n".join(",".join(row) for row in rows).encode()


NO_NUMBERS = {
    "word": "high", "not available": "N/A", "na": "NA", "null": "null", "dash": "-",
    "question": "?", "true": "True",
    "underscore": "1_0", "hexadecimal": "0x1F", "no exponent": "1e", "two points": "1.2.3",
    "two signs": "--1",
    "unit": "1 V", "per cent": "5%", "money": "$1", "date": "2024-01-31", "clock": "00:01:00",
    "fraction": "1/2",
    "gap between thousands": "1 017", "minus sign of a typesetter": "−1",
    "full-width digits": "１２",
    "arabic digits": "٣", "quoted comma": '"1,5"', "less than": "<0.1", "formula": "=A1+1",
    "complex": "1j",
    "zero byte": "1\0", "D exponent": "1D3", "infinite": "inf", "not a number": "nan",
    "beyond numbers": "1e999",
}  # fmt: skip


def wrong_cells() -> Iterator[Case]:
    for column, (name, text) in itertools.product(COLUMNS, NO_NUMBERS.items()):
        yield Case(
            f"{name} in {column}",
            with_cell(column, text),
            rf"row 4, column {column}: .*; (correct it|leave|write dates)",
        )


def text(*rows: str) -> bytes:
    return "\n".join(rows).encode()


GOOD = lines()
WHOLE = "\n".join(GOOD)
ROWS = list(zip(T, Y, SIGMA, strict=True))
READ = {
    "signs and exponents": text("t,y,sigma", *(f"+{t},{y:.17e},{s:E}" for t, y, s in ROWS)),
    "blanks about numbers": text("t , y, sigma", *(f" {t} ,\t{y} ,{s} " for t, y, s in ROWS)),
    "everything quoted": text(*('"' + line.replace(",", '","') + '"' for line in GOOD)),
    "blank lines": text("", *itertools.chain.from_iterable((line, " ", ",,") for line in GOOD), ""),
    "points without zeros": re.sub(r"\.0\b", ".", re.sub(r"\b0\.", ".", WHOLE)).encode(),
    "rows numbered": text("row,t,y,sigma", *(f"{i},{line}" for i, line in enumerate(GOOD[1:], 1))),
    "units": text("t [s],y [V],sigma [V]", *GOOD[1:]),
    "no unit of sigma": text("t [s],y [V],sigma", *GOOD[1:]),
    "called reading": text("t,reading,sigma", *GOOD[1:]),
    "tabs": WHOLE.replace(",", "\t").encode(),
}
WITHOUT_THE_THIRD = {
    "a reading missing": with_cell("y", ""),
    "a reading and its deviation missing": text(*GOOD[:3], "2.0,,", *GOOD[4:]),
}
NO_HEADER = "row 2: looks like the header, which must be the first row"
REFUSED = {
    "weight missing": (
        with_cell("sigma", ""),
        r"row 4, column sigma: '' is not a standard deviation",
    ),
    "weight zero": (
        with_cell("sigma", "0"),
        r"row 4, column sigma: '0' is not a standard deviation",
    ),
    "time missing": (with_cell("t", ""), r"row 4, column t: is empty"),
    "rows numbered otherwise": (
        text("row,t,y,sigma", *(f"{i},{line}" for i, line in enumerate(GOOD[1:]))),
        r"row 2, column row: '0' is out of order, which says 1",
    ),
    "empty": (b"", "is empty"),
    "a mark and nothing else": ("\ufeff".encode(), "is empty"),
    "no header": (text(*GOOD[1:]), "the first row has only numbers and is no header; write"),
    "two readings": (text(*GOOD[:2]), "1 reading is too few for 2 parameters"),
    "tabs and decimal commas": (
        WHOLE.replace(",", "\t").replace(".", ",").encode(),
        "row 2, column y: '-1,25' is not a number",
    ),
    "blanks between": (WHOLE.replace(",", "  ").encode(), "column t is missing"),
    "a separator declared": (text("sep=,", *GOOD), NO_HEADER),
    "a remark first": (text("# voltmeter 3", *GOOD), NO_HEADER),
    "a remark within": (
        text(*GOOD[:3], "# pause", *GOOD[3:]),
        "row 4: has 1 cells and the header 3",
    ),
    "two headers": (text(*GOOD[:4], *GOOD), r"row 5, column .: '.' is not a number"),
    "units in a row": (text(GOOD[0], "s,V,V", *GOOD[1:]), r"row 2, column .: '.' is not a number"),
    "a sum below": (text(*GOOD, ",999,"), r"row 8, column t: is empty"),
    "decimal commas between commas": (
        text(GOOD[0], *(line.replace(".", ",") for line in GOOD[1:])),
        "row 2: has 6 cells and the header 3; with decimal commas, separate the cells by"
        " semicolons",
    ),
    "thousands": (
        text(GOOD[0], '1,"1,017.5",1', *GOOD[1:]),
        r"row 2, column y: '1,017.5' is not a number",
    ),
    # Of which nobody knows whether it is 1.234 or 1234.
    "a point between decimal commas": (
        text("t;y;sigma", "0,5;1,2;1", "1.234;2,4;1"),
        r"row 3, column t: '1\.234'",
    ),
    "thousands of Germany": (
        text("t;y;sigma", "1,5;1.017,5;1", "2;3;1", "3;4;1"),
        r"row 2, column y: '1.017,5'",
    ),
    "a cell too few": (
        text(*GOOD[:2], "1.25,2.5", *GOOD[3:]),
        "row 3: has 2 cells and the header 3",
    ),
    "a cell too many": (
        text(*GOOD[:2], GOOD[2] + ",7", *GOOD[3:]),
        "row 3: has 4 cells and the header 3",
    ),
    "a comma behind each row": (
        text(*(line + "," for line in GOOD)),
        "column 4, which has no name, is not",
    ),
    "two columns of one name": (text("t,y,y", *GOOD[1:]), "column y is there twice"),
    "two columns without a name": (
        text("t,y,sigma,,", *(f"{line},," for line in GOOD[1:])),
        "without a name are there",
    ),
    "weight": (text("t,y,weight", *GOOD[1:]), "column weight is not understood; remove it"),
    "a note": (text("t,y,note", *(f"{t},{y},fine" for t, y, _ in ROWS)), "column note is not"),
    "sigm": (text("t,y,sigm", *GOOD[1:]), "column sigm is not understood; did you mean sigma"),
    "Sigma": (text("t,y,Sigma", *GOOD[1:]), "column Sigma is not understood; did you mean sigma"),
    "T": (
        text("T,y,sigma", *GOOD[1:]),
        "column t is missing; there are T, y, sigma; did you mean T",
    ),
    "Y": (
        text("t,Y,sigma", *GOOD[1:]),
        "column y of the readings is missing; there are t, Y, sigma; set measurement.read",
    ),
    "x": (text("x,y,sigma", *GOOD[1:]), "column t is missing.*If t is a parameter"),
    "another unit of sigma": (
        text("t,y [V],sigma [mV]", *GOOD[1:]),
        r"column sigma \[mV\]: the unit must be the unit of y",
    ),
    "a quote left open": (
        text(*GOOD[:4], '3.5,"0.001,2.0', *GOOD[5:]),
        r"row \d: cannot be read as CSV .*; fix the quotes",
    ),
    "a quote within": (
        text(*GOOD[:4], '3.5,"0."001,2.0', *GOOD[5:]),
        r"row 5: cannot be read as CSV .*; fix the quotes",
    ),
    "latin-1": (
        text("t,y [µV],sigma", *GOOD[1:]).decode().encode("latin-1"),
        "row 1: is not a readable CSV",
    ),
    "UTF-16": (WHOLE.encode("utf-16"), "row 1: is not a readable CSV file"),
    "compressed": (gzip.compress(WHOLE.encode(), mtime=0), "is not a readable CSV file"),
    "a page": (b"<html><body>404 not found</body></html>", "column t is missing"),
    "JSON": (b'{"t": [1, 2], "y": [1, 2]}', "is not a readable CSV|column t is missing"),
}


def odd_files() -> Iterator[Case]:
    yield from itertools.starmap(Case, READ.items())
    yield from (Case(name, content, missing=(2,)) for name, content in WITHOUT_THE_THIRD.items())
    yield from (Case(name, *case) for name, case in REFUSED.items())


def parquet(columns) -> bytes:
    import pandas as pd

    stream = io.BytesIO()
    pd.DataFrame(columns).to_parquet(stream)
    return stream.getvalue()


def tables_of_programs() -> Iterator[Case]:
    yield Case("text called Parquet", WHOLE.encode(), "is not a readable Parquet file", ".parquet")
    yield Case("Parquet called text", parquet(COLUMNS), "is not a readable CSV file")
    yield Case("Parquet", parquet(COLUMNS), suffix=".parquet")
    yield Case(
        "Parquet of texts",
        parquet({k: [repr(v) for v in c] for k, c in COLUMNS.items()}),
        suffix=".parquet",
    )
    yield Case(
        "Parquet in another order", parquet(dict(reversed(COLUMNS.items()))), suffix=".parquet"
    )
    holes = {"t": T, "y": [*Y[:2], None, *Y[3:]], "sigma": SIGMA}
    yield Case("Parquet with a hole", parquet(holes), suffix=".parquet", missing=(2,))
    yield Case(
        "Parquet with words",
        parquet({**COLUMNS, "y": list("abcdef")}),
        "row 1, column y: 'a' is not",
        ".parquet",
    )
    yield Case(
        "Parquet with dates",
        parquet({**COLUMNS, "t": np.arange(6).astype("M8[s]")}),
        "row 1, column t: '1970.*' is not",
        ".parquet",
    )
    yield Case(
        "Parquet without rows",
        parquet({k: [] for k in COLUMNS}),
        "has a header and no rows",
        ".parquet",
    )


def written(model: Measurement, change=lambda rows: rows) -> bytes:
    """The file that a model writes of its own readings, changed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.csv"
        write_readings(path, model, model.simulate(model.nominal[None])[0])
        return text(*change(path.read_text().splitlines()))


def replaced(row: int, old: str, new: str):
    def change(rows: list[str]) -> list[str]:
        assert old in rows[row - 1], rows[row - 1]
        return [*rows[: row - 1], rows[row - 1].replace(old, new, 1), *rows[row:]]

    return change


MEANT = (
    ("ranging in reverse", Ranging(), lambda rows: [rows[0], *reversed(rows[1:])]),
    ("sir in reverse", Sir(), lambda rows: [rows[0], *reversed(rows[1:])]),
    ("a beacon as 1.0", Ranging(), replaced(2, "1,1,", "1.0,1e0,")),
    ("a beacon with weights", Ranging(), lambda rows: with_weights(rows)),
)
MISTAKEN = (
    (
        "a beacon twice",
        Ranging(),
        lambda r: [*r, r[1]],
        r"row \d+: round=1, beacon=1 is in row 2 already",
    ),
    ("a beacon too few", Ranging(), lambda rows: rows[:-1], r"rows; the first absent one is"),
    (
        "an unknown beacon",
        Ranging(),
        replaced(2, "1,1,", "1,99,"),
        "row 2: ranging has no reading round=1, beacon=99",
    ),
    ("a day before the start", Sir(), replaced(2, "1,1.0,", "1,-1.0,"), "comes before the start"),
    ("an unknown output", Sir(), replaced(3, "infected", "healed"), "output=healed"),
    ("no first epidemic", Sir(), replaced(3, "1,", "3,"), "case=3: cases are numbered"),
)


def files_of_models() -> Iterator[Case]:
    for model in (Ranging(), Sir()):
        other_unit = (
            replaced(1, "[day]", "[week]") if model.name == "sir" else replaced(1, "[m", "[km")
        )
        yield Case(f"{model.name} as written", written(model), model=model)
        yield Case(
            f"{model.name} in another unit",
            written(model, other_unit),
            r"unit must be|is missing",
            model=model,
        )
        yield Case(
            f"{model.name} with its first reading gone",
            written(model, emptied),
            model=model,
            missing=(0,),
        )
    yield from (Case(name, written(model, change), model=model) for name, model, change in MEANT)
    yield from (
        Case(name, written(model, change), refusal, model=model)
        for name, model, change, refusal in MISTAKEN
    )


def emptied(rows: list[str]) -> list[str]:
    return [rows[0], rows[1].rpartition(",")[0] + ",", *rows[2:]]


def with_weights(rows: list[str]) -> list[str]:
    return [f"{rows[0]},sigma", *(f"{row},{0.5 + i}" for i, row in enumerate(rows[1:]))]


CASES = [
    *ways_of_writing(), *wrong_cells(), *odd_files(), *tables_of_programs(), *files_of_models()
]  # fmt: skip


def test_there_are_more_than_two_hundred_and_no_two_are_alike():
    assert len({case.name for case in CASES}) == len(CASES)
    assert len({(case.content, case.suffix, case.model.name) for case in CASES}) == len(CASES)
    assert len(CASES) > 200
    assert sum(bool(case.refusal) for case in CASES) > 100


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_file_is_read_as_meant_or_refused_with_its_row(case, tmp_path):
    path = tmp_path / f"file{case.suffix}"
    path.write_bytes(case.content)
    if case.refusal:
        with pytest.raises(UserError) as refused:
            open_together([path], case.model)
        told = str(refused.value)
        assert told.startswith(f"readings={path}: ")
        assert "\n" not in told
        assert re.search(case.refusal, told), told
        return
    found = open_together([path], case.model)
    if case.model is LINE:
        z, known = np.array(Y), found.model.columns["t"]
        assert list(known) == T
        expected = np.where(
            np.isin(np.arange(6), case.missing) & np.isnan(found.deviations), np.nan, SIGMA
        )
        np.testing.assert_array_equal(found.deviations, expected)
    else:
        # In whatever order the rows stand, each reading is that of the model which the file
        # describes.
        z = found.model.simulate(case.model.nominal[None])[0]
        assert (found.deviations is None) == (b"sigma" not in case.content)
    z[list(case.missing)] = np.nan
    np.testing.assert_allclose(found.z, z, rtol=1e-15 if case.model is LINE else 1e-12, atol=0)


def test_files_in_different_units_are_not_estimated_together(tmp_path):
    (tmp_path / "a.csv").write_text("t [s],y\n1,2\n2,3\n3,4\n")
    (tmp_path / "b.csv").write_text("t [min],y\n1,2\n2,3\n3,4\n")
    with pytest.raises(
        UserError, match=r"b.csv: column t \[min\]: .*a.csv has it in s; convert the values"
    ):
        open_together([tmp_path / "a.csv", tmp_path / "b.csv"], LINE)


@pytest.mark.slow
def test_two_hundred_thousand_rows_are_read_and_estimated_as_a_small_file_is(tmp_path):
    rng = np.random.default_rng(4)
    t = rng.uniform(0, 10, 200_000)
    sigma = rng.uniform(0.5, 2.0, t.size)
    y = 3.0 - 0.25 * t + sigma * rng.standard_normal(t.size)
    path = tmp_path / "many.csv"
    np.savetxt(path, np.column_stack([t, y, sigma]), "%.17g", ",", header="t,y,sigma", comments="")
    from ipe_bench.baselines import GaussNewton

    found = open_together([path], LINE)
    np.testing.assert_array_equal(found.z, y)
    np.testing.assert_array_equal(found.deviations, sigma)
    problem = Problem(found.model, Gaussian(tuple(found.deviations)).covariance(t.size))
    result = fit(problem, found.z, {"gn": GaussNewton()})[0]
    A = np.column_stack([np.ones_like(t), t]) / sigma[:, None]
    np.testing.assert_allclose(result.x, np.linalg.lstsq(A, y / sigma)[0], rtol=1e-9)
    np.testing.assert_allclose(result.covariance, np.linalg.inv(A.T @ A), rtol=1e-9)
    assert result.fits
    # One cell among them that is not a number is named by its row.
    with path.open("a") as file:
        file.write("1,2.O,1\n")
    with pytest.raises(UserError, match=r"row 200002, column y: '2.O' is not a number"):
        open_together([path], LINE)
