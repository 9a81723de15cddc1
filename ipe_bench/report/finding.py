"""States what a comparison found in one sentence, the title wherever its results are shown.

An estimator is judged here alone: it succeeds where at least `HELD` of its trials do, with 95 %
confidence, fails where fewer do, and is undecided otherwise. Rows are those of a summary over all
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import Any

from ipe_bench.report.words import agreeing, enumerate_few, from_to, percent, value_text
from ipe_bench.statistics.intervals import LEVEL, clopper_pearson
from ipe_bench.statistics.verdicts import OVERCONFIDENT
from ipe_bench.trials.thresholds import HELD

MOST_NAMES = 3
"""Names in a list of a title; more are counted."""
MOST_PLACES = 2
"""Settings, each at an error scale, that a title names; more are counted."""
MEANING = f"Succeeds: in at least {100 * HELD:.0f} % of trials, with 95 % confidence."
"""What a reader of the title needs to know."""
SUCCEEDS = "succeeds"
FAILS = "fails"
UNDECIDED = "undecided"
_PRIOR = "prior"
"""What some estimators of constants are given besides the readings."""
_SIDES = ("filters", "IPE")
"""The families whose best are named if they part."""

Row = Mapping[str, Any]
Place = tuple[str, float]
"""A column: the setting, empty if there is one, and the error scale."""


@dataclass(frozen=True)
class Standing:
    """Holds how an estimator stands in every column; a column that it lacks is None, and
    undecided."""

    label: str
    rows: tuple[Row | None, ...]
    judged: tuple[str, ...]
    ascending: bool
    """Whether the columns are ascending error scales, of which it succeeds up to one, rather than
    settings."""

    def said(self, column: str) -> str:
        """Returns what a column says of it in every row; empty if none does."""
        return next((str(row.get(column, "")) for row in self.rows if row), "")

    @cached_property
    def sure(self) -> int:
        """The number of columns in which, or up to which, it succeeds."""
        return self._number(lambda word: word == SUCCEEDS)

    @cached_property
    def possible(self) -> int:
        """The number of columns in which, or up to which, it may succeed."""
        return self._number(lambda word: word != FAILS)

    @property
    def seen(self) -> int:
        """The number of columns in which, or up to which, as many trials did succeed."""
        enough = [row is not None and row["success"] >= HELD for row in self.rows]
        return len(list(takewhile(bool, enough))) if self.ascending else sum(enough)

    def _number(self, counts: Callable[[str], bool]) -> int:
        fitting = takewhile if self.ascending else filter
        return len(list(fitting(counts, self.judged)))

    @property
    def rank(self) -> tuple[float, ...]:
        """Sorts who surely succeeds longest first, then who may, then who succeeds most."""
        shares = [row["success"] for row in self.rows if row]
        return (-self.sure, -self.possible, -sum(shares) / max(len(shares), 1))

    def overconfident(self, number: int) -> list[int]:
        """Returns at which of the first columns its reported covariance is too small."""
        shown = enumerate(self.rows[:number])
        return [at for at, row in shown if row and row["verdict"] == OVERCONFIDENT]


@dataclass(frozen=True)
class Finding:
    """Holds how all estimators stand, the best first."""

    places: tuple[Place, ...]
    standings: tuple[Standing, ...]

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Finding:
        """Judges the rows of a summary over all parameters; a `setting` tells those of several
        apart."""
        table: dict[tuple[str, Place], Row | None] = {}
        for row in rows:
            label = str(row["estimator"])
            scale = float(row["error_scale"])
            place = (str(row.get("setting", "")), scale)
            # Settings whose texts are equal are different all the same.
            while (label, place) in table:
                place = (f"{place[0]}'", scale)
            # A share of no trials is no result.
            table[label, place] = None if math.isnan(row["success"]) else row
        places = tuple(dict.fromkeys(place for _, place in table))
        ascending = len({setting for setting, _ in places}) == 1
        places = tuple(sorted(places, key=lambda place: place[1])) if ascending else places
        standings = []
        for label in dict.fromkeys(label for label, _ in table):
            own = tuple(table.get((label, place)) for place in places)
            words = tuple(judged(row, len(places)) for row in own)
            standings.append(Standing(label, own, words, ascending))
        return cls(places, tuple(sorted(standings, key=lambda one: one.rank)))

    @property
    def ascending(self) -> bool:
        return self.standings[0].ascending

    @property
    def across(self) -> str:
        """Names those that were given the prior, and others were not; empty if there are none."""
        more = [one.label for one in self.standings if one.said("given") == _PRIOR]
        if len(more) in (0, len(self.standings)):
            return ""
        return f"Also given the prior of the truth: {enumerate_few(more, 8)}."

    @property
    def leading(self) -> list[bool]:
        """Whether no estimator significantly holds longer, or in more settings, than each; of none
        if this is so of all."""
        most = max(one.sure for one in self.standings)
        may = [one.possible >= most for one in self.standings]
        return [one and not all(may) for one in may]

    def sentence(self) -> str:
        """States who succeeds, who is undecided, whose covariance is too small, and at which scales
        the best filter or IPE fails."""
        most = max(one.sure for one in self.standings)
        if not most:
            return self._nobody()
        winners = [one for one in self.standings if one.sure == most]
        undecided = [one for one in self.standings if one.possible >= most > one.sure]
        clauses = [self._winners(winners, undecided)]
        clauses += self._covariances(winners)
        clauses += [f"{named(undecided, self.standings)}: undecided"] if undecided else []
        clauses += self._parted(most) if self.ascending else []
        return "; ".join(clauses)

    def _winners(self, winners: Sequence[Standing], undecided: Sequence[Standing]) -> str:
        who = named(winners, self.standings)
        if len(winners) < len(self.standings) and not undecided:
            number = len(self.standings)
            is_counted = len(winners) > MOST_NAMES
            who = f"Only {who}" if is_counted else f"Of these {number}, only {who}"
        who = who.replace("all ", "All ", 1) if who.startswith("all ") else who
        verb = agreeing("succeed", winners)
        return f"{who} {verb} {self._where(winners)} ({self._numbers(winners)})"

    def _where(self, winners: Sequence[Standing]) -> str:
        """States up to which scale, or in how many settings, the winners hold."""
        number = winners[0].sure
        if self.ascending:
            return f"{'up to' if number > 1 else 'at'} error scale {self._scale(number - 1)}"
        total = len(self.places)
        if number == total:
            return f"in {'both' if total == 2 else f'all {total}'} {self._columns}"
        if any(one.possible > number for one in winners):
            return f"in at least {number} of {total} {self._columns}"
        return f"in {number} of {total} {self._columns}{self._which(winners)}"

    def _which(self, winners: Sequence[Standing]) -> str:
        """Names the settings where all winners hold, or all where all fail, if those are few."""
        judged = winners[0].judged
        held = [at for at, word in enumerate(judged) if word == SUCCEEDS]
        lost = [at for at, word in enumerate(judged) if word == FAILS]
        few = min(held, lost, key=len)
        if len(few) > MOST_PLACES or any(one.judged != judged for one in winners):
            return ""
        names = " and ".join(self._place(at) for at in few)
        return f", all but {names}" if few is lost else f", {names}"

    def _place(self, at: int) -> str:
        setting, scale = self.places[at]
        name = setting_words(setting)
        return name if self._columns == "settings" else f"{name} at {value_text(scale)}"

    @property
    def _columns(self) -> str:
        return "scenarios" if len({scale for _, scale in self.places}) > 1 else "settings"

    def _scale(self, at: int) -> str:
        return value_text(self.places[at][1])

    def _numbers(self, winners: Sequence[Standing]) -> str:
        """States what share of how many trials succeeds: at the last scale, or over the settings
        where they hold."""
        last = [one.rows[one.sure - 1] for one in winners]
        held = [
            row
            for one in winners
            for row, word in zip(one.rows, one.judged, strict=True)
            if word == SUCCEEDS
        ]
        return seen([row for row in (last if self.ascending else held) if row])

    def _covariances(self, winners: Sequence[Standing]) -> Iterator[str]:
        phrases: dict[str, list[Standing]] = {}
        for one in winners:
            number = one.sure if self.ascending else len(self.places)
            wrong = one.overconfident(number)
            if wrong:
                phrases.setdefault(self._extent(wrong, number), []).append(one)
        for phrase, whose in phrases.items():
            if len(whose) == len(winners):
                of = "its covariance" if len(winners) == 1 else "their covariance"
            else:
                of = f"the covariance of {named(whose, self.standings)}"
            yield f"{of} is too small {phrase}".rstrip()

    def _extent(self, columns: Sequence[int], number: int) -> str:
        """States in which of the first columns something is so, for certain of those that are
        named."""
        first = columns[0]
        if not self.ascending:
            return f"in {len(columns)} {self._columns[: -1 if len(columns) == 1 else None]}"
        if number == 1 and len(self.places) == 1:
            return ""
        goes_on = list(columns) == list(range(first, number)) and len(columns) > 1
        return f"{'from' if goes_on else 'at'} {self._scale(first)}{' on' if goes_on else ''}"

    def _parted(self, most: int) -> Iterator[str]:
        """States where the best filters or the best IPE fail, unless both may be among those that
        hold longest."""
        phrases: dict[str, list[Standing]] = {}
        families = {one.said("family") for one in self.standings}
        for side in _SIDES if families.issuperset(_SIDES) else ():
            own = [one for one in self.standings if one.said("family") == side]
            reach = max(one.possible for one in own)
            for one in own if reach < most else ():
                if one.possible == reach:
                    phrases.setdefault(self._failing(one), []).append(one)
        for phrase, who in phrases.items():
            yield f"{named(who, self.standings)} {agreeing('fail', who)} {phrase}".rstrip()

    def _failing(self, one: Standing) -> str:
        """States where an estimator fails, and from where on its covariance is too small, if that
        is before."""
        number = len(self.places)
        lost = [at for at, word in enumerate(one.judged) if word == FAILS]
        wrong = one.overconfident(number)
        failing = self._extent(lost, number)
        if not wrong or wrong[0] >= lost[0]:
            return failing
        return f"{failing}, with covariances that are too small {self._extent(wrong, number)}"

    def _nobody(self) -> str:
        """States that nowhere an estimator significantly holds, and who did succeed longest or in
        most settings."""
        most = max(one.seen for one in self.standings)
        at = max(most - 1, 0)
        ahead = [one for one in self.standings if one.seen == most]
        columns = slice(at, at + 1) if self.ascending else slice(None)
        share = seen([row for one in ahead for row in one.rows[columns] if row])
        where = f"in {len(self.places)} {self._columns}"
        where = f"at error scale {self._scale(at)}" if self.ascending else where
        who = named(ahead, self.standings)
        told = f"{who} {agreeing('succeed', ahead)} in {share} {where}"
        if any(one.possible for one in self.standings):
            return f"Too few trials to rank; {told}"
        if len(self.places) == 1:
            return f"No estimator succeeds; {told}"
        first = f", even at error scale {self._scale(0)}"
        return f"No estimator succeeds{first if self.ascending else ' in any setting'}; {told}"


def judged(row: Row | None, columns: int) -> str:
    """Judges whether an estimator succeeds by its exact 95 % interval; failing shares that level
    among the columns."""
    if row is None:
        return UNDECIDED
    if row["success_low"] >= HELD:
        return SUCCEEDS
    level = 1 - (1 - LEVEL) / columns
    count = round(row["success"] * row["trials"])
    return FAILS if clopper_pearson(count, int(row["trials"]), level)[1] < HELD else UNDECIDED


def setting_words(setting: str) -> str:
    """Words a setting; a dash stands for the values that most rows have."""
    return "usual" if setting == "-" else setting


def named(standings: Sequence[Standing], among: Sequence[Standing]) -> str:
    """Names estimators; more than three are counted."""
    labels = [one.label for one in standings]
    if len(labels) == len(among) > MOST_NAMES:
        return f"all {len(labels)} estimators"
    if len(labels) > MOST_NAMES:
        return f"{len(labels)} of {len(among)} estimators"
    return " and ".join([", ".join(labels[:-1]), labels[-1]] if len(labels) > 1 else labels)


def seen(rows: Sequence[Row]) -> str:
    """States the successes that were seen, and the number of trials."""
    if not rows:
        return "no trial"
    share = from_to((row["success"] for row in rows), percent).replace(" % to", " to")
    trials = from_to(int(row["trials"]) for row in rows)
    return f"{share} of {trials} {'trial' if trials == '1' else 'trials'}"
