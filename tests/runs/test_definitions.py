"""What is redefined while a process runs has numbers and results of its own, and what is not is
computed once."""

import dataclasses
import importlib
import os
import subprocess
import sys
import types
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.definitions import Definitions, statement_of
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements.problem import require_function
from ipe_bench.noise import Gaussian
from ipe_bench.runs.execution import Processes, end_idle
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.store import ResultKey
from ipe_bench.states.base import widened
from ipe_bench.trials.fit_test import Spread, fit_probability

# Ways to say how far estimates are shifted: the part of a cell that is edited, and the part that
# uses it.
WAYS = {
    "constant": ("class By:\n    def by(self):\n        return {v}", ""),
    "inner function": (
        "class By:\n    def by(self):\n        return (lambda: [{v} for _ in 'a'][0])()",
        "",
    ),
    "default": ("class By:\n    def by(self, v={v}):\n        return v", ""),
    "keyword": ("class By:\n    def by(self, *, v={v}):\n        return v", ""),
    "attribute": ("class By:\n    v = {v}\n    def by(self):\n        return self.v", ""),
    "static": ("class By:\n    @staticmethod\n    def by():\n        return {v}", ""),
    "property": (
        "class By:\n    value = property(lambda self: {v})\n    def by(self):\n        return"
        " self.value",
        "",
    ),
    "closure": ("def method(v):\n    return lambda self: v\nclass By:\n    by = method({v})", ""),
    "array": (
        "def method(v):\n    return lambda self: v[0]\nclass By:\n    by = method(np.array([{v}]))",
        "",
    ),
    "factory": (
        "def kind(v):\n    class By:\n        def by(self):\n            return v\n    return"
        " By\nBy = kind({v})",
        "",
    ),
    "variable": ("V = {v}", "class By:\n    def by(self):\n        return V"),
    "list": ("V = [{v}]", "class By:\n    def by(self):\n        return V[0]"),
    "helper": (
        "def helper():\n    return {v}",
        "class By:\n    def by(self):\n        return helper()",
    ),
    "kept helper": (
        "@functools.cache\ndef f():\n    return {v}",
        "class By:\n    def by(self):\n        return f()",
    ),
    "decorator": (
        "class Times:\n    def __init__(self, f):\n        self.f, self.k ="
        " functools.update_wrapper(self, f), {v}\n    def __call__(self):\n        return self.k *"
        " self.__wrapped__()\n@Times\ndef f():\n    return 1.0",
        "class By:\n    def by(self):\n        return f()",
    ),
    "partial": (
        "f = functools.partial(max, {v})",
        "class By:\n    def by(self):\n        return f(-1.0)",
    ),
    "other class": (
        "class Other:\n    v = {v}",
        "class By:\n    def by(self):\n        return Other.v",
    ),
    "object": (
        "class Box:\n    def __init__(self, v):\n        self.v = v\nbox = Box({v})",
        "class By:\n    def by(self):\n        return box.v",
    ),
    "function of a function": (
        "def inner():\n    return {v}",
        "def outer():\n    return inner()\nclass By:\n    def by(self):\n        return outer()",
    ),
    "evaluated": (
        "def helper():\n    return {v}",
        "class By:\n    def by(self):\n        return eval('helper()')",
    ),
    "private beside evaluated": (
        "def _helper():\n    return {v}",
        "class By:\n    def by(self):\n        return eval('0') + _helper()",
    ),
}
KINDS = {
    "estimator": """
@dataclass(frozen=True)
class Mine(By, ib.Estimator):
    def estimate(self, problem, z, *, history=False):
        found = ib.baselines.LinearLSE().estimate(problem, z)
        found.x = found.x + self.by()
        return found
""",
    "model": """
@dataclass(frozen=True)
class Mine(By, ib.measurements.Polynomial):
    def simulate(self, x):
        return super().simulate(x) + self.by()
""",
    "noise": """
@dataclass(frozen=True)
class Mine(By, ib.noise.Gaussian):
    def corrupt(self, h, offset, rng):
        return super().corrupt(h, offset, rng) + self.by()
""",
    "prior": """
@dataclass(frozen=True)
class Mine(By, ib.priors.GaussianPrior):
    def draw(self, nominal, scale, rng):
        return super().draw(nominal, scale, rng) + self.by()
""",
    "tracker": """
@dataclass(frozen=True)
class Mine(By, ib.states.Tracker):
    def track(self, model, z):
        found = ib.states.ekf().track(model, z)
        found.mean = found.mean + self.by()
        return found
""",
}
COLUMN = {"prior": "x_c0", "tracker": "error_p"}
WALK = {"next": {"p": "p + w"}, "readings": {"z": "p"}, "noise": {"w": 1.0}}
TRACK = ib.StateScenario(
    ib.states.Formulas(**WALK, deviation={"z": 0.5}, spread={"p": 3.0}, count=5)
)
SETUP = (
    "import functools\nfrom dataclasses import dataclass\nimport numpy as np\nimport ipe_bench as"
    " ib"
)


