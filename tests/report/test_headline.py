"""The sentences that open a page are true of what is stored, also where estimators have different
trials."""

from __future__ import annotations

import pickle
import re
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import beta, chi2
from shared.state_models import ConstantVelocity
from shared.synthetic_store import Filter, Pretender, Repeated, Seeker, Synthetic

import ipe_bench as ib
from ipe_bench.api import report as write_report
from ipe_bench.api import run
from ipe_bench.basics.files import make_folder
from ipe_bench.basics.linalg import Covariance
from ipe_bench.cli.session import jobs_of, session
from ipe_bench.cli.words import read
from ipe_bench.measurements import Recorded
from ipe_bench.noise import Certified
from ipe_bench.plugins import discovery
from ipe_bench.report.finding import MEANING
from ipe_bench.report.page.headline import _hidden, about, headline, in_common, success
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.table import Fact, Table
from ipe_bench.report.words import percent
from ipe_bench.states import Smoother, ekf
from ipe_bench.statistics import analyse
from ipe_bench.trials.paths import StateScenario
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.thresholds import GATE

IPE, FILTERS, OTHER = ("newton", "chord"), ("ekf",), ("direct",)
KINDS = {
    **dict.fromkeys(IPE, Seeker()),
    **dict.fromkeys(FILTERS, Filter()),
    **dict.fromkeys(OTHER, Pretender()),
}


def said(directory: Path) -> list[str]:
    """The sentences, and the names of tables."""
    parts = headline(analyse([directory]))
    return [part.name if isinstance(part, Table) else part for part in parts]


def cells(table: Any) -> list[list[str]]:
    return [[cell.text for cell in row] for row in table.rows]


def test_the_headline_says_who_holds_who_agrees_and_who_fails_undetected(synthetic):
    """A filter that is as good as its rival to scale 10, where it claims half its errors, and lost
    from 100 on."""
    rng = np.random.default_rng(1)
    fits = {100.0: np.where(np.arange(100) < 25, 0.5, 0.0), 1000.0: 0.0}
    for scale in (1.0, 10.0, 100.0, 1000.0):
        e = 0.1 * rng.normal(size=(100, 3))
        scenario = synthetic.scenario(error_scale=scale)
        synthetic.add(scenario, "solver", e, estimator=Seeker(), simulations=4.0)
        claimed = np.full(3, 0.1 if scale == 1 else 0.05)
        wrong = e + (9.0 if scale >= 100 else 0.0)
        sure = {"deviation": claimed, "fit_p": fits.get(scale, 0.5)}
        synthetic.add(scenario, "filter", wrong, estimator=Filter(), simulations=187.0, **sure)
    analysis = analyse([synthetic.directory])
    finding, matrix, agree, price, silent = headline(analysis)
    assert [row[0].text for row in matrix.rows] == ["solver", "filter"]
    assert finding == (
        "Of these 2, only solver succeeds up to error scale 1000 (100 % of 100 trials);"
        " filter fails from 100 on, with covariances that are too small from 10 on"
    )
    assert agree.startswith(
        "Small errors: IPE (solver) and filters (filter) perform alike up to error scale 10: all"
        " 100 trials succeed, with an efficiency of "
    )
    assert agree.endswith(" Take the cheapest: solver, 4 simulations.")
    assert price == (
        "Price: Simulations of a trial at error scale 10, of those that succeed: solver 4, filter"
        " 187."
    )
    assert silent == "Undetected failures: up to 25 % of the trials (filter at error scale 100)."
    (model,) = about(analysis)
    assert model.startswith("repeated: Each parameter read `repeats` times directly")
    assert "12 readings determine 3 parameters" in model
    assert "s times group 0 1 m, group 1 0.1 m" in model


def test_one_row_in_many_that_is_off_by_chance_does_not_make_a_covariance_too_small(
    synthetic, tmp_path
):
    """A mean NEES of 2.3 standard errors above n is one in a hundred: much for one row, little for
    the worst of six."""
    e = 0.1 * np.random.default_rng(3).normal(size=(100, 3))
    e /= np.sqrt(((e / 0.1) ** 2).mean())
    off = e * np.sqrt(1 + 2.3 * np.sqrt(2 / 300))
    for scale in (1.0, 10.0, 100.0):
        for label in ("newton", "ekf"):
            synthetic.add(synthetic.scenario(error_scale=scale), label, off if scale == 10 else e)
    assert "covariance" not in said(synthetic.directory)[0]
    alone = Synthetic(tmp_path / "alone")
    alone.add(alone.scenario(error_scale=10.0), "newton", off)
    assert said(alone.directory)[0].endswith("its covariance is too small")


