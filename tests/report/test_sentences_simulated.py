"""What a page counts is so, and what it infers is false of the population in at most 5 % of the reports that say it.

A thousand reports are simulated from populations that are known (`shared.simulated_reports`). Every sentence of the
headline, every entry of its box, every verdict and every row in bold has a kind below: a function whose docstring says
what the kind claims, and which answers for each claim whether it is false. A sentence without a kind fails the test, so
that a new sentence needs a new kind: a function under `@sentence(pattern)` or `@entries`.

The table "kind, times printed, times false, upper limit" of as many reports as one likes, from the first on:
`PYTHONPATH=tests python tests/report/test_sentences_simulated.py 1000`
"""

from __future__ import annotations

import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta, binomtest
from shared.simulated_reports import HOLDING, Report, board, simulated
from shared.synthetic_store import Filter, Pretender, Seeker

from ipe_bench.report.page.headline import headline
from ipe_bench.report.tables.table import Table
from ipe_bench.report.words import brief, percent
from ipe_bench.statistics import analyse
from ipe_bench.statistics.verdicts import (
    CONSISTENT,
    NO_VERDICT,
    OVERCONFIDENT,
    TOO_CAUTIOUS,
    UNDECIDED,
    WRONG,
)
from ipe_bench.trials.thresholds import FEW, FIT_LEVEL

COUNTS, INFERS, READ = "counts", "infers", "read"
"""What a claim does. What is only read into a sentence is listed, to show how much so few trials leave open."""
RIGHT = 1.5
"""Mean NEES over n up to which, and down to whose inverse, a covariance that is called right is nearly so."""
TOLERATED = 0.05
"""Share of the reports that say it in which what a kind infers may be false."""
ENOUGH = 100
"""Reports that say it, below which a kind is listed and not judged."""


@dataclass(frozen=True)
class Claim:
    """One thing that a report says, and whether it is false."""

    kind: str
    does: str
    text: str
    false: bool


Judge = Callable[[Report, Any], Iterator[tuple[str, str, bool]]]
SENTENCES: list[tuple[str, Judge, bool]] = []
ENTRIES: list[Callable[[Report], Iterator[Claim]]] = []


def sentence(pattern: str, *, of_one: bool = False) -> Callable[[Judge], Judge]:
    """Registers a judge of the sentences that match, on reports of several scales or of one: it yields (kind, counts or
    infers, whether it is false)."""

    def add(judge: Judge) -> Judge:
        SENTENCES.append((pattern, judge, of_one))
        return judge

    return add


def entries(judge: Callable[[Report], Iterator[Claim]]) -> Callable[[Report], Iterator[Claim]]:
    """Registers a judge of what tables say."""
    ENTRIES.append(judge)
    return judge


def claims_of(report: Report) -> Iterator[Claim]:
    for part in report.parts:
        if isinstance(part, Table):
            continue
        one_scale = len(report.board.scales) == 1
        kinds = [
            (re.fullmatch(pattern, part), judge)
            for pattern, judge, of_one in SENTENCES
            if of_one == one_scale
        ]
        found = [(match, judge) for match, judge in kinds if match]
        assert len(found) == 1, f"{len(found)} kinds of sentence match: {part}"
        ((match, judge),) = found
        for kind, does, false in judge(report, match):
            yield Claim(kind, does, part, false)
    for judge in ENTRIES:
        yield from judge(report)


# What was seen, computed anew from the trials -------------------------------------------------------------------------


def successes(report: Report, at: int, label: str) -> np.ndarray:
    return report.samples[at, label].scalars["success"]


def shares_named(text: str) -> dict[str, str]:
    """Reads 'e1 (98.0 %), e2 (3.0 %) and 4 others'."""
    return dict(re.findall(r"(e\d+) \(([^)]*)\)", text))


def are_shares(report: Report, at: int, named: dict[str, str]) -> bool:
    return all(
        text == percent(successes(report, at, label).mean()) for label, text in named.items()
    )


