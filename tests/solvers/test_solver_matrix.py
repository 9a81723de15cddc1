"""Every solver on every system: roots where theory promises them, the right status where there are
none."""

import numpy as np
import pytest
from shared.oracles import assert_agrees
from shared.small_models import Written

from ipe_bench.basics.linalg import Covariance, deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.driver import Limits, iterate
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements import Gins, Measurement, Polynomial
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import (
    Broyden,
    DampedNewton,
    FixedPoint,
    Newton,
    Relinearized,
    SteepestDescent,
)
from ipe_bench.solvers.anderson import accelerated, push
from ipe_bench.statistics.sample import orders_of
from ipe_bench.trials.roots import frozen_root
from ipe_bench.trials.scenario import Scenario

BURDEN_FAIRES = Written(
    lambda a, b, c: (
        3 * a - np.cos(b * c) - 0.5,
        a**2 - 81 * (b + 0.1) ** 2 + np.sin(c) + 1.06,
        np.exp(-a * b) + 20 * c + (10 * np.pi - 3) / 3,
    ),
    unknowns=3,
    count=3,
)
"""Burden and Faires, Numerical Analysis, section 10.2, example 2: root (1/2, 0, -pi/6)."""
ROSENBROCK = Written(lambda a, b: (10 * (b - a**2), 1 - a), 2)
"""10 (b - a^2), 1 - a: root (1, 1), from the customary start (-1.2, 1)."""
CUBIC = Written(
    lambda a, b: (1.2 * a + 0.3 * b + (a + b) ** 3 / 20, -0.2 * a + 0.9 * b + (a - b) ** 3 / 20), 2
)
"""A x and a cubic: root 0, a contraction of the fixed-point iteration around it."""
NO_ROOT = Written(lambda a, b: (a**2 + 1, b), 2)
"""a^2 + 1, b: |F| has its minimum 1 at 0, where the Jacobian is singular."""


def system_of(model: Measurement, trials: int) -> FrozenSystem:
    """h(x) = 0 for each trial, with H+ = I."""
    unit = np.eye(model.n)[None]
    R = Covariance(np.ones(model.m))
    counted = CountingModel(model, EvaluationCount.zeros(trials))
    return FrozenSystem(
        counted, unit, np.ones((1, model.n)), R, np.zeros((trials, model.m)), np.arange(trials)
    )


ALL = [
    FixedPoint(),
    Newton(),
    Broyden(),
    Broyden("identity"),
    SteepestDescent(),
    DampedNewton(),
]
WITH_SLOPE = [Newton(), Broyden(), DampedNewton(), SteepestDescent()]


def roots_of(model, solver, starts, *, tolerance=1e-9, max_iterations=2000, history=False):
    starts = np.atleast_2d(np.asarray(starts, dtype=float))
    system = system_of(model, len(starts))
    with np.errstate(all="ignore"):
        roots = iterate(system, solver, starts, Limits(tolerance, max_iterations, history=history))
    return roots, system.model.tally


@pytest.mark.parametrize("solver", ALL, ids=repr)
def test_every_solver_finds_the_root_of_a_contraction(solver):
    starts = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    roots, _ = roots_of(CUBIC, solver, starts)
    assert (roots.status == Status.CONVERGED).all()
    np.testing.assert_allclose(roots.x, 0.0, atol=1e-8)


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_anderson_s_method_of_full_depth_solves_linear_equations_in_one_step_per_unknown(depth):
    """With n differences of F behind it the next step is the root (Walker and Ni 2011: as GMRES
    is); with fewer it is not there yet."""
    A = np.array([[1.3, 0.4, -0.2], [0.1, 0.8, 0.3], [-0.3, 0.2, 1.1]])
    x = np.array([[1.0, -2.0, 0.5], [3.0, 1.0, 4.0]])
    F = x @ A.T
    dx, dF = np.zeros((2, 2, 3, depth))
    for _ in range(4):
        new = accelerated(x, F, dx, dF)
        dx = push(dx, new - x)
        dF = push(dF, new @ A.T - F)
        x = new
        F = x @ A.T
    assert ((np.abs(F).max(axis=1) < 1e-10) == (depth == 3)).all()


