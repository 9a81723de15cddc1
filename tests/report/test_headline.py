"""The sentences that open a page are true of what is stored, also where estimators have different trials."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import beta, binomtest, chi2
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
from ipe_bench.report.page.headline import about, headline, in_common, limits
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.table import Table
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


def test_the_headline_says_who_agrees_who_is_honest_who_breaks_and_what_it_costs(synthetic):
    """A filter that is as good as its rival to scale 10, where it claims half its errors, and lost from 100 on."""
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
    *sentences, table = headline(analysis)
    agree, lead, silent = sentences
    assert (
        "IPE (solver) and filters (filter) agree up to error scale 10: all of 100 trials succeed at each"
        in agree
    )
    assert lead == (
        "At error scale 100, solver succeeds in all of 100 trials, significantly more often than filter (0 %) (exact"
        " McNemar tests, 5 % over all pairs)."
    )
    assert (
        silent
        == "Failures that no test of fit notices: up to 25.0 % of the trials (filter at scale 100)."
    )
    assert cells(table) == [
        ["solver", "1000", "1000", "4 (1.0 ms)"],
        ["filter", "1", "10", "187 (1.0 ms)"],
    ]
    (model,) = about(analysis)
    assert model.startswith("repeated: Each parameter read `repeats` times directly")
    assert "12 readings determine 3 parameters" in model
    assert "s times group 0 1 m, group 1 0.1 m" in model


def test_one_row_in_many_that_is_off_by_chance_does_not_end_who_is_honest(synthetic, tmp_path):
    """A mean NEES of 2.3 standard errors above n is one in a hundred: much for one row, little for the worst of six."""
    e = 0.1 * np.random.default_rng(3).normal(size=(100, 3))
    e /= np.sqrt(((e / 0.1) ** 2).mean())
    off = e * np.sqrt(1 + 2.3 * np.sqrt(2 / 300))
    for scale in (1.0, 10.0, 100.0):
        for label in ("newton", "ekf"):
            synthetic.add(synthetic.scenario(error_scale=scale), label, off if scale == 10 else e)
    (*_, table) = headline(analyse([synthetic.directory]))
    assert [honest for _, honest, *_ in cells(table)] == ["100", "100"]
    alone = Synthetic(tmp_path / "alone")
    alone.add(alone.scenario(error_scale=10.0), "newton", off)
    assert set(analyse([alone.directory]).summary["verdict"]) == {"overconfident"}


def test_who_surely_holds_stands_above_who_is_undecided(synthetic):
    """Of 100 trials 40 are lost at scale 10 alone, 8 at both scales, so that 90 % may hold or not, or 40 at both."""
    e, trial = 0.1 * np.random.default_rng(1).normal(size=(100, 3)), np.arange(100)[:, None]
    for scale in (1.0, 10.0):
        scenario = synthetic.scenario(error_scale=scale)
        synthetic.add(scenario, "open", np.where(trial < 8, 9.0, e))
        synthetic.add(scenario, "lost", np.where(trial < (40 if scale == 10 else 0), 9.0, e))
        synthetic.add(scenario, "none", np.where(trial < 40, 9.0, e))
    (*_, table) = headline(analyse([synthetic.directory]))
    assert [(label, holds) for label, _, holds, _ in cells(table)] == [
        ("lost", "1"),
        ("open", "undecided"),
        ("none", "none"),
    ]


def test_few_trials_leave_open_who_is_honest_and_who_holds(synthetic):
    for scale in (1.0, 10.0):
        e, scenario = (
            0.1 * np.random.default_rng(1).normal(size=(10, 3)),
            synthetic.scenario(error_scale=scale),
        )
        wrong = np.where(np.arange(10)[:, None] < 3, 9.0, e)
        for label, error in (("liar", 100 * e), ("solver", e), ("loser", wrong)):
            synthetic.add(scenario, label, error, deviation=np.full(3, 0.1))
    (*_, table) = headline(analyse([synthetic.directory]))
    found = {label: (honest, holds) for label, honest, holds, _ in cells(table)}
    assert found == {
        "solver": ("undecided", "undecided"),
        "loser": ("undecided", "undecided"),
        "liar": ("undecided", "none"),
    }


def test_one_scale_or_several_settings_are_ranked(synthetic):
    e = 0.1 * np.random.default_rng(2).normal(size=(50, 3))
    for sigma in (0.2, 0.4):
        synthetic.add(synthetic.scenario(sigma=sigma), "good", e)
        synthetic.add(
            synthetic.scenario(sigma=sigma), "bad", np.where(np.arange(50)[:, None] < 20, 50.0, e)
        )
    (sentence,) = said(synthetic.directory)
    assert sentence.startswith(
        "At error scale 1, good succeeds in 100 % of 100 trials in 2 scenarios, bad in 60.0 %."
    )
    assert sentence.endswith(
        "notices: up to 40.0 % of the trials of a scenario (bad, noise.deviation=0.2, scale 1)."
    )


# Random results -------------------------------------------------------------------------------------------------------


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


def ranking_is_so(sentence: str, results: Results) -> None:
    common = results.common()
    trials, labels = sum(map(len, common.values())), results.labels
    assert trials == int(re.search(r"([\d,]+) trials", sentence)[1])  # type: ignore[index]
    assert (len(common) > 1) == (f"{trials} trials in {len(common)} scenarios" in sentence)
    out = len(results.success) - len(common)
    assert (out > 0) == (f"{out} other scenario" in sentence)
    scales = sorted({scale for _, scale in common})
    assert re.match(
        rf"At error scales? {' to '.join(f'{s:g}' for s in dict.fromkeys((scales[0], scales[-1])))}, ",
        sentence,
    )
    shares = {label: results.share("success", label) for label in labels}
    told = sentence.partition("Failures")[0]
    alike = re.search(r", ([\w, ]+) succeed in ([\d.]+) % of", told)
    found = (
        [(label, alike[2]) for label in alike[1].split(", ")]
        if alike
        else re.findall(r"(\w+)(?: succeeds)? in ([\d.]+) %", told)
    )
    if found:
        assert {label: float(share) for label, share in found} == pytest.approx(
            {label: 100 * share for label, share in shares.items()}, abs=0.051
        )
        assert [shares[label] for label, _ in found] == sorted(shares.values(), reverse=True)
    else:
        assert set(shares.values()) == {1.0}
        assert all(label in sentence for label in labels)
    silent = {
        label: max(
            np.mean([results.silent[where][label][t] for t in trials])
            for where, trials in common.items()
        )
        for label in labels
    }
    if worst := re.search(r"notices: up to <?([\d.]+) % of the trials[^(]*\((\w+)", sentence):
        assert float(worst[1]) == pytest.approx(100 * max(silent.values()), abs=0.051)
        assert silent[worst[2]] == max(silent.values())
    else:
        assert max(silent.values()) == 0


def lead_is_so(sentence: str, results: Results) -> None:
    """The scale is one that all share, the shares are those of its common trials, and who is beaten loses pairs."""
    scale = float(re.search(r"At error scale ([\d.]+),", sentence)[1])  # type: ignore[index]
    ((where, trials),) = (
        (where, trials) for where, trials in results.common().items() if where[1] == scale
    )
    assert f" of {len(trials)} trials" in sentence
    success = {
        label: np.array([results.success[where][label][t] for t in trials])
        for label in results.labels
    }
    firsts = re.search(r", ([\w, ]+?) succeeds? in (all|[\d.]+ %) of", sentence)
    assert firsts
    assert {percent(success[label].mean()) for label in firsts[1].split(", ")} == {
        firsts[2].replace("all", "100 %")
    }
    won, _, rest = sentence.partition("not")
    for text, beaten in ((won, True), (rest, False)):
        for label, share in re.findall(r"(\w+) \(([\d.]+ %)\)", text):
            assert share == percent(success[label].mean())
            for first in firsts[1].split(", "):
                ahead, behind = (
                    (success[a] & ~success[b]).sum() for a, b in ((first, label), (label, first))
                )
                assert ahead > behind
                assert binomtest(ahead, ahead + behind).pvalue < 0.05 or not beaten


def limits_are_so(table: Table, results: Results, summary: pd.DataFrame) -> None:
    totals = summary[summary["parameter"] == "all"].set_index(["estimator", "error_scale"])
    assert {row[0] for row in cells(table)} == results.labels
    at = float(table.columns[-1].title.rpartition(" ")[2])
    for label, honest, holds, cost in cells(table):
        own, verdicts = results.of_scales(label), totals["verdict"][label]
        level = 0.05 / len({scale for _, scale in results.success})
        ends = {
            scale: (
                beta.ppf(0.025, sum(v), len(v) - sum(v) + 1) if sum(v) else 0.0,
                beta.ppf(1 - level / 2, sum(v) + 1, len(v) - sum(v)) if sum(v) < len(v) else 1.0,
            )
            for scale, v in own.items()
        }
        kept, lost = (
            {scale: test(*ends[scale]) for scale in own}
            for test in (lambda a, b: a >= 0.9, lambda a, b: b < 0.9)
        )
        wrong = {scale: verdicts[scale] == "overconfident" for scale in own}
        good = {scale: verdicts[scale] in ("consistent", "too cautious") for scale in own}
        for text, surely, never in ((holds, kept, lost), (honest, good, wrong)):
            assert text == between(surely, never)
        assert cost == "-" or float(cost.partition(" ")[0]) == results.cost[at, label]


def between(surely: dict[float, bool], never: dict[float, bool]) -> str:
    """Words the largest scale up to which it is so at all scales, from where it surely is and where it never is."""
    low, high = -1.0, -1.0
    for scale in surely:
        if all(surely[s] for s in surely if s <= scale):
            low = scale
        if not any(never[s] for s in never if s <= scale):
            high = scale
    if low == high:
        return f"{low:g}" if low > 0 else "none"
    if low < 0:
        return f"{high:g} or less" if any(never.values()) else "undecided"
    return f"{low:g} to {high:g}" if any(never.values()) else f"{low:g} or more"


def agreement_is_so(sentence: str, results: Results, summary: pd.DataFrame) -> None:
    labels = [label for label in results.labels if label in (*IPE, *FILTERS)]
    scales = sorted({scale for _, scale in results.success})
    match = re.search(r"agree (?:up to error scale (\d+)|at every error scale)", sentence)
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
        assert (": all of" in sentence) == bool((here["success"] == 1).all())


@pytest.mark.parametrize(
    "seed", [*range(6), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 24))]
)
def test_sentences_are_true_of_random_results(synthetic, seed):
    results = filled(synthetic, seed)
    analysis = analyse([synthetic.directory])
    sentences, parts = said(synthetic.directory), headline(analysis)
    assert len(set(sentences)) == len(sentences) > 0
    for sentence, part in zip(sentences, parts, strict=True):
        if isinstance(part, Table):
            limits_are_so(part, results, analysis.summary)
        elif sentence.startswith("At error scale") and isinstance(parts[-1], Table):
            lead_is_so(sentence, results)
        elif sentence.startswith("At error scale"):
            ranking_is_so(sentence, results)
        elif sentence.startswith("No trial is common to"):
            assert not results.common()
        elif sentence.startswith("IPE ("):
            agreement_is_so(sentence, results, analysis.summary)
        else:
            assert sentence.startswith("Failures that no test of fit notices")
            most = max(
                np.mean([*v.values()]) for each in results.silent.values() for v in each.values()
            )
            assert percent(most) in sentence


def test_what_only_some_have_ranks_nobody_elsewhere(synthetic):
    """On 100 trials in common one is better; 1000 more of the other alone, all of which succeed, do not turn that."""
    rng = np.random.default_rng(0)
    for scale, good, poor in ((1.0, 50, 48), (300.0, 41, 28)):
        scenario = synthetic.scenario(error_scale=scale)
        for label, number in (("newton", good), ("chord", poor)):
            e = 0.1 * rng.normal(size=(50, 3)).clip(-1, 1)
            synthetic.add(
                scenario,
                label,
                np.where(np.arange(50)[:, None] < number, e, 9.0),
                estimator=Seeker(),
            )
    alone = synthetic.scenario(sigma=0.4)
    synthetic.add(alone, "chord", np.zeros((1000, 3)), estimator=Seeker())
    (sentence,) = said(synthetic.directory)
    assert sentence.startswith(
        "At error scales 1 to 300, newton succeeds in 91.0 % of 100 trials in 2 scenarios, chord in 76.0 %."
    )
    assert "1 other scenario is left out, which not all of them have." in sentence


def test_trials_in_common_alone_are_ranked(synthetic):
    scenario = synthetic.scenario()
    wrong = np.where(np.arange(40)[:, None] < 20, np.zeros(3), 9.0)
    synthetic.add(scenario, "newton", wrong[:20], estimator=Seeker())
    synthetic.add(scenario, "chord", wrong, block=20, estimator=Seeker())
    assert said(synthetic.directory) == [
        "At error scale 1, chord, newton succeed in all of 20 trials."
    ]
    other = synthetic.scenario(seed=1)
    synthetic.add(other, "ekf", wrong, estimator=Filter())
    assert said(synthetic.directory) == [
        "No trial is common to chord, ekf, newton, so they are not ranked."
    ]


@pytest.mark.parametrize(
    "verdict",
    [
        "undecided",
        "-",
        "consistent",
        "too cautious",
        "overconfident",
        "optimistic",
        "diverged but confident",
    ],
)
def test_only_a_sure_verdict_calls_an_estimator_overconfident(verdict):
    rows = pd.DataFrame(
        {"estimator": "one", "error_scale": [1.0, 10.0], "nees_median": [1.0, 2.5], "success": 1.0}
    )
    rows = rows.assign(
        trials=100, success_low=0.95, simulations_median=1.0, simulations_mean=1.0, time_mean_s=1.0
    )
    rows = rows.assign(verdict=["consistent", verdict])
    ((_, honest, *_),) = cells(limits(rows, "limits"))
    expected = {
        "undecided": "1 or more",
        "-": "1 or more",
        "consistent": "10",
        "too cautious": "10",
    }
    assert honest == expected.get(verdict, "1")


def test_problems_in_common_alone_are_counted():
    rows = pd.DataFrame({"problem": ["a", "b", "a"], "estimator": ["one", "one", "two"]})
    assert in_common(rows, "problem")["problem"].tolist() == ["a", "a"]
    assert in_common(rows.iloc[:2], "problem")["problem"].tolist() == ["a", "b"]
    assert in_common(rows.iloc[1:], "problem").empty


# Experiments ----------------------------------------------------------------------------------------------------------

SWEEP = (r"At error scale 1, .* succeed in all of 20 trials\.", "limits")
RIVALS = (r"IPE \(.*\) and filters \(.*\) agree at every error scale", "limits")
PAGES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "nist": (
        ("measurement.dataset=Misra1a,BoxBOD", "measurement.start=2"),
        (r"Of 2 certified problems, .* solve",),
    ),
    "pendulum_book": ((), (r"All 2 published errors are met, to \d\.\de-1\d at worst\.",)),
    "mismatch": ((), (r"At error scale 33, .* succeed in all of 100 trials in 5 scenarios\.",)),
    **dict.fromkeys(("headline", "filters", "beyond"), (("error_scale=1,300",), RIVALS)),
    **dict.fromkeys(
        ("paper", "bearings", "ranging", "polynomial"), (("error_scale=0.1,1",), SWEEP)
    ),
    "lotka_volterra": (("error_scale=0.1,1",), SWEEP),
    "states": (
        ("state_model=bearings_only", "error_scale=1,10"),
        (
            r"At error scale 10, .* track .* trials",
            r"Failures that no test of fit notices",
            "limits_of_states",
        ),
    ),
}
"""For each experiment the part of it that is stored here, with errors as large as their bound, and what its page says
first."""


OURS = [o for o in discovery.options("experiment") if o.source.name == "ipe-bench"]
EACH = [
    pytest.param(
        o,
        marks=() if o.name in ("nist", "mismatch", "headline", "polynomial") else pytest.mark.slow,
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
    assert said(tmp_path / "empty") == ["No trial is stored yet, so there is no finding."]
    scenario = Scenario(Measured(), Certified())
    synthetic.bound = lambda scenario: np.full(3, 0.1)  # type: ignore[method-assign]
    synthetic.add(scenario, "newton", np.zeros((1, 3)))
    synthetic.add(scenario, "chord", np.full((1, 3), 9.0))
    (sentence,) = said(synthetic.directory)
    assert sentence.startswith(
        "With certified readings, newton succeeds in 100 % of 1 trial, chord in 0 %."
    )
    synthetic.add(synthetic.scenario(sigma=0.1), "newton", np.zeros((20, 3)))
    assert said(synthetic.directory) == [
        sentence,
        "At error scale 1, newton succeeds in 100 % of 20 trials.",
    ]
    tables = {table.name: table for table in all_tables(analyse([synthetic.directory]).simulated)}
    assert tables["all_trials"].data["capped_error"].tolist() == [0.0]


def test_states_that_move_have_words_of_their_own(tmp_path):
    """A smoother and its filter have the same readings at the last epoch; over all epochs it has later ones too."""
    model = ConstantVelocity(count=30, spread=3.0)
    table = ib.run(StateScenario(model), {"kf": ekf(), "rts": Smoother(ekf())}, 20, output=tmp_path)
    kept, errors, paths = said(tmp_path)
    assert kept == "kf, rts keep the track to the last epoch in all of 20 trials."
    median = table[table["parameter"] == "all"].set_index("estimator")["error_median"]
    assert errors.endswith(f": kf ({median['kf']:.2f}), rts ({median['rts']:.2f}).")
    assert median["rts"] == pytest.approx(median["kf"], rel=1e-12)
    path = table[table["parameter"] != "all"].pivot_table(
        index="estimator", columns="parameter", values="path_rmse"
    )
    ratio = np.sqrt(((path.loc["kf"] / path.loc["rts"]) ** 2).mean())
    assert paths.endswith(f": rts (1), kf ({ratio:.2f}).")
    assert ratio > 1.25
    page = write_report([tmp_path], tmp_path / "out").report.read_text(encoding="utf-8")
    body = page.partition("</main>")[0].partition('id="definitions"')[0]
    assert "30 readings at 30 epochs tell 2 states that move: " in body
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
    assert "median error over the linearised filter" in shown
