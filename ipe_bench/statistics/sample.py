"""All stored trials of one scenario under one estimator, and their sums: what statistics are computed from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtri

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import cost
from ipe_bench.runs.results import StoredCell
from ipe_bench.statistics.calibration import Calibration, calibrations
from ipe_bench.statistics.collect import Collection, Group
from ipe_bench.statistics.histories import History, distances_to_limit, trial_label
from ipe_bench.statistics.intervals import Squares, few_carry, grouped, quantiles, rms_interval_of
from ipe_bench.statistics.sequences import rms_sequence_of

FIT = "fit_p"
NIS = "extra_nis"
"""Where filters report their normalised innovations squared."""
AMBIGUOUS = "extra_ambiguous"
"""Where estimators that look for several minima report 1 if they found some, else 0."""
SCALARS = ("status", "solved", "success", "iterations", "simulations", "jacobians", "time_s", "nees", "crlb_distance")
CURVATURES = ("curvature_intrinsic", "curvature_parameter")
TRUTH = ("contraction_K", "contraction_norm", "contraction_radius", "curvature_M", *CURVATURES)
"""Scalars of the truth, read where they are stored."""
THEORY = ("box_bias", "pseudo_bias", "misspecified")
"""What theory says of least squares for each parameter, read where it is stored."""
OPTIONAL = ("message", FIT, NIS, AMBIGUOUS, "root_distance")
"""Read where they are stored."""
OF_TRUTH = ("crlb", "bayes", "linear_error", "van_trees", "van_trees_error", *THEORY)
"""Vectors of the truth; the others are of the estimates."""
QUANTILES = (0.5, 0.95)
"""Of the size of each parameter's error."""
NORMAL_95 = float(-ndtri(0.025))
"""What 95 % of the values of the normal law do not exceed in size."""
_SEED = 1 << 40


@dataclass(frozen=True)
class Shared:
    """Which trials the estimators of one scenario have in common, each as an `identifier`, ascending."""

    present: Array
    """Those that every estimator has."""
    solved: Array
    """Those that every estimator solved."""

    @classmethod
    def among(cls, collection: Collection, groups: Sequence[Group]) -> Shared:
        present: Array | None = None
        solved: Array | None = None
        for group in groups:
            ids, right = _solved_trials(collection, group)
            if len(ids):
                present = _in_both(present, ids)
            solved = _in_both(solved, ids[right])
        nothing = np.empty(0, dtype=np.int64)
        return cls(nothing if present is None else present, nothing if solved is None else solved)


def _in_both(first: Array | None, second: Array) -> Array:
    if first is None or np.array_equal(first, second):
        return second
    return np.intersect1d(first, second, assume_unique=True)


def _is_in(values: Array, wanted: Array) -> Array:
    return np.ones(len(values), dtype=bool) if np.array_equal(values, wanted) else np.isin(values, wanted)


def _solved_trials(collection: Collection, group: Group) -> tuple[Array, Array]:
    """Every trial of a group by ascending identifier, and whether it is solved."""
    parts = []
    for cell, _ in group.cells:
        rows = collection.load(cell, ["solved"])
        parts.append((_numbers(cell, rows["trial"]), rows["solved"].astype(bool)))
    ids, solved = (np.concatenate(column) for column in zip(*parts, strict=True))
    if np.all(ids[1:] > ids[:-1]):
        return ids, solved
    ids, first = np.unique(ids, return_index=True)
    return ids, solved[first]


def _numbers(cell: StoredCell, trial: Array) -> Array:
    return cell.seed * _SEED + trial.astype(np.int64)