def test_several_settings_are_counted_and_the_worst_is_named(synthetic):
    e = 0.1 * np.random.default_rng(2).normal(size=(50, 3))
    for sigma in (0.2, 0.4):
        synthetic.add(synthetic.scenario(sigma=sigma), "good", e)
        synthetic.add(
            synthetic.scenario(sigma=sigma), "bad", np.where(np.arange(50)[:, None] < 20, 50.0, e)
        )
    finding, matrix, silent = said(synthetic.directory)
    assert matrix == "matrix"
    assert finding.startswith(
        "Of these 2, only good succeeds in both settings (100 % of 50 trials)"
    )
    assert silent == (
        "Undetected failures: up to 40 % of the trials (bad at error scale 1, noise.deviation=0.2)."
    )


# Random results -----------------------------------------------------------------------------------


@dataclass
class Results:
    """What was stored, by scenario (sigma, scale), estimator and trial."""

    success: dict[tuple[float, float], dict[str, dict[int, bool]]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    silent: dict[tuple[float, float], dict[str, dict[int, bool]]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    cost: dict[tuple[float, str], float] = field(default_factory=dict)

    @property
    def labels(self) -> set[str]:
        return {label for each in self.success.values() for label in each}

    def common(self) -> dict[tuple[float, float], set[int]]:
        """The trials that all estimators have, of the scenarios where there are any."""
        found = {
            where: set.intersection(*(set(trials) for trials in each.values()))
            for where, each in self.success.items()
            if set(each) == self.labels
        }
        return {where: trials for where, trials in found.items() if trials}

    def share(self, kind: str, label: str) -> float:
        held = getattr(self, kind)
        values = [held[where][label][t] for where, trials in self.common().items() for t in trials]
        return sum(values) / len(values)

    def of_scales(self, label: str) -> dict[float, list[bool]]:
        return {
            where[1]: list(each[label].values())
            for where, each in sorted(self.success.items())
            if label in each
        }


def filled(store: Synthetic, seed: int) -> Results:
    """Estimators of random merit, each in random trials of most of the scenarios."""
    rng, found = np.random.default_rng(seed), Results()
    labels = rng.permutation(list(KINDS))[: rng.integers(2, 5)].tolist()
    sigmas, scales = (0.2, 0.4)[: rng.integers(1, 3)], (1.0, 10.0, 100.0)[: rng.integers(1, 4)]
    everywhere = rng.random() < 0.3
    for scenario in (
        store.scenario(error_scale=scale, sigma=sigma) for sigma in sigmas for scale in scales
    ):
        sigma, scale = scenario.noise.deviation, scenario.error_scale
        for label in labels:
            if not everywhere and rng.random() < 0.25:
                continue
            start, trials = (
                (0, 60) if everywhere else (20 * rng.integers(3), 20 * rng.integers(1, 4))
            )
            lost = rng.random(trials) < rng.choice(
                [0.0, 0.03, 0.15, 0.5, 1.0], p=[0.5, 0.2, 0.1, 0.1, 0.1]
            )
            e = np.where(lost[:, None], 9.0, sigma / 2 * rng.normal(size=(trials, 3)))
            fits = rng.random(trials) < rng.choice([0.0, 0.5])
            claimed, spent = (
                np.full(3, sigma / 2 * rng.choice([0.3, 1.0, 3.0])),
                float(rng.integers(1, 200)),
            )
            columns: dict[str, Any] = {
                "deviation": claimed,
                "fit_p": np.where(lost & ~fits, 0.0, 0.5),
            }
            store.add(
                scenario,
                label,
                e,
                start=start,
                block=20,
                estimator=KINDS[label],
                simulations=spent,
                **columns,
            )
            good = ((e / (sigma / 2)) ** 2).sum(axis=1) <= chi2.isf(GATE, 3)
            numbers = range(int(start), int(start) + int(trials))
            found.success[sigma, scale][label] = dict(zip(numbers, good.tolist(), strict=True))
            found.silent[sigma, scale][label] = dict(
                zip(numbers, (~good & (fits | ~lost)).tolist(), strict=True)
            )
            found.cost[scale, label] = spent
    return found


def finding_is_so(sentence: str, results: Results) -> None:
    """Computes the winners anew: who surely holds in most columns, or at most scales from the first
    on."""
    places = list(dict.fromkeys(sorted(results.success)))
    sweep = len({sigma for sigma, _ in places}) == 1
    level = 0.05 / len(places)
    sure, possible = {}, {}
    for label in results.labels:
        kept, open_ = [], []
        for where in places:
            trials = [*results.success[where].get(label, {}).values()]
            good, bad = sum(trials), len(trials) - sum(trials)
            kept.append(bool(good) and beta.ppf(0.025, good, bad + 1) >= 0.9)
            open_.append(not bad or beta.ppf(1 - level / 2, good + 1, bad) >= 0.9)
        sure[label], possible[label] = (
            (each.index(False) if sweep and False in each else sum(each)) for each in (kept, open_)
        )
    most = max(sure.values())
    winners = {label for label, number in sure.items() if number == most}
    rivals = {label for label, number in possible.items() if number >= most} - winners
    if not most:
        assert re.match("No estimator succeeds|Too few trials to rank", sentence)
        assert sentence.startswith("No") == (not any(possible.values()))
        return
    first, *others = sentence.split("; ")
    who = re.match(r"(?:Of these \d+, only |Only )?(.*?) succeeds? ", first)
    assert who
    if who[1] != f"All {len(winners)} estimators" and " of " not in who[1]:
        assert set(re.split(", | and ", who[1])) == winners
    assert first.startswith(("Only", "Of these")) == (not rivals and len(winners) < len(sure))
    told = [other for other in others if re.fullmatch(r"(?!at )[^:]*: undecided", other)]
    named = [set(re.split(", | and ", one.removesuffix(": undecided"))) for one in told]
    assert named == ([rivals] if rivals else [])


def agreement_is_so(sentence: str, results: Results, summary: pd.DataFrame) -> None:
    labels = [label for label in results.labels if label in (*IPE, *FILTERS)]
    scales = sorted({scale for _, scale in results.success})
    match = re.search(r"perform alike (?:up to error scale (\d+)|at every error scale)", sentence)
    assert match
    last = float(match[1] or scales[-1])
    totals = summary[(summary["parameter"] == "all") & summary["estimator"].isin(labels)]
    for scale in (scale for scale in scales if scale <= last):
        (each,) = (each for where, each in results.success.items() if where[1] == scale)
        assert set(labels) <= set(each)
        assert len({tuple(each[label]) for label in labels}) == 1, "ranked over different trials"
        efficiency = totals[totals["error_scale"] == scale]["efficiency_capped"]
        assert efficiency.max() <= 1.05 * efficiency.min()
    here = totals[totals["error_scale"] <= last]
    if told := re.search(r"efficiency of ([\d.]+\d)(?: to ([\d.]+\d))?", sentence):
        low, high = float(told[1]), float(told[2] or told[1])
        ends = here["efficiency_capped"].min(), here["efficiency_capped"].max()
        assert (low, high) == pytest.approx(ends, abs=0.0051)
        assert (": all " in sentence) == bool((here["success"] == 1).all())


@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 24))]
)
def test_sentences_are_true_of_random_results(synthetic, seed):
    results = filled(synthetic, seed)
    analysis = analyse([synthetic.directory])
    sentences = said(synthetic.directory)
    assert len(set(sentences)) == len(sentences) > 0
    finding, *others = sentences
    finding_is_so(finding, results)
    for sentence in others:
        if sentence.startswith("matrix") or sentence == MEANING:
            continue
        if sentence.startswith(("Price:", "Error bars:")):
            continue  # whose numbers simulated reports hold
        if sentence.startswith("Small errors:"):
            agreement_is_so(sentence, results, analysis.summary)
        else:
            assert sentence.startswith("Undetected failures")
            most = max(
                np.mean([*v.values()]) for each in results.silent.values() for v in each.values()
            )
            assert percent(most) in sentence