class Session:
    """A process in which cells are run, as a notebook runs them."""

    def __init__(self, kind: str, way: str, v: float) -> None:
        self.kind, (self.edited, self.used) = kind, WAYS[way]
        self.names: dict[str, Any] = {"__name__": "__main__"}
        exec(SETUP, self.names)
        self.run_all(v)

    def edit(self, v: float) -> None:
        """Runs the cell again that says how far."""
        exec(self.edited.format(v=v), self.names)

    def run_all(self, v: float) -> None:
        self.edit(v)
        exec(self.used, self.names)
        exec(KINDS[self.kind], self.names)

    def asked(self) -> tuple[Any, Any]:
        """The scenario and the estimators."""
        mine = self.names["Mine"](0.01) if self.kind == "noise" else self.names["Mine"]()
        if self.kind == "tracker":
            return TRACK, {"mine": mine}
        if self.kind == "estimator":
            return ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01)), {
                "mine": mine
            }
        plain: dict = {
            "measurement": ib.measurements.Polynomial(),
            "noise": ib.noise.Gaussian(0.01),
        }
        plain |= {"truth" if self.kind == "model" else self.kind: mine}
        return ib.Scenario(**plain), {"linear": ib.baselines.LinearLSE()}

    def key(self) -> str:
        scenario, estimators = self.asked()
        return ResultKey(scenario, *next(iter(estimators.items()))).key