def significant(report: Report) -> set[tuple[int, str, str]]:
    """Finds by whom whom is beaten at which scale: exact McNemar tests, corrected by Holm over all pairs and scales."""
    labels, tests = list(report.board.populations), []
    for at in range(len(report.board.scales)):
        for i, first in enumerate(labels):
            for second in labels[i + 1 :]:
                a, b = successes(report, at, first), successes(report, at, second)
                alone = int((a & ~b).sum()), int((b & ~a).sum())
                p = float(binomtest(alone[0], sum(alone)).pvalue) if sum(alone) else 1.0
                winner = (first, second) if alone[0] > alone[1] else (second, first)
                tests.append((p, at, *winner))
    found = set()
    for rank, (p, at, winner, loser) in enumerate(sorted(tests)):
        if p * (len(tests) - rank) >= 0.05:
            break
        found.add((at, winner, loser))
    return found


# Sentences ------------------------------------------------------------------------------------------------------------

LEAD = (
    r"At error scale (?P<scale>[\d.]+), (?P<first>[\w, ]+?) (?:succeeds?|keeps? the track to the last epoch) in"
    r" (?P<share>all|\S+ %) of (?P<trials>[\d,]+) trials"
    r"(?:, (?:each )?significantly more often than (?P<beaten>.+?))??"
    r"(?:, but not than (?P<others>.+?)|, not (?:each )?significantly more often than (?P<only>.+?))?"
    r"(?: \(exact McNemar tests, 5 % over all pairs\))?\."
)


@sentence(LEAD)
def who_leads(report: Report, match: Any) -> Iterator[tuple[str, str, bool]]:
    """Counts who succeeds most at a scale and how often each does; who is not beaten significantly is not; infers that
    the leaders succeed more often, in the population, than those that they are said to beat."""
    at = report.board.scales.index(float(match["scale"]))
    beaten, others = (
        shares_named(match["beaten"] or ""),
        shares_named(match["others"] or match["only"] or ""),
    )
    compared = compared_by(report) if has_rivals(report) else list(report.board.populations)
    share = {label: successes(report, at, label).mean() for label in compared}
    leaders = most_successful(report, at, compared)
    told = "all" if max(share.values()) == 1 else percent(max(share.values()))
    wrong = told != match["share"] or int(match["trials"].replace(",", "")) != report.board.trials
    named = set(re.findall(r"e\d+", match["first"]))
    wrong = wrong or not named <= set(leaders) or not are_shares(report, at, beaten | others)
    won = significant(report)
    # Of rivals that agree at first, the sentence is on the first scale at which they part.
    earlier = (
        [(k, most_successful(report, k, compared)) for k in range(at)] if has_rivals(report) else []
    )
    parted = [
        k for k, best in earlier if any(all((k, a, b) in won for a in best) for b in compared)
    ]
    yield "who leads", COUNTS, bool(wrong or parted)
    yield (
        "not significantly more often",
        COUNTS,
        any(all((at, a, b) in won for a in leaders) for b in others),
    )
    if beaten:
        truth = {label: report.board.success(label)[at] for label in share}
        false = any(truth[a] <= truth[b] + 1e-12 for a in leaders for b in beaten)
        yield "significantly more often", INFERS, false


def most_successful(report: Report, at: int, labels: list[str]) -> list[str]:
    share = {label: successes(report, at, label).mean() for label in labels}
    return [label for label, value in share.items() if value == max(share.values())]


WHO = r"IPE \((?P<ipe>[^)]*)\) and filters \((?P<filters>[^)]*)\)"


def compared_by(report: Report) -> list[str]:
    return [label for label, family in report.board.family.items() if family in ("IPE", "filters")]


def has_rivals(report: Report) -> bool:
    """Whether IPE and filters of constants are compared, rather than all estimators at the largest scale."""
    return {"IPE", "filters"} <= set(report.board.family.values()) and not report.board.moving