@dataclass(frozen=True)
class Sample:
    """All trials of one group, seeds one after another; errors and deviations in multiples of the parameters' sizes.

    Arrays cannot be written into. Those of shape (trials, n) are read when they are first asked for, and kept.
    """

    collection: Collection
    group: Group
    number: Array
    """(trials,): one number per (seed, trial)."""
    scalars: Mapping[str, Array]
    """Per trial, by the names in `SCALARS`, and those of `OPTIONAL` that are stored."""
    shared: Shared
    _kept: dict[str, Array] = field(default_factory=dict, repr=False)

    @classmethod
    def load(cls, collection: Collection, group: Group, shared: Shared) -> Sample:
        parts = [collection.load(cell, SCALARS, OPTIONAL) for cell, _ in group.cells]
        number = np.concatenate([_numbers(cell, p["trial"]) for (cell, _), p in zip(group.cells, parts, strict=True)])
        known = [name for name in (*SCALARS, *OPTIONAL) if all(name in part for part in parts)]
        # Each column is forgotten when it has been joined.
        scalars = {name: np.concatenate([part.pop(name) for part in parts]) for name in known}
        for name in ("solved", "success"):
            scalars[name] = scalars[name].astype(bool)
        return cls(collection, group, _read_only(number), {k: _read_only(v) for k, v in scalars.items()}, shared)

    def protected(self) -> Sample:
        """The same, for code that is not ours: what that changes is its own."""
        return replace(self, scalars=dict(self.scalars))

    def __len__(self) -> int:
        return len(self.number)

    @property
    def n(self) -> int:
        return len(self.parameters)

    @property
    def parameters(self) -> Sequence[Mapping[str, Any]]:
        return self.group.footer["parameters"]

    @cached_property
    def names(self) -> list[str]:
        return [str(p["name"]) for p in self.parameters]

    @cached_property
    def sizes(self) -> Array:
        """(n,): the parameters' units, by which what is in multiples of them is multiplied."""
        return np.array([float(p["size"]) for p in self.parameters])

    @cached_property
    def linear_bound(self) -> Array:
        return np.array(self.group.footer["linear_bound"], dtype=float)

    @cached_property
    def members(self) -> dict[str, list[int]]:
        """The groups of parameters, by name, in the order of the parameters."""
        found: dict[str, list[int]] = {}
        for i, parameter in enumerate(self.parameters):
            found.setdefault(parameter.get("group") or parameter["name"], []).append(i)
        return found

    # What is one number per trial -------------------------------------------------------------------------------------

    @property
    def ids(self) -> Array:
        """(trials, 2): seed and trial."""
        return np.stack(np.divmod(self.number, _SEED), axis=1)

    @property
    def seeds(self) -> Array:
        """(trials,)"""
        return self.number // _SEED

    def id_of(self, row: int) -> tuple[int, int]:
        """Seed and trial."""
        return divmod(int(self.number[row]), _SEED)

    @cached_property
    def cost(self) -> Array:
        """(trials,)"""
        jacobian_cost = self.group.footer.get("jacobian_cost", self.n)
        return cost(self.scalars["simulations"], self.scalars["jacobians"], jacobian_cost)

    @property
    def iterates(self) -> bool:
        """Whether the estimator approaches a limit step by step; the epochs of a filter are not such steps."""
        return not self.group.footer.get("sequential", False)

    @cached_property
    def present(self) -> Array:
        """Whether every estimator of the scenario has the trial."""
        return _is_in(self.number, self.shared.present)

    @cached_property
    def solved_by_all(self) -> Array:
        return _is_in(self.number, self.shared.solved)

    @property
    def solved(self) -> Array:
        return self.scalars["solved"]

    @cached_property
    def converged(self) -> Array:
        return self.scalars["status"] == Status.CONVERGED.label

    @cached_property
    def distance(self) -> Array:
        """Mahalanobis errors (trials,) in deviations of the Cramér-Rao bound, infinite where not finite."""
        distance = np.sqrt(self.scalars["crlb_distance"])
        distance[~np.isfinite(distance)] = np.inf
        return distance

    # What is a number per trial and parameter -------------------------------------------------------------------------

    @property
    def error(self) -> Array:
        """(trials, n)"""
        return self._matrix("error")

    @property
    def deviation(self) -> Array:
        """(trials, n), as the estimator reports it; NaN where it reports none."""
        return self._matrix("deviation")

    @property
    def crlb(self) -> Array:
        """(trials, n), deviations of the Cramér-Rao bound at the truth; NaN where the truth is missing."""
        return self._matrix("crlb")

    @property
    def bayes(self) -> Array:
        """(trials, n), those of the Bayesian bound."""
        return self._matrix("bayes")

    @property
    def bound(self) -> Array:
        """The deviations (trials, n) that the estimator is held against: the Bayesian bound where it uses a prior."""
        return self._matrix(self.bound_kind)

    @property
    def bound_kind(self) -> str:
        return "bayes" if self.group.footer["bound"] == "bayes" else "crlb"

    @property
    def linear_error(self) -> Array:
        """(trials, n), H+ v: what the linear estimate would be off by if h were linear."""
        return self._matrix("linear_error")

    @property
    def van_trees(self) -> Array:
        """(trials, n), deviations of Van Trees's bound, in the first trial of each seed and NaN in the others."""
        return self._matrix("van_trees")

    @property
    def theory(self) -> Mapping[str, Array]:
        """(trials, n) by the names in `THEORY`; NaN where it is not stored."""
        return {kind: self._matrix(kind) for kind in THEORY}

    @property
    def truth(self) -> Mapping[str, Array]:
        """(trials,) by the names in `TRUTH`; NaN where it is not stored."""
        return {name: self._matrix(name)[:, 0] for name in TRUTH}

    @property
    def normalised(self) -> Array:
        """Errors over the linear bound (trials, n)."""
        return self.error / self.linear_bound

    def _matrix(self, kind: str) -> Array:
        if kind not in self._kept:
            together = next((several for several in (("error", "deviation"), TRUTH) if kind in several), (kind,))
            self._kept.update(zip(together, (_read_only(values.T) for values in self.read(*together)), strict=True))
        return self._kept[kind]

    def read(self, *kinds: str) -> list[Array]:
        """The columns (columns, trials) of each of these kinds, each in one piece of memory and not kept.

        Raises:
            UserError: the trials are others than those that the sample was loaded from.
        """
        names = [[kind] if kind in TRUTH else [f"{kind}_{name}" for name in self.names] for kind in kinds]
        columns, of_truth = [name for several in names for name in several], kinds[0] in (*TRUTH, *OF_TRUTH)
        values, at = np.full((len(columns), len(self)), np.nan), 0
        for cell, known in self.group.cells:
            rows = self.collection.load(cell, () if of_truth else columns)
            number = _numbers(cell, rows["trial"])
            part = slice(at, at + len(number))
            if not np.array_equal(self.number[part], number):
                break
            at = part.stop
            found = [rows[name] for name in columns] if not of_truth else self._beside(known, rows["trial"], columns)
            for row, column in zip(values, found, strict=True):
                row[part] = column
        if at != len(self):
            raise UserError(
                f"{', '.join(map(str, self.collection.directories))}: changed while it was read; the same command reads"
                " it anew"
            )
        return np.split(values, np.cumsum([len(several) for several in names])[:-1])

    def _beside(self, known: StoredCell | None, trial: Array, names: Sequence[str]) -> list[Array]:
        """Columns of the truth of ascending trials; NaN where a column or a trial is missing."""
        stored = {"trial": np.empty(0)} if known is None else self.collection.load(known, (), names)
        row = np.searchsorted(stored["trial"], trial)
        there = np.append(stored["trial"], -1)[row] == trial
        nothing = np.full(len(stored["trial"]), np.nan)
        return [np.where(there, np.append(stored.get(name, nothing), np.nan)[row], np.nan) for name in names]

    # What is a sum over trials ----------------------------------------------------------------------------------------

    @cached_property
    def sums(self) -> Sums:
        with np.errstate(all="ignore"):
            return Sums.of(self)

    @property
    def reports_covariance(self) -> bool:
        return self.sums.reports_covariance

    @property
    def rmse(self) -> Array:
        """(n,), over solved trials."""
        return self.sums.rmse

    @cached_property
    def rmse_limits(self) -> tuple[Array, Array]:
        """Ends of the intervals of rmse: per parameter (n), of all over the linear bound, and so of each group of
        parameters; NaN where few trials carry it, see `intervals.few_carry`."""
        low, high = rms_interval_of(self.sums.binned, self.sums.counts)
        few = few_carry(self.sums.squares, self.sums.degrees)
        return np.where(few, np.nan, low), np.where(few, np.nan, high)

    @cached_property
    def rmse_sequence(self) -> tuple[Array, Array]:
        """Such ends that are valid at all numbers of trials."""
        return rms_sequence_of(self.sums.squares, self.sums.degrees)

    # What has to be ordered -------------------------------------------------------------------------------------------

    @cached_property
    def error_quantiles(self) -> Array:
        """(`QUANTILES`, n) of the size of the errors, what is not finite counting as infinite."""
        return np.stack([quantiles(np.abs(column), np.array(QUANTILES)) for column in self.error.T], axis=1)

    @cached_property
    def calibrations(self) -> list[Calibration]:
        """How honest the reported covariance is for each parameter, and for all last; empty where none is reported."""
        return calibrations(self.error, self.deviation, self.scalars["nees"], self.converged)

    # How iterations went ----------------------------------------------------------------------------------------------

    @cached_property
    def histories(self) -> list[History]:
        """Those of the converged trials whose iterates are stored; none of a filter, which has epochs instead."""
        if not self.iterates:
            return []
        columns = [f"x_{name}" for name in self.names]
        names = [*(f"crlb_{name}" for name in self.names), *TRUTH]
        result: list[History] = []
        for cell, known in self.group.cells:
            stored = self.collection.load_history(cell)
            if stored is None:
                continue
            x = np.stack([stored[c] for c in columns], axis=1)
            trials = np.unique(stored["trial"])
            truth = np.array(self._beside(known, trials, names))
            for i, trial in enumerate(trials):
                row = np.flatnonzero(self.number == cell.seed * _SEED + trial)
                iterates = x[stored["trial"] == trial]
                if len(row) and self.converged[row[0]] and len(iterates) > 1:
                    result.append(self._history(int(row[0]), iterates, truth[:, i]))
        return result

    def _history(self, row: int, iterates: Array, truth: Array) -> History:
        """`truth`: the deviations (n,) of the bound, then the values of `TRUTH`."""
        theory: dict[str, float] = dict(zip(TRUTH, truth[self.n :].tolist(), strict=True))
        distances = distances_to_limit(iterates, truth[: self.n])
        return History(row, trial_label(*self.id_of(row)), iterates, distances, float(self.cost[row]), theory)


