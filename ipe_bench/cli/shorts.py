"""Reads the short form of a command: a model and files of readings without keys, in place of
`measurement=`, `state_model=` and `readings=`.

    oxygen.py oxygen.csv           the one function of a file, or oxygen.py:demand
    "a*exp(-b*t)+c" decay.csv      a formula
    car.yaml log.csv               a state model by formulas, or differential equations
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

from ipe_bench.basics.errors import UserError, did_you_mean, place_of, unknown
from ipe_bench.basics.files import fault_of
from ipe_bench.cli import listed, refuse_blanks
from ipe_bench.cli import words as w
from ipe_bench.cli.spec import KEYS
from ipe_bench.measurements.arithmetic import parse
from ipe_bench.plugins import discovery as plugins
from ipe_bench.real.readings import SIGMA, quantity, read_headings, read_tables
from ipe_bench.report.words import enumerate_few

_DATA = (".csv", ".tsv", ".txt", ".dat", ".parquet")
_NUMERIC = re.compile(r"[\W_]*\d")
"""The beginning of a number, perhaps behind a sign: <2, $2."""
_SHEETS = (".xlsx", ".xls", ".ods", ".numbers")
_YAML = (".yaml", ".yml")
_FUNCTION = re.compile(r"(?P<file>.+\.py)(:(?P<name>\w*))?")
_FORMULA = re.compile(r"[-+*/^()<>]|\bif\b")
"""A sign that a word without a key is a formula, rather than a name."""
_PATH = re.compile(r".*\.(?![eE]\d)[A-Za-z]\w*")
"""A path of a file, such as ./my-data.CSV: what no formula ends with."""
_BARE = re.compile(r"[^\w.:/,=-]")
"""What a shell may read as its own."""
_BARE_TITLE = re.compile(r"[A-Za-z][\w-]*")
"""A file's name that is a word of a command as it stands."""
_FLAG = re.compile("--?[a-z][a-z-]*")
_VALUED = re.compile(
    "-(cd|cn|c|p|i)|--(config-dir|config-name|experimental-rerun|cfg|package|info)"
)
"""A flag of `run` whose value is the next word."""
_NAMED = re.compile(r"\s*(?P<reading>[A-Za-z_]\w*)\s*(?:=(?!=)|~)\s*(?P<formula>.+)", re.DOTALL)
_DEFINED = re.compile(
    r"\s*(?P<name>[A-Za-z_]\w*)\s*\([^)]*\)\s*=(?!=)\s*(?P<formula>.+)", re.DOTALL
)
"""A formula with arguments: f(t), an equals sign, and a*t."""
_START = re.compile(r"measurement\.start(?:\.(?P<name>\w+)=|=\{(?P<names>.*)\}$)")
_MODELS = ("measurement", "state_model")
_ALIKE = 4
"""Letters that a wrong key has in common with the one that is meant."""
_NAMED_LIKE = {"deviation": "readings", "spread": "next"}
"""Keys of a state model whose entries are named like those of another key."""


@dataclass
class Short:
    """Holds a command in the long form, besides `readings=`."""

    words: list[str]
    readings: list[str] = field(default_factory=list)
    """Files of readings that stand without a key."""
    assumed: list[str] = field(default_factory=list)
    """Lines that say what the short form was taken for; none in the long form."""

    @property
    def in_full(self) -> list[str]:
        """The words with the files as `readings=`."""
        if not self.readings:
            return self.words
        files = [w.quoted(file) for file in self.readings]
        given = files[0] if len(files) == 1 else f"[{','.join(files)}]"
        return [*self.words, f"readings={given}"]


def read(command: str, words: Sequence[str]) -> Short:
    """Reads a command in its short form; one without a model's or a readings' file comes back as
    it is.

    Raises:
        UserError: a file is absent, or does not say which model, parameters or columns are meant.
    """
    refuse_blanks(words)
    given = _sorted(words)
    files = [*given.files, *given.files_of_keys]
    _refuse_columns(words, files)
    if not given.files and not given.models:
        return Short(list(words))
    models = given.models
    others = given.others
    if not models:
        # y = a*t + b looks like KEY=VALUE: that y is a column tells that it is a formula.
        models = [word for word in others if _is_formula_for(word, files)][:1]
        others = [word for word in others if word not in models]
    _require_pair(command, models, files, others)
    for file in files:
        _require_file(file)
    if not models:
        return Short(others, files)
    return _Reader(command, models[0], files, others).read()


class _Words(NamedTuple):
    """Holds the words of a command, each in one list."""

    models: list[str]
    files: list[str]
    """Files of readings without a key."""
    files_of_keys: list[str]
    """Files of `readings=`."""
    others: list[str]
    """KEY=VALUE, flags and their values, and what is none of all this."""