def test_a_line_search_takes_no_step_that_decreases_nothing():
    """Newton's steps on sign(a) sqrt(abs(a)) lead from a to -a, for ever; half of one leads to the
    root."""

    def signed_root(a):
        at = np.real(a)
        size = np.sqrt(np.abs(at))
        return (np.sign(at) * size + (a - at) / np.maximum(2 * size, 1e-300),)

    model = Written(signed_root, 1, 1, first=0.5)
    start = np.array([[0.5], [-3.0]])
    assert (
        roots_of(model, Newton(), start, max_iterations=50)[0].status == Status.MAX_ITERATIONS
    ).all()
    damped, _ = roots_of(model, DampedNewton(), start, max_iterations=50)
    np.testing.assert_allclose(damped.x, 0.0, atol=1e-12)


@pytest.mark.parametrize("solver", [Newton(), FixedPoint(), Broyden()], ids=repr)
def test_rounds_of_relinearized_count_the_steps_within_them(solver):
    scenario = Scenario(Polynomial(strength=0.05), Gaussian(0.1), error_scale=3.0)
    found = Relinearized(solver).estimate(scenario.problem, scenario.draw(0, 6).z, history=True)
    assert found.iterations.tolist() == [len(path) - 1 for path in found.history or ()]


@pytest.mark.oracle(
    "published: Burden and Faires, Numerical Analysis, section 10.2; Rosenbrock's function",
    "roots",
    1e-4,
)
@pytest.mark.parametrize("solver", WITH_SLOPE, ids=repr)
@pytest.mark.parametrize(
    ("model", "start", "root"),
    [
        (BURDEN_FAIRES, (0.1, 0.1, -0.1), (0.5, 0.0, -np.pi / 6)),
        (ROSENBROCK, (-1.2, 1.0), (1.0, 1.0)),
    ],
    ids=["burden_faires", "rosenbrock"],
)
def test_textbook_systems_have_their_roots(solver, model, start, root):
    limit = 200000 if isinstance(solver, SteepestDescent) else 200
    roots, _ = roots_of(model, solver, start, tolerance=1e-6, max_iterations=limit)
    assert roots.status[0] == Status.CONVERGED
    assert_agrees(roots.x[0], root, atol=1e-4)


@pytest.mark.oracle(
    "published: Burden and Faires, Numerical Analysis, tables 10.3 and 10.4",
    "iterates of Newton's and Broyden's methods",
    1e-9,
)
def test_newton_and_broyden_reproduce_the_tables_of_burden_and_faires():
    newton, _ = roots_of(BURDEN_FAIRES, Newton(), (0.1, 0.1, -0.1), history=True)
    broyden, _ = roots_of(BURDEN_FAIRES, Broyden(), (0.1, 0.1, -0.1), history=True)
    # Tables 10.3 and 10.4 (ninth edition).
    assert_agrees(newton.history[0][1], [0.4998696728, 0.0194668485, -0.5215204718], atol=1e-9)
    assert_agrees(newton.history[0][2], [0.5000142403, 0.0015885914, -0.5235569638], atol=1e-9)
    assert_agrees(broyden.history[0][2], [0.4999863754, 0.0087378393, -0.5231745744], atol=1e-9)


@pytest.mark.parametrize("solver", ALL, ids=repr)
def test_gins_at_scale_10_converges_to_the_root_near_the_truth(solver):
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 10.0)
    trials = scenario.draw(0, 12)
    estimates = solver.estimate(scenario.problem, trials.z)
    root = frozen_root(scenario.problem, trials.z, trials.x)
    assert (estimates.status == Status.CONVERGED).all()
    assert np.isfinite(root).all()
    assert (np.abs(estimates.x - root) / deviations(estimates.covariance)).max() < 1e-4


