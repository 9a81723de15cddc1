"""What is stored stays valid whatever is written about the code, and not one constant longer."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ipe_bench
from ipe_bench.basics.options import component_classes
from ipe_bench.measurements.polynomial import Polynomial
from ipe_bench.noise.kinds import Gaussian
from ipe_bench.runs import provenance
from ipe_bench.runs.provenance import numerical_code
from ipe_bench.trials.scenario import Scenario

KEYS = """
import ipe_bench as ib
from ipe_bench.runs.store import ResultKey
bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
named = {"ukf": ib.baselines.UKF(), "newton": ib.solvers.Newton(), "truth": None}
for name, estimator in named.items():
    print(name, ResultKey(bench, name, estimator).key)
walk = {"next": {"p": "p + w"}, "readings": {"z": "p"}, "noise": {"w": 1.0}}
model = ib.states.Formulas(**walk, deviation={"z": 0.5}, spread={"p": 3.0}, count=20)
track = ib.StateScenario(model)
for name, tracker in {"track": ib.states.ekf(), "path": None}.items():
    print(name, ResultKey(track, name, tracker).key)
"""


@pytest.fixture
def copy(tmp_path) -> Path:
    """A copy of the package to edit."""
    # With what is compiled of it: a module that is not edited is not compiled again.
    shutil.copytree(Path(ipe_bench.__file__).parent, tmp_path / "ipe_bench")
    return tmp_path


@pytest.fixture(scope="module")
def before() -> dict[str, str]:
    """The keys of the package as it is."""
    return keys(Path(ipe_bench.__file__).parents[1])


def said(code: str, copy: Path) -> str:
    """What that code prints in a process that has the copy."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, text=True, check=True
    ).stdout


def keys(copy: Path) -> dict[str, str]:
    return dict(line.split() for line in said(KEYS, copy).splitlines())


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text, f"{path.name} says {old} no more"
    path.write_text(text.replace(old, new), encoding="utf-8")


@pytest.mark.slow
def test_keys_do_not_depend_on_the_order_of_sets_or_of_files_in_a_folder(copy, monkeypatch):
    (copy / "ipe_bench/measurements/another.json").write_text("{}", encoding="utf-8")
    listed = (
        "from pathlib import Path; glob = Path.glob; Path.glob = lambda *a: iter(sorted(glob(*a),"
        " reverse={}))\n"
    )
    seen = set()
    for seed, reverse in (("1", False), ("2", True)):
        monkeypatch.setenv("PYTHONHASHSEED", seed)
        seen.add(said(listed.format(reverse) + KEYS, copy))
    assert len(seen) == 1


@pytest.mark.parametrize(
    ("room", "least"), [("trials", 10), pytest.param(".", 200, marks=pytest.mark.slow)]
)
def test_prose_edited_anywhere_leaves_every_key_as_it_was(copy, before, room, least):
    edited = 0
    for path in (copy / "ipe_bench" / room).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        new = (
            re.sub(r'^( *)"""', r'\1# A remark.\n\1"""In other words: ', text, flags=re.MULTILINE)
            + "\n# The end.\n"
        )
        try:
            ast.parse(new)
        except SyntaxError:  # an end of a docstring was taken for a beginning
            new = text + "\n# The end.\n"
        edited += new.count("In other words")
        path.write_text(new, encoding="utf-8")
    assert edited > least
    assert keys(copy) == before


def test_a_changed_constant_makes_stale_what_was_computed_with_it_and_nothing_else(copy, before):
    edit(copy / "ipe_bench/report/style.py", "\n", "\nUNSEEN = 3\n")
    edit(copy / "ipe_bench/basics/errors.py", "there is no such", "nobody knows such a")
    edit(
        copy / "ipe_bench/baselines/sequential.py",
        "import numpy as np\n",
        "import numpy as np\nFACTOR = 2\n",
    )
    after = keys(copy)
    assert {name for name in before if before[name] != after[name]} == {"ukf"}
    edit(copy / "ipe_bench/trials/thresholds.py", "SAME_ROOT = 1e-3", "SAME_ROOT = 2e-3")
    after = keys(copy)
    assert all(before[name] != after[name] for name in before)


@pytest.mark.slow
def test_a_change_to_states_that_move_makes_stale_what_is_computed_with_them_and_no_constants(
    copy, before
):
    # Filters of constants linearise as trackers do; bounds of states are those of a filter and of a
    # smoother, and where readings fold those of a grid, which is built on particles' densities.
    changed = {"states/linearisation.py": {"track", "path", "ukf"}}
    changed |= {"states/trackers.py": {"track", "path"}, "trials/paths.py": {"track", "path"}}
    changed |= {"states/smoothers.py": {"track", "path"}, "states/particles.py": {"track", "path"}}
    for module, stale in changed.items():
        edit(
            copy / "ipe_bench" / module, "import numpy as np\n", "import numpy as np\nFACTOR = 2\n"
        )
        after = keys(copy)
        assert {name for name in before if before[name] != after[name]} == stale
        before = after


