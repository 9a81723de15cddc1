"""`import ipe_bench as ib` is enough for all that the command line does, and costs nothing until it
is used."""

import doctest
import inspect
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench import api
from ipe_bench.plugins import discovery
from ipe_bench.runs.store import ResultKey

HEAVY = ("pandas", "matplotlib", "seaborn", "hydra", "omegaconf", "filterpy", "llvmlite", "rich")
FUNCTIONS = (
    "audit",
    "check",
    "compare",
    "component",
    "design",
    "estimate",
    "load",
    "posterior",
    "report",
    "run",
    "status",
)


@pytest.mark.parametrize(
    "use", ["pass", "ib.Scenario, ib.Status, ib.UserError, ib.Estimator", "ib.noise.Gaussian"]
)
def test_nothing_heavy_is_imported_until_it_is_used(use):
    script = (
        f"import sys, ipe_bench as ib\n{use}\nprint(*[name for name in {HEAVY} if name in"
        " sys.modules])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    ).stdout
    assert loaded.split() == []


def test_every_public_name_is_there_and_explains_itself():
    for name in ib.__all__:
        thing = getattr(ib, name)
        assert name == "__version__" or inspect.getdoc(thing), name


CONTRACTS = {
    place: resolve_name(place) for places in discovery.CONTRACTS.values() for place in places
}


@pytest.mark.parametrize("place", CONTRACTS)
def test_a_contract_says_what_is_required_optional_and_promised(place):
    words = re.findall(r"\b(Required|Optional|Promised)\b", CONTRACTS[place].__doc__)
    assert words == ["Required", "Optional", "Promised"]


PUBLIC = {f"ipe_bench.{name}" for name in ib.__all__} - {"ipe_bench.__version__"}


def parts() -> list[str]:
    """The classes that users construct by name: estimators, trackers, rules, state models and
    noises."""
    states = (ib.states.Tracker, ib.states.StateModel, ib.states.Taylor.__base__)
    kinds = (ib.Estimator, ib.Noise, *states)
    return [
        f"ipe_bench.{room.__name__.rpartition('.')[2]}.{name}"
        for room in (ib.solvers, ib.baselines, ib.states, ib.noise)
        for name in room.__all__
        if isinstance(thing := getattr(room, name), type)
        if issubclass(thing, kinds) and not inspect.isabstract(thing)
    ]


@pytest.mark.parametrize("place", parts())
def test_the_example_of_a_part_comes_out_as_it_says(place):
    thing = resolve_name(place)
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder(recurse=False).find(thing, place):
        runner.run(test)
    assert runner.summarize(verbose=False).failed == 0
    assert ">>> " in thing.__doc__, f"{place} has no example"


@pytest.mark.parametrize("place", sorted(PUBLIC | {*CONTRACTS}))
def test_the_examples_in_the_docstrings_come_out_as_they_say(place):
    name = place.removeprefix("ipe_bench.")
    thing = getattr(api, name, None) or CONTRACTS.get(place) or getattr(ib, name)
    options = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    runner = doctest.DocTestRunner(optionflags=options)
    found = doctest.DocTestFinder(recurse=False).find(thing, name)
    for test in found:
        runner.run(test)
    counts = runner.summarize(verbose=False)
    assert counts.failed == 0
    needed = name in FUNCTIONS or (
        place in CONTRACTS and name != "ConstantFilter"
    )  # which a `Sequential` makes
    assert counts.attempted > 0 or not needed, f"{place} has no example"


@pytest.mark.slow
def test_the_python_of_the_readme_runs_as_it_stands(tmp_path, monkeypatch):
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    (function,) = re.findall(r"cat > oxygen\.py <<'END'\n(.*?)\n    END", readme, re.DOTALL)
    (tmp_path / "oxygen.py").write_text(textwrap.dedent(function), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names: dict = {}
    exec(code, names)
    del sys.modules["oxygen"]
    assert set(names["table"]["estimator"]) == {"auto", "multistart", "iplf"}
    # As the command above it has answered, and R's nls.
    fit = names["fits"][0]
    assert fit.values == pytest.approx({"b1": 19.1426, "b2": 0.5311}, rel=1e-4)
    deviations = np.sqrt(np.diag(fit.covariance))
    assert deviations == pytest.approx([2.4959, 0.2031], rel=1e-3)


@pytest.fixture(scope="module")
def polynomial() -> ib.Scenario:
    return ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)


def test_rows_of_trials_say_what_they_belong_to(tmp_path, polynomial):
    bent = ib.Scenario(
        ib.measurements.Polynomial(strength=0.001), ib.noise.Gaussian(0.01), error_scale=3.0, seed=1
    )
    estimators = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
    ib.run([polynomial, bent], estimators, 12, output=tmp_path, block_size=5)
    rows = ib.load(tmp_path)
    assert len(rows) == 2 * 2 * 12
    belongs = [
        "measurement",
        "noise",
        "error_scale",
        "seed",
        "estimator",
        "measurement.strength",
        "trial",
    ]
    assert not rows[belongs].isna().any().any()
    order, few = [*rows.columns], [*rows.columns[rows.isna().mean() > 0.5]]
    assert {*order[: len(belongs) + 1]} == {*belongs, "prior"}
    assert order[len(belongs) :][:5] == ["trial", "status", "success", "solved", "error_c0"]
    assert order[-len(few) :] == few
    assert not rows.duplicated(belongs).any()
    assert rows.groupby("seed")["measurement.strength"].unique().map(list).to_dict() == {
        0: [0.005],
        1: [0.001],
    }
    drawn = polynomial.draw(0, 12).x
    found = rows[(rows["estimator"] == "newton") & (rows["seed"] == 0)].sort_values("trial")
    names = [p.name for p in polynomial.measurement.parameters]
    np.testing.assert_array_equal(found[[f"x_{name}" for name in names]], drawn)
    estimates = ib.solvers.Newton().estimate(polynomial.problem, polynomial.draw(0, 12).z)
    np.testing.assert_array_equal(found[[f"error_{name}" for name in names]], estimates.x - drawn)


def test_a_file_and_an_array_are_estimated_alike(tmp_path, polynomial):
    from ipe_bench.real.readings import write_readings

    z = polynomial.draw(0, 1).z[0]
    z[3] = np.nan
    write_readings(tmp_path / "z.csv", polynomial.measurement, z)
    chosen = {"lm": ib.baselines.LevenbergMarquardt()}
    for readings in (tmp_path / "z.csv", str(tmp_path / "z.csv")):
        (of_file,) = ib.estimate(polynomial.measurement, readings, chosen, noise=polynomial.noise)
        (of_array,) = ib.estimate(polynomial.measurement, z, chosen, noise=polynomial.noise)
        np.testing.assert_array_equal(of_file.x, of_array.x)


def chosen(words, standard=()):
    from ipe_bench.cli.single import single

    return single("estimate", [*words, "readings=z.csv"], standard).spec.estimators


def test_without_estimators_they_are_those_of_the_command(polynomial):
    from ipe_bench.cli.estimate import standard_words

    command = chosen(["measurement=polynomial"], standard_words([]))
    fits = ib.estimate(polynomial.measurement, polynomial.draw(0, 1).z[0], noise=polynomial.noise)
    assert {fit.label: fit.estimator for fit in fits} == command
    assert [fit.label for fit in fits] == [*command]


@pytest.mark.parametrize("find", [[], ["noise.w"]])
def test_without_trackers_they_are_those_of_the_command(monkeypatch, find):
    from ipe_bench.cli.estimate import standard_words
    from ipe_bench.real import logs

    words = ["find=noise.w"] if find else []
    command = chosen(["state_model=growth"], standard_words(words))
    used = {}

    def note(log, label, tracker, *_):
        used[label] = tracker
        return [None]

    monkeypatch.setattr(logs.LogTracks, "of", note)
    monkeypatch.setattr(logs, "found_and_tracked", note)
    model = ib.component("state_model/growth", count=3)
    ib.estimate(model, np.ones((3, 1)), find=find)
    assert used == command
    assert [*used] == [*command]


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        ((np.zeros(3),), {}, "give the 40 readings"),
        (("nowhere.csv",), {}, "no such file"),
        ((np.zeros(40), {"map": ib.baselines.MapLM()}), {}, "needs a prior"),
        ((np.full(40, np.nan),), {}, "all are missing"),
        ((np.full(40, np.inf),), {}, "inf is not a reading"),
        ((np.full(40, 1j),), {}, "are complex; give real numbers"),
        ((np.zeros(40),), {"noise": 0.1}, "noise: 0.1 is none; give one such as ib.noise"),
    ],
)
def test_mistakes_in_an_estimate_are_one_line(polynomial, arguments, options, words):
    with pytest.raises(ib.UserError, match=words):
        ib.estimate(polynomial.measurement, *arguments, **options)