def _sorted(words: Sequence[str]) -> _Words:
    given = _Words([], [], [], [])
    for before, word in zip(["", *words], words, strict=False):
        kind = "key" if _VALUED.fullmatch(before) else _kind(word)
        if kind == "model":
            given.models.append(word)
        elif kind == "readings":
            given.files.append(word)
        elif _files_of_key(word):
            given.files_of_keys.extend(_files_of_key(word))
        else:
            given.others.append(word)
    return given


def _refuse_columns(words: Sequence[str], files: Sequence[str]) -> None:
    """Refuses columns that are typed where a file has them: they would have no effect."""
    typed = [word for word in words if word.lstrip("+").startswith("measurement.columns")]
    if typed and files:
        key = typed[0].partition("=")[0]
        raise UserError(f"{key}: {files[0]} has the columns; remove the key, or the file")


def _kind(word: str) -> str:
    """Tells a model and a file of readings from KEY=VALUE and other words."""
    bare = re.sub("[=<>!]=", "", word)
    if "=" in bare or word.startswith("~") or _FLAG.fullmatch(word):
        return "key"
    if _is_data(word):
        return "readings"
    if _FUNCTION.fullmatch(word) or Path(word).suffix in _YAML:
        return "model"
    is_path = _PATH.fullmatch(word) or os.path.lexists(word)
    return "model" if _FORMULA.search(word) and not is_path else "key"


def _is_data(name: str) -> bool:
    return Path(name).suffix.lower() in _DATA


def _files_of_key(word: str) -> list[str]:
    """Returns the files of readings=FILE or readings=[A,B]; none of a number."""
    key, _, value = word.partition("=")
    names = [name.strip("'\"") for name in listed(value)]
    if key != "readings" or not all(map(_is_data, names)):
        return []
    return names


def _left_side(word: str) -> str:
    """Returns y of a formula y = a*t + b, which names its reading; empty if the word is none."""
    named = _NAMED.fullmatch(word)
    if named is None or named["reading"] in {*KEYS, *plugins.groups()}:
        return ""
    return named["reading"] if _FORMULA.search(named["formula"]) else ""


def _is_formula_for(word: str, files: Sequence[str]) -> bool:
    """Tells if a word is a formula that names its reading among the columns."""
    reading = _left_side(word)
    if not reading:
        return False
    for file in files:
        _require_file(file)
    return reading in _columns(files[0])


def _require_pair(
    command: str, models: Sequence[str], files: Sequence[str], others: Sequence[str]
) -> None:
    """Refuses several models, one beside that of a key, and a model or file alone."""
    keys = {word.partition("=")[0].partition(".")[0] for word in others}
    typed = [word for word in others if word.partition("=")[0] in _MODELS]
    if len(models) > 1:
        raise UserError(
            f"{' '.join(models)}: are {len(models)} models; give one, and put a formula in quotes"
        )
    if models and typed:
        raise UserError(f"{models[0]}: is a model, and {typed[0]} is another; give one of them")
    if models and not files:
        _refuse_no_readings(others)
        example = f"ipe-bench {command} {_quoted_model(models[0])} readings.csv"
        raise UserError(f"{models[0]}: is a model without readings; add their file: {example}")
    if files and not models and keys.isdisjoint(_MODELS):
        _refuse_bare_names(others)
        _refuse_no_model(files[0], others)
        raise UserError(
            f"{files[0]}: contains readings, but no model is given; write a function's file, a"
            " formula in quotes or a YAML file before it: ipe-bench"
            f' {command} "a*exp(-b*t)+c" {files[0]}, or choose measurement=NAME'
        )


def _refuse_no_readings(words: Sequence[str]) -> None:
    """Refuses what stands in the place of a file of readings."""
    if any(_FLAG.fullmatch(word) for word in words):
        return
    for word in words:
        if "=" not in word and not word.startswith(("-", "~")):
            if Path(word).suffix.lower() in _SHEETS:
                raise UserError(
                    f"{word}: cannot be read; save the sheet as CSV, and give that file"
                )
            near = did_you_mean(word, [one.name for one in Path().iterdir() if _is_data(one.name)])
            raise UserError(f"{word}: is no file of readings ({', '.join(_DATA)}){near}")


def _refuse_bare_names(words: Sequence[str]) -> None:
    """Refuses the name of a model without its key."""
    for word in words:
        for group in _MODELS:
            if word in [option.name for option in plugins.options(group)]:
                raise UserError(f"{word}: is not KEY=VALUE; write {group}={word}")


