"""Checks the promises that every component makes: plugin authors run on theirs what we run on ours.

A check raises an AssertionError whose message is for the author, or returns why it does not apply;
the first line of its docstring is the promise.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ipe_bench.baselines.sequential import Sequential
from ipe_bench.basics.errors import UserError, describe_exception, place_of
from ipe_bench.basics.linalg import Array, deviations, finite
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, estimate_safely
from ipe_bench.estimators.ipe import IPE, State, begin
from ipe_bench.functions.differences import WRONG, along_units, judge, measured
from ipe_bench.functions.judged import same_values
from ipe_bench.measurements import Polynomial, Sir
from ipe_bench.measurements.base import Measurement, UsualNoise
from ipe_bench.measurements.counted import cost
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, ModelNoise
from ipe_bench.noise.base import Noise
from ipe_bench.plugins.construct import construct, find_class
from ipe_bench.plugins.discovery import COMPONENT_GROUPS, Option, blame, composed
from ipe_bench.priors import Prior
from ipe_bench.runs.execution import Execution, Serial
from ipe_bench.runs.provenance import TARGET, describe
from ipe_bench.states import Formulas
from ipe_bench.states.base import StateModel, require_sound
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import nees

TRIALS = 8
SCATTERED = 60
"""Trials from which the scatter of estimates is known to about 10 %."""
DRAWS = 10_000
"""Draws from which the covariance of a noise is known to about 1 %, or several where its tails are
heavy."""
_USUAL_NOISE = UsualNoise(deviation=0.007, step=0.02)
"""Noise for components whose options leave out how large it is."""
_IMPROBABLE = 1e-6
_ROUND_OFF = 1e-9
_NO_LAW = "it draws no errors of a covariance that it states as the true one"
_TURN = 360.0
_PLACEHOLDER = re.compile(
    r"One line that (says|`ipe-bench list)[^.]*|Replace (it|them) by your own[^.]*"
)
"""Texts of the skeletons of `ipe-bench new`."""
_READINGS = 6
"""Readings that a noise is tried on, unless it is made for another number."""


@dataclass(frozen=True)
class Finding:
    """Holds the outcome of one check on one component."""

    component: str
    check: str
    complaint: str = ""
    """Empty where the check passed."""
    note: str = ""
    """Why the check tested nothing, or what the author has left to do; empty where neither is
    so."""


def check_component(name: str, component: Any) -> Iterator[Finding]:
    """Runs the checks of the component's kind; a component of no kind is a finding itself. A model
    that takes inputs from a file is tried with columns that are made up."""
    kinds = (checks for kind, checks in _CHECKS.items() if isinstance(component, kind))
    checks = next(kinds, None)
    if checks is None:
        yield Finding(
            name,
            "is a component",
            "it is neither measurement, noise, prior, solver, baseline nor execution",
        )
        return
    if isinstance(component, Measurement) and not component.input_columns_known:
        component = _with_columns(component)
        if component is None:
            yield Finding(
                name,
                "Takes columns of a file that cannot be made up, and is tried where there is one",
            )
            return
    if isinstance(component, Noise):
        component = component.completed(_USUAL_NOISE)
    for check in (describes_itself, *checks):
        promise = (check.__doc__ or "").splitlines()[0].rstrip(".")
        yield replace(_outcome(check, component), component=name, check=promise)


def _outcome(check: Callable[[Any], str | None], component: Any) -> Finding:
    """Makes a check, of which nothing but its outcome is told."""
    try:
        with np.errstate(all="ignore"):
            inapplicable = check(component)
    except (AssertionError, UserError) as error:
        return Finding("", "", complaint=str(error) or "it does not")
    except Exception as error:
        said = describe_exception(error)
        # Where it writes into what it is given is what its author has to find.
        if "read-only" in said:
            said = place_of(error)
        return Finding("", "", complaint=f"it raises {said}")
    return Finding("", "", note=f"does not apply, {inapplicable}" if inapplicable else "")


def check_option(option: Option) -> Iterator[Finding]:
    """Runs the checks on the component that an option of a plugin describes; of an experiment only
    its file is read."""
    name = f"{option.group}={option.name}"
    if option.fault is not None or option.group not in COMPONENT_GROUPS:
        yield Finding(name, "Has a config that can be read", option.fault or "")
        return
    try:
        config = composed(option)
        where = option.package or option.group
        required = _required(config, where)
        if required:
            yield Finding(
                name, f"Names what is to be given, {', '.join(required)}, and is tried where it is"
            )
            return
        yield from check_component(name, construct(config, where))
    except UserError as error:
        yield Finding(name, f"Can be made from its config, {option.path.name}", str(error))
    except Exception as error:
        complaint = blame(error)
        if complaint is None:
            raise
        yield Finding(name, "Can be used", complaint)


def left_of_skeleton(options: Sequence[Option]) -> Iterator[Finding]:
    """Finds the texts of `ipe-bench new` that authors replace, in the packages of these options."""
    homes = dict.fromkeys(option.source.conf.parent for option in options)
    for home in homes:
        for path in [p for p in sorted(home.rglob("*")) if p.suffix in (".py", ".yaml")]:
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            for number, line in enumerate(lines, 1):
                found = _PLACEHOLDER.search(line)
                if found:
                    note = f'line {number} still says "{found[0].strip()}": say what yours is'
                    yield Finding(path.name, "Describes itself", note=note)


def _required(config: dict[str, Any], where: str) -> list[str]:
    """Returns the options without a value for which the class has no default."""
    if "???" not in config.values():
        return []
    options = fields(find_class(config[TARGET], where))
    without = [f.name for f in options if f.default is f.default_factory]
    return [name for name in without if config.get(name) == "???"]


def describes_itself(component: Any) -> None:
    """Is a frozen dataclass whose fields are its config and its identity."""
    frozen = getattr(getattr(type(component), "__dataclass_params__", None), "frozen", False)
    assert frozen, "decorate the class with @dataclass(frozen=True)"
    try:
        json.dumps(describe(component))
    except TypeError as error:
        remedy = "give it numbers, texts, lists or components"
        raise AssertionError(f"a field is not plain data ({error}); {remedy}") from None


def _shaped(what: str, value: Any, wanted: tuple[int, ...], meaning: str = "") -> None:
    shape = np.shape(value)
    expected = f"{meaning}, which is {wanted} here" if meaning else f"{wanted}"
    assert shape == wanted, f"{what} has shape {shape}, and not {expected}"


# Estimators


def _scenario(estimator: Estimator, strength: float = 0.005) -> Scenario:
    """Returns a mildly bent polynomial model; for estimators that need differential equations a
    short epidemic."""
    if "differential equations" in estimator.needs:
        return Scenario(Sir(), Gaussian(5.0), error_scale=0.5, seed=5)
    return Scenario(Polynomial(strength=strength), Gaussian(0.01), seed=5)


def _readings(estimator: Estimator) -> tuple[Problem, Array]:
    scenario = _scenario(estimator)
    z = scenario.draw(0, TRIALS).z
    z.flags.writeable = False
    return scenario.problem, z


def steps_to_a_state(estimator: Estimator) -> str | None:
    """Returns from step() a state with x and F of the trials."""
    if not isinstance(estimator, IPE):
        return "it is no IPE and has no step()"
    x, system = begin(*_readings(estimator), "linear_lse")
    after = estimator.step(system, estimator.begin(system, x))
    remedy = "return State(x, system.F(x))"
    assert isinstance(after, State), (
        f"step returns {type(after).__name__}, and not a State: {remedy}"
    )
    for name in ("x", "F"):
        _shaped(f"step returns a State whose {name}", getattr(after, name), x.shape)


def finds_the_parameters(estimator: Estimator) -> None:
    """Recovers the parameters of a mildly bent model, with covariances that agree with the scatter
    of its estimates."""
    scenario = _scenario(estimator, strength=0.0005)
    drawn = scenario.draw(0, SCATTERED)
    n = scenario.measurement.n
    estimates = estimator.estimate(scenario.problem, drawn.z)
    assert isinstance(estimates, Estimates), (
        f"estimate returns {type(estimates).__name__}, and not Estimates"
    )
    _shaped("x", estimates.x, drawn.x.shape)
    raised = np.flatnonzero(estimates.status == Status.ERROR).tolist()
    assert not raised, f"it raises {estimates.messages.get(raised[0], 'an exception')}"
    error = estimates.x - drawn.x
    worst = float((np.abs(error) / _bound(scenario.problem)).max())
    assert worst < 8, f"the largest error is {worst:.1f} standard deviations of the bound"
    P = estimates.covariance
    if P is not None:
        _shaped("covariance", P, (SCATTERED, n, n), "(trials, n, n)")
        known = finite(P)
        known &= estimates.status == Status.CONVERGED
        if known.sum() >= SCATTERED // 2:
            _agrees("the reported variances are", nees(error, P)[known], n)


def _bound(problem: Problem) -> Array:
    """Computes the standard deviations (n,) of the linear bound (H' R^-1 H)^-1."""
    H = problem.R.whiten_jacobian(problem.H)
    return deviations(np.linalg.inv(H.T @ H))


def _agrees(what: str, squared: Array, n: int) -> None:
    """Tells whether the mean NEES of trials (trials,) is about n: E[e' P^-1 e] = n where the
    reported P is that of the errors e."""
    mean = float(squared.mean())
    ratio = mean / n
    times = f"{ratio:.3g} times too small" if ratio > 1 else f"{1 / ratio:.3g} times too large"
    assert 0.5 < ratio < 2, (
        f"{what} {times}: the mean NEES of {len(squared)} trials is {n * ratio:.3g} for {n} numbers"
    )


def answers_alike(estimator: Estimator) -> None:
    """Gives a trial the same bits a second time, and in a batch and alone."""
    problem, z = _readings(estimator)
    whole, again = (estimator.estimate(problem, z) for _ in range(2))
    assert np.array_equal(whole.x, again.x, equal_nan=True), (
        "a second call with the same readings gave another answer: it draws random numbers (draw"
        " them from a stream that is seeded by the trial's readings) or remembers something"
    )
    for i in range(len(z)):
        alone = estimator.estimate(problem, z[i : i + 1])
        for name in ("x", "status", "iterations", "simulations", "covariance"):
            together = getattr(whole, name)
            if together is not None:
                _same_bits(f"{name} of trial {i}", together[i], getattr(alone, name)[0])


def _same_bits(what: str, together: Array, alone: Array) -> None:
    """Tells whether an answer depends on the batch, and whether by round-off alone."""
    remedy = (
        "more than rounding: what it does to a trial must not depend on the others of the batch"
    )
    if np.allclose(together, alone, rtol=_ROUND_OFF, atol=_ROUND_OFF, equal_nan=True):
        remedy = "rounding alone: use stacked matmul, einsum or batched solve, one per trial"
    same = np.array_equal(together, alone, equal_nan=True)
    assert same, f"{what} differs, by {remedy}"


@dataclass(frozen=True)
class _Circular(Polynomial):
    """A mildly bent model whose readings are angles in degrees."""

    strength: float = 0.0005

    @property
    def periods(self) -> Array:
        return np.full(self.m, _TURN)


def turns_with_its_angles(estimator: Estimator) -> str | None:
    """Gives the same estimate whatever whole turns are added to readings that are angles."""
    scenario = Scenario(_Circular(), Gaussian(0.01), seed=5)
    problem = scenario.problem
    why = estimator.hindrance(problem)
    if why:
        return f"it {why}"
    z = scenario.draw(0, TRIALS).z
    turns = np.random.default_rng(5).integers(-1, 2, z.shape)
    turned = z + _TURN * turns
    x = estimator.estimate(problem, z).x
    other = estimator.estimate(problem, turned).x
    apart = np.abs(other - x) / _bound(problem)
    remedy = "take residuals from z - model.near(model.simulate(x), z)"
    assert (apart < 8).all(), (
        f"whole turns move it by {apart.max():.3g} standard deviations of the bound: {remedy}"
    )


def takes_process_noise(estimator: Estimator) -> str | None:
    """Reports larger variances on average if its parameters may walk, by `process_noise`."""
    if not isinstance(estimator, Sequential):
        return "it is no Sequential and has no process_noise"
    problem, z = _readings(estimator)
    still = replace(estimator, process_noise=0.0).estimate(problem, z)
    walking = replace(estimator, process_noise=0.3).estimate(problem, z)
    message = "; ".join(dict.fromkeys(walking.messages.values()))
    assert (walking.status == Status.CONVERGED).all(), (
        f"with process_noise=0.3 trials end: {message}"
    )
    assert still.covariance is not None, "it reports no covariance"
    assert walking.covariance is not None, "it reports no covariance"
    small = np.einsum("tii->ti", still.covariance).mean(axis=0)
    large = np.einsum("tii->ti", walking.covariance).mean(axis=0)
    assert (large > small).all(), (
        "with process_noise=0.3 a variance is not larger: add Q to P in predict"
    )


def a_bad_trial_disturbs_no_other(estimator: Estimator) -> None:
    """Ends a trial of NaN readings as a status, and leaves the others as they were."""
    problem, z = _readings(estimator)
    bad = np.arange(len(z)) == 2
    spoiled = np.where(bad[:, None], np.nan, z)
    before = estimate_safely(estimator, problem, z)
    after = estimate_safely(estimator, problem, spoiled)
    assert (after.status[bad] != Status.CONVERGED).all(), (
        "a trial of NaN readings counts as converged"
    )
    same = np.array_equal(before.x[~bad], after.x[~bad], equal_nan=True)
    assert same, "the other trials changed"


def accounts_for_itself(estimator: Estimator) -> None:
    """Reports known statuses, counts of its cost, and a symmetric, positive covariance."""
    problem, z = _readings(estimator)
    estimates = estimator.estimate(problem, z)
    known = set(Status) - {Status.RUNNING}
    assert set(estimates.status.tolist()) <= known, "a status is not one of ipe_bench.Status"
    spent = cost(estimates.simulations, estimates.jacobians, problem.measurement.n)
    assert (spent > 0).all(), "simulations and jacobians are not counted"
    P = estimates.covariance
    if P is None:
        return
    trials, n = estimates.x.shape
    if np.shape(P) == (trials, n, n):
        P = P[finite(P)]
        assert np.allclose(P, P.swapaxes(1, 2), rtol=1e-6), "a covariance is not symmetric"
        assert (np.diagonal(P, axis1=1, axis2=2) > 0).all(), "a variance is not positive"


def keeps_a_history_if_asked(estimator: Estimator) -> str | None:
    """Returns the iterates that lead to the estimate, where it keeps any."""
    estimates = estimator.estimate(*_readings(estimator), history=True)
    history = estimates.history
    if history is None:
        return "it keeps none"
    assert len(history) == len(estimates.x), "history has not one entry per trial"
    for x, iterates in zip(estimates.x, history, strict=True):
        assert iterates.ndim == 2, "an entry of history is not (iterations + 1, n)"
        assert np.array_equal(iterates[-1], x, equal_nan=True), (
            "the last iterate is not the estimate"
        )


# Measurement models


def _with_columns(model: Measurement) -> Measurement | None:
    """Returns the model with columns of no particular numbers, about 1, or where those must be one
    number with that; None where it makes no sense with either."""
    count = 2 * model.n + 4
    rng = np.random.default_rng(2)
    grid = np.linspace(0.5, 1.5, count)
    required = [i.heading for i in model.inputs if i.default is None and not i.label]
    varied = {name: rng.permutation(grid).tolist() for name in required}
    same = varied | dict.fromkeys(required[1:], [1.0] * count)
    labels = {}
    for one in model.inputs:
        labels[one.heading] = [1 if one.default is None else one.default] * count
    for columns in (labels | varied, labels | same):
        try:
            tried = model.with_inputs(columns, count)
        except UserError:
            continue
        with np.errstate(all="ignore"):
            if np.isfinite(tried.simulate(_points(tried))).all():
                return tried
    return None


def _points(model: Measurement) -> Array:
    """Returns points a tenth of a unit around the start, where every model makes sense."""
    deviates = np.random.default_rng(11).standard_normal((4, model.n))
    x = model.nominal + 0.1 * deviates
    x.flags.writeable = False
    return x


def names_its_readings(model: Measurement) -> None:
    """Has at least as many readings as parameters, each with its own label, and units."""
    assert model.m >= model.n, f"{model.m} readings are too few for {model.n} parameters"
    lengths = {name: len(column) for name, column in model.index.items()}
    right = set(lengths.values()) == {model.m}
    assert right, f"the columns of index have lengths {lengths}, and not {model.m}"
    labels = set(zip(*model.index.values(), strict=True))
    assert len(labels) == model.m, "two readings have one label in index"
    assert len({p.name for p in model.parameters}) == model.n, "two parameters have one name"
    _shaped("nominal", model.nominal, (model.n,), "one number for each parameter")
    if len(model.periods):
        _shaped("periods", model.periods, (model.m,), "one number for each reading")
    assert (model.sizes > 0).all(), "a parameter's size is not above 0"


def simulates_batches(model: Measurement) -> None:
    """Simulates a batch as its trials one by one, bit for bit."""
    x = _points(model)
    z = model.simulate(x)
    _shaped("what simulate returns", z, (len(x), model.m))
    assert np.isfinite(z).all(), "a reading near the start is not finite"
    for i in range(len(x)):
        alone = model.simulate(x[i : i + 1])[0]
        assert np.array_equal(alone, z[i]), (
            f"trial {i} alone has other bits: compute each trial by itself"
        )


def differentiates(model: Measurement) -> None:
    """Has the Jacobian that differences of its readings show."""
    x = _points(model)
    J = model.jacobian(x)
    _shaped("what jacobian returns", J, (len(x), model.m, model.n), "(trials, m, n)")
    scale = model.widest_steps
    found = measured(model.simulate, x, along_units(scale, len(x)), model.near)
    wrong = judge(J * scale, found) == WRONG
    differences = found.central.slope / scale
    largest = np.abs(differences).max(axis=1, keepdims=True) + 1e-300
    off = np.nan_to_num(np.abs(J - differences) / largest, nan=np.inf)
    off = np.where(wrong, off, 0.0)
    at = _largest(off)
    _, i, j = at
    entries = [f"{name}={column[i]}" for name, column in model.index.items()]
    hint = ""
    if model.analytic and type(model).jacobian is Measurement.jacobian:
        hint = (
            "; `analytic` is set, so it is a complex step, which np.abs, np.sign, np.maximum and"
            " the like do not survive: write np.where(u.real < 0, -u, u) for np.abs(u), or leave"
            " `analytic` out"
        )
    assert off[at] < 1e-6, (
        f"it is off by {off[at]:.1e} of a column's largest entry, most for parameter"
        f" {model.parameters[j].name} in reading {', '.join(entries)}: it says {J[at]:.6g}, and"
        f" differences {differences[at]:.6g}{hint}"
    )


def _largest(values: Array) -> tuple[int, ...]:
    """Finds the place of the largest value."""
    place = np.unravel_index(int(values.argmax()), values.shape)
    return tuple(int(k) for k in place)


def orders_its_epochs(model: Measurement) -> str | None:
    """Splits its readings into epochs, each reading in one, and computes a prefix as the whole
    does."""
    if model.epochs is None:
        return "it has no epochs"
    rows = np.sort(np.concatenate(model.epochs))
    assert np.array_equal(rows, np.arange(model.m)), "the epochs do not contain every reading once"
    x = _points(model)
    stop = max(1, len(model.epochs) // 2)
    whole = model.simulate(x)[:, model.rows(stop)]
    largest = np.abs(whole).max()
    prefix = model.simulate_until(x, stop)
    coarse = model.coarse_simulate_until(x, stop)
    same = np.allclose(prefix, whole, rtol=1e-12, atol=1e-12 * largest)
    assert same, "a prefix differs from the whole"
    near = np.allclose(coarse, whole, rtol=1e-3, atol=1e-3 * largest)
    assert near, "a coarse prefix is far from the whole"


# Noises and priors


def _repeatable(
    name: str, given: Array, draw: Callable[[Array, np.random.Generator], Array]
) -> None:
    """Tells whether a function draws alike from one stream."""
    given.flags.writeable = False
    first = draw(given, np.random.default_rng(3))
    second = draw(given, np.random.default_rng(3))
    _shaped(f"what {name} returns", first, given.shape)
    assert np.array_equal(first, second), "it uses randomness besides the stream that it is given"


def _scatter_as_stated(w: Array, C: Array, slack: float, noun: str) -> None:
    """Tells whether draws w (draws, k) in stated deviations have mean zero and the correlations C
    (k, k), but for the slack and for what chance does: six standard errors."""
    chance = 6 / np.sqrt(len(w))
    mean = np.abs(w.mean(axis=0))
    near = (mean < slack + chance * w.std(axis=0)).all()
    assert near, f"the mean of the draws is off by up to {mean.max():.3g} of the stated deviation"
    products = w[:, :, None] * w[:, None, :]
    moments = products.mean(axis=0)
    off = np.abs(moments - C) - chance * products.std(axis=0)
    i = int(np.diag(off).argmax())
    times = f"{w[:, i].std():.3g} times"
    assert off[i, i] <= slack, f"the draws of {noun} {i + 1} have {times} the stated deviation"
    at = _largest(off)
    j, k = at
    said = f"the correlation {moments[at]:.2f}, and {C[at]:.2f} is stated"
    assert off[at] <= slack, f"the draws of {noun}s {j + 1} and {k + 1} have {said}"


def _count(noise: Noise) -> int:
    """Counts the readings that the noise is tried on: a few, or as many as an option that is a list
    has."""
    options = [getattr(noise, f.name) for f in fields(noise)]  # type: ignore[arg-type]
    lengths = [len(value) for value in options if isinstance(value, tuple)]
    for m in (_READINGS, *lengths):
        with suppress(UserError):
            noise.covariance(m)
            return m
    return _READINGS


def _draws(noise: Noise) -> bool:
    """Tells whether the noise draws errors itself: readings are simulated, and R is neither
    estimated nor a model's."""
    return not (noise.real or noise.estimated or isinstance(noise, ModelNoise))


def _errors(noise: Noise, draws: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draws errors of the noise, also whitened by R (draws, m); h is spread over many steps of
    rounding."""
    m = _count(noise)
    R = noise.covariance(m)
    h = rng.uniform(-1000.0, 1000.0, (draws, m)) * R.deviations
    z = np.array([noise.corrupt(row.copy(), np.zeros(m), rng) for row in h])
    v = z - h
    return v, R.whiten(v)


def corrupts_reproducibly(noise: Noise) -> str | None:
    """States a covariance R of the readings, and gives the same readings from the same random
    stream."""
    if noise.real or isinstance(noise, ModelNoise):
        return "R comes with the readings or with the model"
    m = _count(noise)
    R = noise.covariance(m)
    assert R.m == m, f"covariance({m}) is for {R.m} readings"
    assert (R.deviations > 0).all(), "a standard deviation is not above 0"
    if _draws(noise):
        h = np.linspace(-1.0, 1.0, m)
        _repeatable("corrupt", h, lambda h, rng: noise.corrupt(h, np.zeros(m), rng))


def draws_what_it_states(noise: Noise) -> str | None:
    """Draws errors of mean zero whose standard deviations and correlations are those of R."""
    if not (_draws(noise) and noise.true_covariance):
        return _NO_LAW
    v, _ = _errors(noise, DRAWS, np.random.default_rng(7))
    R = noise.covariance(v.shape[1])
    C = R.matrix() / np.outer(R.deviations, R.deviations)
    _scatter_as_stated(v / R.deviations, C, 0.02, "reading")


def states_its_law(noise: Noise) -> str | None:
    """Says by `whitened` how its errors are distributed, where they are not normal: the test of fit
    takes that law."""
    from scipy.stats import ks_2samp

    if not (_draws(noise) and noise.true_covariance):
        return _NO_LAW
    rng = np.random.default_rng(9)
    _, w = _errors(noise, DRAWS // 5, rng)
    stated = noise.whitened(w.shape, rng)
    law = rng.standard_normal(w.shape) if stated is None else stated
    words = "normal, since there is no `whitened`" if stated is None else "what `whitened` draws"
    # Of each trial its chi-square, which is what the test of fit looks at, and one reading: trials
    # are independent.
    compared = {
        "reading": (w[:, 0], law[:, 0]),
        "chi-square": ((w**2).sum(1), (law**2).sum(1)),
    }
    for what, (found, said) in compared.items():
        p = float(tuple(ks_2samp(found, said))[1])  # type: ignore[arg-type]
        distributed = f"distributed as {words} (Kolmogorov-Smirnov, p = {p:.1g})"
        assert p > _IMPROBABLE, f"the {what} of whitened errors is not {distributed}"


def _point(prior: Prior) -> Array:
    """Returns a point of four parameters, or as many as the prior is made for."""
    for name in ("deviations", "correlations"):
        options = getattr(prior, name, None)
        if options:
            return np.linspace(-1.0, 1.0, len(options))
    return np.linspace(-1.0, 1.0, 4)


def states_its_deviations(prior: Prior) -> None:
    """States a standard deviation for each parameter, which grows with the error scale."""
    n = len(_point(prior))
    deviation = np.asarray(prior.deviation(n, 1.0))
    tenfold = np.asarray(prior.deviation(n, 10.0))
    _shaped("what deviation returns", deviation, (n,))
    assert np.isfinite(deviation).all(), "a deviation is not finite"
    assert (deviation >= 0).all(), "a deviation is negative"
    assert deviation.any(), "every deviation is 0"
    same = np.allclose(tenfold, 10 * deviation)
    assert same, "at ten times the error scale the deviations are not ten times as large"


def draws_reproducibly(prior: Prior) -> None:
    """Draws the same parameters from the same random stream, and leaves x0 alone."""
    _repeatable("draw", _point(prior), lambda x0, rng: prior.draw(x0, 2.0, rng))


def draws_what_is_told(prior: Prior) -> None:
    """Draws parameters of the mean x0 and of the deviations and correlations that it states, normal
    where it says so."""
    from scipy.stats import kstest

    x0 = _point(prior)
    rng = np.random.default_rng(7)
    n = len(x0)
    deviation = np.asarray(prior.deviation(n, 2.0))
    varies = deviation > 0
    stated = prior.correlation(n)
    C = np.eye(n) if stated is None else stated
    _shaped("what correlation returns", C, (n, n))
    C = C[np.ix_(varies, varies)]
    x = np.array([prior.draw(x0.copy(), 2.0, rng) for _ in range(DRAWS)])
    away = x - x0
    assert not away[:, ~varies].any(), "a parameter of deviation 0 varies"
    w = away[:, varies] / deviation[varies]
    _scatter_as_stated(w, C, 0.0, "parameter")
    p = min(float(kstest(column, "norm").pvalue) for column in w.T)
    assert not prior.normal or p > _IMPROBABLE, (
        f"the draws are not normal (p = {p:.1g}); set `normal` to False"
    )


# States that move


def suits_itself(model: StateModel) -> None:
    """Has times, a prior, covariances, a transition and readings of the same shapes."""
    require_sound(model)


def moves_batches(model: StateModel) -> None:
    """Moves and reads a stack of states as one by one, bit for bit."""
    x = StateModel.draw(model, 0, 4).x[:, -1]
    k = model.epochs - 1
    by_state = {"gain_at": model.gain_by_state, "R_at": model.R_by_state}
    varying = [name for name, varies in by_state.items() if varies]
    for name in ("transition", "observe", *varying):
        function = getattr(model, name)
        values = function(x, k)
        alone = np.concatenate([function(one[None], k) for one in x])
        same = np.array_equal(values, alone)
        assert same, f"{name} gives a state alone other bits: compute each by itself"


def is_recorded(model: StateModel) -> str | None:
    """Has the same transition and readings along whole paths, recorded and compiled, as epoch by
    epoch."""
    x = StateModel.draw(model, 0, 4).x
    for name, functions in zip(("transition", "observe"), model.epoch_functions, strict=True):
        if functions.why:
            continue
        for k in filter(model.moves, range(model.epochs)):
            here = x[:, k]
            same = same_values(functions.at[k](here), getattr(model, name)(here, k))
            assert same, f"{name} of epoch {k + 1} is not as recorded; mend `alike`"
    return "; ".join(model.remarks()) or None


def wraps_its_angles(model: StateModel) -> None:
    """States the periods of readings and states that jump by a whole turn."""
    x = StateModel.draw(model, 0, TRIALS).x[:, -1]
    # From each state to the far side of another.
    ways = np.linspace(x, -np.roll(x, 1, axis=0), 2001)
    sides = (
        ("reading", model.observe, model.periods),
        ("state", model.transition, model.state_periods),
    )
    for what, function, periods in sides:
        values = function(ways, model.epochs - 1)
        steps = np.abs(np.diff(values, axis=0)).max(axis=(0, 1))
        if not len(periods):
            periods = np.zeros(len(steps))
        for i, (step, period) in enumerate(zip(steps, periods, strict=True)):
            turns = [turn for turn in (2 * np.pi, 360.0) if 0.98 * turn < step < 1.02 * turn]
            assert period or not turns, (
                f"{what} {i + 1} jumps by {step:.3g}: it is an angle; state its period"
            )


def tracks_its_trials(tracker: Tracker) -> None:
    """Tracks a linear model with covariances that agree with its errors, and a trial alone with the
    same bits."""
    linear = {"next": {"x": "0.9*x + w"}, "readings": {"z": "x"}, "noise": {"w": 1.0}}
    model = Formulas(**linear, deviation={"z": 0.5}, spread={"x": 3.0}, count=20)
    paths = model.draw(0, SCATTERED)
    tracks = tracker.track(model, paths.z)
    _shaped("mean", tracks.mean, paths.x.shape)
    _shaped("covariance", tracks.covariance, (*paths.x.shape, model.n))
    alone = tracker.track(model, paths.z[:1])
    same = np.array_equal(alone.mean[0], tracks.mean[0], equal_nan=True)
    assert same, "trial 0 alone has other bits than in a batch"
    error = tracks.mean[:, -1] - paths.x[:, -1]
    last = nees(error, tracks.covariance[:, -1])
    _agrees("the reported variances of the last epoch are", last, model.n)


# Executions


def _work(task: Any) -> Iterator[int]:
    """Takes the steps of the task, or two of one that ends in an error."""
    yield from (0, 1) if isinstance(task, Exception) else task
    if isinstance(task, Exception):
        raise task


def does_every_task(execution: Execution) -> None:
    """Tells of every step of every task in order, once of its end, and of a task that raises as a
    failure."""
    told = _told(execution)
    for i, right in _told(Serial()).items():
        reported = ", ".join(told[i]) or "nothing"
        assert told[i] == right, f"of task {i} it reports {reported}; right is {', '.join(right)}"


def _told(execution: Execution) -> dict[int, list[str]]:
    """Returns what an execution reports of a task that raises and of others, by task."""
    found: dict[int, list[str]] = {0: [], 1: [], 2: []}
    tasks = (range(3), ValueError("wrong"), range(0))
    for event in execution.run(_work, tasks):
        end = "end" if event.failure is None else f"a Failure {event.failure.message}"
        found[event.index].append(end if event.ended else f"step {event.step}")
    return found


def ends_with_the_run(execution: Execution) -> None:
    """Hands on what ends the whole run, a UserError or StorageError, and can be closed before its
    end."""
    with suppress(UserError):
        list(execution.run(_work, (UserError("wrong"), range(3))))
        raise AssertionError(
            "a UserError does not end the run; raise what is in ipe_bench.runs.execution.FATAL"
        )
    events = execution.run(_work, (range(3), range(3)))
    next(iter(events))
    assert isinstance(events, Generator), "run returns no generator, which could be closed"
    events.close()


_CHECKS: dict[type, tuple[Callable[[Any], str | None], ...]] = {
    Estimator: (
        steps_to_a_state,
        finds_the_parameters,
        answers_alike,
        turns_with_its_angles,
        takes_process_noise,
        a_bad_trial_disturbs_no_other,
        accounts_for_itself,
        keeps_a_history_if_asked,
    ),
    Measurement: (names_its_readings, simulates_batches, differentiates, orders_its_epochs),
    Noise: (corrupts_reproducibly, draws_what_it_states, states_its_law),
    Prior: (states_its_deviations, draws_reproducibly, draws_what_is_told),
    StateModel: (suits_itself, moves_batches, is_recorded, wraps_its_angles),
    Tracker: (tracks_its_trials,),
    Execution: (does_every_task, ends_with_the_run),
}
