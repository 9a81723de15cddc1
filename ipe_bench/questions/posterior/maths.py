"""Samples the posterior of one trial by sequential Monte Carlo, to compare Gaussians of estimators with it.

Slow and general, with nothing linearised: particles go from the prior to the posterior by tempering the likelihood (Del
Moral, Doucet and Jasra, J. R. Stat. Soc. B 68, 2006), moved by Metropolis steps with covariances of Gauss and Newton.
The likelihood is the one that estimators assume: normal errors of covariance R, for every noise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, deviations, information, inverse, multiply
from ipe_bench.estimators.base import Estimates, Estimator, estimate_safely
from ipe_bench.measurements.problem import Problem
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario

PARTICLES = 1000
"""Number of particles in two independent populations together: if they disagree, neither is to be believed."""
AGREED = 0.35
"""Means of populations farther apart than this, in deviations of the posterior, have not settled; half of it and the
deviations differ by more."""
_KEPT = 0.5
"""The share of effective particles that a step of temperature leaves."""
_ACCEPTED = 0.25
"""The share of moves that step lengths are set to accept (Roberts, Gelman and Gilks, Ann. Appl. Probab. 7, 1997)."""
_MOVES, _FEWEST, _MOST = 3.0, 4, 30
"""Accepted moves per particle and stage, and the least and most that are tried."""
_POOL = 32
"""Particles whose slopes give the shapes of moves in a stage."""
_SETTLE, _SNAPSHOTS, _BETWEEN = 40, 8, 8
"""Moves at the end before draws are kept, how often they are, and moves between."""
_MOST_STAGES = 2000
_STARTS = 48
"""Draws from which modes are looked for."""
_SAME_MODE = 0.5
"""Maxima closer than this, in deviations of the posterior, are one mode."""
_COMPARED = 1000
"""Draws of an estimator's Gaussian, and of the posterior, behind an energy distance."""


