"""Every kind of plugin that `new` makes works, and one that does not is named and leaves the rest
as it was."""

import hashlib
import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shared.small_models import Bent

from ipe_bench import Scenario, check
from ipe_bench.cli.main import main
from ipe_bench.noise import Gaussian
from ipe_bench.plugins import discovery
from ipe_bench.priors import Prior
from ipe_bench.questions.posterior.maths import reference
from ipe_bench.report import figures
from ipe_bench.runs.execution import Event, Execution, Serial
from ipe_bench.statistics.registry import add_statistics
from ipe_bench.workshop.conformance import check_component
from ipe_bench.workshop.kinds import KINDS, RECORDS

SMALL = ("measurement=polynomial", "noise=gaussian", "trials=8", "execution=serial", "output=out")
MAIN = "figures=main"
GROUPS = {"filter": "baseline"}
"""The config groups of kinds with other names."""
OURS = ("costs",)
"""Of our figures, one is enough to see whether it stays as it is."""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """A working folder of its own, whose plugins are forgotten afterwards."""
    before = dict(sys.modules)
    monkeypatch.setattr(figures, "FIGURES", OURS)
    path = list(sys.path)
    monkeypatch.setenv("PYTHONPATH", "")
    monkeypatch.chdir(tmp_path)
    discovery.sources.cache_clear()
    yield tmp_path
    monkeypatch.undo()
    sys.path[:] = path
    for name in set(sys.modules) - set(before):
        if name.startswith("ipe_bench_"):
            del sys.modules[name]
    discovery._added.clear()
    discovery.sources.cache_clear()
    add_statistics([])


def write(kind: str, name: str, source: str, plugin: str | None = None) -> None:
    """A record whose module is the source, in that plugin or in one of its own."""
    plugin = plugin or name
    package = Path("plugins") / plugin / f"ipe_bench_{plugin}"
    (package / "conf" / kind).mkdir(parents=True, exist_ok=True)
    (package / "__init__.py").write_text("")
    (package / f"{name}.py").write_text(source)
    target = f"{package.name}.{name}.{RECORDS[kind]}"
    (package / "conf" / kind / f"{name}.yaml").write_text(f"# One.\n_target_: {target}\n")
    discovery.sources.cache_clear()


def edit_figure(name: str, *changes: tuple[str, str]) -> None:
    """Counts a new figure among the main ones, and changes its source in other ways."""
    module = Path("plugins") / name / f"ipe_bench_{name}" / f"{name}.py"
    source = module.read_text()
    for old, new in (
        ('Figure(draw, ("summary",))', 'Figure(draw, ("summary",), main=True)'),
        *changes,
    ):
        assert old in source
        source = source.replace(old, new)
    module.write_text(source)
    discovery.sources.cache_clear()


def files(folder: str) -> dict[str, str]:
    """The digests of the tables and figures of a report."""
    paths = [path for part in ("tables", "figures") for path in Path(folder, part).iterdir()]
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in paths
        if path.name != "index.json"
    }


DEAR = ("figure", "table", "section", "experiment", "filter", "statistic")
"""Each draws a report, as `test_a_report_has_what_plugins_add_beside_all_that_is_ours` does of all
of them at once, or runs many trials."""


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.slow if k in DEAR else ()) for k in KINDS]
)
def test_what_new_makes_passes_its_checks(kind, capsys):
    assert main(["new", kind, "mine"]) == 0
    assert ("figures=all" in capsys.readouterr().out) == (
        kind == "figure"
    )  # the main ones do not hold a new figure
    assert main(["check", "plugins/mine"]) == 0
    out = capsys.readouterr().out
    assert f"ok     {GROUPS.get(kind, kind)}=mine: " in out
    assert "all checks passed" in out
    assert re.search(
        r'^-      mine.yaml: Describes itself -- line \d still says "One line that',
        out,
        re.MULTILINE,
    )


