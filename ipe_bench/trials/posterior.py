"""What the readings of one trial really say: draws of the posterior, by sequential Monte Carlo, to hold Gaussians of
estimators against.

Slow and general, with nothing linearised: particles go from the prior to the posterior by tempering the likelihood (Del
Moral, Doucet and Jasra, J. R. Stat. Soc. B 68, 2006), moved by Metropolis steps with covariances of Gauss and Newton.
The likelihood is the one that estimators assume: normal errors of covariance R, for every noise.
"""

from __future__ import annotations

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
POPULATIONS = 2
"""Populations that know nothing of each other: where they disagree, neither is to be believed."""
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
    """Draws of a trial's posterior, in multiples of the parameters' sizes."""

    x: Array
    """(draws, n), equally weighted."""
    modes: Array
    """(modes, n): local maxima of the posterior that draws lead to, the one with most draws first."""
    shares: Array
    """(modes,) of the draws that lead there."""
    apart: float
    """How far the means of the populations differ, in standard deviations; not a number where there is one."""
    noise: float
    """The divergence (see `Divergence.kl`) of the populations' own moments: what is not above it is chance."""
    evidence: Array
    """(populations,): the logarithm of the probability density of the readings."""
    stages: int
    simulations: int

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
    """How far an estimator's Gaussian is from the posterior."""

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
    """A trial's posterior, and what estimators made of the same readings."""

    trial: int
    truth: Array
    """(n,)"""
    posterior: Posterior
    estimates: Mapping[str, Estimates]
    divergences: Mapping[str, Divergence]


def reference(
    scenario: Scenario, estimators: Mapping[str, Estimator], trial: int, particles: int = PARTICLES
) -> Reference:
    """The posterior of one trial of a scenario beside its estimators.

    Raises:
        UserError: the scenario has no prior or one that is not normal, or there are too few particles.
    """
    if not scenario.prior.normal:
        raise UserError(f"prior={scenario.prior.name}: is not normal, as the posterior here takes it to be")
    drawn = scenario.draw(trial, trial + 1)
    sampled = sample_posterior(scenario.problem, drawn.z[0], particles=particles, seed=trial)
    estimates = {label: estimate_safely(e, scenario.problem, drawn.z, history=False) for label, e in estimators.items()}
    return Reference(
        trial, drawn.x[0], sampled, estimates, {label: divergence(sampled, e) for label, e in estimates.items()}
    )


def require_particles(problem: Problem, particles: int, populations: int = POPULATIONS) -> None:
    """Refuses a problem without a prior, and fewer than ten particles per parameter and population."""
    if problem.prior_deviation is None:
        raise UserError("posterior: needs a prior; choose a noise and an error_scale that parameters are drawn with")
    least = 10 * problem.measurement.n * populations
    if particles < least:
        raise UserError(f"particles={particles}: give at least {least}, 10 per parameter and population")


def sample_posterior(
    problem: Problem, z: Array, *, particles: int = PARTICLES, populations: int = POPULATIONS, seed: int = 0
) -> Posterior:
    """Draws of the posterior of one trial's readings z (m,).

    Each of the populations has its share of the particles. They are put together by their evidence.

    Raises:
        UserError: no prior is known, or there are too few particles.
    """
    require_particles(problem, particles, populations)
    each = particles // populations
    sequences = np.random.SeedSequence(seed).spawn(populations)
    runs = [_Population.run(problem, z, each, np.random.Generator(np.random.Philox(s))) for s in sequences]
    evidence = np.array([run.evidence for run in runs])
    x = _together([run.x for run in runs], evidence)
    modes, shares = _modes(problem, z, x)
    return Posterior(
        x=x,
        modes=modes,
        shares=shares,
        apart=_apart([run.x for run in runs]),
        noise=_between([run.x for run in runs]),
        evidence=evidence,
        stages=max(run.stages for run in runs),
        simulations=sum(run.simulations for run in runs),
    )


def _apart(parts: list[Array]) -> float:
    """The largest distance of the means of populations, or of half their logarithmic deviations' twofold, in standard
    deviations of the widest."""
    if len(parts) < 2:
        return float("nan")
    means, widths = np.stack([p.mean(axis=0) for p in parts]), np.stack([p.std(axis=0) for p in parts])
    moved = np.ptp(means, axis=0) / widths.max(axis=0)
    return float(max(moved.max(), 0.5 * np.ptp(np.log(widths), axis=0).max()))


