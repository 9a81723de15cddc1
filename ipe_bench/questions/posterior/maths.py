"""Samples the posterior of one trial by sequential Monte Carlo, to compare Gaussians of estimators
with it.

Slow and general, with nothing linearised: particles go from the prior to the posterior by tempering
the likelihood (Del Moral, Doucet and Jasra, J. R. Stat. Soc. B 68, 2006), moved by Metropolis steps
with covariances of Gauss and Newton. The likelihood is the one that estimators assume: normal
errors of covariance R, for every noise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    correlations,
    deviations,
    finite,
    information,
    inverse,
    multiply,
)
from ipe_bench.basics.streams import generator
from ipe_bench.estimators.base import Estimates, Estimator, estimate_safely
from ipe_bench.measurements.problem import Problem
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario

PARTICLES = 1000
"""Number of particles in two independent populations together: if they disagree, neither is to be
believed."""
AGREED = 0.35
"""Means of populations farther apart than this, in deviations of the posterior, have not settled;
half of it and the deviations differ by more."""
_KEPT = 0.5
"""The share of effective particles that a step of temperature leaves."""
_ACCEPTED = 0.25
"""The share of moves that step lengths are set to accept (Roberts, Gelman and Gilks, Ann. Appl.
Probab. 7, 1997)."""
_MOVES = 3.0
"""Accepted moves per particle and stage."""
_FEWEST = 4
"""Least number of moves that a stage tries."""
_MOST = 30
"""Largest number of moves that a stage tries."""
_POOL = 32
"""Particles whose slopes give the shapes of moves in a stage."""
_SETTLE = 40
"""Moves at the end before draws are kept."""
_SNAPSHOTS = 8
"""Times that draws are kept."""
_BETWEEN = 8
"""Moves between snapshots."""
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
    """(modes, n): local maxima of the posterior that draws lead to, the one with most draws
    first."""
    shares: Array
    """(modes,) of the draws that lead there."""
    apart: float
    """Difference of the populations' means in standard deviations, or half of their widths' in
    their logarithms."""
    noise: float
    """The divergence (see `Divergence.kl`) of the populations' own moments: what is not above it is
    chance."""
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
        return deviations(self.covariance)

    @property
    def settled(self) -> bool:
        """Whether the populations agree, so that the draws can be believed."""
        return bool(self.apart <= AGREED)


@dataclass(frozen=True)
class Divergence:
    """Measures how far an estimator's Gaussian is from the posterior."""

    kl: float
    """The Kullback-Leibler divergence, in nats, from the Gaussian with the posterior's moments to
    the estimator's: 0.5 (tr P^-1 S + d' P^-1 d - n + ln |P| / |S|). Infinite where no Gaussian is
    reported."""
    shift: float
    """|d| in the metric of the posterior's covariance S, per root of n: how far the estimate is
    from its mean."""
    width: float
    """The estimator's deviations over the posterior's, the geometric mean over all directions."""
    energy: float
    """The energy distance (Székely and Rizzo, J. Stat. Plan. Inference 143, 2013) between draws of
    both, over the posterior's own mean distance: 0 where they are alike, moments or not."""


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
        UserError: the scenario has no prior or one that is not normal, or there are too few
            particles.
    """
    if not scenario.prior.normal:
        raise UserError(
            f"prior={scenario.prior.name}: is not normal, as the posterior here takes it to be"
        )
    drawn = scenario.draw(trial, trial + 1)
    sampled = sample_posterior(scenario.problem, drawn.z[0], particles=particles, seed=trial)
    estimates = {}
    for label, estimator in estimators.items():
        estimates[label] = estimate_safely(estimator, scenario.problem, drawn.z)
    divergences = {label: divergence(sampled, e) for label, e in estimates.items()}
    return Reference(trial, drawn.x[0], sampled, estimators, estimates, divergences)


def require_particles(problem: Problem, particles: int) -> None:
    """Refuses a problem without a prior, and fewer than ten particles per parameter and
    population."""
    if problem.prior_deviation is None:
        raise UserError(
            "posterior: needs a prior; choose a noise and an error_scale that parameters are drawn"
            " with"
        )
    least = 20 * problem.measurement.n
    if particles < least:
        raise UserError(
            f"particles={particles}: give at least {least}, 10 per parameter and population"
        )


def sample_posterior(
    problem: Problem, z: Array, *, particles: int = PARTICLES, seed: int = 0
) -> Posterior:
    """Samples the posterior of one trial's readings z (m,), by two populations that are put
    together by their evidence.

    Raises:
        UserError: no prior is known, or there are too few particles.
    """
    require_particles(problem, particles)
    seeds = np.random.SeedSequence(seed).spawn(2)
    runs = [_Population.run(problem, z, particles // 2, generator(s)) for s in seeds]
    parts = [run.x for run in runs]
    evidence = np.array([run.evidence for run in runs])
    # As many draws of each population as its evidence deserves, the best one's all.
    weights = np.exp(evidence - evidence.max())
    counts = np.round(weights * [len(p) for p in parts]).astype(int)
    x = np.concatenate([_spaced(p, count) for p, count in zip(parts, counts, strict=True)])
    modes, shares = _modes(problem, z, x)

    # Populations that have settled agree in their means and widths.
    means = np.stack([p.mean(axis=0) for p in parts])
    widths = np.stack([p.std(axis=0) for p in parts])
    moved = np.ptp(means, axis=0) / widths.max(axis=0)
    widened = 0.5 * np.ptp(np.log(widths), axis=0)
    apart = float(max(moved.max(), widened.max()))
    one, other = (np.atleast_2d(np.cov(p.T)) for p in parts)
    noise = _kl(means[1] - means[0], other, one)
    return Posterior(x, modes, shares, apart, noise, evidence)


def _spaced(x: Array, count: int) -> Array:
    """Returns so many of the draws (draws, n), evenly spaced from the first to the last."""
    places = np.linspace(0, len(x) - 1, count)
    return x[places.round().astype(int)]


def _kl(d: Array, S: Array, P: Array) -> float:
    """Computes the divergence 0.5 (tr P^-1 S + d' P^-1 d - n + ln |P| / |S|) from N(0, S) to
    N(d, P), in nats."""
    inner = np.linalg.inv(P)
    log_ratio = np.linalg.slogdet(P)[1] - np.linalg.slogdet(S)[1]
    squares = np.trace(inner @ S) + d @ inner @ d
    return float(0.5 * (squares - len(d) + log_ratio))


def _modes(problem: Problem, z: Array, x: Array) -> tuple[Array, Array]:
    """Finds the maxima (modes, n) that draws lead to, and their shares (modes,) of the draws."""
    starts = _spaced(x, min(_STARTS, len(x)))
    readings = np.tile(z, (len(starts), 1))
    with np.errstate(all="ignore"):
        ends = least_squares_root(problem, readings, starts, prior=1.0)
    ends = ends[finite(ends)]
    if not len(ends):
        return np.empty((0, x.shape[1])), np.empty(0)
    P = inverse(_tempered(problem, ends, 1.0))[0]
    width = deviations(P)
    counts: Counter[int] = Counter()
    for i, end in enumerate(ends):
        # Each end is of the first mode that is near, or else one of its own.
        near = (k for k in counts if (np.abs(end - ends[k]) / width[k]).max() < _SAME_MODE)
        counts[next(near, i)] += 1
    order, numbers = zip(*counts.most_common(), strict=True)
    return ends[list(order)], np.array(numbers) / len(ends)


def _tempered(problem: Problem, x: Array, beta: float) -> Array:
    """Computes beta J' R^-1 J + P0^-1 (points, n, n)."""
    J = problem.measurement.jacobian(x)
    return beta * information(J, problem.R) + _prior(problem).inverse()


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
        white = rng.standard_normal((count, problem.measurement.n))
        x = problem.x0 + _prior(problem).coloured(white)
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
            h = model.near(model.simulate(x), self.z)
            r = self.problem.R.whiten(self.z - h)
            squares = np.sum(r**2, axis=1)
        return np.where(np.isfinite(squares), -0.5 * squares, -np.inf)

    def _log_prior(self, x: Array) -> Array:
        """Computes the logarithm of the prior density of each, less its constant."""
        r = _prior(self.problem).whiten(x - self.problem.x0)
        return -0.5 * np.sum(r**2, axis=1)

    def _stage(self) -> None:
        """Takes a step of temperature, resampling, and moves."""
        # Importance sampling: the weights of draws for the next power are the likelihood to the
        # power of its rise; their mean is the factor by which the evidence grows.
        rise = self._rise()
        w = np.exp(rise * (self.log - self.log.max()))
        self.evidence += float(np.log(w.mean()) + rise * self.log.max())
        self.beta = 1.0 if self.beta + rise >= 1 - 1e-12 else self.beta + rise
        # Each as often as its weight says, by one draw for all (Kitagawa, J. Comput. Graph. Stat.
        # 5, 1996).
        at = (self.rng.random() + np.arange(len(w))) / len(w)
        places = np.searchsorted(np.cumsum(w / w.sum()), at)
        chosen = np.minimum(places, len(w) - 1)
        self.x = self.x[chosen]
        self.log = self.log[chosen]
        # Moves part the copies that resampling made.
        shapes = self._shapes()
        accepted = 0.0
        tried = 0
        while tried < _MOST and (tried < _FEWEST or accepted < _MOVES):
            accepted += self._move(shapes)
            tried += 1

    def _rise(self) -> float:
        """Finds the growth of the power at which half of the particles still count, by bisection of
        its logarithm: it begins at billionths."""

        def effective(rise: float) -> float:
            """Computes the share (sum w)^2 / sum w^2 of particles that count."""
            w = np.exp(rise * (self.log - self.log.max()))
            return float(w.sum() ** 2 / np.sum(w**2) / len(w))

        most = 1 - self.beta
        if effective(most) >= _KEPT:
            return most
        low = -300.0
        high = float(np.log10(most))
        for _ in range(60):
            middle = (low + high) / 2
            if effective(10**middle) >= _KEPT:
                low = middle
            else:
                high = middle
        return 10**low

    def _shapes(self) -> Array:
        """Computes factors (shapes, n, n) of covariances: Gauss and Newton's at some particles. A
        move's shape is that of another particle, drawn anew each time, so that moves there and back
        are alike."""
        some = self.rng.choice(len(self.x), min(_POOL, len(self.x)), replace=False)
        with np.errstate(all="ignore"):
            P = inverse(_tempered(self.problem, self.x[some], self.beta))[0]
        P = P[finite(P)]
        if not len(P):
            return np.diag(_prior(self.problem).deviations)[None]
        D = deviations(P)
        # By eigenvalues, since round-off may leave a correlation a shade beyond 1.
        values, axes = np.linalg.eigh(correlations(P))
        roots = np.sqrt(np.maximum(values, 0.0))
        return D[:, :, None] * axes * roots[:, None, :]

    def _move(self, shapes: Array) -> float:
        """Takes a Metropolis step of every particle; returns the share that is accepted."""
        count, n = self.x.shape
        chosen = self.rng.integers(0, len(shapes), count)
        step = multiply(shapes[chosen], self.rng.standard_normal((count, n)))
        # 2.38 / sqrt(n) is the best length for normal laws.
        proposed = self.x + self.reach * 2.38 / np.sqrt(n) * step
        log = self._log_likelihood(proposed)
        # The logarithm of the ratio of densities: beta times that of likelihoods, and of priors.
        before = self._log_prior(self.x)
        after = self._log_prior(proposed)
        with np.errstate(invalid="ignore"):
            gain = self.beta * (log - self.log) + after - before
        taken = np.log(self.rng.random(count)) < gain
        self.x = np.where(taken[:, None], proposed, self.x)
        self.log = np.where(taken, log, self.log)
        # Steps become longer where more are accepted than should be, and shorter where fewer.
        share = float(taken.mean())
        reach = self.reach * np.exp(share - _ACCEPTED)
        self.reach = float(np.clip(reach, 1e-4, 4.0))
        return share

    def _final(self) -> Array:
        """Samples draws (snapshots x particles, n) of the posterior itself; the length of moves no
        longer changes."""
        shapes = self._shapes()
        for _ in range(_SETTLE):
            self._move(shapes)
        kept = []
        reach = self.reach
        for _ in range(_SNAPSHOTS):
            shapes = self._shapes()
            for _ in range(_BETWEEN):
                self._move(shapes)
                self.reach = reach
            kept.append(self.x)
        return np.concatenate(kept)


def divergence(posterior: Posterior, estimates: Estimates) -> Divergence:
    """Measures how far the Gaussian of the first trial of `estimates` is from the posterior."""
    # All in standard deviations of the posterior: d of the means, S and P the covariances.
    scale = posterior.deviation
    n = len(scale)
    d = (estimates.x[0] - posterior.mean) / scale
    S = posterior.covariance / np.outer(scale, scale)
    shift = np.inf
    if np.isfinite(d).all():
        shift = float(np.sqrt(d @ np.linalg.solve(S, d) / n))
    nothing = Divergence(np.inf, shift, np.nan, np.nan)
    if estimates.covariance is None:
        return nothing
    P = estimates.covariance[0] / np.outer(scale, scale)
    if not (np.isfinite(P).all() and np.isfinite(d).all()):
        return nothing
    values, axes = np.linalg.eigh(P)
    if values[0] <= 0:
        return nothing
    # (|P| / |S|)^(1 / 2n) is the mean ratio of deviations.
    log_ratio = float(np.sum(np.log(values)) - np.linalg.slogdet(S)[1])
    width = float(np.exp(0.5 * log_ratio / n))
    rng = generator(0)
    white = rng.standard_normal((_COMPARED, n))
    draws = d + (white * np.sqrt(values)) @ axes.T
    theirs = _spaced((posterior.x - posterior.mean) / scale, _COMPARED)
    return Divergence(_kl(d, S, P), shift, width, _energy(draws, theirs, S))


def _energy(a: Array, b: Array, S: Array) -> float:
    """Computes 2 E|A - B| - E|A - A'| - E|B - B'| over E|B - B'|, in the metric of S."""
    from scipy.spatial.distance import cdist, pdist

    L = np.linalg.inv(np.linalg.cholesky(S)).T
    a = a @ L
    b = b @ L
    own = pdist(b).mean()
    distance = 2 * cdist(a, b).mean() - pdist(a).mean() - own
    return max(0.0, float(distance / own))
