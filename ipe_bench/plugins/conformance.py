"""The promises that every component makes, as checks that anybody can run on theirs.

Third parties test their solvers, estimators, models and noises with the same checks as ours are tested with. A check is
a function that raises an AssertionError whose message is for the author; its docstring opens with the promise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimator, estimate_safely
from ipe_bench.measurements.base import Measurement, differentiate
from ipe_bench.measurements.counted import cost
from ipe_bench.measurements.polynomial import Polynomial
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise
from ipe_bench.noise.gaussian import Gaussian
from ipe_bench.noise.own import ModelNoise
from ipe_bench.priors.gaussian import GaussianPrior
from ipe_bench.runs.provenance import describe
from ipe_bench.trials.scenario import Scenario

TRIALS = 8


@dataclass(frozen=True)
class Finding:
    """The outcome of one check on one component."""

    component: str
    check: str
    complaint: str = ""
    """Empty where the check passed."""


def check_component(name: str, component: Any) -> Iterator[Finding]:
    """Runs the checks of the component's kind; a component of no kind is a finding itself."""
    checks = next((c for kind, c in _CHECKS.items() if isinstance(component, kind)), None)
    if checks is None:
        yield Finding(name, "is a component", "it is neither measurement, noise, prior, solver nor baseline")
        return
    for check in (describes_itself, *checks):
        title = (check.__doc__ or check.__name__).strip().splitlines()[0].rstrip(".")
        try:
            with np.errstate(all="ignore"):
                check(component)
        except AssertionError as error:
            yield Finding(name, title, str(error) or "it does not")
        except Exception as error:
            yield Finding(name, title, f"it raises {type(error).__name__}: {error}")
        else:
            yield Finding(name, title)


def describes_itself(component: Any) -> None:
    """Is a frozen dataclass whose fields are its config and its identity."""
    parameters = getattr(type(component), "__dataclass_params__", None)
    assert parameters is not None, "decorate the class with @dataclass(frozen=True)"
    assert parameters.frozen, "decorate the class with @dataclass(frozen=True)"
    description = describe(component)
    import json

    try:
        json.dumps(description)
    except TypeError as error:
        raise AssertionError(
            f"a field is not plain data ({error}); give it numbers, texts, lists or components"
        ) from None


# Estimators


def _scenario(strength: float = 0.005) -> Scenario:
    return Scenario(Polynomial(strength=strength), Gaussian(0.01), GaussianPrior(), error_scale=1.0, seed=5)


def _readings(trials: int = TRIALS) -> tuple[Problem, Array, Array]:
    scenario = _scenario()
    drawn = scenario.draw(0, trials)
    return scenario.problem, drawn.x, drawn.z


def finds_the_parameters(estimator: Estimator) -> None:
    """Recovers the parameters of a mildly bent polynomial model."""
    scenario = _scenario(strength=0.0005)
    drawn = scenario.draw(0, TRIALS)
    estimates = estimator.estimate(scenario.problem, drawn.z)
    assert estimates.x.shape == drawn.x.shape, f"x has shape {estimates.x.shape}, and not {drawn.x.shape}"
    H = scenario.problem.H
    bound = 0.01 * np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
    worst = float((np.abs(estimates.x - drawn.x) / bound).max())
    assert worst < 8, f"the largest error is {worst:.1f} standard deviations of the bound"


def a_batch_is_its_trials(estimator: Estimator) -> None:
    """Gives a trial the same bits in a batch and alone."""
    problem, _, z = _readings()
    whole = estimator.estimate(problem, z)
    for i in range(len(z)):
        alone = estimator.estimate(problem, z[i : i + 1])
        for name in ("x", "status", "iterations", "simulations", "covariance"):
            a, b = getattr(whole, name), getattr(alone, name)
            same = a is None or np.array_equal(a[i], b[0], equal_nan=True)
            assert same, f"{name} of trial {i} differs: use stacked matmul, einsum or batched solve, one per trial"


def a_bad_trial_disturbs_no_other(estimator: Estimator) -> None:
    """Ends a trial of NaN readings as a status, and leaves the others as they were."""
    problem, _, z = _readings()
    spoiled = z.copy()
    spoiled[2] = np.nan
    before = estimate_safely(estimator, problem, z)
    after = estimate_safely(estimator, problem, spoiled)
    assert Status(int(after.status[2])) is not Status.CONVERGED, "a trial of NaN readings counts as converged"
    others = [i for i in range(len(z)) if i != 2]
    assert np.array_equal(before.x[others], after.x[others], equal_nan=True), "the other trials changed"


def leaves_its_input_alone(estimator: Estimator) -> None:
    """Does not write into the readings, and gives the same answer twice."""
    problem, _, z = _readings()
    copy = z.copy()
    first = estimator.estimate(problem, z)
    assert np.array_equal(z, copy), "the readings have changed: work on a copy"
    second = estimator.estimate(problem, z)
    assert np.array_equal(first.x, second.x, equal_nan=True), "a second call gave another answer"