def _refuse_no_model(file: str, words: Sequence[str]) -> None:
    """Refuses what stands in a model's place: a formula of another column, or another word."""
    for word in words:
        defined = _DEFINED.fullmatch(word)
        if defined:
            raise UserError(
                f'{word}: write the formula alone, "{defined["formula"]}", or behind the name of'
                " the column of the readings and ="
            )
        reading = _left_side(word)
        if reading:
            _refuse_absent(word, file, reading)
    flags = [word for word in words if word.startswith("-")]
    bare = [word for word in words if "=" not in word and not word.startswith("~")]
    if bare and not flags:
        what = "is a folder" if Path(bare[0]).is_dir() else "is no model"
        remedy = "write a function's file, a formula in quotes or a YAML file in its place"
        for one in Path().iterdir():
            if one.stem == bare[0] and one.suffix in (".py", *_YAML):
                remedy = f"did you mean {one.name}?"
        raise UserError(f"{bare[0]}: {what}; {remedy}")


def _refuse_absent(formula: str, file: str, reading: str) -> NoReturn:
    """Refuses a formula of readings that are no column."""
    sign = formula.partition(reading)[2].strip()[0]
    raise UserError(
        f"{formula}: {file} has no column {reading}; its columns are"
        f" {', '.join(_columns(file))}: name one of them before the {sign}"
    )


def _quoted_model(model: str) -> str:
    return f'"{model}"' if _FORMULA.search(model) and not _FUNCTION.fullmatch(model) else model


def _require_file(name: str) -> None:
    path = Path(name)
    fault = fault_of(path)
    if not fault or path.parent.as_posix().startswith("ipe_bench/real/samples"):
        return
    if os.path.lexists(path):
        raise UserError(f"{name}: {fault}")
    siblings = []
    if path.parent.is_dir():
        alike = [one for one in path.parent.iterdir() if one.suffix == path.suffix]
        siblings = [one.name for one in alike if one.is_file()]
    raise UserError(f"{name}: {fault} here{did_you_mean(path.name, siblings)}")


def _columns(file: str) -> list[str]:
    """Lists the columns of a file without their units."""
    return [quantity(heading) for heading in read_headings(Path(file))]