@sentence(
    WHO
    + r" agree (?:at every error scale|up to error scale (?P<last>[\d.]+)): (?P<share>all|at least \S+ %) of"
    r" (?P<trials>\d+) trials succeed at each, with an efficiency of (?P<low>[\d.]+\d)(?: to (?P<high>[\d.]+\d))?\."
)
def who_agree(report: Report, match: Any) -> Iterator[tuple[str, str, bool]]:
    """Counts the least success and the range of efficiencies of so many trials at these scales, which lie within 5 % at
    each; infers that in the population success differs by less than 10 points, and efficiency by less than a quarter,
    between any two at one scale: errors that are too rare for so many trials may make up as much."""
    drawn, labels = report.board, compared_by(report)
    last = drawn.scales.index(float(match["last"])) if match["last"] else len(drawn.scales) - 1
    cells = [(at, label) for at in range(last + 1) for label in labels]
    least = min(successes(report, *cell).mean() for cell in cells)
    squares = [
        np.minimum((report.samples[cell].error ** 2).mean(axis=1), 25.0).mean() for cell in cells
    ]
    each = np.reshape(squares, (last + 1, len(labels)))
    ends = float(match["low"]), float(match["high"] or match["low"])
    wrong = match["share"] != ("all" if least == 1 else f"at least {percent(least)}")
    wrong = (
        wrong
        or int(match["trials"]) != drawn.trials
        or bool((each.max(axis=1) > 1.1026 * each.min(axis=1)).any())
    )
    wrong = wrong or not np.allclose(
        ends, (max(squares) ** -0.5, min(squares) ** -0.5), rtol=0, atol=0.00501
    )
    yield "agree, in numbers", COUNTS, bool(wrong)
    false = False
    for at in range(last + 1):
        truth = [drawn.populations[label][at] for label in labels]
        success, good = [p.success(drawn.n) for p in truth], [p.efficiency(drawn.n) for p in truth]
        false = false or max(success) - min(success) > 0.1 or max(good) > 1.25 * min(good)
    yield "agree up to", INFERS, false


@sentence(
    r"Failures that no test of fit notices: up to (?P<most>\S+ %) of the trials \((?P<label>e\d+) at scale"
    r" (?P<scale>\S+)\)\."
)
def silent_failures(report: Report, match: Any) -> Iterator[tuple[str, str, bool]]:
    """Counts the largest share of trials that fail, converged and fitting, and where it is."""
    silent = {
        key: float((~s.scalars["success"] & (s.scalars["status"] == "converged")).mean())
        for key, s in report.samples.items()
    }
    here = silent[report.board.scales.index(float(match["scale"])), match["label"]]
    wrong = here != max(silent.values()) or percent(here) != match["most"]
    yield "silent failures", COUNTS, wrong


@sentence(
    r"(?:At error scale [\d.]+, )?(?P<head>e[^.%]*?(?:succeeds?|keeps?).*?)"
    r"(?P<silent> Failures that no test of fit notices: up to (?P<most>\S+ %) of the trials \((?P<who>[^)]*)\)\.)?",
    of_one=True,
)
def who_succeeds(report: Report, match: Any) -> Iterator[tuple[str, str, bool]]:
    """Counts the success of each at one scale, in order, and the largest share of silent failures."""
    assert len(report.board.scales) == 1
    head = match["head"]
    share = {label: float(successes(report, 0, label).mean()) for label in report.board.populations}
    alike = re.search(
        r"(?:succeed|keep)(?: the track to the last epoch)? in (?:(all)|(\S+ %)) of", head
    )
    if alike:
        wrong = {percent(v) for v in share.values()} != {alike[2] or "100 %"}
    else:
        told = re.findall(
            r"(e\d+)(?: succeeds| keeps the track to the last epoch)? in (\S+ %)", head
        )
        wrong = any(percent(share[label]) != text for label, text in told)
        wrong = (
            wrong
            or [share[label] for label, _ in told]
            != sorted(share.values(), reverse=True)[: len(told)]
        )
    wrong = wrong or f"of {report.board.trials} trials" not in head
    silent = {
        label: float((~s.scalars["success"] & (s.scalars["status"] == "converged")).mean())
        for (_, label), s in report.samples.items()
    }
    most = max(silent.values())
    wrong = wrong or (match["most"] or "0 %") != percent(most)
    if match["who"]:
        wrong = wrong or any(silent[label] != most for label in re.findall(r"e\d+", match["who"]))
    yield "who succeeds how often", COUNTS, bool(wrong)