@dataclass(frozen=True)
class Sums:
    """Means over the trials of a sample, and what else is a sum over them; (n,) unless it is said otherwise. Means of
    no trials are NaN."""

    bias: Array
    std: Array
    """Standard deviation (n - 1) of the errors of solved trials."""
    correlation: Array
    """(n, n) of the errors of solved trials; NaN where an error does not vary or there are too few trials."""
    rmse: Array
    rmse_common: Array
    rmse_all: Array
    crlb_square: Array
    """Mean square of the bound's deviations over solved trials."""
    crlb: Array
    """Its root."""
    crlb_all: Array
    """The root mean square over all trials."""
    bayes: Array
    bayes_all: Array
    van_trees: Array
    van_trees_error: Array
    reported: Array
    compensation: Array
    """Mean square of the error less H+ v."""
    nees: Array
    covered: Array
    """Share of errors within 1.96 reported deviations."""
    predicted: tuple[Array, Array]
    """Mean and mean square of the error of least squares under the wrong model, by theory."""
    box: tuple[Array, Array]
    """Mean and mean square of Box's bias."""
    squares: Squares
    """Of the errors of solved trials; then of all parameters together, and of each group, over the linear bound."""
    degrees: Array
    """Degrees of freedom of these squares if errors are normal: 1 of each parameter and group, the least there can be;
    of all parameters what matches the variance (Satterthwaite, Biometrics 2, 1946)."""
    binned: Array
    """(groups of trials in succession, squares): their sums; see `intervals.grouped`."""
    counts: Array
    """(groups of trials in succession, 1): how many of them are solved."""
    together: Array
    """(trials,), root mean square over parameters of error over linear bound, solved or not."""
    reports_covariance: bool

    @classmethod
    def of(cls, s: Sample) -> Sums:
        solved, common = s.solved, s.solved & s.solved_by_all
        error, deviation = s.error.T, s.deviation.T
        square, normalised = error**2, (error / s.linear_bound[:, None]) ** 2
        together = normalised.mean(axis=0)
        groups = [normalised[members].mean(axis=0) for members in s.members.values()]
        squares = np.vstack([square, together, *groups])
        count = int(solved.sum())
        products = _products(error, s.linear_bound, solved)
        unit = np.where(s.linear_bound > 0, s.linear_bound, 1.0)
        scale = np.sqrt(np.diag(products))
        correlation = products / np.outer(scale, scale) if count > 2 else np.full(products.shape, np.nan)
        found: dict[str, Any] = {
            "bias": _mean(error, solved),
            "std": unit * np.sqrt(np.diag(products) / (count - 1)) if count > 1 else np.full(s.n, np.nan),
            "correlation": correlation,
            "rmse": np.sqrt(_mean(square, solved)),
            "rmse_common": np.sqrt(_mean(square, common)),
            "rmse_all": np.sqrt(_mean(np.where(np.isfinite(error), square, np.inf))),
            "squares": Squares.of(_chosen(squares, solved)),
            "degrees": _degrees(products * np.outer(unit / s.linear_bound, unit / s.linear_bound), len(groups)),
            "binned": grouped(np.where(solved, squares, 0.0)),
            "counts": grouped(solved[None].astype(float)),
            "together": np.sqrt(together),
        }
        del normalised, squares, groups
        known = np.isfinite(deviation)
        over = np.abs(error) / deviation
        found |= {
            "reports_covariance": bool(known.any()),
            "reported": np.sqrt(_mean(deviation**2, solved & known.all(axis=0))),
            "nees": _mean(over**2, solved),
            "covered": _mean(over <= NORMAL_95),
        }
        crlb, bayes, linear_error = s.read("crlb", "bayes", "linear_error")
        found["compensation"] = _mean((error - linear_error) ** 2, solved)
        crlb, bayes = crlb**2, bayes**2
        found |= {"crlb_square": _mean(crlb, solved), "crlb": np.sqrt(_mean(crlb, solved))}
        found |= {"crlb_all": np.sqrt(_mean(crlb)), "bayes_all": np.sqrt(_mean(bayes))}
        found["bayes"] = np.sqrt(_mean(bayes, solved))
        return cls(**found, **_of_first_trials(s, solved))


