"""What a terminal of 80 or 120 columns shows: names are whole, and nothing is cut."""

import io
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from rich.console import Console
from shared.synthetic_store import Synthetic

import ipe_bench as ib
import ipe_bench.cli
from ipe_bench.cli.main import main
from ipe_bench.report import figures
from ipe_bench.report.tables.table import terminal
from ipe_bench.states import Formulas, ekf

WIDTHS = (80, 120)
SHORT = ("linear_lse", "fixed_point", "levenberg_marquardt", "scipy_least_squares")
LONG = "progressive_with_windows_and_restarts_of_a_very_long_name"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two folders of a sweep over scale and noise, one of which lacks some trials."""
    rng = np.random.default_rng(0)
    found = []
    for name, factor in (("a", 1.0), ("b", 1.3)):
        store = Synthetic(tmp_path_factory.mktemp(name) / name)
        for scale in (1.0, 1000.0):
            for sigma in (0.2, 0.4):
                for label in (*SHORT, LONG):
                    store.add(
                        store.scenario(error_scale=scale, sigma=sigma),
                        label,
                        factor * rng.normal(size=(30, 3)),
                    )
        store.record(30 if name == "a" else 40)
        found.append(str(store.directory))
    return found


@pytest.fixture(params=WIDTHS)
def screen(request, monkeypatch, capsys):
    """Runs a command on a screen of that width: its lines but for those that are left to the
    terminal to fold."""
    monkeypatch.setattr(ipe_bench.cli, "_WIDTH_WITHOUT_TERMINAL", request.param)
    monkeypatch.setattr(figures, "FIGURES", ())

    def run(*words: str) -> list[str]:
        main(list(words))
        lines = capsys.readouterr().out.splitlines()
        folded = ("worse: ", "missing: ", "Summary", "Tables", "Figures", "Report", "/")
        kept = [line for line in lines if not line.startswith(folded)]
        assert max(map(len, kept)) <= request.param
        assert not any("…" in line for line in kept)
        return kept

    return run


def rows(lines: list[str], name: str) -> int:
    return sum(name in line.split() for line in lines)


def unfolded(lines: list[str]) -> list[str]:
    """The long name as often as it stands there, put together from the lines that it is folded
    into."""
    found, folded = [], False
    for line in lines:
        begun = [word for word in line.split() if LONG.startswith(word) and len(word) > 10]
        folded = bool(begun) or (folded and len(line.split()) == 1)
        if folded:
            found += begun or [found.pop() + line.strip()]
    return found


@pytest.mark.slow
def test_a_report_of_many_settings_takes_two_screens_and_names_what_is_left_out(capsys, tmp_path):
    store, rng = Synthetic(tmp_path / "many"), np.random.default_rng(0)
    for sigma in range(1, 9):
        for scale in (1.0, 3.0, 10.0, 30.0, 100.0):
            for label in SHORT[:2]:
                store.add(
                    store.scenario(error_scale=scale, sigma=0.1 * sigma),
                    label,
                    rng.normal(size=(30, 3)),
                )
    store.record(30)
    assert main(["report", str(store.directory)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 60
    titles = sum("30 trials per row" in line for line in lines)
    # Each has a table of its two estimators at one scale.
    shown = 2 * titles
    left_out = (
        f"{80 - shown} of 80 rows are not shown here, {8 - titles} of 8 settings whole; summary.csv"
        " and"
    )
    assert any(line.startswith(left_out) for line in lines)
    drawn = set((store.directory / "figures").glob("headline_*.png"))
    without = f"{8 - len(drawn)} further settings are in the tables; figures=all draws 6 of the 8"
    assert any(line.startswith("Figures") and without in line for line in lines)
    assert without in (store.directory / "report.html").read_text(encoding="utf-8")


def test_a_report_names_every_estimator_of_every_scenario(screen, folders, tmp_path):
    lines = screen("report", folders[0], f"output={tmp_path / 'out'}")
    for name in SHORT:
        assert rows(lines, name) == 4
    assert unfolded(lines).count(LONG) == 4
    assert any("deviation=0.4" in line for line in lines)


@dataclass(frozen=True)
class Unfinished(ib.baselines.EKF):
    def track(self, P0, Q, z):
        raise AttributeError("no such thing")


def test_a_report_tells_which_exception_ended_the_trials(capsys, tmp_path):
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    ib.run(bench, {"mine": Unfinished()}, trials=4, output=str(tmp_path))
    assert main(["report", str(tmp_path), "figures=none"]) == 1  # all of them
    lines = capsys.readouterr().out.splitlines()
    assert "mine: 4 trials ended by an exception: AttributeError: no such thing" in lines


def test_status_names_every_estimator_and_each_scenario_once(screen, folders):
    lines = screen("status", folders[1], "-v")
    for name in SHORT:
        assert rows(lines, name) == 4
    assert sum("30 of 40" in line for line in lines) == 24


def test_a_comparison_names_who_and_which_setting(screen, folders):
    text = " ".join(" ".join(screen("compare", *folders)).split())
    for name in (*SHORT, LONG):
        assert text.count(f": {name};") == 4
    assert text.count("noise.deviation 0.4") == 10


def test_lists_name_every_option(screen):
    lines = screen("list", "baseline")
    for name in ("linear_lse", "levenberg_marquardt", "multiscale_lm", "iterated_ekf"):
        assert rows(lines, name) == 1


def test_the_list_of_all_begins_with_five_to_start_with(screen):
    lines = [line for line in screen("list") if line.strip()]
    named = re.findall(r"^ (\w+/\w+) ", "\n".join(lines), re.MULTILINE)
    assert lines[0].strip() == "start here"
    assert len(named) == 5
    assert {"measurement/function", "solver/auto", "tracker/auto"} <= set(named)


@pytest.fixture(scope="module")
def answer():
    model = ib.measurements.Polynomial()
    z = ib.Scenario(model, ib.noise.Gaussian(0.01), error_scale=3.0).draw(0, 1).z[0]
    estimators = {
        "levenberg_marquardt": ib.baselines.LevenbergMarquardt(),
        LONG: ib.solvers.Newton(),
    }
    return ib.estimate(model, z, estimators, noise=ib.noise.Gaussian(0.01))


@pytest.mark.parametrize("width", WIDTHS)
def test_an_answer_names_every_estimator(answer, width):
    out = io.StringIO()
    Console(file=out, width=width).print(terminal(answer.parts(), width))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert not re.search(r"\w…", out.getvalue())  # a range has blanks around it
    assert "levenberg_marquardt" in out.getvalue()
    assert LONG[-8:] in out.getvalue()


def test_headings_name_models_and_what_differs_beside_their_names():
    """Two models of their own steps, one of which has two deviations as well."""
    fields = {"next": {"x": "x + w"}, "noise": {"w": 0.1}, "readings": {"z": "x"}, "count": 3}
    models = [
        Formulas(**fields, deviation={"z": 0.1}, spread={"x": 1.0}, title=title, step=step)
        for title, step in (("slow", 2.0), ("fast", 0.5))
    ]
    sharp = replace(models[0], deviation={"z": 0.2})
    tables = [
        str(ib.run(some, {"kf": ekf()}, 2, progress=False)) for some in (models, [*models, sharp])
    ]
    headings = [re.findall(r"^ ?(\S.*): 2 trials per row", table, re.MULTILINE) for table in tables]
    assert headings[0] == ["fast, model", "slow, model"]
    assert headings[1] == [
        "fast, model, model.deviation.z=0.1",
        "slow, model, model.deviation.z=0.1",
        "slow, model, model.deviation.z=0.2",
    ]


@pytest.mark.slow
def test_the_table_of_a_sweep_shows_the_largest_scale_at_which_half_may_hold(tmp_path, capsys):
    """At the least scale, where all are alike, nothing is told."""
    store, rng = Synthetic(tmp_path / "half"), np.random.default_rng(0)
    for scale in (1.0, 10.0, 100.0):
        for label, fails_from in zip(SHORT[:2], (10.0, 100.0), strict=True):
            error = 0.1 * rng.normal(size=(30, 3)) + 9.0 * (scale >= fails_from)
            store.add(store.scenario(error_scale=scale), label, error)
    store.record(30)
    assert main(["report", str(store.directory)]) == 0
    assert "30 trials per row at error scale 10\n" in capsys.readouterr().out