def first(folder: Path, asked: tuple[Any, Any], column: str) -> float:
    """That column of the first trial, as it is computed into or found in the folder."""
    scenario, estimators = asked
    assert not compute([scenario], estimators, 2, folder)
    return float(ib.load(folder)[column].iloc[0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_helper_that_is_edited_in_another_cell_changes_numbers_in_any_folder(tmp_path, kind):
    session, column = Session(kind, "helper", 0.0), COLUMN.get(kind, "error_c0")
    asked = session.asked()
    before = first(tmp_path / "one", asked, column)
    session.edit(1000.0)
    # The same objects of the same classes: what they have worked out is the old helper's.
    for folder in ("one", "another"):
        assert first(tmp_path / folder, asked, column) == pytest.approx(before + 1000, abs=1e-6)
    session.edit(0.0)
    assert first(tmp_path / "one", asked, column) == before


@pytest.mark.parametrize("way", WAYS)
def test_a_cell_that_is_edited_changes_numbers_and_one_that_is_run_again_does_not(tmp_path, way):
    session = Session("estimator", way, 0.0)
    before, key = first(tmp_path, session.asked(), "error_c0"), session.key()
    session.run_all(0.0)
    assert session.key() == key
    session.run_all(1000.0)
    assert first(tmp_path, session.asked(), "error_c0") == pytest.approx(before + 1000)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", [way for way, (_, used) in WAYS.items() if used])
def test_the_key_of_each_kind_follows_what_the_cell_above_it_says(way, kind):
    session = Session(kind, way, 1.0)
    key = session.key()
    session.edit(2.0)
    assert session.key() != key
    session.edit(1.0)
    assert session.key() == key == Session(kind, way, 1.0).key()


@pytest.mark.parametrize("way", WAYS)
def test_remarks_docstrings_and_lines_change_no_key(way):
    session = Session("estimator", way, 1.0)
    key = session.key()
    told = session.edited.replace(
        ":\n", ":\n\n    # a remark\n" if way == "variable" else ":\n\n", 1
    )
    exec("'''What it does.'''\n\n" + told.format(v=1.0), session.names)
    exec(session.used, session.names)
    exec(KINDS["estimator"].replace("=False):\n", "=False):\n        'Shifts.'\n"), session.names)
    assert session.key() == key


def test_what_cannot_be_digested_is_another_with_each_definition():
    session = Session("estimator", "variable", 1.0)
    lines = [
        "import threading",
        "lock = threading.Lock()",
        "class By:\n    def by(self):\n        return id(lock)",
    ]
    keys = []
    for _ in range(2):
        for line in (*lines, KINDS["estimator"]):
            exec(line, session.names)
        keys.append(session.key())
        assert session.key() == keys[-1]
    assert keys[0] != keys[1]


def test_a_rerun_computes_nothing_though_the_code_fills_its_variables(tmp_path):
    session = Session("estimator", "constant", 1.0)
    exec(
        "seen = []\nclass By:\n    def by(self):\n        seen.append(1)\n        return 1.0",
        session.names,
    )
    exec(KINDS["estimator"], session.names)
    scenario, estimators = session.asked()
    table = ib.run(scenario, estimators, trials=40, precision=1e-9, block_size=20, output=tmp_path)
    assert table.attrs["stops"][0]["trials"] == 40
    assert len(Results.read([tmp_path]).stored) == 2


def test_the_test_of_residuals_follows_a_noise_whose_helper_was_edited():
    session = Session("noise", "helper", 1.0)
    text = (
        "@dataclass(frozen=True)\nclass Mine(ib.noise.Gaussian):\n    def whitened(self, shape,"
        " rng):\n"
    )
    exec(f"{text}        return helper() * rng.uniform(-1, 1, shape)", session.names)
    problem, noise = SCENARIO.problem, session.names["Mine"](0.01)
    spread = Spread(problem.measurement.m - problem.measurement.n, np.empty((1, 0)))

    def p() -> float:
        return fit_probability(np.array([5.0]), spread, noise, problem.H, problem.R)[0]

    one = p()
    session.edit(0.1)
    assert p() < 0.01 < one


def test_a_function_that_is_defined_anew_is_another_model_and_the_old_model_is_refused(tmp_path):
    names: dict[str, Any] = {}
    main, found, models = sys.modules["__main__"], [], []
    for power in (1, 2):
        exec(f"def line(t, a=1.0, b=2.0):\n    return a * t**{power} + b", vars(main), names)
        main.__dict__["line"] = names["line"]
        models.append(ib.measurements.function(names["line"], columns={"t": np.linspace(0, 1, 9)}))
        scenario = ib.Scenario(models[-1], ib.noise.Gaussian(0.01))
        found.append(first(tmp_path, (scenario, {"linear": ib.baselines.LinearLSE()}), "error_a"))
    assert found[0] != found[1]
    with pytest.raises(UserError, match="make the model anew"):
        require_function(models[0])
    del main.__dict__["line"]


RECORDED = """
@dataclass(frozen=True)
class Decay(ib.OdeMeasurement):
    states, outputs, reading_unit, tolerance = 1, ("y",), "", 1e-9
    parameters = (ib.measurements.Parameter("k", "1/s", 0.1),)
    nominal = np.array([5.0])
    times = np.arange(0.5, 5.0, 0.5)
    def start(self, p, c):
        return (1.0,)
    def rhs(self, t, y, p, c):
        return (-helper() * p[0] * y[0],)
    def read(self, t, y, p, c):
        return (y[0],)
"""


KEPT = """
@dataclass(frozen=True)
class Kept(ib.measurements.Polynomial):
    @functools.cached_property
    def factor(self):
        return helper()
    def simulate(self, x):
        return self.factor * super().simulate(x)
"""


def test_a_design_is_of_what_a_model_computes_with_and_not_of_what_it_has_kept():
    """Readings twice as large say twice as much of each parameter."""
    session = Session("estimator", "helper", 1.0)
    exec(KEPT, session.names)
    model, values = session.names["Kept"](), []
    for factor in (1.0, 2.0):
        session.edit(factor)
        seen = ib.design(model, noise=Gaussian(0.01), error_scale=1e-6, errors=()).observability
        values.append(seen.singular_values[0])
    assert values[1] == pytest.approx(2 * values[0])


SHOWN = {
    "mapping": ("held = {'k': 1.0}; shown = types.MappingProxyType(held)", "held['k'] = 2.0"),
    "memory": ("held = np.ones(1); shown = memoryview(held)", "held[0] = 2.0"),
    "reference": ("class C: k = 1.0\nshown = weakref.ref(C)", "C.k = 2.0"),
    "metaclass": ("class K(type): k = 1.0\nclass shown(metaclass=K): pass", "K.k = 2.0"),
}
"""What shows another object, and how that changes."""


@pytest.mark.parametrize("kind", SHOWN)
def test_a_definition_follows_what_is_seen_through_another_object(kind):
    made, edit = SHOWN[kind]
    names = {"types": types, "np": np, "weakref": weakref, "__name__": "__main__"}
    exec(made, names)
    exec("def used():\n    return shown", names)
    before = repr(Definitions().of(names["used"]))
    assert repr(Definitions().of(names["used"])) == before
    exec(edit, names)
    assert repr(Definitions().of(names["used"])) != before


def test_classes_of_one_name_that_are_made_by_a_call_have_results_of_their_own():
    """Python calls the module of such a class abc, and they were taken for classes of Python's."""
    bounds = []
    for factor in (1.0, 2.0):
        parts = {
            "simulate": lambda self, x, f=factor: f * ib.measurements.Polynomial.simulate(self, x)
        }
        base = (ib.measurements.Polynomial,)
        made = dataclasses.make_dataclass("Made", [], bases=base, namespace=parts, frozen=True)
        table = ib.run(made(), {"map": LevenbergMarquardt()}, trials=5, noise=Gaussian(0.01))
        bounds.append(table["crlb"].iloc[0])
    assert bounds[0] == pytest.approx(2 * bounds[1])


def test_a_draw_follows_a_function_that_was_edited_and_an_object_keeps_its_class():
    session = Session("estimator", "helper", 1.0)
    exec(KEPT, session.names)
    model = session.names["Kept"]()
    bench = ib.Scenario(model, Gaussian(1e-9), seed=1)
    before = bench.draw(0, 2)
    assert bench.draw(0, 2).z == pytest.approx(before.z, abs=0)
    session.edit(3.0)
    for one in (bench, ib.Scenario(model, Gaussian(1e-9), seed=1)):
        assert one.draw(0, 2).z == pytest.approx(3 * before.z, rel=1e-6)
        assert (one.draw(0, 2).x == before.x).all()
    exec(KEPT.replace("return helper()", "return -helper()"), session.names)
    assert bench.draw(0, 2).z == pytest.approx(3 * before.z, rel=1e-6)
    session.edit(1.0)
    assert (bench.draw(0, 2).z == before.z).all()


@pytest.mark.slow
def test_what_is_asked_of_a_model_after_an_edit_is_answered_by_its_functions_as_they_are():
    """exp(-2 k t) has half the k of exp(-k t), known twice as well."""
    session = Session("estimator", "helper", 1.0)
    exec(RECORDED, session.names)
    model, noise = session.names["Decay"](), Gaussian(0.01)
    z = np.exp(-0.5 * model.times)

    def found() -> list[float]:
        (fit,) = ib.estimate(model, z, {"lm": LevenbergMarquardt()}, noise=noise, progress=False)
        seen = ib.design(model, noise=noise, error_scale=1e-6).observability
        return [fit.values["k"], float(fit.standard_errors[0]), float(seen.singular_values[0, 0])]

    before = found()
    session.edit(2.0)
    exec(session.used, session.names)
    after = found()
    assert before[0] == pytest.approx(0.5)
    assert after[:2] == pytest.approx([before[0] / 2, before[1] / 2])
    # The slope at the start, and not at the estimate.
    exact = model.times * 2 * np.exp(-model.times) / 0.01 * 0.1
    assert after[2] == pytest.approx(np.linalg.norm(exact), rel=1e-4)


MODULE = """
from dataclasses import dataclass
import ipe_bench as ib
{helper}
@dataclass(frozen=True)
class Reloaded(ib.Estimator):
    def estimate(self, problem, z, *, history=False):
        found = ib.baselines.LinearLSE().estimate(problem, z)
        found.x = found.x + shift()
        return found
"""
SCENARIO = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))