def test_a_report_has_what_plugins_add_beside_all_that_is_ours(ours, capsys):
    before = ours
    for kind in RECORDS:
        assert main(["new", kind, f"own_{kind}"]) == 0
    edit_figure("own_figure")
    assert main(["report", "out", MAIN]) == 0
    page = Path("out/report.html").read_text(encoding="utf-8").replace("<wbr>", "")
    summary = pd.read_csv("out/summary.csv")
    trials = pd.concat([summary["own_statistic"], summary["rmse_solved"]], axis=1)
    assert (trials["own_statistic"] >= trials["rmse_solved"]).all()
    for text in ("own_statistic", "What own_section says", "figure-own_figure", "table-own_table"):
        assert text in page
    after = files("out")
    added = {"own_figure.png"}
    added |= {f"own_{kind}.csv" for kind in ("table", "section")}
    assert set(after) - set(before) == added
    # A statistic stands in the tables that it names; no other table or figure has changed.
    changed = {name for name in before if before[name] != after[name]}
    assert {name.partition(".")[0] for name in changed} <= {"parameters", "costs"}
    capsys.readouterr()
    stamp = Path("out/report.html").stat().st_mtime_ns
    assert main(["report", "out", MAIN]) == 0
    assert Path("out/report.html").stat().st_mtime_ns == stamp
    # The code of a plugin is part of what a report is made from.
    module = Path("plugins/own_figure/ipe_bench_own_figure/own_figure.py")
    module.write_text(module.read_text() + "\n# changed\n")
    assert main(["report", "out", MAIN]) == 0
    assert Path("out/report.html").stat().st_mtime_ns > stamp


RAISING = {
    "statistic": (
        "from ipe_bench.statistics.records import Statistic\ndef f(s):\n    raise"
        " ValueError('broken')\nSTATISTIC = Statistic('bad_statistic', 'bad', 'all trials', '',"
        " f)\n"
    ),
    "figure": (
        "from ipe_bench.report.figures.views import Figure\ndef f(view):\n    raise"
        " ValueError('broken')\n    yield\nFIGURE = Figure(f, ('summary',), main=True)\n"
    ),
    "table": "def table(analysis):\n    raise ValueError('broken')\n",
    "section": (
        "from ipe_bench.report.sections import Section\ndef f(analysis):\n    yield 'so far'\n   "
        " raise ValueError('broken')\nSECTION = Section('Bad', f)\n"
    ),
}


@pytest.fixture(scope="module")
def reported(tmp_path_factory) -> Path:
    """A folder with a report without any plugin."""
    place = tmp_path_factory.mktemp("reported")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setattr(figures, "FIGURES", OURS)
        discovery.sources.cache_clear()
        assert main(["run", *SMALL, MAIN]) == 0
    discovery.sources.cache_clear()
    return place / "out"


@pytest.fixture
def ours(reported) -> dict[str, str]:
    """The report without any plugin, in this folder."""
    shutil.copytree(reported, "out")
    return files("out")


@pytest.mark.slow
def test_those_that_raise_are_named_and_the_rest_is_whole(ours, capsys):
    for kind in RECORDS:
        write(kind, f"bad_{kind}", RAISING[kind], plugin="bad")
    for _ in range(2):
        capsys.readouterr()
        assert main(["report", "out", MAIN]) == 1
        lines = capsys.readouterr().err.splitlines()
        assert {line.partition(": ")[2].partition(": ")[0] for line in lines} == {
            f"{k}=bad_{k}" for k in RECORDS
        }
        assert len(lines) == len(RECORDS)
        assert all(line.startswith("ipe-bench: ") and "broken" in line for line in lines)
    after = files("out")
    assert {name for name in ours if after.get(name) != ours[name]} <= {
        "parameters.csv",
        "costs.csv",
    }
    assert set(after) == set(ours)
    complaints = {
        finding.component for finding in check("plugins/bad") if "broken" in finding.complaint
    }
    assert complaints == {f"{kind}=bad_{kind}" for kind in RECORDS}


@pytest.mark.slow
def test_a_figure_under_the_name_of_ours_is_left_out_and_ours_stays(ours, capsys):
    main(["new", "figure", "mine"])
    edit_figure("mine", ('fig, "mine"', 'fig, "cost_against_accuracy"'))
    capsys.readouterr()
    assert main(["report", "out", MAIN]) == 1
    assert (
        "figure=mine: there is a figure cost_against_accuracy already; it is left out"
        in capsys.readouterr().err
    )
    assert files("out") == ours