def _between(parts: list[Array]) -> float:
    """The largest divergence of one population's moments from another's."""
    moments = [(p.mean(axis=0), np.atleast_2d(np.cov(p.T))) for p in parts]
    found = [_kl(a[0] - b[0], a[1], b[1]) for i, a in enumerate(moments) for b in moments[:i]]
    return max(found, default=float("nan"))


def _kl(d: Array, S: Array, P: Array) -> float:
    """From N(0, S) to N(d, P), in nats."""
    inner = np.linalg.inv(P)
    log_ratio = np.linalg.slogdet(P)[1] - np.linalg.slogdet(S)[1]
    return float(0.5 * (np.trace(inner @ S) + d @ inner @ d - len(d) + log_ratio))


def _together(parts: list[Array], evidence: Array) -> Array:
    """As many draws of each population as its evidence deserves, the best one's all."""
    shares = np.exp(evidence - evidence.max())
    counts = np.round(shares * [len(p) for p in parts]).astype(int)
    spaced = [p[np.linspace(0, len(p) - 1, count).round().astype(int)] for p, count in zip(parts, counts, strict=True)]
    return np.concatenate(spaced)


def _modes(problem: Problem, z: Array, x: Array) -> tuple[Array, Array]:
    starts = x[np.linspace(0, len(x) - 1, min(_STARTS, len(x))).round().astype(int)]
    with np.errstate(all="ignore"):
        ends = least_squares_root(problem, np.broadcast_to(z, (len(starts), len(z))).copy(), starts, prior=1.0)
    ends = ends[np.isfinite(ends).all(axis=1)]
    if not len(ends):
        return np.empty((0, x.shape[1])), np.empty(0)
    width = deviations(inverse(_tempered(problem, ends, 1.0))[0])
    kept: list[int] = []
    counts: list[int] = []
    for i, end in enumerate(ends):
        near = [j for j, k in enumerate(kept) if (np.abs(end - ends[k]) / width[k]).max() < _SAME_MODE]
        if near:
            counts[near[0]] += 1
        else:
            kept.append(i)
            counts.append(1)
    order = np.argsort(-np.array(counts), kind="stable")
    return ends[kept][order], np.array(counts)[order] / len(ends)


def _tempered(problem: Problem, x: Array, beta: float) -> Array:
    """beta J' R^-1 J + P0^-1 (points, n, n)."""
    return beta * information(problem.measurement.jacobian(x), problem.R) + _prior(problem).inverse()


def _prior(problem: Problem) -> Covariance:
    prior = problem.prior_covariance()
    assert prior is not None
    return prior