def test_problems_in_common_alone_are_counted():
    rows = pd.DataFrame({"problem": ["a", "b", "a"], "estimator": ["one", "one", "two"]})
    assert in_common(rows, "problem")["problem"].tolist() == ["a", "a"]
    assert in_common(rows.iloc[:2], "problem")["problem"].tolist() == ["a", "b"]
    assert in_common(rows.iloc[1:], "problem").empty


# Experiments --------------------------------------------------------------------------------------

FEW = r"Too few trials to rank; .* succeed in 100 % of 20 trials"
SWEEP = (rf"{FEW} at error scale 1", "matrix")
ALIKE = r"Small errors: IPE \(.*\) and filters \(.*\) perform alike at every error scale"
RIVALS = (rf"{FEW} at error scale 300", "matrix", ALIKE)
PAGES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "nist": (
        ("measurement.dataset=Misra1a,BoxBOD", "measurement.start=2"),
        (r"Of 2 certified problems, .* solve",),
    ),
    "pendulum_book": ((), (r"All 2 published errors are met, to \d\.\de-1\d at worst\.",)),
    "mismatch": ((), (rf"{FEW} in 5 settings", "matrix")),
    **dict.fromkeys(("headline", "filters", "beyond"), (("error_scale=1,300",), RIVALS)),
    "paper": (("error_scale=0.1,1",), SWEEP),
    **dict.fromkeys(
        ("bearings", "ranging", "polynomial", "lotka_volterra"),
        (("error_scale=0.1,1",), (*SWEEP, ALIKE)),
    ),
    "states": (
        ("state_model=bearings_only", "error_scale=1,10"),
        (
            r"Too few trials to rank; .* succeed in .* of 20 trials at error scale 10",
            "matrix",
            r"Undetected failures",
        ),
    ),
}
"""For each experiment the part of it that is stored here, with errors as large as their bound, and
what its page says first."""