@dataclass
class _Reader:
    """Reads the model of a command, given its files of readings and its words KEY=VALUE."""

    command: str
    model: str
    files: list[str]
    others: list[str]

    def read(self) -> Short:
        model = self.model
        function = _FUNCTION.fullmatch(model)
        if function:
            _require_file(function["file"])
            return self._function(function["file"], function["name"])
        if Path(model).suffix in _YAML:
            _require_file(model)
            return self._equations(model)
        return self._formula(model)

    def _short(
        self, words: Sequence[str], assumed: Sequence[str], left_out: Sequence[str] = ()
    ) -> Short:
        # What was typed comes last, and replaces what the short form sets.
        last = [self._ignoring(left_out)] if left_out else []
        return Short([*words, *self.others, *last], self.files, [line for line in assumed if line])

    def _refuse_bare(self, names: Sequence[str]) -> None:
        """Refuses a bare parameter as a key."""
        for word in self.others:
            name, equals, value = word.partition("=")
            if equals and name in names:
                raise UserError(
                    f"{word}: measurement.start.{name}={value} sets the start, and"
                    f" parameters.{name}.fixed={value} keeps the value"
                )

    def _refuse_starts_of_columns(self) -> None:
        """Refuses the start of a column, which would make it a parameter."""
        for name in self._typed_starts:
            if name in self._columns_besides([]):
                raise UserError(
                    f"measurement.start.{name}: makes {name} a parameter, and {self.files[0]} has a"
                    f" column {name}; remove the key, or leave the column out by"
                    f" ignore_columns=[{name}]"
                )

    # Columns

    def _columns_left(self, taken: Sequence[str]) -> list[str]:
        """Lists the columns that may have the readings: those besides the columns that the model
        takes, sigma and those left out."""
        left = self._columns_besides(taken)
        # A column of texts is passed over, but not if nothing else is left: then it is named.
        if len(left) < 2:
            return left
        return [name for name in left if name not in self.texts] or left

    def _text_columns_left(self, taken: Sequence[str], reading: str) -> list[str]:
        """Lists the columns of texts that stand beside the readings, and are left out."""
        besides = self._columns_besides([*taken, reading])
        return [name for name in besides if name in self.texts]

    def _columns_besides(self, taken: Sequence[str]) -> list[str]:
        known = {*taken, SIGMA}
        return [name for name in self.columns if name not in known]

    @property
    def _ignored(self) -> list[str]:
        """Lists the columns that are left out."""
        (typed,) = self._last_value("ignore_columns") or [""]
        return listed(typed)

    def _last_value(self, key: str) -> list[str]:
        """Returns the last value that was typed for a key; an empty list if there is none."""
        values = [word.partition("=")[2] for word in self.others if word.startswith(f"{key}=")]
        return values[-1:]

    @cached_property
    def columns(self) -> list[str]:
        """Columns of the first file, besides those left out."""
        return [name for name in _columns(self.files[0]) if name not in self._ignored]

    @cached_property
    def texts(self) -> list[str]:
        """Columns of the first file whose cells are texts that begin with no number, such as
        remarks: 20 °C and <2 may be readings."""
        (table,) = read_tables([Path(self.files[0])])
        found = []
        for heading in table.heading:
            cells = [text for text, _ in table.column(heading) if text.strip()]
            if cells and not any(_NUMERIC.match(text) for text in cells):
                found.append(quantity(heading))
        return found

    def _reading_column(self, what: str, taken: Sequence[str], usual: Sequence[str]) -> str:
        """Finds the column of the readings: the one that is typed, has a usual name, or is left."""
        free = self._columns_left(taken)
        named = [
            *self._last_value("measurement.reading"),
            *(name for name in usual if name in free),
        ]
        if named:
            unused = [name for name in free if name != named[0]]
            if unused:
                self._refuse_unused(what, unused, taken)
            return named[0]
        if len(free) == 1:
            return free[0]
        if not free:
            raise UserError(
                f"{self.files[0]}: no column is left for the readings; {what} takes"
                f" {enumerate_few(taken)}"
            )
        if not taken:
            raise UserError(
                f"{self.files[0]}: no name in {what} is a column (there are {', '.join(free)});"
                " correct the name, as columns are what the readings depend on"
            )
        stems = {name.rstrip("0123456789") for name in free}
        if len(stems) == 1 and stems.isdisjoint(free):
            raise UserError(
                f"{self.files[0]}: columns {enumerate_few(free)} look like repeated readings; write"
                f" them below each other in one column reading, and repeat {enumerate_few(taken)}"
                " beside them"
            )
        rest = self._ignoring(free[1:])
        raise UserError(
            f"{self.files[0]}: columns {enumerate_few(free)} are not in {what}, and one of them has"
            f" the readings; if that is {free[0]}:"
            f" {self._again(f'measurement.reading={free[0]}', rest)}"
        )

    def _again(self, *words: str, model: str = "") -> str:
        """Writes the whole command with further words, or with another model."""
        typed = [model or self.model, *self.files, *self.others, *words]
        quoted = [shlex.quote(word) if _BARE.search(word) else word for word in typed]
        return f"ipe-bench {self.command} {' '.join(quoted)}"

    def _ignoring(self, columns: Sequence[str]) -> str:
        return f"ignore_columns=[{','.join([*self._ignored, *columns])}]"

    def _refuse_unused(self, what: str, unused: Sequence[str], taken: Sequence[str]) -> None:
        said = f"columns {enumerate_few(unused)} are"
        if len(unused) == 1:
            said = f"column {unused[0]} is"
        raise UserError(
            f"{self.files[0]}: {said} not in {what}, which takes"
            f" {enumerate_few(taken) or 'no column'}; correct the name, or leave out what is not"
            f" needed: {self._again(self._ignoring(unused))}"
        )

    @property
    def _noise_stated(self) -> bool:
        return any(word.startswith("noise") for word in self.others)

    def _levels(self, read: Sequence[str]) -> list[str]:
        """Returns the words by which each of several columns of readings has a noise level of its
        own, unless noise is stated."""
        deviations = {SIGMA, *(f"{SIGMA}_{name}" for name in read)}
        if self._noise_stated or not deviations.isdisjoint(self.columns):
            return []
        return ["noise=unknown", "noise.by=output"]

    def _noise_line(self, levels: Sequence[str] = ()) -> str:
        """Says what is taken for the noise of an estimate; other commands say it with its size."""
        if self._noise_stated or self.command != "estimate":
            return ""
        if levels:
            return "Noise: a level for each of these columns, estimated from its residuals."
        deviations = [name for name in self.columns if name.startswith(SIGMA)]
        if deviations and (SIGMA in deviations or deviations[1:]):
            return f"Noise: standard deviations from column {enumerate_few(deviations)}."
        return "Noise: one level, estimated from the residuals; noise.deviation=X states it."

    # Functions

    def _function(self, file: str, name: str | None) -> Short:
        tree = _parsed(file)
        module = _module(file)
        chosen = self._chosen(file, tree, name)
        signature = _Signature.of(chosen, self._typed_starts)
        self._refuse_default_of_column(file, signature)
        self._refuse_absent_columns(file, signature)
        self._refuse_bare(signature.arguments)
        self._refuse_starts_of_columns()
        words = ["measurement=function", f"measurement.of={module}:{chosen.name}"]
        model = f"Model: {signature.text} of {file}{_starts_phrase(signature.starts)}."
        outputs = self._outputs(chosen, signature.text, signature.columns)
        if outputs:
            levels = self._levels(outputs)
            words += [f"measurement.outputs=[{','.join(map(w.quoted, outputs))}]", *levels]
            readings = f"Readings: columns {enumerate_few(outputs)} of {', '.join(self.files)}"
            readings += f", in the order in which {chosen.name} returns them."
            if "output" in self.columns:
                readings = f"Readings: column reading of {', '.join(self.files)}; column output"
                readings += f" distinguishes {enumerate_few(outputs)}."
            return self._short(words, [model, readings, self._noise_line(levels)])
        columns = signature.columns
        reading = self._reading_column(signature.text, columns, ["reading"])
        words += _key_for_reading(reading, ("reading",))
        lines = [model, self._readings_line(columns, reading), self._noise_line()]
        return self._short(words, lines, self._text_columns_left(columns, reading))

    def _refuse_default_of_column(self, file: str, signature: _Signature) -> None:
        """Refuses an argument that its default makes a parameter, or its place a constant, and the
        file a column."""
        for column in self._columns_left(signature.columns):
            if column in signature.constants and not self._last_value("measurement.reading"):
                remedy = f"ignore_columns=[{column}] leaves the column out"
                if len(self._columns_left(signature.columns)) == 1:
                    remedy = f"measurement.reading={column} says that it has the readings"
                raise UserError(
                    f"{file}: the argument {column} of {signature.text} stands behind *, which"
                    f" makes it a constant, and {self.files[0]} has a column {column}; put it"
                    f" before *, without a default, to take the column; {remedy}"
                )
            if column in signature.defaults:
                raise UserError(
                    f"{file}: the argument {column} of {signature.text} has a default, which makes"
                    f" it a parameter, and {self.files[0]} has a column {column}; remove the"
                    f" default, or leave the column out by ignore_columns=[{column}]"
                )

    def _refuse_absent_columns(self, file: str, signature: _Signature) -> None:
        """Refuses arguments without a default that are no columns."""
        absent = [column for column in signature.columns if column not in self.columns]
        if not absent:
            return
        left_out = [column for column in absent if column in self._ignored]
        if left_out:
            raise UserError(
                f"ignore_columns: leaves out {enumerate_few(left_out)}, which {signature.text}"
                f" takes; keep it, or make it a parameter by measurement.start.{left_out[0]}=1"
            )
        left = self._columns_left([*signature.columns, "reading"])
        near = did_you_mean(absent[0], left)
        words = [f"measurement.start.{name}=1" for name in absent]
        raise UserError(
            f"{self.files[0]}: has no {'columns' if absent[1:] else 'column'}"
            f" {enumerate_few(absent)}, which {signature.text} takes (there are"
            f" {', '.join(self.columns)}{near}); rename the column, or give a parameter its"
            f" start: as a default in {file}, or by {self._again(*words)}"
        )

    def _outputs(self, chosen: ast.FunctionDef, what: str, taken: Sequence[str]) -> list[str]:
        """Finds the column of each array that a function returns in a tuple; none for one array."""
        typed = self._last_value("measurement.outputs")
        if typed:
            return listed(typed[0])
        tuples = [one for one in _returned(chosen) if isinstance(one, ast.Tuple)]
        if not tuples:
            return []
        arrays = tuples[-1].elts
        if "output" in self.columns and "reading" in self.columns:
            return self._outputs_below(_names_of(tuples[-1]), what)
        free = [name for name in self._columns_left(taken) if not name.startswith(f"{SIGMA}_")]
        alike = [_names_of(one) for one in tuples if len(one.elts) == len(arrays)]
        meanings = [{*names} & {*free} for names in zip(*alike, strict=True)]
        named = ["".join(names) if len(names) == 1 else "" for names in meanings]
        certain = all(len(names) < 2 for names in meanings)
        if {*named} <= {*free}:
            unused = [name for name in free if name not in named]
            if unused:
                self._refuse_unused(what, unused, [*taken, *named])
            return named
        rest = (name for name in free if name not in named)
        meant = [name if name in free else next(rest, "NAME") for name in named]
        if len(free) == len(arrays) and meant == free and certain:
            return free
        example = ",".join(meant)
        raise UserError(
            f"{self.files[0]}: {what} returns {len(arrays)} arrays, and columns"
            f" {enumerate_few(free) or 'none'} are left for them; name theirs in order:"
            f" {self._again(f'measurement.outputs=[{example}]')}"
        )

    def _outputs_below(self, named: Sequence[str], what: str) -> list[str]:
        """Finds the names of outputs whose readings stand below each other."""
        (table,) = read_tables([Path(self.files[0])])
        there = list(dict.fromkeys(text.strip() for text, _ in table.column("output")))
        if sorted(named) == sorted(there):
            return list(named)
        word = f"measurement.outputs=[{','.join(there)}]"
        raise UserError(
            f"{self.files[0]}: {what} returns {len(named)} arrays, and the column output names"
            f" {enumerate_few(there)}; name them in the order of the arrays:"
            f" {self._again(word)}"
        )

    @property
    def _typed_starts(self) -> dict[str, str]:
        """Starts that are typed, by name."""
        found = {}
        for word in self.others:
            start = _START.match(word)
            if start and start["name"]:
                found[start["name"]] = word.partition("=")[2]
            elif start:
                found |= dict(re.findall(r"(\w+)\s*:\s*([^,\s]*)", start["names"]))
        return found

    def _chosen(self, file: str, tree: ast.Module, name: str | None) -> ast.FunctionDef:
        """Finds the function that is named, or the only one whose name begins with a letter."""
        functions = {one.name: one for one in tree.body if isinstance(one, ast.FunctionDef)}
        public = [one for one in functions if not one.startswith("_")]
        if name is not None:
            if name not in functions:
                raise UserError(f"{file}:{name}: {unknown(name, public, 'function')}")
            return functions[name]
        if not public:
            raise UserError(
                f"{file}: has no function; define the model, as in def model(t, a=1.0, b=0.5):"
                " return a * t + b"
            )
        if len(public) > 1:
            raise UserError(
                f"{file}: has {len(public)} functions, {enumerate_few(public)}; begin the names of"
                f" helpers with _, or name the model: {self._again(model=f'{file}:{public[0]}')}"
            )
        return functions[public[0]]

    def _readings_line(self, columns: Sequence[str], reading: str) -> str:
        taken = f"columns {enumerate_few(columns)}" if columns else "no column"
        remarks = enumerate_few(self._text_columns_left(columns, reading))
        left_out = f"; {remarks}, without numbers, left out" if remarks else ""
        return f"Readings: column {reading} of {', '.join(self.files)}; {taken}{left_out}."

    # Formulas

    def _formula(self, text: str) -> Short:
        named = _NAMED.fullmatch(text)
        formula = named["formula"] if named else text
        names = parse(formula, "formula").names
        columns = [name for name in names if name in self.columns]
        typed = self._typed_starts
        untyped = [name for name in names if name not in (*columns, *typed)]
        usual = ("y", "reading")
        if named:
            usual = (named["reading"],)
            self._refuse_other_reading(named["reading"], names)
        what = f"the formula of {', '.join(names)}"
        self._refuse_bare(names)
        self._refuse_starts_of_columns()
        if not columns:
            self._refuse_without_column(names, self._last_value("measurement.reading") or usual)
        reading = self._reading_column(what, columns, usual)
        if not untyped and not typed:
            raise UserError(
                f"{formula}: every name is a column of {self.files[0]}; no parameter is left"
            )
        words = ["measurement=formula", f"measurement.expression={w.quoted(formula)}"]
        words += [f"measurement.start.{name}=1" for name in untyped]
        words += _key_for_reading(reading, () if "y" in columns else ("y", "reading"))
        start = f"; start 1 for {enumerate_few(untyped)}" if untyped else ""
        start += _starts_phrase({name: typed[name] for name in names if name in typed})
        parameters = [name for name in names if name not in columns]
        remedy = f"measurement.start.{parameters[0]}=X sets another"
        model = f"Model: {formula}{start}; {remedy}."
        lines = [model, self._readings_line(columns, reading), self._noise_line()]
        return self._short(words, lines, self._text_columns_left(columns, reading))

    def _refuse_other_reading(self, reading: str, names: Sequence[str]) -> None:
        """Refuses a formula whose readings are no column, or one that is used otherwise."""
        if reading not in [*self.columns, *self._ignored]:
            _refuse_absent(self.model, self.files[0], reading)
        (typed,) = self._last_value("measurement.reading") or [reading]
        use = ""
        if reading in names:
            use = "is part of the formula, too; use it on one side alone"
        elif reading == SIGMA:
            use = "has the standard deviations of the readings; name another column"
        elif reading in self._ignored:
            use = "is left out by ignore_columns; name another column, or keep this one"
        elif listed(typed) != [reading]:
            use = f"has the readings, and so has measurement.reading={typed}; give one of them"
        if use:
            raise UserError(f"{self.model}: the column {reading} {use}")

    def _refuse_without_column(self, names: Sequence[str], usual: Sequence[str]) -> NoReturn:
        """Refuses a formula of names that are no columns; one may be short for a column."""
        free = self._columns_left([])
        likely = [column for column in free if column not in usual]
        short = [(name, column) for name in names for column in likely if _is_short(name, column)]
        there = f"no name in the formula is a column (there are {', '.join(self.columns)})"
        if not short:
            raise UserError(
                f"{self.files[0]}: {there}; write the column that the readings depend on in the"
                f" formula of {', '.join(names)}"
            )
        name, column = short[0]
        model = re.sub(rf"\b{re.escape(name)}\b", column, self.model)
        rest = [one for one in free if one != column]
        reading = next((one for one in usual if one in rest), rest[0])
        others = [one for one in rest if one != reading]
        words = [] if reading in usual else [f"measurement.reading={reading}"]
        words += [self._ignoring(others)] if others else []
        raise UserError(
            f"{self.files[0]}: {there}; if {name} is {column}: {self._again(*words, model=model)}"
        )

    # Equations

    def _equations(self, file: str) -> Short:
        content = plugins.read_yaml_file(Path(file), file)
        keys = list(content) if isinstance(content, dict) else []
        files = ", ".join(self.files)
        if "next" in keys:
            words = ["state_model=formulas", f"state_model.file={file}"]
            words += _title("state_model", file, content)
            from ipe_bench.states.formulas import Formulas

            states = content["next"] if isinstance(content["next"], dict) else {}
            self._require_complete(file, content, "state_model", Formulas)
            model = f"Model: states {enumerate_few(list(states))} of {file}, which move."
            log = f"Log: {files}, a row per time step"
            if self._is_timed(content):
                words += ["state_model.inputs.time=0"]
                log += "; its column time has the times, and dt is the step"
            return self._short(words, [model, f"{log}."])
        if "rates" in keys:
            from ipe_bench.measurements.ode.described import Ode

            self._require_complete(file, content, "measurement", Ode)
            words = ["measurement=ode", f"measurement.file={file}"]
            words += _title("measurement", file, content)
            model = f"Model: differential equations of {file}."
            outputs = content.get("outputs", content["rates"])
            read = [name for name in outputs if name in self._columns_left([])]
            if "output" in self.columns or len(read) < 2:
                return self._short(words, [model, f"Readings: {files}.", self._noise_line()])
            levels = self._levels(read)
            readings = f"Readings: columns {enumerate_few(read)} of {files}."
            return self._short([*words, *levels], [model, readings, self._noise_line(levels)])
        there = f"its keys are {', '.join(map(str, keys))}" if keys else "it has no keys"
        raise UserError(
            f"{file}: is no model: it has neither next: (a state model by formulas) nor rates:"
            f" (differential equations); {there}"
        )

    def _is_timed(self, content: dict[str, Any]) -> bool:
        """Tells if a state model's formulas name times that only the column time of its log has."""
        typed = self._last_value("state_model.inputs.time") or self._last_value("state_model.step")
        told = typed or "step" in content or "time" in content.get("inputs", {})
        clock = {"t", "dt"} & set(_names(content)) - _defined(content)
        return bool(clock) and "time" in self.columns and not told

    def _require_complete(self, file: str, content: dict[str, Any], group: str, cls: type) -> None:
        """Refuses a file with keys that mean nothing, or without those that are needed."""
        options = {one.name: one for one in fields(cls) if one.init}
        for name, one in options.items():
            if name in content and str(one.type).startswith("Mapping"):
                _require_entries(file, content, name)
        said = []
        for key in [str(key) for key in content if key not in options]:
            near = [name for name in options if name[:_ALIKE] == key[:_ALIKE]]
            said.append(f"{key} means nothing{f' (did you mean {near[0]}?)' if near else ''}")
        misnamed = bool(said)
        typed = {
            re.split("[.=]", word)[1]
            for word in self.others
            if word.lstrip("+").startswith((f"{group}.", f"{group}="))
        }
        words = []
        for name, one in options.items():
            given = name in content or name in typed
            if given or one.default is not MISSING or one.default_factory is not MISSING:
                continue
            entries = ", ".join(f"{key}: 1" for key in content.get(_NAMED_LIKE.get(name, ""), {}))
            said.append(f"{name} is missing")
            words.append(f"{group}.{name}={{{entries}}}")
        if not misnamed and group == "state_model" and not typed & {"noise", "inputs", "constants"}:
            for name in _undefined(content):
                said.append(f"{name} is not defined")
                key = "inputs" if name in self.columns else "noise"
                words.append(f"{group}.{key}.{name}=1")
        if not said:
            return
        remedy = f"add each to the file, or: {self._again(*words)}"
        if misnamed:
            remedy = f"its keys are {', '.join(options)}"
        raise UserError(f"{file}: {'; '.join(said)}; {remedy}")