@dataclass
class _Population:
    """Particles on their way from the prior to the posterior."""

    problem: Problem
    z: Array
    rng: np.random.Generator
    x: Array
    log: Array
    """The logarithm of the likelihood of each, less its constant."""
    beta: float = 0.0
    """The power of the likelihood that the particles are draws with."""
    reach: float = 1.0
    """The length of moves, times 2.38 / sqrt(n)."""
    evidence: float = 0.0
    stages: int = 0
    simulations: int = 0

    @classmethod
    def run(cls, problem: Problem, z: Array, count: int, rng: np.random.Generator) -> _Population:
        x = problem.x0 + _prior(problem).coloured(rng.standard_normal((count, problem.measurement.n)))
        self = cls(problem, z, rng, x, np.empty(count))
        self.log = self._log_likelihood(x)
        while self.beta < 1 and self.stages < _MOST_STAGES:
            self._stage()
        if self.beta < 1:
            raise UserError(f"particles={count}: do not reach the posterior in {_MOST_STAGES} stages; give more")
        self.x = self._final()
        return self

    def _log_likelihood(self, x: Array) -> Array:
        self.simulations += len(x)
        with np.errstate(all="ignore"):
            r = self.problem.R.whiten(self.z - self.problem.measurement.simulate(x))
            squares = np.sum(r**2, axis=1)
        return np.where(np.isfinite(squares), -0.5 * squares, -np.inf)

    def _log_prior(self, x: Array) -> Array:
        return -0.5 * np.sum(_prior(self.problem).whiten(x - self.problem.x0) ** 2, axis=1)

    def _stage(self) -> None:
        """A step of temperature, resampling, and moves."""
        rise = self._rise()
        w = np.exp(rise * (self.log - self.log.max()))
        self.evidence += float(np.log(w.mean()) + rise * self.log.max())
        self.beta = 1.0 if self.beta + rise >= 1 - 1e-12 else self.beta + rise
        chosen = _resampled(w, self.rng)
        self.x, self.log = self.x[chosen], self.log[chosen]
        self.stages += 1
        shapes, accepted, tried = self._shapes(), 0.0, 0
        while tried < _MOST and (tried < _FEWEST or accepted < _MOVES):
            accepted += self._move(shapes)
            tried += 1

    def _rise(self) -> float:
        """By how much the power may grow so that half of the particles still count, found by bisection of its
        logarithm: it begins at billionths."""

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
        """Factors (shapes, n, n) of covariances: Gauss and Newton's at some particles. A move's shape is that of
        another particle, drawn anew each time, so that moves there and back are alike."""
        some = self.rng.choice(len(self.x), min(_POOL, len(self.x)), replace=False)
        with np.errstate(all="ignore"):
            P = inverse(_tempered(self.problem, self.x[some], self.beta))[0]
        P = P[np.isfinite(P).all(axis=(1, 2))]
        if not len(P):
            return np.diag(_prior(self.problem).deviations)[None]
        D = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        # By eigenvalues, since round-off may leave a correlation a shade beyond 1.
        values, axes = np.linalg.eigh(P / (D[:, :, None] * D[:, None, :]))
        return D[:, :, None] * axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]

    def _move(self, shapes: Array) -> float:
        """A Metropolis step of every particle; returns the share that is accepted."""
        count, n = self.x.shape
        chosen = self.rng.integers(0, len(shapes), count)
        step = multiply(shapes[chosen], self.rng.standard_normal((count, n)))
        proposed = self.x + self.reach * 2.38 / np.sqrt(n) * step
        log = self._log_likelihood(proposed)
        with np.errstate(invalid="ignore"):
            gain = self.beta * (log - self.log) + self._log_prior(proposed) - self._log_prior(self.x)
        taken = np.log(self.rng.random(count)) < gain
        self.x, self.log = np.where(taken[:, None], proposed, self.x), np.where(taken, log, self.log)
        share = float(taken.mean())
        self.reach = float(np.clip(self.reach * np.exp(share - _ACCEPTED), 1e-4, 4.0))
        return share

    def _final(self) -> Array:
        """Draws (snapshots x particles, n) of the posterior itself; the length of moves no longer changes."""
        shapes = self._shapes()
        for _ in range(_SETTLE):
            self._move(shapes)
        kept = []
        for _ in range(_SNAPSHOTS):
            shapes, reach = self._shapes(), self.reach
            for _ in range(_BETWEEN):
                self._move(shapes)
                self.reach = reach
            kept.append(self.x)
        return np.concatenate(kept)


def _resampled(w: Array, rng: np.random.Generator) -> Array:
    """Places (particles,), each as often as its weight says, by one draw for all (Kitagawa, J. Comput. Graph. Stat. 5,
    1996)."""
    at = (rng.random() + np.arange(len(w))) / len(w)
    return np.minimum(np.searchsorted(np.cumsum(w / w.sum()), at), len(w) - 1)


def divergence(posterior: Posterior, estimates: Estimates, seed: int = 0) -> Divergence:
    """How far the Gaussian of the first trial of `estimates` is from the posterior."""
    x, n = estimates.x[0], posterior.x.shape[1]
    scale = posterior.deviation
    S = posterior.covariance / np.outer(scale, scale)
    d = (x - posterior.mean) / scale
    shift = float(np.sqrt(d @ np.linalg.solve(S, d) / n)) if np.isfinite(d).all() else float("inf")
    P = None if estimates.covariance is None else estimates.covariance[0] / np.outer(scale, scale)
    nothing = Divergence(float("inf"), shift, float("nan"), float("nan"))
    if P is None or not np.isfinite(P).all() or not np.isfinite(d).all():
        return nothing
    values, axes = np.linalg.eigh(P)
    if values[0] <= 0:
        return nothing
    log_ratio = float(np.sum(np.log(values)) - np.linalg.slogdet(S)[1])
    draws = d + (np.random.Generator(np.random.Philox(seed)).standard_normal((_COMPARED, n)) * np.sqrt(values)) @ axes.T
    theirs = (posterior.x - posterior.mean) / scale
    theirs = theirs[np.linspace(0, len(theirs) - 1, _COMPARED).round().astype(int)]
    return Divergence(_kl(d, S, P), shift, float(np.exp(0.5 * log_ratio / n)), _energy(draws, theirs, S))


def _energy(a: Array, b: Array, S: Array) -> float:
    """2 E|A - B| - E|A - A'| - E|B - B'| over E|B - B'|, in the metric of S."""
    from scipy.spatial.distance import cdist, pdist

    L = np.linalg.inv(np.linalg.cholesky(S)).T
    a, b = a @ L, b @ L
    own = pdist(b).mean()
    return max(0.0, float((2 * cdist(a, b).mean() - pdist(a).mean() - own) / own))