OURS = [o for o in discovery.options("experiment") if o.source.name == "ipe-bench"]
EACH = [
    pytest.param(
        o,
        marks=() if o.name in ("nist", "headline", "polynomial") else pytest.mark.slow,
    )
    for o in OURS
]


@pytest.mark.parametrize("option", EACH, ids=[o.name for o in OURS])
def test_the_page_of_every_experiment_opens_with_what_fits_it(option, synthetic):
    words, patterns = PAGES[option.name]
    with session():
        specs = jobs_of(read("run", [f"+experiment={option.name}", *words]), multirun=True).specs
    if option.name in ("pendulum_book", "states"):
        trials = 1 if option.name == "pendulum_book" else 20
        for spec in specs:
            chosen = {label: spec.estimators[label] for label in ("ekf", "ukf")}
            run(spec.scenario, chosen, trials, output=synthetic.directory)
    else:
        fill(synthetic, specs)
    sentences = said(synthetic.directory)
    assert len(sentences) == len(patterns)
    for sentence, pattern in zip(sentences, patterns, strict=True):
        assert re.match(pattern, sentence), sentence


def fill(store: Synthetic, specs: list[Any]) -> None:
    for spec in specs:
        scenario = spec.scenario
        trials = 1 if scenario.noise.name == "certified" else 20
        e = (
            0.0
            if trials == 1
            else np.random.default_rng(0).normal(size=(trials, scenario.measurement.n))
        )
        error = e * scenario.linear_bound if trials > 1 else np.zeros((1, scenario.measurement.n))
        store.bound = lambda scenario: scenario.linear_bound  # type: ignore[method-assign]
        for label, estimator in spec.estimators.items():
            store.add(scenario, label, error, estimator=estimator)


@dataclass(frozen=True)
class Measured(Repeated):
    """Readings that come with a model of no collection."""

    @property
    def recorded(self) -> Recorded:  # type: ignore[override]
        return Recorded(np.zeros(self.m), Covariance(np.ones(self.m)), np.zeros(self.n))