def accounts_for_itself(estimator: Estimator) -> None:
    """Reports known statuses, counts of its cost, and a symmetric, positive covariance."""
    problem, _, z = _readings()
    estimates = estimator.estimate(problem, z)
    known = {int(status) for status in Status if status is not Status.RUNNING}
    assert set(estimates.status.tolist()) <= known, "a status is not one of ipe_bench.Status"
    spent = cost(estimates.simulations, estimates.jacobians, problem.measurement.n)
    assert (spent > 0).all(), "simulations and jacobians are not counted"
    P = estimates.covariance
    if P is not None:
        usable = np.isfinite(P).all(axis=(1, 2))
        assert np.allclose(P[usable], P[usable].swapaxes(1, 2), rtol=1e-6), "a covariance is not symmetric"
        assert (np.diagonal(P[usable], axis1=1, axis2=2) > 0).all(), "a variance is not positive"


def keeps_a_history_if_asked(estimator: Estimator) -> None:
    """Returns the iterates that lead to the estimate, where it keeps any."""
    problem, _, z = _readings()
    estimates = estimator.estimate(problem, z, history=True)
    if estimates.history is None:
        return
    assert len(estimates.history) == len(z), "history has not one entry per trial"
    for x, iterates in zip(estimates.x, estimates.history, strict=True):
        assert iterates.ndim == 2, "an entry of history is not (iterations + 1, n)"
        assert np.array_equal(iterates[-1], x, equal_nan=True), "the last iterate is not the estimate"


# Measurement models


def _points(model: Measurement, trials: int = 4) -> Array:
    """A tenth of a unit around the nominal point, where every model makes sense."""
    return model.nominal + 0.1 * np.random.default_rng(11).standard_normal((trials, model.n))


def names_its_readings(model: Measurement) -> None:
    """Has at least as many readings as parameters, each with its own label, and units."""
    assert model.m >= model.n, f"{model.m} readings are too few for {model.n} parameters"
    lengths = {name: len(column) for name, column in model.index.items()}
    assert set(lengths.values()) == {model.m}, f"the columns of index have lengths {lengths}, and not {model.m}"
    labels = list(zip(*model.index.values(), strict=True))
    assert len(set(labels)) == model.m, "two readings have one label in index"
    names = [p.name for p in model.parameters]
    assert len(set(names)) == model.n, "two parameters have one name"
    assert (model.sizes > 0).all(), "a parameter's size is not above 0"


def simulates_batches(model: Measurement) -> None:
    """Simulates a batch as its trials one by one, bit for bit."""
    x = _points(model)
    z = model.simulate(x)
    assert z.shape == (len(x), model.m), f"simulate returns {z.shape}, and not {(len(x), model.m)}"
    assert np.isfinite(z).all(), "a reading near the nominal point is not finite"
    for i in range(len(x)):
        alone = model.simulate(x[i : i + 1])[0]
        assert np.array_equal(alone, z[i]), f"trial {i} alone has other bits: compute each trial by itself"


def differentiates(model: Measurement) -> None:
    """Has the Jacobian that differences of its readings show."""
    x = _points(model)
    J = model.jacobian(x)
    assert J.shape == (len(x), model.m, model.n), f"jacobian returns {J.shape}"
    differences = differentiate(model.simulate, x, analytic=False)
    # Differences cannot tell more than the round-off of h over their step.
    round_off = 10 * np.finfo(float).eps ** (2 / 3) * np.abs(model.simulate(x)).max()
    off = np.maximum(np.abs(J - differences) - round_off, 0.0)
    worst = float((off / (np.abs(differences).max(axis=1, keepdims=True) + 1e-300)).max())
    assert worst < 1e-5, f"it is off by {worst:.1e} of a column's largest entry"


def orders_its_epochs(model: Measurement) -> None:
    """Splits its readings into epochs, each reading in one, and computes a prefix as the whole does."""
    if model.epochs is None:
        return
    rows = np.sort(np.concatenate(model.epochs))
    assert np.array_equal(rows, np.arange(model.m)), "the epochs do not hold every reading once"
    x, stop = _points(model), max(1, len(model.epochs or ()) // 2)
    prefix, whole = model.simulate_until(x, stop), model.simulate(x)[:, model.rows(stop)]
    assert np.allclose(prefix, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max()), "a prefix differs from the whole"


# Noise


def states_its_covariance(noise: Noise) -> None:
    """States a covariance R that whitens as many readings as there are."""
    if noise.real or isinstance(noise, ModelNoise):
        return  # R comes with the readings, or with the model.
    R = noise.covariance(6)
    assert R.m == 6, f"covariance(6) is for {R.m} readings"
    assert (R.deviations > 0).all(), "a standard deviation is not above 0"


def corrupts_reproducibly(noise: Noise) -> None:
    """Gives the same readings from the same random stream, and leaves h alone."""
    if noise.real or noise.estimated or isinstance(noise, ModelNoise):
        return  # Nothing is corrupted.
    h, offset = np.linspace(-1.0, 1.0, 6), np.zeros(6)
    copy = h.copy()
    first, second = (noise.corrupt(h, offset, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(h, copy), "corrupt writes into h"
    assert first.shape == h.shape, f"corrupt returns {first.shape}, and not {h.shape}"
    assert np.array_equal(first, second), "it uses randomness besides the stream that it is given"


Check = Callable[[Any], None]

_CHECKS: dict[type, tuple[Check, ...]] = {
    Estimator: (
        finds_the_parameters,
        a_batch_is_its_trials,
        a_bad_trial_disturbs_no_other,
        leaves_its_input_alone,
        accounts_for_itself,
        keeps_a_history_if_asked,
    ),
    Measurement: (names_its_readings, simulates_batches, differentiates, orders_its_epochs),
    Noise: (states_its_covariance, corrupts_reproducibly),
    GaussianPrior: (),
}