class _Signature(NamedTuple):
    """Holds what the arguments of a function are: columns, or parameters with a start."""

    text: str
    """The function as it is called, such as model(t, a, b)."""
    arguments: list[str]
    columns: list[str]
    """Arguments without a start."""
    defaults: dict[str, str]
    """Starts by the function's defaults, where none is typed."""
    starts: dict[str, str]
    """All starts, in the order of the arguments."""
    constants: list[str]
    """Arguments behind *."""

    @classmethod
    def of(cls, function: ast.FunctionDef, typed: dict[str, str]) -> Self:
        arguments = [one.arg for one in (*function.args.posonlyargs, *function.args.args)]
        values = function.args.defaults
        # Defaults belong to the last arguments.
        first = len(arguments) - len(values)
        columns = [name for name in arguments[:first] if name not in typed]
        defaults = {}
        for name, value in zip(arguments[first:], values, strict=True):
            if name not in typed:
                defaults[name] = ast.unparse(value)
        known = {**defaults, **typed}
        starts = {name: known[name] for name in arguments if known.get(name)}
        constants = [one.arg for one in function.args.kwonlyargs]
        text = f"{function.name}({', '.join(arguments)})"
        return cls(text, arguments, columns, defaults, starts, constants)


def _require_entries(file: str, content: dict[str, Any], key: str) -> None:
    """Refuses a list, a number or nothing where names with values belong."""
    given = content[key]
    if isinstance(given, dict):
        return
    like = content.get(_NAMED_LIKE.get(key, ""))
    names = given if isinstance(given, list) else list(like) if isinstance(like, dict) else []
    usual = {"inputs": 0, **dict.fromkeys(("next", "readings", "rates", "outputs"), "FORMULA")}
    value = given if isinstance(given, int | float | str) else usual.get(key, 1)
    entries = ", ".join(f"{name}: {value}" for name in names or ["NAME"])
    raise UserError(f"{file}: {key} has no names with values; write {key}: {{{entries}}}")