def are_told(match: Any, values: dict[str, float]) -> bool:
    named = shares_named(match["each"])
    ordered = list(dict(sorted(values.items(), key=lambda item: item[1])))[: len(named)]
    order = [values[label] for label in named] == [values[label] for label in ordered]
    return order and all(text == brief(values[label]) for label, text in named.items())


@sentence(r"Median error at the last epoch, in multiples of .*: (?P<each>.*)\.", of_one=True)
def median_errors(report: Report, match: Any) -> Iterator[tuple[str, str, bool]]:
    """Counts the median error of each."""
    values = {
        label: float(np.median(np.sqrt((s.error**2).mean(axis=1))))
        for (_, label), s in report.samples.items()
    }
    yield "median errors", COUNTS, not are_told(match, values)


@sentence(
    r"Root mean square error over all epochs, relative to the smallest: (?P<each>.*)\.", of_one=True
)
def path_errors(report: Report, match: Any) -> Iterator[tuple[str, str, bool]]:
    """Counts the errors of each, of which the smallest is 1 and none is 0."""
    errors = {label: np.sqrt((s.error**2).mean(axis=0)) for (_, label), s in report.samples.items()}
    least = np.min(list(errors.values()), axis=0)
    size = {label: float(np.sqrt(((each / least) ** 2).mean())) for label, each in errors.items()}
    values = {label: each / min(size.values()) for label, each in size.items()}
    yield "errors over all epochs", COUNTS, not are_told(match, values) or "(0" in match["each"]


# Entries of the box and of tables -------------------------------------------------------------------------------------


def reach(text: str, scales: tuple[float, ...]) -> tuple[float, float]:
    """Reads an entry of the box: the ends between which the largest scale lies, minus infinity for none."""
    if text in ("none", "undecided"):
        return -np.inf, -np.inf if text == "none" else scales[-1]
    if match := re.fullmatch(r"([\d.]+) or (less|more)", text):
        end = float(match[1])
        return (-np.inf, end) if match[2] == "less" else (end, scales[-1])
    ends = [float(end) for end in text.split(" to ")]
    return ends[0], ends[-1]


def is_lost(report: Report, at: int, label: str) -> bool:
    """Returns whether success is below 90 % at the level of all scales, by Clopper and Pearson's upper limit."""
    success = successes(report, at, label)
    tail = 0.025 / len(report.board.scales)
    return not success.all() and bool(beta.ppf(1 - tail, success.sum() + 1, (~success).sum()) < 0.9)


def limit_of(held: list[bool], scales: tuple[float, ...]) -> float:
    """Returns the largest scale up to which it is so at every scale."""
    return max(scales[: held.index(False)] if False in held else scales, default=-np.inf)


@entries
def box(report: Report) -> Iterator[Claim]:
    """Honest up to: counts that up to its lower end no verdict is against the covariance or undecided; infers that
    beyond its upper end the covariance is too small, at some scale up to the next. Holds: infers that the largest scale
    up to which 90 % succeed, in the population, lies between both ends. Order: who surely holds longest stands first,
    and undecided below all who surely hold somewhere."""
    drawn = report.board
    for table in (part for part in report.parts if isinstance(part, Table)):
        rows = [[cell.text for cell in row] for row in table.rows]
        lows = []
        for label, honest, holds, _ in rows:
            low, high = reach(honest, drawn.scales)
            here = report.analysis.summary.query("parameter == 'all' and estimator == @label")
            verdicts = dict(zip(here["error_scale"], here["verdict"], strict=True))
            good = [verdicts[s] not in (OVERCONFIDENT, UNDECIDED, NO_VERDICT) for s in drawn.scales]
            yield Claim(
                "honest up to, by the verdicts", COUNTS, honest, limit_of(good, drawn.scales) != low
            )
            if low > -np.inf:
                nearly = [p.mean_nees <= RIGHT for p in drawn.populations[label]]
                yield Claim(
                    "honest up to, as proven", READ, honest, limit_of(nearly, drawn.scales) < low
                )
            if high < drawn.scales[-1]:
                right = [p.mean_nees <= 1 + 1e-9 for p in drawn.populations[label]]
                yield Claim("honest up to", INFERS, honest, limit_of(right, drawn.scales) > high)
            low, high = reach(holds, drawn.scales)
            lows.append(low)
            if (low, high) != (-np.inf, drawn.scales[-1]):
                truth = limit_of([p >= HOLDING for p in drawn.success(label)], drawn.scales)
                yield Claim("holds 90 % up to", INFERS, holds, not low <= truth <= high)
        scale = float(table.columns[-1].title.rpartition(" ")[2])
        spent = {label: cost for label, *_, cost in rows}
        nobody = all(is_lost(report, at, label) for at, label in report.samples)
        wrong = [
            (cost == "-") != (is_lost(report, drawn.scales.index(scale), e) and not nobody)
            for e, cost in spent.items()
        ]
        yield Claim("cost of who may hold", COUNTS, str(spent), any(wrong))
        yield Claim("order of the box", COUNTS, "", lows != sorted(lows, reverse=True))


