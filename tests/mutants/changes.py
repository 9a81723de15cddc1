"""Changes that would make ipe-bench wrong, and the quick tests that notice each; `notice.py` tries
them.

A change replaces a snippet that stands exactly once in the package, wherever that is: white space
and commas before a bracket do not count, so that neither reformatting nor moving a module makes a
change stale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
PACKAGE = TESTS.parent / "ipe_bench"


@dataclass(frozen=True)
class Change:
    """A snippet that is replaced by another, and what that does."""

    room: str
    does: str
    """What becomes wrong, in words."""
    before: str
    after: str
    tests: str
    """Names of test files or of folders of them, wherever they stand; those that notice it soonest
    come first."""
    survives: str = ""
    """Why no quick test notices it; empty if one does."""

    @property
    def files(self) -> list[Path]:
        """The test files and folders that are named."""
        return [path for name in self.tests.split() for path in TESTS.rglob(name)]


@cache
def sources() -> dict[Path, str]:
    """The text of every module, folded."""
    return {
        path: folded(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))
    }


def folded(text: str) -> str:
    """A text without white space and without commas before a bracket."""
    text = "".join(text.split())
    for bracket in ")]}":
        text = text.replace(f",{bracket}", bracket)
    return text


def places(change: Change) -> Iterator[tuple[Path, int]]:
    """Where the snippet stands: modules, and places in their folded text."""
    wanted = folded(change.before)
    for path, text in sources().items():
        at = text.find(wanted)
        while at >= 0:
            yield path, at
            at = text.find(wanted, at + 1)


def changed(text: str, change: Change) -> str:
    """The text of a module with the snippet, with the other one in its place."""
    solid = [i for i, sign in enumerate(text) if not sign.isspace()]
    commas = {i for i, after in pairwise(solid) if text[i] == "," and text[after] in ")]}"}
    kept = [i for i in solid if i not in commas]
    wanted = folded(change.before)
    at = folded(text).index(wanted)
    return text[: kept[at]] + change.after + text[kept[at + len(wanted) - 1] + 1 :]


CHANGES = {
    # Those that an audit of 0.3.0 found unnoticed.
    "margin-start": Change(
        "statistics",
        "a start that may be right counts as wrong where two folders are compared",
        "if _may_be_right(kind, first, n):",
        "if False:",
        "test_margins.py test_compare.py",
    ),
    "margin-crossing": Change(
        "statistics",
        "an interval that holds what is right counts as if it ended there",
        "0.0 if crosses else min(ends)",
        "min(ends)",
        "test_margins.py test_compare.py",
    ),
    "bias-either": Change(
        "statistics",
        "bias is compared over trials in which either succeeds",
        "np.logical_and(*_successes(a, b, one, other))",
        "np.logical_or(*_successes(a, b, one, other))",
        "test_margins.py test_compare.py",
    ),
    "widened-by-second": Change(
        "statistics",
        "a ratio is widened in parts of the mean of the second",
        "if largest is None else largest) / means[0]",
        "if largest is None else largest) / means[1]",
        "test_paired.py",
    ),
    "unseen-few": Change(
        "statistics",
        "one differing trial in twenty is taken for having seen the others",
        "others >= min(RARE, trials / 2)",
        "others >= min(RARE, trials / 20)",
        "test_paired.py",
    ),
    "capped-least": Change(
        "statistics",
        "errors that the bound allows count as unusual beside smaller ones",
        "rare = unseen(squares, degrees, least=1 / degrees)",
        "rare = unseen(squares, degrees)",
        "test_intervals.py",
    ),
    "rmse-unseen": Change(
        "statistics",
        "the upper end of rmse is given though larger errors may be unseen",
        "unknown = few | (rmse_unseen(s) > 0)",
        "unknown = few",
        "test_sequences.py",
    ),
    "inflation-once": Change(
        "trials",
        "the test of fit takes the inflation of a prior for that of its variance",
        "(1 + inflation**2 * values) ** 2",
        "(1 + inflation * values) ** 2",
        "test_fit_test.py",
    ),
    "cosines-largest": Change(
        "trials",
        "of few readings the least oblique directions are left in the test of fit",
        "others[:, n - min(n, m - n) :]",
        "others[:, : min(n, m - n)]",
        "test_fit_test.py",
    ),
    "angles-unturned": Change(
        "trials",
        "residuals of angles are not within half a turn",
        "self.trials.z - self.problem.measurement.near(h, self.trials.z)",
        "self.trials.z - h",
        "test_scoring.py",
    ),
    "path-missing": Change(
        "states",
        "the fit of a path counts missing readings",
        "chdtrc(np.isfinite(z).sum(axis=(1, 2)), cost)",
        "chdtrc(np.ones(z.shape).sum(axis=(1, 2)), cost)",
        "test_paths.py",
    ),
    "restart-narrow": Change(
        "states",
        "restarts of lm_ieks have a fiftieth of the prior's deviations",
        "_SHARES[number % len(_SHARES)] ** 2 * P",
        "0.02**2 * P",
        "test_paths.py",
    ),
    "damping-unscaled": Change(
        "states",
        "damping of lm_ieks knows no unit of the states",
        "1 / np.where(scale > 0, scale, np.inf)",
        "np.ones_like(scale)",
        "test_paths.py",
    ),
    "ekf-alone": Change(
        "states",
        "lm_ieks begins at the EKF alone",
        "other = Descent.of(density, passed(model, z, Unscented())[0])",
        "other = first",
        "test_paths.py",
    ),
    "recorded-unheld": Change(
        "states",
        "a recorded function is used without being held against the model's own",
        'return "other slopes" if wrong.any() else ""',
        'return ""',
        "test_judged.py",
    ),
    "values-unheld": Change(
        "states",
        "a recorded function may have other values than the model's own",
        "if not same_values(recorded(odd), own(odd)):",
        "if False:",
        "test_along.py",
    ),
    "astray": Change(
        "states",
        "trials that recorded functions lead astray stay there",
        "astray = _astray(model, tracks)",
        "astray = np.zeros(len(z), dtype=bool)",
        "test_judged.py",
    ),
    "never-renewed": Change(
        "states",
        "a model that has changed is tracked by its old functions",
        "if not _UNCHANGED.get():",
        "if False:",
        "test_judged.py",
    ),
    "slopes-unjudged": Change(
        "functions",
        "complex steps are not doubted where they are used",
        "rows = np.flatnonzero(self._wrong_slopes(x, value, J))",
        "rows = np.empty(0, dtype=int)",
        "test_judged.py",
    ),
    "ties-unmended": Change(
        "states",
        "a branch that stands for one point gives its slope",
        "if self.ties is None:",
        "if True:",
        "test_battery.py",
    ),
    "trap-swallowed": Change(
        "functions",
        "a refusal that a bare except swallows is forgotten",
        "if graph.refused:",
        "if False:",
        "test_judged.py",
    ),
    "wide-steps": Change(
        "functions",
        "wide differences step over what narrow ones find",
        "apart = np.abs(slope - finest) - noise",
        "apart = 0.0 * np.abs(slope - finest)",
        "test_judged.py test_constants.py",
    ),
    "copied-functions": Change(
        "states",
        "a copy of a model has the functions of what it was copied from",
        "if self._functions[0] is not self:",
        "if False:",
        "test_along.py",
    ),
    "numbers-of-first": Change(
        "engine",
        "every epoch has the inputs of the first",
        "repeated = b.urem(i, count)",
        "repeated = integer(0)",
        "test_along.py",
    ),
    "frozen-sandwich": Change(
        "states",
        "the covariance of a path at the root of eq. (11) is that of frozen slopes",
        "self.Q[:N] - np.matmul(self.gain, W)",
        "self.Q[:N] - 0 * np.matmul(self.gain, W)",
        "test_paths.py",
    ),
    "copies-unhalved": Change(
        "states",
        "copies of a path weigh exp(-J)",
        "np.exp((cost - density.settled(other).cost) / 2)",
        "np.exp(cost - density.settled(other).cost)",
        "test_copies.py",
    ),
    "path-worst-epoch": Change(
        "trials",
        "a path succeeds by its worst epoch",
        "finished & (normalised.mean(axis=1) <= gate(n))",
        "finished & (normalised.max(axis=1) <= gate(n))",
        "test_tracking.py",
    ),
    "posterior-error": Change(
        "trials",
        "the error of the posterior bound is that of one part in ten",
        ".std(axis=0, ddof=1)[at] / np.sqrt(_PARTS)",
        ".std(axis=0, ddof=1)[at]",
        "test_tracking.py",
    ),
    "periodic-state": Change(
        "states",
        "a periodic state is not followed next to its path",
        "state = State(near(state.x, path_here.x, self.state_periods), state.F)",
        "state = State(state.x, state.F)",
        "test_paths.py",
    ),
    "sigma-next": Change(
        "states",
        "sigma points of an angle lie about the first of them",
        "y = nearest(y, g(m)[..., None, :])",
        "y = nearest(y, y[..., :1, :])",
        "test_trackers.py",
    ),
    "far-below-each": Change(
        "real",
        "a log is far less likely at one per reading",
        "_FAR_BELOW + np.isfinite(best.nis).sum() / 10",
        "_FAR_BELOW + np.isfinite(best.nis).sum()",
        "test_verdicts.py",
    ),
    "deviance-shift": Change(
        "real",
        "minus twice the log likelihood is shifted",
        "return replace(minima, chi_square=value - shift)",
        "return replace(minima, chi_square=value)",
        "test_levels.py",
    ),
    "minima-twice": Change(
        "estimators",
        "a minimum that is found again counts as another",
        "if all(_apart(x, found.x[i], deviation[i]) for x in known):",
        "if True:",
        "test_minima.py",
    ),
    "restarts-free": Change(
        "estimators",
        "iterations of restarts are not counted",
        "spent[rows] += again.iterations",
        "spent[rows] += 0 * again.iterations",
        "test_minima.py",
    ),
    "no-end-kept": Change(
        "estimators",
        "a minimum does not replace a lower point that is none",
        "(~(self.chi_square >= old.chi_square) | ~old.converged)",
        "~(self.chi_square >= old.chi_square)",
        "test_minima.py",
    ),
    "report-in-search": Change(
        "estimators",
        "the slope of a report ends a trial where it raises",
        "replace(objective, model=objective.model.reporting()).subset(coarse)",
        "objective.subset(coarse)",
        "test_minima.py",
    ),
    # Others, over all rooms.
    "one-stream": Change(
        "basics",
        "noise and parameters of a trial come from one random stream",
        "spawn_key=(trial, child)",
        "spawn_key=(trial,)",
        "test_streams.py test_scenario.py",
    ),
    "turns-floored": Change(
        "basics",
        "a reading is shifted by whole turns to below the other one",
        "turns = np.round(np.real(z - to)",
        "turns = np.floor(np.real(z - to)",
        "test_bearings.py test_circular.py",
    ),
    "rows-of-factor": Change(
        "basics",
        "the covariance of some readings is made of rows of the Cholesky factor of all",
        "np.linalg.cholesky(self.matrix()[np.ix_(rows, rows)])",
        "self.factor[np.ix_(rows, rows)]",
        "test_linalg.py test_filters.py",
    ),
    "gathered-inverse": Change(
        "basics",
        "trials that end at different times come back in another order",
        "np.argsort(rows))",
        "rows)",
        "test_solver_matrix.py",
    ),
    "temporary-kept": Change(
        "basics",
        "a temporary file of a write that fails stays",
        "temporary.unlink(missing_ok=True)",
        "temporary.exists()",
        "test_files.py",
    ),
    "safety-forgotten": Change(
        "engine",
        "the estimate of an integration error is believed to the last digit",
        "error = SAFETY * np.maximum(shifts, astray / STATES)",
        "error = np.maximum(shifts, astray / STATES)",
        "test_ode_integrator.py test_ode_paths.py test_gins.py",
    ),
    "states-unseen": Change(
        "engine",
        "an integration is judged by its readings alone",
        "SAFETY * np.maximum(shifts, astray / STATES)",
        "SAFETY * shifts",
        "test_stiff.py test_described_cases.py test_ode_paths.py",
    ),
    "stages-at-start": Change(
        "engine",
        "the stages of an explicit step are all at its beginning",
        "v.constant(plan.tableau.C[s])",
        "v.constant(0.0)",
        "test_ode_integrator.py test_driven.py test_compiled.py",
    ),
    "rodas-autonomous": Change(
        "engine",
        "sensitivities of stiff equations forget that rates depend on time",
        '"dft": Program.of(tangent(in_time, along), point + ways)',
        '"dft": Program.of(tangent(in_time, {}), point + ways)',
        "test_stiff.py",
    ),
    "line-before-rows": Change(
        "engine",
        "a straight input goes on before its first row",
        "np.where(k < 0, 0.0, slopes[row])",
        "slopes[row]",
        "test_driven.py",
    ),
    "constants-late": Change(
        "engine",
        "a reading sees the input of the interval before it",
        "self.place[lanes] + later",
        "self.place[lanes]",
        "test_driven.py test_stiff.py",
    ),
    "switch-inside": Change(
        "engine",
        "steps cross the moments at which known inputs change",
        "if same < time < end]",
        "if False]",
        "test_driven.py",
    ),
    "walk-per-time": Change(
        "measurements",
        "the random walk of a drift grows with time and not with its root",
        "self.gyro_random_walk * self._drift * np.sqrt(self.interval_min / 60.0)",
        "self.gyro_random_walk * self._drift * (self.interval_min / 60.0)",
        "test_gins.py test_walking_gins.py",
    ),
    "coriolis-sign": Change(
        "measurements",
        "the Coriolis acceleration along y has the other sign",
        "ay - coriolis * vx",
        "ay + coriolis * vx",
        "test_gins.py",
    ),
    "files-from-0": Change(
        "measurements",
        "the epochs of a second file are those of the first",
        "[rows + start for rows in part.epochs]",
        "list(part.epochs)",
        "test_files_together.py",
    ),
    "course-from-east": Change(
        "measurements",
        "an observer's course counts from east",
        "np.array([np.sin(heading), np.cos(heading)])",
        "np.array([np.cos(heading), np.sin(heading)])",
        "test_bearings.py",
    ),
    "logit-slope": Change(
        "measurements",
        "the slope of a parameter between two bounds forgets their distance",
        "above * below / (self.upper - self.lower)",
        "above * below",
        "test_instruments.py test_intervals_within.py test_fit.py",
    ),
    "prefix-for-free": Change(
        "measurements",
        "a Jacobian of the first epochs costs as much as one of all",
        "self.tally.jacobians[rows] += self.share * cost",
        "self.tally.jacobians[rows] += cost",
        "test_costs.py",
    ),
    "student-variance": Change(
        "noise",
        "Student's t has the variance of its scale squared",
        "scale = np.sqrt((self.degrees_of_freedom - 2) / self.degrees_of_freedom)",
        "scale = (self.degrees_of_freedom - 2) / self.degrees_of_freedom",
        "test_noise.py",
    ),
    "mixture-variance": Change(
        "noise",
        "gross errors count by their factor and not by its square",
        "self.share * self.factor**2",
        "self.share * self.factor",
        "test_noise.py",
    ),
    "coloured-fresh": Change(
        "noise",
        "coloured noise grows along its series",
        "fresh = np.sqrt(1 - self.correlation**2)",
        "fresh = np.sqrt(1 - self.correlation)",
        "test_noise.py",
    ),
    "rounded-error": Change(
        "noise",
        "the error is rounded and not the read-out",
        "np.rint((offset + h + shift) / self._size) - offset - shift",
        "np.rint((h + shift) / self._size) - shift",
        "test_noise.py test_gins.py",
    ),
    "prior-transposed": Change(
        "priors",
        "correlated parameters are drawn by the transposed factor",
        "np.linalg.cholesky(C) @ white",
        "np.linalg.cholesky(C).T @ white",
        "test_correlated_prior.py",
    ),
    "scale-forgotten": Change(
        "priors",
        "an error scale widens the draws alone",
        "return error_scale * of_each",
        "return of_each",
        "test_scenario.py test_scoring.py",
    ),
    "never-diverged": Change(
        "estimators",
        "an iteration that runs away is not called diverged",
        "(check.growth > FAR * begun, Status.DIVERGED)",
        "(check.growth > np.inf, Status.DIVERGED)",
        "test_solver_matrix.py test_paths.py",
    ),
    "budget-twice": Change(
        "estimators",
        "a search ends at twice its budget",
        "tally.of_search(n)[rows] >= limits.budget",
        "tally.of_search(n)[rows] >= 2 * limits.budget",
        "test_solver_matrix.py test_costs.py test_least_squares.py",
    ),
    "linear-covariance": Change(
        "estimators",
        "a root reports the covariance of the linear estimate",
        "return np.matmul(np.matmul(inverse_slope, self.covariance()), inverse_slope.swapaxes(1,"
        " 2))",
        "return self.covariance() + 0 * inverse_slope",
        "test_equations.py test_solver_matrix.py",
    ),
    "geodesic-sign": Change(
        "estimators",
        "geodesic acceleration bends a step the other way",
        "np.where(believed[:, None], 0.5 * a, 0.0)",
        "np.where(believed[:, None], -0.5 * a, 0.0)",
        "test_batched_least_squares.py test_least_squares.py",
    ),
    "broyden-transposed": Change(
        "solvers",
        "Broyden's update multiplies by B and not by its transpose",
        "multiply(state.B.swapaxes(1, 2), s)",
        "multiply(state.B, s)",
        "test_solver_matrix.py test_equations.py",
    ),
    "anderson-newest": Change(
        "solvers",
        "Anderson's memory keeps the oldest difference",
        "memory[:, :, :-1]]",
        "memory[:, :, 1:]]",
        "test_solver_matrix.py",
    ),
    "armijo-uphill": Change(
        "solvers",
        "a line search takes steps that lead uphill",
        "(1 - self.decrease * t) * size",
        "(1 + self.decrease * t) * size",
        "test_solver_matrix.py",
    ),
    "prior-unasked": Change(
        "solvers",
        "among minima that fit the prior has no say",
        "return minima.chi_square + of_prior",
        "return minima.chi_square",
        "test_auto.py",
    ),
    "rounds-not-steps": Change(
        "solvers",
        "relinearized counts rounds for steps",
        "state.steps + ended.iterations",
        "state.steps + 1",
        "test_solver_matrix.py",
    ),
    "candidates-once": Change(
        "solvers",
        "of several candidates of a trial one alone is paid for",
        "np.add.at(total, owner, spent)",
        "total[owner] += spent",
        "test_costs.py test_auto.py",
    ),
    "beta-is-kappa": Change(
        "baselines",
        "the unscented filter takes beta for kappa",
        "MerweScaledSigmaPoints(n, self.alpha, self.beta, self.kappa)",
        "MerweScaledSigmaPoints(n, self.alpha, self.kappa, self.beta)",
        "test_filters.py",
    ),
    "nis-each-time": Change(
        "baselines",
        "every linearisation of an epoch adds to the squared innovations",
        "if self.iteration == 1:",
        "if self.iteration >= 1:",
        "test_filters.py",
    ),
    "starts-beyond-budget": Change(
        "baselines",
        "multistart begins again beyond its budget",
        "(confirmed < self.confirmations) & affordable & ~hopeless",
        "(confirmed < self.confirmations) & ~hopeless",
        "test_minima.py test_least_squares.py",
    ),
    "worse-of-two": Change(
        "baselines",
        "of two minimisations the higher minimum is kept",
        "costs[1] < costs[0] * (1 - 1e-12)",
        "costs[1] > costs[0] * (1 - 1e-12)",
        "test_least_squares.py test_nist.py",
    ),
    "inflation-ignored": Change(
        "baselines",
        "map_lm does not inflate the prior",
        "Objective.of(problem, z, self.prior_inflation)",
        "Objective.of(problem, z, 1.0)",
        "test_least_squares.py test_scoring.py",
    ),
    "forgets-nothing": Change(
        "baselines",
        "the filters of a batch have no process noise",
        "self.P[at] += self.Q",
        "self.P[at] += 0 * self.Q",
        "test_filters.py",
    ),
    "missing-density": Change(
        "states",
        "a missing reading counts in the log likelihood",
        "np.where(np.less_equal(one, 0.0), 1.0, 2 * np.pi * one * one)",
        "np.where(np.less_equal(one, 0.0), 2 * np.pi, 2 * np.pi * one * one)",
        "test_likelihood.py test_trackers.py",
    ),
    "iterated-once": Change(
        "states",
        "an iterated filter linearises at the prediction again",
        "linear = law(h, state, update.state)",
        "linear = law(h, state, state)",
        "test_trackers.py test_likelihood.py test_logs.py",
    ),
    "smoother-gain": Change(
        "states",
        "a smoother forgets the noise of a transition",
        "lower(beside(product(X, S), Y))",
        "lower(product(X, S))",
        "test_recorded_steps.py",
    ),
    "resampled-last": Change(
        "states",
        "resampling leaves out the last share of the weights",
        "upto = np.ceil(N * np.cumsum(w, axis=1) - offset[:, None]).clip(0, N)",
        "upto = np.floor(N * np.cumsum(w, axis=1) - offset[:, None]).clip(0, N)",
        "test_likelihood.py test_trackers.py",
    ),
    "smoothers-bound": Change(
        "trials",
        "a smoother's path is held to the filter's bound",
        "self.smoothed_variances if tracker.smooths else self.variances",
        "self.variances",
        "test_tracking.py",
    ),
    "design-squared": Change(
        "trials",
        "designs are compared by variances and called deviations",
        "np.sqrt((1 / s).mean())",
        "(1 / s).mean()",
        "test_design.py",
    ),
    "evidence-untempered": Change(
        "trials",
        "the evidence of readings forgets the temperature",
        "float(np.log(w.mean()) + rise * self.log.max())",
        "float(np.log(w.mean()) + self.log.max())",
        "test_posterior.py",
    ),
    "noise-of-block": Change(
        "trials",
        "a trial's noise depends on the block in which it is drawn",
        "numbered(self.seed, start, stop, _NOISE)",
        "numbered(self.seed, 0, stop - start, _NOISE)",
        "test_scenario.py test_joined.py test_execution.py",
    ),
    "lags-alike": Change(
        "trials",
        "far lags of few pairs weigh as much as near ones",
        "count * (count + 2) * r**2 / np.maximum(number, 1)",
        "(count + 2) * r**2",
        "test_residuals.py test_tracking.py",
    ),
    "covered-once": Change(
        "runs",
        "a range that lies inside of another one opens a gap",
        "reached = max(reached, last)",
        "reached = last",
        "test_store.py",
    ),
    "blocks-off-grid": Change(
        "runs",
        "blocks that are continued do not lie on the grid",
        "range((start // block_size + 1) * block_size, stop, block_size)",
        "range(start + block_size, stop, block_size)",
        "test_execution.py test_store.py",
    ),
    "source-forgotten": Change(
        "runs",
        "results of older code are taken for those of today's",
        '"source": self.made_by["source"]})',
        '"source": ""})',
        "test_keys.py test_definitions.py test_store.py",
    ),
    "shorter-first": Change(
        "runs",
        "of two files of the same trials the shorter is read first",
        "return self.start, -self.stop, str(self.path)",
        "return self.start, self.stop, str(self.path)",
        "test_store.py test_damage.py",
        survives=(
            "nothing is wrong: parts of one key hold the same bits, and each trial is taken once"
            " in either order"
        ),
    ),
    "footer-unchecked": Change(
        "runs",
        "a footer that was changed is believed",
        "if hashlib.sha256(footer).digest() != digest:",
        "if False:",
        "test_damage.py",
    ),
    "died-thrice": Change(
        "runs",
        "a task that ends its process is tried once more than is said",
        "self.tries[cell.key, task.start] < TRIES",
        "self.tries[cell.key, task.start] <= TRIES",
        "test_execution.py",
    ),
    "best-at-level": Change(
        "statistics",
        "the best of many is tested as if it had one rival",
        "level / max(k - 1, 1)",
        "level",
        "test_comparisons.py",
    ),
    "flag-unheard": Change(
        "statistics",
        "a failure that was called ambiguous counts as silent",
        "noticed = noticed | (s.scalars[AMBIGUOUS] > 0)",
        "noticed = noticed | (s.scalars[AMBIGUOUS] > 1)",
        "test_columns.py test_summary.py",
    ),
    "scale-of-shifted": Change(
        "statistics",
        "the scale of shifted errors holds their shift",
        "z = z - middle",
        "z = z + 0 * middle",
        "test_calibration.py",
    ),
    "wider-by-ratio": Change(
        "statistics",
        "a run that needs intervals half as wide takes twice as many trials",
        "1.02 * trials * ratio**2",
        "1.02 * trials * ratio",
        "test_sequences.py",
    ),
    "normal-for-t": Change(
        "real",
        "intervals of an estimated level are those of a known one",
        "freedom = None if self.level is None else self.degrees_of_freedom",
        "freedom = None",
        "test_fit.py test_levels.py",
    ),
    "new-reading": Change(
        "real",
        "a further reading is as uncertain as the curve",
        "np.hypot(self.fitted_errors, known[0] if same",
        "np.maximum(self.fitted_errors, 0 * known[0] if same",
        "test_examination.py test_levels.py test_fit.py",
    ),
    "turned-interval": Change(
        "real",
        "a negative unit turns an interval around",
        "values if slope[k] > 0 else values[::-1]",
        "values",
        "test_intervals_within.py test_fit.py test_examination.py",
    ),
    "raw-noise": Change(
        "real",
        "residuals are tested for whiteness as if nothing had been fitted",
        "noise - (noise @ Q) @ Q.T",
        "noise",
        "test_residuals.py",
    ),
    "keys-twice": Change(
        "plugins",
        "of a key that stands twice in a file one value is lost",
        "if key.value in known:",
        "if False:",
        "test_options.py test_check_options.py",
    ),
    "yaml-unread": Change(
        "plugins",
        "texts of a skeleton are looked for in Python alone",
        'sorted(home.rglob("*")) if p.suffix in (".py", ".yaml")',
        'sorted(home.rglob("*")) if p.suffix in (".py",)',
        "test_check_options.py test_conformance.py",
    ),
    "mean-below": Change(
        "report",
        "a mean cost far below the median is not shown",
        "abs(mean - median) > _ALIKE * median",
        "mean - median > _ALIKE * median",
        "test_report.py test_headline.py",
    ),
    "milli-is-micro": Change(
        "report",
        "milliseconds are called microseconds",
        '" ms": 1e-3, " µs": 1e-6',
        '" µs": 1e-3, " ms": 1e-6',
        "test_report.py test_headline.py",
    ),
    "grey-faces": Change(
        "report",
        "estimators that the bench is about may be grey",
        "[*ranked[:1], *known, *ranked]",
        "[*ranked]",
        "test_figures.py",
    ),
    "seed-ignored": Change(
        "api",
        "run ignores its seed",
        "dataclasses.replace(one, seed=seed)",
        "one",
        "test_displays.py",
    ),
    "lacking-unsaid": Change(
        "questions",
        "compare passes over what the second lacks",
        "list(gone(ours, theirs, versions)) if complete else []",
        "[]",
        "test_compare.py",
    ),
    "problems-pass": Change(
        "cli",
        "compare exits with 0 though results are damaged",
        '1 if told["worse"] or told["problems"] else 0',
        '1 if told["worse"] else 0',
        "test_compare.py",
    ),
    "estimate-passes": Change(
        "cli",
        "estimate exits with 0 though no fit passes",
        "return 0 if all(answer.passes for answer in found) else 1",
        "return 0",
        "test_estimate.py",
    ),
    "figures-drawn": Change(
        "cli",
        "estimate draws figures though none were asked for",
        'drawn = asked.spec.figures != "none"',
        "drawn = True",
        "test_estimate.py",
    ),
    "interrupt-is-failure": Change(
        "cli",
        "Ctrl-C exits as a failure does",
        'return 130, f"stopped;',
        'return 1, f"stopped;',
        "test_this_command.py",
    ),
    "any-settled": Change(
        "cli",
        "posterior exits with 0 if one trial has settled",
        "settled = all(one.posterior.settled for one in found)",
        "settled = any(one.posterior.settled for one in found)",
        "test_one_scenario.py",
    ),
    # Those that a second random draw found unnoticed.
    "arrived-by-unit": Change(
        "states",
        "an iterated smoother by points ends early in units in which deviations are below 1",
        "moved & (deviation > 0)",
        "moved & (deviation > 1)",
        "test_paths.py",
    ),
    "unknown-directions": Change(
        "questions",
        "readings that leave two directions unknown have a finite mean bound",
        "s[:, 0] <= 1e-12 * s[:, -1]",
        "s[:, 0] <= 1e-12 * s[:, 1]",
        "test_design.py",
    ),
    "level-weighed": Change(
        "real",
        "fits with unknown levels are compared by another likelihood than theirs",
        "np.sum(w**2 + 2 * np.log(R.factor))",
        "np.sum(w**2 + 3 * np.log(R.factor))",
        "test_levels.py",
    ),
    "no-minimum": Change(
        "real",
        "resampled readings without a minimum count as answered",
        "found[beyond] = False",
        "found[beyond] = True",
        "test_examination.py",
    ),
    "tail-floor": Change(
        "statistics",
        "the p of a curve far outside its band is never below 1e-9",
        "np.minimum(2 * len(POINTS) * tails, _RESOLVED)",
        "np.maximum(2 * len(POINTS) * tails, _RESOLVED)",
        "test_calibration.py",
    ),
    "quantiles-shifted": Change(
        "statistics",
        "quantiles had from one sort are no quantiles",
        "between = a + (b - a) * beyond",
        "between = a + (b - a) + beyond",
        "test_intervals.py",
    ),
    "readings-unread": Change(
        "real",
        "every estimate is said to have no finite readings",
        "if not np.isfinite(residual).all():",
        "if not np.isnan(residual).all():",
        "test_answers_compared.py",
    ),
    "aside-unsaid": Change(
        "runs",
        "a run does not say which damaged files it computes again",
        'lines.append(f"{path}: {reason}; set aside as {aside.name} and computed again")',
        "pass",
        "test_damage.py",
    ),
    "names-alike": Change(
        "runs",
        "models of one name are not told apart in what is missing",
        'replace(state, tag=f" (#{state.key[:6]})")',
        "replace(state)",
        "test_store.py",
    ),
    "file-unstated": Change(
        "report",
        "the page of an estimate does not state the file that was read",
        'readings"],\n        sources=read_from(provenance)',
        'readings"]',
        "test_answers.py",
    ),
    "bound-by-prior": Change(
        "real",
        "an estimate with a prior is held on a bound",
        "if inside.with_prior:\n        return inside\n",
        "",
        "test_intervals_within.py",
    ),
    "nonfinite-unsaid": Change(
        "states",
        "a path without a cost is not said to be so",
        "np.where(finite, paths.status, Status.NONFINITE)",
        "np.where(finite, Status.NONFINITE, paths.status)",
        "test_whole_paths.py",
    ),
    "start-of-first": Change(
        "states",
        "the likelier smoother has the start of the other",
        "smooth.start.mean[rows] = unscented.start.mean[likelier]",
        "pass",
        "test_auto_tracker.py",
    ),
    "alike-unsaid": Change(
        "report",
        "the page of a log calls innovations alike that chance explains",
        "one.white_p >= FIT_LEVEL else",
        "one.white_p < FIT_LEVEL else",
        "test_answers.py",
    ),
}