def test_numbers_in_a_list_are_readings_as_in_an_array(polynomial):
    z = polynomial.draw(0, 1).z[0]
    chosen = {"lse": ib.baselines.LinearLSE()}
    (of_array,) = ib.estimate(polynomial.measurement, z, chosen, noise=polynomial.noise)
    (of_list,) = ib.estimate(polynomial.measurement, z.tolist(), chosen, noise=polynomial.noise)
    np.testing.assert_array_equal(of_list.x, of_array.x)


def test_numbers_and_choices_that_cannot_be_are_refused(polynomial):
    newton = {"newton": ib.solvers.Newton()}
    odd: dict[str, Any] = {"trials": 2.5, "seed": 1.5, "criterion": "Q"}
    with pytest.raises(ib.UserError, match=r"trials=2\.5: give a whole number"):
        ib.run(polynomial, newton, odd["trials"])
    with pytest.raises(ib.UserError, match=r"seed=1\.5"):
        ib.run(polynomial, newton, 2, seed=odd["seed"])
    with pytest.raises(ib.UserError, match="criterion=Q: choose A or D"):
        ib.design(polynomial, criterion=odd["criterion"])


def test_status_and_report_agree_and_the_report_is_still_a_function_afterwards(
    tmp_path, polynomial
):
    ib.run(polynomial, {"newton": ib.solvers.Newton()}, 10, output=tmp_path, block_size=5)
    assert ib.status(tmp_path).attrs["problems"] == []
    newton = ResultKey(polynomial, "newton", ib.solvers.Newton())
    (tmp_path / "trials" / f"{newton.key}-0-10.parquet").unlink()
    problems = ib.status(tmp_path).attrs["problems"]
    assert len(problems) == 1
    for _ in range(2):  # the second call finds the room `report` where the function was
        result = ib.report(tmp_path, tmp_path / "elsewhere", figures="none")
        assert list(result.problems) == problems
    assert result.report == tmp_path / "elsewhere" / "report.html"
    with pytest.warns(UserWarning, match="missing"):
        ib.load([tmp_path])


def test_a_component_is_what_the_command_line_constructs():
    assert ib.component("solver/newton", max_iterations=20) == ib.solvers.Newton(max_iterations=20)
    assert ib.component("noise/gaussian", deviation=0.1) == ib.noise.Gaussian(0.1)
    # A mapping changes the keys that it has, and an option stands on the options that its defaults
    # name.
    pendulum = ib.component("state_model/pendulum", spread={"rate": 0.3})
    assert pendulum.spread == {"angle": 1.0, "rate": 0.3}
    book = ib.component("tracker/ekf_rts")
    assert book == ib.states.Smoother(ib.states.ekf())
    with pytest.raises(ib.UserError, match="did you mean state_model/pendulum"):
        ib.component("state_model/pendulom")
    with pytest.raises(ib.UserError, match=r"solver\.newton.*max_iter"):
        ib.component("solver/newton", max_iter=20)