def test_certified_readings_of_no_collection_are_found_too_and_an_empty_folder_is_said_to_be(
    tmp_path, synthetic
):
    make_folder(tmp_path / "empty" / "runs")
    assert said(tmp_path / "empty") == ["No trials yet."]
    scenario = Scenario(Measured(), Certified())
    synthetic.bound = lambda scenario: np.full(3, 0.1)  # type: ignore[method-assign]
    synthetic.add(scenario, "newton", np.zeros((1, 3)))
    synthetic.add(scenario, "chord", np.full((1, 3), 9.0))
    (sentence,) = said(synthetic.directory)
    assert sentence == "Of 1 certified problem, newton solves all."
    synthetic.add(synthetic.scenario(sigma=0.1), "newton", np.zeros((20, 3)))
    assert said(synthetic.directory) == [
        sentence,
        "Too few trials to rank; newton succeeds in 100 % of 20 trials at error scale 1",
        MEANING,
    ]
    tables = {table.name: table for table in all_tables(analyse([synthetic.directory]).simulated)}
    assert tables["all_trials"].data["capped_error"].tolist() == [0.0]


@pytest.mark.slow
def test_states_that_move_have_words_of_their_own(tmp_path):
    """A smoother and its filter have the same readings at the last epoch; over all epochs it has
    later ones too."""
    model = ConstantVelocity(count=30, spread=3.0)
    table = ib.run(StateScenario(model), {"kf": ekf(), "rts": Smoother(ekf())}, 20, output=tmp_path)
    kept, meaning, fact = said(tmp_path)
    assert meaning == MEANING
    assert fact == "Tracks kept: kf 20 of 20, rts 20 of 20."
    assert kept == (
        "Too few trials to rank; kf and rts succeed in 100 % of 20 trials at error scale 1"
    )
    median = table[table["parameter"] == "all"].set_index("estimator")["error_median"]
    assert median["rts"] == pytest.approx(median["kf"], rel=1e-12)
    path = table[table["parameter"] == "all"].set_index("estimator")["path_error_median"]
    assert path["kf"] > 1.25 * path["rts"]
    page = write_report([tmp_path], tmp_path / "out").report.read_text(encoding="utf-8")
    body = page.partition("</main>")[0].partition('id="definitions"')[0]
    assert "2 moving states are estimated from 30 readings at 30 time steps: " in page
    shown = re.sub(r"base64,[^\"]*", "", body)
    for words in (
        "1 is the best",
        "cost counts simulations",
        "multiples of the bound",
        "parameters; at error scale",
        "error / bound",
        "the bound at the truth",
    ):
        assert words not in shown, words
    assert "the filter linearised at the true path" in shown
    assert "error over the linearised filter" in shown


def test_the_line_below_the_title_says_which_error_makes_a_trial_a_success(synthetic):
    """Chi-square with three degrees of freedom: all but one in a million errors lie within 3.2
    deviations."""
    limit = np.sqrt(chi2.isf(1e-6, 3) / 3)
    scenario = synthetic.scenario()
    synthetic.bound = lambda scenario: np.ones(3)  # type: ignore[method-assign]
    for label, size in (("inside", 0.99), ("outside", 1.01)):
        synthetic.add(scenario, label, np.full((20, 3), size * limit))
    analysis = analyse([synthetic.directory])
    rows = analysis.summary[analysis.summary["parameter"] == "all"].set_index("estimator")
    assert rows["success"].to_dict() == {"inside": 1.0, "outside": 0.0}
    assert f"A trial succeeds if its error is at most {limit:.1f} times the" in success(analysis)


def test_a_fact_comes_back_from_another_process_as_it_was():
    fact = Fact("Price", "simulations of a trial: 12")
    again = pickle.loads(pickle.dumps(fact))
    assert (again, again.label, again.text) == (fact, fact.label, fact.text)
    assert again == "Price: simulations of a trial: 12"


def test_the_hidden_model_error_is_the_most_harmful_of_those_that_tests_do_not_detect():
    """By the best of the tests and estimators: one that any test detects is not hidden."""
    settings = {"right model": (0.0, 1.0), "tilt": (0.02, 70.0), "walk": (0.9, 300.0)}
    settings |= {"twist": (0.4, 5.0)}
    rows = pd.DataFrame(
        [
            {"setting": name, "error_scale": 1.0, "misfit": seen * share, "error_median": error}
            for name, (seen, error) in settings.items()
            for share in (1.0, 0.1)
        ]
    )
    (fact,) = _hidden(rows)
    assert fact == (
        "Hidden model error: the test of fit detects tilt in 2 % of the trials; the median error is"
        " 70 times the bound."
    )
    # Without readings of the right model beside them there is nothing to blame a misfit on.
    assert not list(_hidden(rows[rows["setting"] != "right model"]))