def _undefined(content: dict[str, Any]) -> list[str]:
    """Lists the names in the formulas of a state model that its file does not define."""
    known = {"k", "t", "dt", *_defined(content)}
    return [name for name in _names(content) if name not in known]


def _defined(content: dict[str, Any]) -> set[str]:
    """Lists the names that a state model's file gives a meaning."""
    kinds = ("next", "noise", "inputs", "constants")
    return {name for kind in kinds for name in content.get(kind, {})}


def _names(content: dict[str, Any]) -> list[str]:
    """Lists the names in the formulas of a state model's file."""
    formulas = [*content.get("next", {}).values(), *content.get("readings", {}).values()]
    names = [name for text in formulas for name in parse(str(text), "formula").names]
    return list(dict.fromkeys(names))


def _title(group: str, file: str, content: dict[str, Any]) -> list[str]:
    """Returns the word that names a model after its file, unless the file names it."""
    stem = Path(file).stem
    if "title" in content or not _BARE_TITLE.fullmatch(stem):
        return []
    return [f"{group}.title={stem}"]


def _returned(function: ast.FunctionDef) -> list[ast.expr | None]:
    """Lists what a function returns, without the functions inside of it."""
    found = []
    nodes: list[ast.AST] = [*function.body]
    while nodes:
        node = nodes.pop(0)
        if isinstance(node, ast.Return):
            found.append(node.value)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            nodes += ast.iter_child_nodes(node)
    return found