def write(folder: Path, name: str, v: float, *, apart: bool = False) -> None:
    """Writes a module with an estimator, and its helper in it or apart."""
    helper = f"def shift():\n    return {v}\n"
    (folder / f"{name}.py").write_text(
        MODULE.format(helper="from helper import shift" if apart else helper)
    )
    if apart:
        (folder / "helper.py").write_text(helper)


@pytest.fixture
def importing(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    for name in ("mine", "helper"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("apart", [False, True])
def test_a_module_that_is_edited_and_reloaded_has_new_numbers_and_known_ones_when_it_is_as_before(
    importing, apart
):
    shifts, keys = [], []
    for v in (0.0, 1000.0, 0.0):
        write(importing, "mine", v, apart=apart)
        importlib.invalidate_caches()
        for name in ("helper", "mine") if apart else ("mine",):
            importlib.reload(importlib.import_module(name))
        mine = sys.modules["mine"].Reloaded()
        shifts.append(first(importing / "out", (SCENARIO, {"mine": mine}), "error_c0"))
        keys.append(ResultKey(SCENARIO, "mine", mine).key)
    assert shifts[1] == pytest.approx(shifts[0] + 1000)
    assert shifts[2] == shifts[0]
    assert keys[0] == keys[2] != keys[1]


def test_a_module_that_is_edited_and_not_imported_again_is_neither_the_old_one_nor_the_new(
    importing,
):
    write(importing, "mine", 0.0)
    mine = importlib.import_module("mine").Reloaded()
    keys = {ResultKey(SCENARIO, "mine", mine).key}
    write(importing, "mine", 1000.0)
    keys.add(ResultKey(SCENARIO, "mine", mine).key)
    keys.add(ResultKey(SCENARIO, "mine", importlib.reload(sys.modules["mine"]).Reloaded()).key)
    assert len(keys) == 3


def test_what_is_set_in_a_module_from_outside_is_part_of_the_key(importing, monkeypatch):
    write(importing, "mine", 0.0)
    module = importlib.import_module("mine")
    key = ResultKey(SCENARIO, "mine", module.Reloaded()).key
    monkeypatch.setattr(module, "shift", lambda: 1.0)
    assert ResultKey(SCENARIO, "mine", module.Reloaded()).key != key


TABLES = ["[{v}]", "{{'a': [{v}]}}['a']", "np.array([{v}])", "list(map(float, '{v}'.split()))"]
USES = {
    "name": "from helper import TABLE\ndef shift():\n    return TABLE[0]",
    "module": "import helper\ndef shift():\n    return helper.TABLE[0]",
}


def with_table(folder: Path, table: str, use: str, v: float) -> ib.Estimator:
    """Writes and imports a module whose estimator reads a table of numbers in another file."""
    (folder / "helper.py").write_text(f"import numpy as np\nTABLE = {table.format(v=v)}\n")
    (folder / "mine.py").write_text(MODULE.format(helper=USES[use]))
    importlib.invalidate_caches()
    for name in ("helper", "mine"):
        importlib.reload(importlib.import_module(name))
    return sys.modules["mine"].Reloaded()


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("table", TABLES)
def test_numbers_of_a_table_in_another_file_are_part_of_the_key(importing, table, use):
    keys = [
        ResultKey(SCENARIO, "mine", with_table(importing, table, use, v)).key
        for v in (0.0, 1000.0, 0.0)
    ]
    assert keys[0] == keys[2] != keys[1]


def test_a_file_is_part_of_the_key_though_what_it_fills_is_no_table(importing):
    keys = []
    for v in (0.0, 1000.0):
        table = "type('Object', (), {{'__getitem__': lambda *_: {v}}})()"
        keys.append(ResultKey(SCENARIO, "mine", with_table(importing, table, "name", v)).key)
    assert keys[0] != keys[1]


def test_a_cell_reaches_the_file_of_a_module_that_it_imports(importing):
    session = Session("estimator", "constant", 0.0)
    keys = []
    for v in (0.0, 1000.0):
        table = "type('Object', (), {{'__getitem__': lambda *_: {v}}})()"
        with_table(importing, table, "name", v)
        exec("import helper\ndef helped():\n    return helper.TABLE[0]", session.names)
        exec("class By:\n    def by(self):\n        return helped()", session.names)
        exec(KINDS["estimator"], session.names)
        keys.append(session.key())
    assert keys[0] != keys[1]


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("table", TABLES)
def test_a_table_that_is_changed_from_outside_is_part_of_the_key(importing, table, use):
    mine = with_table(importing, table, use, 0.0)
    key = ResultKey(SCENARIO, "mine", mine).key
    sys.modules["helper"].TABLE[0] = 1000.0
    assert ResultKey(SCENARIO, "mine", mine).key != key


CELLS = """
import sys
import types
import weakref
from dataclasses import dataclass
import ipe_bench as ib
from ipe_bench.runs.execution import Processes

SHIFT = 0.0

def helper():
    return SHIFT

@dataclass(frozen=True)
class Mine(ib.Estimator):
    def estimate(self, problem, z, *, history=False):
        found = ib.baselines.LinearLSE().estimate(problem, z)
        found.x = found.x + helper()
        return found

def make(shift):
    @dataclass(frozen=True)
    class Made(Mine):
        def estimate(self, problem, z, *, history=False):
            found = super().estimate(problem, z)
            found.x = found.x + shift
            return found
    return Made()

def show(**estimators):
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    ib.run(bench, estimators, 4, output="out", execution=Processes(2), block_size=2)
    rows = ib.load("out").set_index(["estimator", "trial"])["error_c0"]
    print(*(round(rows[label, 3]) for label in estimators))

if __name__ == "__main__":
    show(mine=Mine(), made=make(100.0))
    SHIFT = 1000.0
    show(mine=Mine(), made=make(100.0))
    def helper():
        return 2 * SHIFT
    show(mine=Mine(), made=make(200.0))
"""


@pytest.mark.slow
@pytest.mark.parametrize("given", ["file", "input", "argument"])
def test_classes_of_the_main_program_are_computed_by_workers_as_they_are_now(tmp_path, given):
    (tmp_path / "script.py").write_text(CELLS)
    arguments = {"file": ["script.py"], "input": ["-"], "argument": ["-c", CELLS]}[given]
    environment = {**os.environ, "PYTHONWARNINGS": "error::UserWarning"}
    options: dict = {
        "input": CELLS,
        "cwd": tmp_path,
        "env": environment,
        "capture_output": True,
        "text": True,
    }
    done = subprocess.run([sys.executable, *arguments], **options, check=False)
    assert done.stdout.split("\n")[:3] == ["0 100", "1000 1100", "2000 2200"], done.stderr


@pytest.mark.slow
def test_a_worker_that_imported_a_module_before_it_was_edited_does_not_compute_with_it(importing):
    found = []
    for v in (0.0, 1000.0):
        write(importing, "mine", v, apart=True)
        for name in ("helper", "mine"):
            importlib.reload(importlib.import_module(name))
        mine, folder = sys.modules["mine"].Reloaded(), importing / str(v)
        assert not compute([SCENARIO], {"mine": mine}, 4, folder, execution=Processes(1))
        found.append(ib.load(folder)["error_c0"].iloc[0])
    end_idle()
    assert found[1] == pytest.approx(found[0] + 1000)


def test_a_packaged_model_states_its_options_and_not_what_it_has_worked_out():
    model = ib.component("state_model/pendulum", count=5)
    stated = statement_of(model)
    ib.states.ekf().track(model, model.draw(0, 1).z)
    assert statement_of(model) == stated
    assert statement_of(dataclasses.replace(model)) == stated
    wide = statement_of(widened(model, 2.0))
    assert wide not in (None, stated, statement_of(widened(model, 3.0)))
    object.__setattr__(model, "start", {"angle": 0.1})
    assert statement_of(model) not in (None, stated)


def test_a_model_of_a_file_states_nothing_for_sure():
    @dataclasses.dataclass(frozen=True)
    class Own(ib.states.WalkingGins):
        pass

    assert statement_of(Own()) is None


def test_a_long_transition_is_recorded_again_only_where_its_model_has_changed(monkeypatch):
    model = ib.states.WalkingGins(steps=1)
    epochs = range(5)
    written = []
    record = ib.states.WalkingGins._written

    def watched(self, *arguments):
        written.append(self)
        return record(self, *arguments)

    monkeypatch.setattr(ib.states.WalkingGins, "_written", watched)
    first = model.recorded_numbers("transition", epochs)
    assert model.recorded_numbers("transition", epochs) is first
    assert len(written) == 1
    object.__setattr__(model.gins, "latitude_deg", 10.0)
    again = model.recorded_numbers("transition", epochs)
    assert len(written) == 2
    fresh = ib.states.WalkingGins(steps=1, gins=ib.measurements.Gins(latitude_deg=10.0))
    expected = fresh.recorded_numbers("transition", epochs)
    assert again.keys() == expected.keys()
    for form, found in again.items():
        np.testing.assert_array_equal(found.numbers, expected[form].numbers)