STATISTIC = """
from ipe_bench.statistics.records import Statistic
STATISTIC = Statistic({!r}, "mine", "all trials", "Mine.", lambda s: {}{})
"""


FAULTY = {
    "other": (STATISTIC.format("rmse", "1.0", ""), "is called rmse; give file and record one name"),
    "text": (STATISTIC.format("text", "'one'", ""), "a value is a str; return a float"),
    "short": (
        STATISTIC.format("short", "s.sizes", ""),
        "has 4 values; return one, or one for each of 4 parameters",
    ),
    "colour": (STATISTIC.format("colour", "1.0", ", kind='colour'"), "kind=colour: choose from"),
    "nowhere": (
        STATISTIC.format("nowhere", "1.0", ", where=('nowhere',)"),
        "where=nowhere: choose from",
    ),
    "number": ("STATISTIC = 3\n", "is a int and not a Statistic"),
    "library": ("import nothing_like_it\n", "nothing_like_it"),
    "syntax": ("def f(:\n", "SyntaxError"),
}


@pytest.mark.slow
def test_faulty_statistics_are_found():
    for name, (source, _) in FAULTY.items():
        write("statistic", name, source, plugin="bad")
    complaints = [
        (finding.component, finding.complaint)
        for finding in check("plugins/bad")
        if finding.complaint
    ]
    assert sorted(name for name, _ in complaints) == sorted(f"statistic={name}" for name in FAULTY)
    for component, complaint in complaints:
        assert FAULTY[component.removeprefix("statistic=")][1] in complaint


DRAWS = {
    "flat": lambda x0, scale, rng: x0 + np.sqrt(3) * scale * rng.uniform(-1, 1, len(x0)),
    "wide": lambda x0, scale, rng: x0 + 1.1 * scale * rng.standard_normal(len(x0)),
    "shifted": lambda x0, scale, rng: x0 + 0.1 * scale + scale * rng.standard_normal(len(x0)),
    "common": lambda x0, scale, rng: x0 + scale * rng.standard_normal(),
}


@dataclass(frozen=True)
class Faulty(Prior):
    """Says that it draws independent normal numbers."""

    draws: str = "flat"
    power: float = 1.0

    def deviation(self, n, error_scale):
        return np.full(n, error_scale**self.power)

    def draw(self, x0, error_scale, rng):
        return DRAWS[self.draws](x0, error_scale, rng)


@dataclass(frozen=True)
class Swallowing(Execution):
    """Takes what is raised for the end."""

    def run(self, work, tasks):
        for index, task in enumerate(tasks):
            try:
                for step in work(task):
                    yield Event(index, step)
            except Exception:
                pass
            yield Event(index, ended=True)


@dataclass(frozen=True)
class Hasty(Execution):
    """Does not tell of steps."""

    def run(self, work, tasks):
        yield from (event for event in Serial().run(work, tasks) if event.ended)


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (Faulty(), "the draws are not normal"),
        (Faulty("wide"), "have 1.1 times the stated deviation"),
        (Faulty("shifted"), "the mean of the draws is off by up to 0.09"),
        (Faulty("common"), "have the correlation 0.99, and 0.00 is stated"),
        (Faulty(power=0.0), "at ten times the error scale"),
        (
            Swallowing(),
            "of task 1 it reports step 0, step 1, end; right is step 0, step 1, a Failure"
            " ValueError: wrong",
        ),
        (Hasty(), "of task 0 it reports end; right is step 0, step 1, step 2, end"),
    ],
    ids=repr,
)
def test_a_faulty_prior_or_execution_is_found(faulty, complaint):
    assert complaint in " ".join(finding.complaint for finding in check_component("mine", faulty))


def test_the_posterior_is_not_sampled_under_a_prior_that_is_not_normal():
    from ipe_bench.basics.errors import UserError

    class Uniform(Faulty):
        normal = False

    with pytest.raises(UserError, match="prior=uniform: is not normal"):
        reference(Scenario(Bent(0.02), Gaussian(0.1), Uniform()), {}, 0)