def _names_of(arrays: ast.Tuple) -> list[str]:
    """Lists the names of arrays that are returned, empty of those without one."""
    return [one.id if isinstance(one, ast.Name) else "" for one in arrays.elts]


def _is_short(name: str, column: str) -> bool:
    """Tells if one of a name and a column begins with the other, as time with t."""
    short, long = sorted((name.lower(), column.lower()), key=len)
    return long.startswith(short)


def _key_for_reading(reading: str, usual: Sequence[str]) -> list[str]:
    return [] if reading in usual else [f"measurement.reading={w.quoted(reading)}"]


def _starts_phrase(starts: dict[str, str]) -> str:
    listed = ", ".join(f"{name} = {value}" for name, value in starts.items())
    return f"; start {listed}" if listed else ""


def _parsed(file: str) -> ast.Module:
    try:
        return ast.parse(Path(file).read_text(encoding="utf-8-sig"), file)
    except SyntaxError as error:
        raise UserError(f"{place_of(error)}; correct the file") from None
    except ValueError:
        raise UserError(f"{file}: is not a text in UTF-8; save it as such") from None


def _module(file: str) -> str:
    """Returns the module of a file below the working folder."""
    path = Path(file).resolve()
    here = Path.cwd().resolve()
    if not path.is_relative_to(here):
        raise UserError(f"{file}: lies outside of the working folder; change to its folder first")
    parts = path.relative_to(here).with_suffix("").parts
    if not all(part.isidentifier() for part in parts):
        raise UserError(
            f"{file}: cannot be imported by this name; use letters, digits and _ in the names of"
            " the file and its folders"
        )
    module = ".".join(parts)
    loaded = getattr(sys.modules.get(module), "__file__", None)
    if module in sys.modules and (loaded is None or Path(loaded).resolve() != path):
        raise UserError(f"{file}: has the name of a module that Python has loaded; rename the file")
    return module