def test_the_source_of_a_result_is_in_the_rooms_that_draw_estimate_and_score():
    modules = {cls.__module__ for cls in component_classes(Scenario(Polynomial(), Gaussian(0.01)))}
    covered = set[str]().union(
        *map(provenance._import_closure, ["ipe_bench.trials.scoring", *modules])
    )
    rooms = {module.split(".")[1] for module in covered}
    assert rooms == {
        "basics",
        "engine",
        "functions",
        "measurements",
        "noise",
        "priors",
        "estimators",
        "solvers",
        "trials",
    }
    assert {"ipe_bench.trials.scenario", "ipe_bench.measurements.polynomial"} <= covered


def code(source: str) -> str:
    return numerical_code(ast.parse(source))


# fmt: off
OTHERS = [
    ("x = 1", "x = 2"), ("x = 1", "x = 1.0"), ("x = None", "x = ..."), ("x = 'a'", "x = 'b'"),
    ("x = []", "x = [None]"),
    ("raise ValueError('a')", "raise KeyError('a')"), ("raise E(1)", "raise E(2)"),
    ("f(a, b)", "f(b, a)"),
    ("f(a, k=b)", "f(a, b)"), ("def f(a=1): pass", "def f(*, a=1): pass"),
    ("x + y - z", "x + (y - z)"),
    ("if a: b\nc", "if a:\n  b\n  c"),
]
# fmt: on


@pytest.mark.parametrize(("one", "other"), OTHERS)
def test_whatever_can_change_a_number_is(one, other):
    assert code(one) != code(other)


SCRIPT = """
from dataclasses import dataclass
import ipe_bench as ib

FACTOR = 2.0

@dataclass(frozen=True)
class Scaled(ib.baselines.LinearLSE):
    def estimate(self, problem, z, *, history=False):
        estimates = super().estimate(problem, z)
        estimates.x = FACTOR * estimates.x
        return estimates

bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
ib.run(bench, {"scaled": Scaled()}, 5, output="out")
print(ib.status("out")["stale"].sum())
"""


@pytest.mark.slow
@pytest.mark.parametrize("given", ["file", "input"])
def test_an_estimator_can_stand_in_a_script_and_what_it_computed_before_an_edit_is_stale(
    tmp_path, given
):
    def stale(text: str) -> int:
        (tmp_path / "script.py").write_text(text, encoding="utf-8")
        command = [sys.executable, *(["script.py"] if given == "file" else ["-"])]
        options = {"cwd": tmp_path, "capture_output": True, "text": True, "check": True}
        return int(subprocess.run(command, input=text, **options).stdout)

    assert stale(SCRIPT) == 0
    assert stale(SCRIPT + "# a remark") == 0
    assert stale(SCRIPT.replace("FACTOR = 2.0", "FACTOR = 3.0")) == 5


@pytest.mark.slow
def test_a_base_class_in_another_module_is_part_of_the_source(copy):
    edit(
        copy / "ipe_bench/baselines/least_squares.py",
        "import annotations\n",
        "import annotations\nFACTOR = 2\n",
    )
    (copy / "mine.py").write_text(
        "from dataclasses import dataclass\nimport ipe_bench as ib\n"
        "@dataclass(frozen=True)\nclass Mine(ib.baselines.LinearLSE):\n    pass\n",
        encoding="utf-8",
    )
    code = (
        "from mine import Mine; from ipe_bench.runs.provenance import fingerprint;"
        " print(fingerprint([Mine()]))"
    )
    before = said(code, copy)
    edit(copy / "ipe_bench/baselines/least_squares.py", "FACTOR = 2", "FACTOR = 3")
    assert said(code, copy) != before


def test_what_is_kept_of_our_sources_is_read_anew_after_an_edit(tmp_path, monkeypatch):
    """Even of one that leaves size and time as they were, as an installation may."""
    monkeypatch.setenv("IPE_BENCH_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "room.py"
    monkeypatch.setattr(provenance, "_file_of", lambda module: file)
    file.write_text("import ipe_bench.noise\nA = 1\n")
    about = file.stat()

    def found() -> tuple[str, frozenset[str]]:
        provenance._source_when.cache_clear()
        return provenance._source_of("ipe_bench.room")

    first = found()
    assert first[1] == {"ipe_bench.noise"}
    with monkeypatch.context() as patch:
        patch.setattr(provenance.ast, "parse", None)
        assert found() == first
    file.write_text("import ipe_bench.noise\nA = 2\n")
    os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns))
    assert file.stat().st_size == about.st_size
    assert found()[0] != first[0]
    provenance._source_when.cache_clear()