@entries
def opening(report: Report) -> Iterator[Claim]:
    """Counts that a page of several scales opens with who leads at the largest, unless IPE and filters are compared."""
    scales = report.board.scales
    if len(scales) > 1 and not has_rivals(report):
        first = str(report.parts[0])
        yield Claim(
            "opening", COUNTS, first, not first.startswith(f"At error scale {scales[-1]:g}, ")
        )


@entries
def verdicts(report: Report) -> Iterator[Claim]:
    """Overconfident: infers that the mean NEES of converged trials is above n, or the mean NIS above the number of
    readings; too cautious: that it is below; wrong: that more than 1 % of the trials have innovations whose whiteness
    has a p below 0.001; the others count that nothing was found, in enough trials."""
    whole = report.analysis.summary.query("parameter == 'all'")
    for row in whole.to_dict("records"):
        there = report.population(row["error_scale"], row["estimator"])
        sample = report.trials_of(row["error_scale"], row["estimator"])
        enough = int(sample.converged.sum()) >= FEW
        means = {
            "verdict": there.mean_nees,
            "path_verdict": there.mean_nees,
            "nis_verdict": there.innovations,
        }
        for column in list(means)[: 3 if report.board.moving else 1]:
            word, kind = row[column], f"{column}: {row[column]}"
            if word == OVERCONFIDENT:
                yield Claim(kind, INFERS, word, means[column] <= 1 + 1e-9)
            elif word == TOO_CAUTIOUS:
                yield Claim(kind, INFERS, word, means[column] >= 1 - 1e-9)
            elif word == WRONG:
                yield Claim(
                    kind,
                    INFERS,
                    word,
                    there.correlated + FIT_LEVEL * (1 - there.correlated) <= 0.01,
                )
            else:
                yield Claim(kind, COUNTS, word, enough != (word != NO_VERDICT))
            if word == CONSISTENT:
                yield Claim(
                    f"{kind}, as right", READ, word, not 1 / RIGHT <= means[column] <= RIGHT
                )


@entries
def bold(report: Report) -> Iterator[Claim]:
    """Infers, of a scenario where some are in bold, that those who are not are not the best."""
    whole = report.analysis.summary.query("parameter == 'all'")
    for at, scale in enumerate(report.board.scales):
        marks = whole[whole["error_scale"] == scale].set_index("estimator")["may_be_best"]
        if not marks.all():
            truth = {label: report.board.success(label)[at] for label in marks.index}
            best = [label for label, value in truth.items() if value >= max(truth.values()) - 1e-12]
            yield Claim(
                "may be the best (bold)",
                INFERS,
                str(scale),
                not all(marks[label] for label in best),
            )


# The reports ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tally:
    """Counts what a kind says, by reports and one by one."""

    kind: str
    does: str
    reports: int
    false_reports: int
    times: int
    false_times: int

    @property
    def upper(self) -> float:
        """The upper limit (95 %, Clopper and Pearson) of the share of reports in which it is false."""
        return float(
            beta.ppf(0.95, self.false_reports + 1, self.reports - self.false_reports) or 1.0
        )