def _of_first_trials(s: Sample, solved: Array) -> dict[str, Any]:
    """What is stored for some trials of each seed only."""
    bound, error, *theory = s.read("van_trees", "van_trees_error", *THEORY)
    drawn: Array = np.asarray(~np.isnan(bound[0]))
    mean = np.sqrt(_mean(bound**2, drawn))
    # Of the squared bounds of several seeds, whose errors are twice the bound times its own.
    square = _mean((2 * bound * error) ** 2, drawn) / max(1, int(drawn.sum()))
    box, wrong, scatter = theory
    used: Array = np.asarray(solved & np.isfinite(wrong).all(axis=0) & np.isfinite(scatter).all(axis=0))
    bent: Array = np.asarray(np.isfinite(box).all(axis=0))
    return {
        "van_trees": mean,
        "van_trees_error": np.sqrt(square) / (2 * mean),
        "predicted": (_mean(wrong, used), _mean(wrong**2 + scatter**2, used)),
        "box": (_mean(box, bent), _mean(box**2, bent)),
    }


def _chosen(values: Array, used: Array | None) -> Array:
    return values if used is None or used.all() else values[:, used]


def _mean(values: Array, used: Array | None = None) -> Array:
    """The mean (k,) of columns (k, trials) over the trials used; NaN where there is none."""
    chosen = _chosen(values, used)
    return chosen.sum(axis=1) / chosen.shape[1] if chosen.shape[1] else np.full(len(values), np.nan)


def _products(error: Array, linear_bound: Array, solved: Array) -> Array:
    """Sums (n, n) of products of the deviations of errors (n, trials) from their mean, in multiples of the linear
    bound: parameters may differ by many orders of magnitude."""
    chosen = _chosen(error / np.where(linear_bound > 0, linear_bound, 1.0)[:, None], solved)
    if not chosen.shape[1]:
        return np.zeros((len(error), len(error)))
    centred = chosen - chosen.mean(axis=1)[:, None]
    return centred @ centred.T


def _degrees(products: Array, groups: int) -> Array:
    n = len(products)
    together = np.trace(products) ** 2 / np.sum(products**2)
    whole = np.floor(together + 1e-9) if 1 <= together <= n + 1e-6 else 1.0
    return np.array([*np.ones(n), whole, *np.ones(groups)])


def _read_only(array: Array) -> Array:
    array.flags.writeable = False
    return array.view()