def _errors(solver, model, start, root, **options):
    roots, _ = roots_of(model, solver, start, tolerance=1e-13, history=True, **options)
    return np.abs(roots.history[0] - np.asarray(root)).max(axis=1)


def test_fixed_point_is_linear_with_the_spectral_radius_as_rate():
    errors = _errors(FixedPoint(), CUBIC, (0.5, -0.3), (0.0, 0.0), max_iterations=60)
    slope = np.eye(2) - np.array([[1.2, 0.3], [-0.2, 0.9]])
    radius = np.abs(np.linalg.eigvals(slope)).max()
    used = errors[errors > 1e-13]
    decrease = (used[-1] / used[5]) ** (1 / (len(used) - 6))
    assert abs(decrease - radius) < 0.06


@pytest.mark.parametrize("solver", [Newton(), DampedNewton()], ids=repr)
def test_newton_is_quadratic(solver):
    errors = _errors(solver, BURDEN_FAIRES, (0.1, 0.1, -0.1), (0.5, 0.0, -np.pi / 6))
    assert 1.9 < orders_of(errors, floor=1e-14)[-1] < 2.1


@pytest.mark.parametrize("solver", [Broyden(), Broyden("identity")], ids=repr)
def test_quasi_newton_is_superlinear(solver):
    """Ratios of successive errors go to zero, those of fixed-point iteration stay where they
    are."""
    start, root = (0.8, -0.5), (0.0, 0.0)
    fast, slow = (_errors(s, CUBIC, start, root, max_iterations=60) for s in (solver, FixedPoint()))
    fast, slow = fast[fast > 1e-14], slow[slow > 1e-14]
    assert fast[-1] / fast[-2] < 0.1 * slow[-1] / slow[-2]
    assert len(fast) < len(slow) / 1.5


@pytest.mark.parametrize("solver", [DampedNewton(), SteepestDescent()], ids=repr)
def test_where_f_only_has_a_minimum_descent_stalls(solver):
    roots, _ = roots_of(NO_ROOT, solver, [(2.0, 1.0)], max_iterations=5000)
    assert roots.status[0] in (Status.STALLED, Status.SINGULAR)
    assert abs(roots.x[0, 0]) < 1e-3


def test_a_steepest_descent_that_still_descends_has_not_stalled():
    roots, _ = roots_of(ROSENBROCK, SteepestDescent(), [(-1.2, 1.0)], max_iterations=50)
    assert roots.status[0] == Status.MAX_ITERATIONS


@pytest.mark.parametrize("solver", [Newton(), Broyden(), DampedNewton()], ids=repr)
def test_a_singular_slope_is_named(solver):
    roots, _ = roots_of(NO_ROOT, solver, [(0.0, 1.0)])
    assert roots.status[0] == Status.SINGULAR


def test_an_expansion_has_diverged_before_it_overflows():
    roots, _ = roots_of(ROSENBROCK, FixedPoint(), [(-1.2, 1.0)])
    assert roots.status[0] == Status.DIVERGED


def test_the_budget_ends_a_trial():
    scenario = Scenario(Polynomial(strength=0.05), Gaussian(0.1), GaussianPrior(), 5.0)
    trials = scenario.draw(0, 5)
    estimates = Newton(tolerance=1e-15, budget=12.0).estimate(scenario.problem, trials.z)
    assert set(estimates.status) <= {Status.BUDGET, Status.CONVERGED}
    assert (estimates.simulations + 4 * estimates.jacobians <= 12 + 5).all()


def test_a_jacobian_free_solver_evaluates_one_for_its_covariance_alone():
    scenario = Scenario(Polynomial(), Gaussian(0.1), GaussianPrior(), 5.0)
    trials = scenario.draw(0, 5)
    for solver in (FixedPoint(), Broyden("identity")):
        assert (solver.estimate(scenario.problem, trials.z).jacobians == 1).all()
    assert (Broyden().estimate(scenario.problem, trials.z).jacobians == 2).all()
