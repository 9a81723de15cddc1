"""Comparisons that the site shows contain the strongest of each family: who that is, stored results
say."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from gallery_frames import SUFFIX, read
from make_docs import STORED

import ipe_bench as ib
from ipe_bench.basics.files import own_conf
from ipe_bench.plugins.standard import OF_OWN
from ipe_bench.report.finding import Finding
from ipe_bench.statistics.records import family_of

ROOT = Path(__file__).parents[2]
EXPERIMENTS = own_conf() / "experiment"
APART = {
    "paper": "the paper's two estimates, which its title counts",
    "nist": "certified readings, without a prior for filters",
    "pendulum_book": "published errors of twelve trackers",
}
"""Experiments that compare nobody else, and why."""


def strongest(experiment: str, column: str) -> dict[str, str]:
    """Returns the best estimator of the stored experiment in each family, or by what it is given,
    as the finding ranks them."""
    analysis = read(STORED / f"{experiment}{SUFFIX}").analysis
    footers = {one.estimator: one.footer for one in analysis.collection.groups}
    rows: Any = analysis.totals
    kinds = {label: family_of(footer) for label, footer in footers.items()}
    rows = rows.assign(setting=rows["measurement"], family=rows["estimator"].map(kinds))
    families = rows.groupby(column, sort=False)
    return {
        str(family): Finding.of(own.to_dict("records")).standings[0].label
        for family, own in families
    }


def compared(path: Path) -> set[str]:
    """Returns the estimators, or trackers, of an experiment."""
    defaults = yaml.safe_load(path.read_text(encoding="utf-8"))["defaults"]
    chosen = [one for one in defaults if isinstance(one, dict)]
    groups = ("override /solver", "override /baseline", "override /tracker")
    return {name for one in chosen for group in groups for name in one.get(group, ())}


@pytest.mark.parametrize("path", sorted(EXPERIMENTS.glob("*.yaml")), ids=lambda path: path.stem)
def test_an_experiment_contains_the_strongest_of_each_family(path):
    if path.stem in APART:
        return
    if path.stem == "states":
        assert compared(path) >= {*strongest("states", "given").values(), "iplf", "iterated_ekf"}
        return
    best = strongest("beyond", "family")
    assert set(best) >= {"IPE", "least squares", "filters"}
    assert compared(path) >= {best["least squares"], best["filters"]}
    assert compared(path) >= {"multistart", "map_lm", "iterated_ekf", "iplf"}


def shown_runs(path: Path) -> list[str]:
    """Returns the commands of a page that compare estimators or trackers, in one line each."""
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    return re.findall(r"ipe-bench (run .*(?:solver|baseline|tracker)=\[.*)$", text, re.MULTILINE)


PAGES = "ipe_bench/report/docs/pages"


@pytest.mark.parametrize(
    ("page", "number"),
    [
        ("README.md", 4),
        (f"{PAGES}/first_hour.md", 2),
        (f"{PAGES}/choosing.md", 1),
        (f"{PAGES}/index.md", 0),
    ],
)
def test_a_command_that_compares_contains_the_strongest_of_each_family(page, number):
    best = strongest("headline", "family")
    trackers = {*strongest("states", "given").values(), "iplf"}
    shown = shown_runs(ROOT / page)
    assert len(shown) == number
    for words in shown:
        named = set(re.findall(r"\w+", " ".join(re.findall(r"=\[([^\]]*)\]", words))))
        wanted = trackers if "tracker=" in words else {best["least squares"], best["filters"]}
        assert named >= wanted, words


def test_what_run_compares_on_own_data_contains_the_strongest_of_each_family():
    """`ipe-bench run oxygen.py oxygen.csv`, on README and in the First hour."""
    best = strongest("headline", "family")
    constants = {*OF_OWN["solver"], *OF_OWN["baseline"]}
    assert constants >= {*best.values(), "multistart", "map_lm", "iterated_ekf", "iplf"}
    assert set(OF_OWN["tracker"]) >= {*strongest("states", "given").values()}


@pytest.mark.parametrize("page", ["README.md", f"{PAGES}/first_hour.md"])
def test_a_comparison_in_python_contains_the_strongest_of_each_family(page):
    best = strongest("headline", "family")
    text = (ROOT / page).read_text(encoding="utf-8")
    compared = re.findall(r"^estimators = \{([^}]*)\}$", text, re.MULTILINE)
    assert len(compared) == text.count("ib.run(")
    for words in compared:
        assert set(re.findall(r'"(\w+)":', words)) >= {best["least squares"], best["filters"]}


def test_a_title_with_only_names_its_field():
    rows: Any = read(STORED / f"paper{SUFFIX}").analysis.totals
    said = Finding.of(rows.to_dict("records")).sentence()
    assert re.match(r"Of these 2, only fixed_point succeeds up to ", said)


@pytest.mark.parametrize("model", ["bearings_only", "coordinated_turn", "pendulum", "walking_gins"])
def test_each_tracker_of_the_experiment_can_track_each_of_its_models(model):
    one = ib.component(f"state_model/{model}")
    named = sorted(compared(EXPERIMENTS / "states.yaml"))
    trackers = {name: ib.component(f"tracker/{name}") for name in named}
    assert {name: each.hindrance(one) for name, each in trackers.items()} == dict.fromkeys(named)