def judged(seed: int, largest: bool = True) -> list[Claim]:
    return list(claims_of(simulated(board(seed, largest=largest))))


def of_seeds(number: int) -> list[list[Claim]]:
    """Judges so many reports, in two processes."""
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(judged, range(number), chunksize=5))


def tallies(reports: list[list[Claim]]) -> list[Tally]:
    printed: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for claims in reports:
        each: dict[tuple[str, str], list[bool]] = defaultdict(list)
        for claim in claims:
            each[claim.does, claim.kind].append(claim.false)
        for key, false in each.items():
            found = {
                "reports": 1,
                "false_reports": any(false),
                "times": len(false),
                "false_times": sum(false),
            }
            printed[key].update(found)
    return [Tally(kind, does, **printed[does, kind]) for does, kind in sorted(printed)]


def shown(found: list[Tally]) -> str:
    head = f"{'':8}{'kind':34}{'reports':>9}{'false':>7}{'share %':>9}{'upper %':>9}{'times':>9}{'false':>7}"
    lines = [
        f"{t.does:8}{t.kind:34}{t.reports:9}{t.false_reports:7}{100 * t.false_reports / t.reports:9.1f}"
        f"{100 * t.upper:9.1f}{t.times:9}{t.false_times:7}{'' if t.reports >= ENOUGH else '  few'}"
        for t in found
    ]
    return "\n".join([head, *lines])


@pytest.mark.parametrize("first", range(0, 50, 10))
def test_what_a_report_counts_is_so(first):
    found = [claim for seed in range(first, first + 10) for claim in judged(seed, largest=False)]
    assert len(found) > 100
    assert [claim for claim in found if claim.does == COUNTS and claim.false] == []


def test_a_simulated_report_says_what_the_stored_trials_say(synthetic):
    """The frames that are put together here are those that the product reads from files of the same trials."""
    report = next(r for r in map(of_constants, range(100)) if r is not None)
    kinds = {"IPE": Seeker(), "filters": Filter(), "least squares": Pretender()}
    names = tuple(f"x{i}" for i in range(report.board.n))
    for (at, label), sample in report.samples.items():
        kept = {name: sample.scalars[name] for name in ("status", "fit_p", "simulations", "time_s")}
        scenario = synthetic.scenario(
            report.board.scales[at], sigma=2.0, names=names, sizes_given=(1.0,)
        )
        estimator = kinds[report.board.family[label]]
        synthetic.add(
            scenario, label, sample.error, estimator=estimator, deviation=sample.deviation, **kept
        )
    assert list(map(shown_part, headline(analyse([synthetic.directory])))) == list(
        map(shown_part, report.parts)
    )


def test_all_verdicts_of_a_page_share_one_level():
    for seed in (0, 2):
        drawn = board(seed)
        report = simulated(drawn)
        each = 3 if drawn.moving else 1
        assert {sample.verdicts for sample in report.samples.values()} == {
            each * len(report.samples)
        }


def of_constants(seed: int) -> Report | None:
    """Simulates a report if it is on several scales, and opens with where estimators agree or lead."""
    drawn = board(seed, largest=False)
    cells = len(drawn.scales) * len(drawn.populations)
    if drawn.moving or len(drawn.scales) == 1 or drawn.n == 1 or cells > 6:
        return None
    report = simulated(drawn)
    return report if len(report.parts) > 2 else None


def shown_part(part: Any) -> Any:
    return [[cell.text for cell in row] for row in part.rows] if isinstance(part, Table) else part


@pytest.mark.slow
def test_what_a_report_infers_is_false_in_few_of_those_that_say_it():
    found = tallies(of_seeds(1000))
    print("\n" + shown(found))
    assert [t for t in found if t.does == COUNTS and t.false_times] == []
    often = [t for t in found if t.does == INFERS and t.reports >= ENOUGH]
    assert len(often) >= 6
    assert [t for t in often if t.false_reports > TOLERATED * t.reports] == []


if __name__ == "__main__":
    print(shown(tallies(of_seeds(int(sys.argv[1])))))