@dataclass(frozen=True)
class Posterior:
    """Holds draws of a trial's posterior, in multiples of the parameters' sizes."""

    x: Array
    """(draws, n), equally weighted."""
    modes: Array
    """(modes, n): local maxima of the posterior that draws lead to, the one with most draws first."""
    shares: Array
    """(modes,) of the draws that lead there."""
    apart: float
    """Difference of the populations' means in standard deviations, or half of their widths' in their logarithms."""
    noise: float
    """The divergence (see `Divergence.kl`) of the populations' own moments: what is not above it is chance."""
    evidence: Array
    """(populations,): the logarithm of the probability density of the readings."""

    @cached_property
    def mean(self) -> Array:
        return self.x.mean(axis=0)

    @cached_property
    def covariance(self) -> Array:
        return np.atleast_2d(np.cov(self.x.T))

    @cached_property
    def deviation(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    @property
    def settled(self) -> bool:
        """Whether the populations agree, so that the draws can be believed."""
        return bool(self.apart <= AGREED)


@dataclass(frozen=True)
class Divergence:
    """Measures how far an estimator's Gaussian is from the posterior."""

    kl: float
    """The Kullback-Leibler divergence, in nats, from the Gaussian with the posterior's moments to the estimator's:
    0.5 (tr P^-1 S + d' P^-1 d - n + ln |P| / |S|). Infinite where no Gaussian is reported."""
    shift: float
    """|d| in the metric of the posterior's covariance S, per root of n: how far the estimate is from its mean."""
    width: float
    """The estimator's deviations over the posterior's, the geometric mean over all directions."""
    energy: float
    """The energy distance (Székely and Rizzo, J. Stat. Plan. Inference 143, 2013) between draws of both, over the
    posterior's own mean distance: 0 where they are alike, moments or not."""


@dataclass(frozen=True)
class Reference:
    """Holds a trial's posterior, and what estimators made of the same readings."""

    trial: int
    truth: Array
    """(n,)"""
    posterior: Posterior
    estimators: Mapping[str, Estimator]
    estimates: Mapping[str, Estimates]
    divergences: Mapping[str, Divergence]


def reference(
    scenario: Scenario, estimators: Mapping[str, Estimator], trial: int, particles: int = PARTICLES
) -> Reference:
    """Computes the posterior of one trial of a scenario beside its estimators.

    Raises:
        UserError: the scenario has no prior or one that is not normal, or there are too few particles.
    """
    if not scenario.prior.normal:
        raise UserError(
            f"prior={scenario.prior.name}: is not normal, as the posterior here takes it to be"
        )
    drawn = scenario.draw(trial, trial + 1)
    sampled = sample_posterior(scenario.problem, drawn.z[0], particles=particles, seed=trial)
    estimates = {
        label: estimate_safely(e, scenario.problem, drawn.z) for label, e in estimators.items()
    }
    divergences = {label: divergence(sampled, e) for label, e in estimates.items()}
    return Reference(trial, drawn.x[0], sampled, estimators, estimates, divergences)


def require_particles(problem: Problem, particles: int) -> None:
    """Refuses a problem without a prior, and fewer than ten particles per parameter and population."""
    if problem.prior_deviation is None:
        raise UserError(
            "posterior: needs a prior; choose a noise and an error_scale that parameters are drawn with"
        )
    if particles < (least := 20 * problem.measurement.n):
        raise UserError(
            f"particles={particles}: give at least {least}, 10 per parameter and population"
        )


def sample_posterior(
    problem: Problem, z: Array, *, particles: int = PARTICLES, seed: int = 0
) -> Posterior:
    """Samples the posterior of one trial's readings z (m,), by two populations that are put together by their evidence.

    Raises:
        UserError: no prior is known, or there are too few particles.
    """
    require_particles(problem, particles)
    generators = [
        np.random.Generator(np.random.Philox(s)) for s in np.random.SeedSequence(seed).spawn(2)
    ]
    runs = [_Population.run(problem, z, particles // 2, rng) for rng in generators]
    parts, evidence = [run.x for run in runs], np.array([run.evidence for run in runs])
    # As many draws of each population as its evidence deserves, the best one's all.
    counts = np.round(np.exp(evidence - evidence.max()) * [len(p) for p in parts]).astype(int)
    spaced = [
        p[np.linspace(0, len(p) - 1, count).round().astype(int)]
        for p, count in zip(parts, counts, strict=True)
    ]
    x = np.concatenate(spaced)
    means, widths = (
        np.stack([p.mean(axis=0) for p in parts]),
        np.stack([p.std(axis=0) for p in parts]),
    )
    moved = np.ptp(means, axis=0) / widths.max(axis=0)
    apart = float(max(moved.max(), 0.5 * np.ptp(np.log(widths), axis=0).max()))
    one, other = (np.atleast_2d(np.cov(p.T)) for p in parts)
    return Posterior(
        x, *_modes(problem, z, x), apart, _kl(means[1] - means[0], other, one), evidence
    )


def _kl(d: Array, S: Array, P: Array) -> float:
    """Computes the divergence from N(0, S) to N(d, P), in nats."""
    inner = np.linalg.inv(P)
    log_ratio = np.linalg.slogdet(P)[1] - np.linalg.slogdet(S)[1]
    return float(0.5 * (np.trace(inner @ S) + d @ inner @ d - len(d) + log_ratio))


def _modes(problem: Problem, z: Array, x: Array) -> tuple[Array, Array]:
    starts = x[np.linspace(0, len(x) - 1, min(_STARTS, len(x))).round().astype(int)]
    with np.errstate(all="ignore"):
        ends = least_squares_root(
            problem, np.broadcast_to(z, (len(starts), len(z))).copy(), starts, prior=1.0
        )
    ends = ends[np.isfinite(ends).all(axis=1)]
    if not len(ends):
        return np.empty((0, x.shape[1])), np.empty(0)
    width = deviations(inverse(_tempered(problem, ends, 1.0))[0])
    counts: Counter[int] = Counter()
    for i, end in enumerate(ends):
        counts[
            next((k for k in counts if (np.abs(end - ends[k]) / width[k]).max() < _SAME_MODE), i)
        ] += 1
    order, numbers = zip(*counts.most_common(), strict=True)
    return ends[list(order)], np.array(numbers) / len(ends)


def _tempered(problem: Problem, x: Array, beta: float) -> Array:
    """Computes beta J' R^-1 J + P0^-1 (points, n, n)."""
    return (
        beta * information(problem.measurement.jacobian(x), problem.R) + _prior(problem).inverse()
    )


def _prior(problem: Problem) -> Covariance:
    prior = problem.prior_covariance()
    assert prior is not None
    return prior


@dataclass
class _Population:
    """Moves particles on their way from the prior to the posterior."""

    problem: Problem
    z: Array
    rng: np.random.Generator
    x: Array
    beta: float = 0.0
    """The power of the likelihood that the particles are draws with."""
    reach: float = 1.0
    """The length of moves, times 2.38 / sqrt(n)."""
    evidence: float = 0.0

    def __post_init__(self) -> None:
        self.log = self._log_likelihood(self.x)

    @classmethod
    def run(cls, problem: Problem, z: Array, count: int, rng: np.random.Generator) -> _Population:
        x = problem.x0 + _prior(problem).coloured(
            rng.standard_normal((count, problem.measurement.n))
        )
        self = cls(problem, z, rng, x)
        for _ in range(_MOST_STAGES):
            self._stage()
            if self.beta == 1:
                self.x = self._final()
                return self
        raise UserError(
            f"particles={count}: do not reach the posterior in {_MOST_STAGES} stages; give more"
        )

    def _log_likelihood(self, x: Array) -> Array:
        """Computes the logarithm of the likelihood of each, less its constant."""
        with np.errstate(all="ignore"):
            model = self.problem.measurement
            r = self.problem.R.whiten(self.z - model.near(model.simulate(x), self.z))
            squares = np.sum(r**2, axis=1)
        return np.where(np.isfinite(squares), -0.5 * squares, -np.inf)

    def _stage(self) -> None:
        """Takes a step of temperature, resampling, and moves."""
        rise = self._rise()
        w = np.exp(rise * (self.log - self.log.max()))
        self.evidence += float(np.log(w.mean()) + rise * self.log.max())
        self.beta = 1.0 if self.beta + rise >= 1 - 1e-12 else self.beta + rise
        # Each as often as its weight says, by one draw for all (Kitagawa, J. Comput. Graph. Stat. 5, 1996).
        at = (self.rng.random() + np.arange(len(w))) / len(w)
        chosen = np.minimum(np.searchsorted(np.cumsum(w / w.sum()), at), len(w) - 1)
        self.x, self.log = self.x[chosen], self.log[chosen]
        shapes, accepted, tried = self._shapes(), 0.0, 0
        while tried < _MOST and (tried < _FEWEST or accepted < _MOVES):
            accepted += self._move(shapes)
            tried += 1

    def _rise(self) -> float:
        """Finds the growth of the power at which half of the particles still count, by bisection of its logarithm: it
        begins at billionths."""

        def effective(rise: float) -> float:
            w = np.exp(rise * (self.log - self.log.max()))
            return float(w.sum() ** 2 / np.sum(w**2) / len(w))

        most = 1 - self.beta
        if effective(most) >= _KEPT:
            return most
        low, high = -300.0, float(np.log10(most))
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if effective(10**middle) >= _KEPT else (low, middle)
        return 10**low

    def _shapes(self) -> Array:
        """Computes factors (shapes, n, n) of covariances: Gauss and Newton's at some particles. A move's shape is that
        of another particle, drawn anew each time, so that moves there and back are alike."""
        some = self.rng.choice(len(self.x), min(_POOL, len(self.x)), replace=False)
        with np.errstate(all="ignore"):
            P = inverse(_tempered(self.problem, self.x[some], self.beta))[0]
        P = P[np.isfinite(P).all(axis=(1, 2))]
        if not len(P):
            return np.diag(_prior(self.problem).deviations)[None]
        D = deviations(P)
        # By eigenvalues, since round-off may leave a correlation a shade beyond 1.
        values, axes = np.linalg.eigh(P / (D[:, :, None] * D[:, None, :]))
        return D[:, :, None] * axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]

    def _move(self, shapes: Array) -> float:
        """Takes a Metropolis step of every particle; returns the share that is accepted."""
        (count, n), prior, x0 = self.x.shape, _prior(self.problem), self.problem.x0
        chosen = self.rng.integers(0, len(shapes), count)
        step = multiply(shapes[chosen], self.rng.standard_normal((count, n)))
        proposed = self.x + self.reach * 2.38 / np.sqrt(n) * step
        log = self._log_likelihood(proposed)
        before, after = (
            -0.5 * np.sum(prior.whiten(x - x0) ** 2, axis=1) for x in (self.x, proposed)
        )
        with np.errstate(invalid="ignore"):
            gain = self.beta * (log - self.log) + after - before
        taken = np.log(self.rng.random(count)) < gain
        self.x, self.log = (
            np.where(taken[:, None], proposed, self.x),
            np.where(taken, log, self.log),
        )
        share = float(taken.mean())
        self.reach = float(np.clip(self.reach * np.exp(share - _ACCEPTED), 1e-4, 4.0))
        return share

    def _final(self) -> Array:
        """Samples draws (snapshots x particles, n) of the posterior itself; the length of moves no longer changes."""
        shapes = self._shapes()
        for _ in range(_SETTLE):
            self._move(shapes)
        kept, reach = [], self.reach
        for _ in range(_SNAPSHOTS):
            shapes = self._shapes()
            for _ in range(_BETWEEN):
                self._move(shapes)
                self.reach = reach
            kept.append(self.x)
        return np.concatenate(kept)


def divergence(posterior: Posterior, estimates: Estimates) -> Divergence:
    """Measures how far the Gaussian of the first trial of `estimates` is from the posterior."""
    scale, n = posterior.deviation, posterior.x.shape[1]
    d, S = (estimates.x[0] - posterior.mean) / scale, posterior.covariance / np.outer(scale, scale)
    shift = float(np.sqrt(d @ np.linalg.solve(S, d) / n)) if np.isfinite(d).all() else np.inf
    nothing = Divergence(np.inf, shift, np.nan, np.nan)
    P = (
        np.full((n, n), np.nan)
        if estimates.covariance is None
        else estimates.covariance[0] / np.outer(scale, scale)
    )
    if not (np.isfinite(P).all() and np.isfinite(d).all()):
        return nothing
    values, axes = np.linalg.eigh(P)
    if values[0] <= 0:
        return nothing
    log_ratio = float(np.sum(np.log(values)) - np.linalg.slogdet(S)[1])
    white = np.random.Generator(np.random.Philox(0)).standard_normal((_COMPARED, n))
    draws = d + (white * np.sqrt(values)) @ axes.T
    theirs = (posterior.x - posterior.mean) / scale
    theirs = theirs[np.linspace(0, len(theirs) - 1, _COMPARED).round().astype(int)]
    return Divergence(
        _kl(d, S, P), shift, float(np.exp(0.5 * log_ratio / n)), _energy(draws, theirs, S)
    )


def _energy(a: Array, b: Array, S: Array) -> float:
    """Computes 2 E|A - B| - E|A - A'| - E|B - B'| over E|B - B'|, in the metric of S."""
    from scipy.spatial.distance import cdist, pdist

    L = np.linalg.inv(np.linalg.cholesky(S)).T
    a, b = a @ L, b @ L
    own = pdist(b).mean()
    return max(0.0, float((2 * cdist(a, b).mean() - pdist(a).mean() - own) / own))
