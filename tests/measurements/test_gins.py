"""The gimballed INS: closed forms, other integrators, the reference values of its linear bound, and
richer truths."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import DOP853
from scipy.stats import chi2
from shared.gins_reference import velocities
from shared.oracles import agreed, assert_agrees
from shared.slopes import differentiate

from ipe_bench.api import run
from ipe_bench.baselines import GaussNewton, LinearLSE
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.main import main
from ipe_bench.measurements import Gins, Polynomial, RicherGins, SubsetModel
from ipe_bench.noise import Gaussian, NoNoise, Quantization
from ipe_bench.solvers import FixedPoint, Progressive
from ipe_bench.trials.scenario import Scenario

NOISE = Quantization(0.02286)
STEP = 0.075 * 0.3048
LINEAR_BOUND = [
    0.001105, 0.001321, 0.01559, 0.01560, 0.002182, 0.001645, 0.001446, 0.001660, 0.001549,
    0.001558, 0.001663
]  # fmt: skip


@pytest.fixture(scope="module")
def gins():
    return Gins()


def draw(scale, trials=2, seed=0):
    return scale * np.random.default_rng(seed).normal(size=(trials, 11))


@pytest.mark.oracle("closed form: Schuler's pendulum", "velocities, m/s", 1e-7)
def test_an_accelerometer_bias_swings_at_the_schuler_period():
    # Without Earth rate the platform is a pendulum: v = b / w sin(w t), w^2 = g / R.
    model = Gins(earth_rate=0.0, injected=((0.0, 0.0),) * 4, step=60.0)
    frequency = np.sqrt(model.gravity / model.earth_radius)
    assert 2 * np.pi / frequency / 60 == pytest.approx(84.45, abs=0.005)
    x = np.zeros((2, 11))
    x[0, 0] = x[1, 1] = 1.0
    velocity = model.simulate(x).reshape(2, 4, 30, 2)
    expected = 1e-4 * model.gravity / frequency * np.sin(frequency * model.times)
    for axis in range(2):
        assert_agrees(velocity[axis, :, :, axis], np.tile(expected, (4, 1)), atol=1e-7)
        assert_agrees(velocity[axis, :, :, 1 - axis], 0.0, atol=1e-7)


def test_axes_that_keep_north_show_the_same_speed_and_other_components():
    """The azimuth of the axes is a choice of coordinates: it turns the velocity of a system without
    errors, and changes no speed."""
    none = np.zeros((1, 11))
    wander = Gins().offset.reshape(4, 30, 2)
    north = Gins(azimuth="north").offset.reshape(4, 30, 2)
    speeds = (np.linalg.norm(v, axis=2) for v in (wander, north))
    np.testing.assert_allclose(*speeds, rtol=0, atol=1e-7)
    assert np.abs(wander - north).max() > 1.0
    assert (Gins(azimuth="north").simulate(none) == 0).all()
    # Its tangents turn with the same platform.
    model, x = Gins(azimuth="north"), draw(30.0)
    slopes = differentiate(model.simulate, x, analytic=False)
    np.testing.assert_allclose(model.jacobian(x), slopes, atol=1e-6)


@pytest.mark.slow
def test_the_choices_that_the_paper_leaves_change_scale_1_alone():
    """The table of method.md: the linear estimate at scale 1 is on its bound if 0.075 ft/s is the
    deviation of readings; azimuth and latitude matter nowhere."""
    estimators = {"linear": LinearLSE(), "ipe": FixedPoint()}

    def outcome(scale, noise=NOISE, **options):
        bench = Scenario(Gins(**options), noise, error_scale=scale)
        rows = run(bench, estimators, trials=200).set_index(["estimator", "parameter"])
        return rows.xs("all", level="parameter")

    assert outcome(1.0).loc["linear", "success"] < 0.85
    as_deviation = outcome(1.0, Gaussian(0.02286))
    assert as_deviation.loc["linear", "success"] > 0.98
    for other in ({"azimuth": "north"}, {"latitude_deg": 55.0}):
        assert 0.7 < outcome(1.0, **other).loc["linear", "success"] < 0.85
        assert outcome(100.0, **other).loc["ipe", "success"] > 0.95
    for noise in (NOISE, Gaussian(0.02286)):
        far = outcome(10.0, noise)
        assert far["success"].to_dict() == {"linear": 0.0, "ipe": 1.0}


def errors_beside_scipy(scale, trials):
    x = draw(scale, trials, seed=int(scale))
    reference = np.concatenate([velocities(x[i : i + 10]) for i in range(0, trials, 10)])
    # The model is not told the scale: the step follows from each x.
    return np.abs(Gins().simulate(x) - (reference - velocities(np.zeros((1, 11))))).max(axis=1)


QUICK = [(scale, 4, 1e-6) for scale in (1.0, 33.0, 300.0, 3000.0)]
SLOW = [
    (scale, 60, 2e-6 if scale == 10000.0 else 1e-6) for scale in (300.0, 1000.0, 3000.0, 10000.0)
]


@pytest.mark.oracle(
    "library: SciPy's DOP853 at a tolerance of 1e-13, on the equations in vectors",
    "velocities to error scale 10,000, m/s",
    2e-6,
)
@pytest.mark.parametrize(
    ("scale", "trials", "limit"),
    [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)],
)
def test_every_step_keeps_its_promise_whatever_the_scale(scale, trials, limit):
    agreed(errors_beside_scipy(scale, trials), limit)


def lopsided(trials, seed):
    """Draws in which few parameters dominate, which a bound from their sizes alone would judge
    wrongly."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(3, trials, 11))
    x[0] *= rng.random((trials, 11)) < 0.2
    x[1] *= np.arange(11) < 4
    x[2] *= np.arange(11) == rng.integers(0, 11, (trials, 1))
    return x.reshape(-1, 11)


@pytest.mark.parametrize("scale", [100.0, 300.0, 1000.0, 5000.0])
def test_every_step_keeps_its_promise_where_few_parameters_dominate(scale):
    x = scale * lopsided(40, seed=4)
    assert np.abs(Gins().simulate(x) - Gins(step=3.75).simulate(x)).max() < 1e-6


@pytest.mark.slow
def test_bits_of_a_trial_depend_on_itself_alone_where_steps_differ(monkeypatch):
    """In one batch of several levels, alone, in another order, up to a stop, and after other calls
    or none."""
    x = np.concatenate([draw(scale, 8, seed=9) for scale in (33.0, 1000.0, 3000.0, 10000.0)])
    model = Gins()
    z, J = model.simulate(x), model.jacobian(x)
    assert len(set(model._rungs_of(x, model.offset).places.tolist())) >= 5
    for threads in ("1", "2"):
        monkeypatch.setenv("IPE_BENCH_THREADS", threads)
        assert (Gins().jacobian(x[::-1]) == J[::-1]).all()
        assert (Gins().simulate(x[::-1]) == z[::-1]).all()
        assert (np.concatenate([Gins().simulate(row[None]) for row in x]) == z).all()
        assert (np.concatenate([Gins().jacobian(row[None]) for row in x]) == J).all()
    rows = model.rows(11)
    for fresh in (model, Gins()):
        assert (fresh.simulate_until(x, 11) == z[:, rows]).all()
        assert (fresh.jacobian_until(x, 11) == J[:, rows]).all()


@pytest.mark.oracle(
    "own second implementation: complex arithmetic with SciPy's coefficients",
    "slopes of velocities, over the largest",
    1e-9,
)
def test_the_jacobian_is_that_of_the_same_formula_in_complex_arithmetic(gins):
    x = draw(33.0, 1, seed=2)[0]
    J = gins.jacobian(x[None])[0].reshape(4, 30, 2, 11)
    for k in (0, 3):
        p = list(((x + 1e-100j * np.eye(11)) * gins.si_sizes).T)
        y = np.stack([np.broadcast_to(v, 11) + 0j for v in gins.start(p, gins.cases[k])])
        for i in range(30):
            slopes = []
            for s in range(12):
                at = y + 180.0 * sum(
                    (DOP853.A[s, j] * slopes[j] for j in range(s)), np.zeros_like(y)
                )
                slopes.append(np.array(gins.rhs(0.0, list(at), p, gins.cases[k])))
            y = y + 180.0 * sum(DOP853.B[s] * slopes[s] for s in range(12))
            exact = y[:2].imag / 1e-100
            agreed(np.abs(J[k, i] - exact).max() / np.abs(exact).max(), 1e-9)


class Plain(Gins):
    """Without its equations of small deviations: the tangents of the whole state."""

    variation = None


@pytest.mark.parametrize("scale", [1.0, 33.0, 300.0, 3000.0])
def test_eight_deviations_say_what_eleven_tangents_say(scale):
    """To the error that the integration leaves in either."""
    x = draw(scale, 10, seed=12)
    exact, reduced = Plain().jacobian(x), Gins().jacobian(x)
    assert (np.abs(reduced - exact) / np.abs(exact).max(axis=1, keepdims=True)).max() < 1e-9


def test_a_jacobian_costs_what_the_kernel_computes():
    """Eight deviations in eleven directions, beside eleven states: operations counted, not time."""
    assert 10.5 < Gins().jacobian_cost < 11.5
    assert Plain().jacobian_cost > 1.3 * Gins().jacobian_cost
    assert Gins().coarse_jacobian_cost < 3.0
    assert SubsetModel.until(Gins(), 5).jacobian_cost == Gins().jacobian_cost
    assert Gins(step=60.0).coarse_jacobian_cost == Gins().jacobian_cost


def test_bits_of_a_coarse_jacobian_depend_on_the_trial_alone():
    x = np.concatenate([draw(scale, 5, seed=14) for scale in (33.0, 1000.0, 3000.0)])
    model = Gins()
    coarse = model.coarse_jacobian(x)
    assert not (coarse == model.jacobian(x)).all(axis=(1, 2)).any()
    assert (np.concatenate([Gins().coarse_jacobian(row[None]) for row in x]) == coarse).all()
    assert (Gins().coarse_jacobian(x[::-1]) == coarse[::-1]).all()
    part = model.coarse_jacobian_until(x, 4)
    assert (np.concatenate([Gins().coarse_jacobian_until(row[None], 4) for row in x]) == part).all()
    assert (SubsetModel.until(model, 4).coarse_jacobian(x) == part).all()


@pytest.mark.parametrize(
    ("scale", "stops"),
    [
        (33.0, (30,)),
        (300.0, (4, 16, 30)),
        (1000.0, (30,)),
        (3000.0, (4, 16, 30)),
        (10000.0, (4, 16)),
    ],
)
def test_steps_with_a_coarse_jacobian_contract(scale, stops):
    model = Gins()
    for stop in stops:
        x = draw(scale, 40 if stop == 30 else 20, seed=13)
        J, coarse = model.jacobian_until(x, stop), model.coarse_jacobian_until(x, stop)
        size = np.linalg.norm(J, axis=1, keepdims=True)
        left = [
            np.eye(11) - np.linalg.lstsq(c, j)[0]
            for c, j in zip(coarse / size, J / size, strict=True)
        ]
        assert np.linalg.norm(left, 2, axis=(1, 2)).max() < (0.01 if scale < 10000 else 0.1)


def test_parameters_are_taken_in_any_layout_and_left_alone():
    model, x = Gins(), draw(33.0, 5)
    z, J = model.simulate(x), model.jacobian(x)
    locked, strided = x.copy(), np.asfortranarray(np.repeat(x, 2, axis=0))[::2]
    locked.flags.writeable = False
    for same in (locked, strided):
        assert (model.simulate(same) == z).all()
        assert (model.jacobian(same) == J).all()


def test_the_linear_bound_is_the_reference(gins):
    H = gins.linearization()
    deviation = np.sqrt(np.diag(np.linalg.inv(H.T @ H))) * STEP / np.sqrt(12)
    np.testing.assert_allclose(deviation, LINEAR_BOUND, rtol=5e-4)
    assert np.linalg.cond(H) == pytest.approx(19.99, abs=0.01)


def test_readings_of_a_window_are_near_enough_and_the_same_bits_in_any_batch():
    """Without a search for the step, at error scales where no step is known to do."""
    model = Gins()
    x = Scenario(model, NOISE, error_scale=5000.0).draw(0, 12).x
    for stop in (1, 8, 16):
        near = model.coarse_simulate_until(x, stop)
        exact = model.simulate_until(x, stop)
        off = np.abs(near - exact).max(axis=1)
        assert off.max() < 0.1 * 0.02286 / np.sqrt(12)
        assert (off > 0).any()
        np.testing.assert_array_equal(model.coarse_simulate_until(x[3:4], stop), near[3:4])


# Readings in a file, whose command is not told how far the parameters lie


@pytest.mark.slow
def test_an_estimate_that_fits_is_right_at_large_errors(tmp_path, monkeypatch):
    """The command is not told the error scale: the step follows from the parameters."""
    monkeypatch.chdir(tmp_path)
    assert main(["run", "error_scale=3000", "seed=3", "write_readings=t.csv"]) == 0
    assert main(["estimate", "readings=t.csv", "solver=[progressive]", "baseline=[]"]) == 0
    rows = csv.DictReader((tmp_path / "t.truth.csv").read_text().splitlines())
    truth = {row["parameter"]: float(row["value"]) for row in rows}
    found = json.loads(next(tmp_path.glob("outputs/*/estimate.json")).read_text())["estimators"][
        "progressive"
    ]
    assert found["status"] == "converged"
    assert found["fits"]
    for name, value in truth.items():
        assert abs(found["estimates"][name] - value) < 4 * found["standard_errors"][name]


@pytest.mark.slow
@pytest.mark.parametrize("scale", [300.0, 1000.0, 3000.0, 10_000.0])
def test_without_a_prior_estimates_succeed_as_often_as_with_one(scale):
    """Who has a file alone cannot say how far the parameters may lie: windows then take it from the
    linear estimate."""
    scenario = Scenario(Gins(), NOISE, error_scale=scale)
    trials = scenario.draw(0, 60)
    problem = replace(scenario.problem, prior_deviation=None)
    found = Progressive().estimate(problem, trials.z)
    J = scenario.problem.R.whiten_jacobian(scenario.measurement.jacobian(trials.x))
    distance = np.sum(np.einsum("tij,tj->ti", J, found.x - trials.x) ** 2, axis=1)
    success = distance <= chi2.isf(1e-6, problem.measurement.n)
    assert success.sum() >= 59
    assert (found.extras["fit_p"][~success] < 1e-6).all()


# Truths richer than the model: exact, of their own draws, and seen or not seen by the test of the
# fit


def scenario(scale=33.0, **errors):
    return Scenario(Gins(), NOISE, error_scale=scale, truth=RicherGins(**errors))


def test_without_its_errors_it_is_gins():
    model, rich = Gins(), RicherGins()
    x = 33.0 * np.random.default_rng(0).normal(size=(3, 11))
    z = rich.simulate(np.pad(x, ((0, 0), (0, len(rich.nuisance_deviation)))))
    np.testing.assert_allclose(z, model.simulate(x), atol=1e-9)
    assert (rich.simulate(x) == model.simulate(x)).all()


def test_a_constant_walk_is_a_drift():
    """An increment at the start of a case and none after it is that drift in this case."""
    model, rich = Gins(), RicherGins()
    extra = np.zeros((1, len(rich.nuisance_deviation)))
    walk = extra[:, 7:].reshape(4, 30, 3)
    walk[:, 0, 1] = 5.0 * model.si_sizes[5]
    z = rich.simulate(np.concatenate([np.zeros((1, 11)), extra], axis=1))
    drift = np.zeros((1, 11))
    drift[0, 5] = 5.0
    np.testing.assert_allclose(z, model.simulate(drift), atol=1e-9)


@pytest.mark.oracle("library: SciPy's DOP853", "velocities with a walk of the drifts, m/s", 1e-6)
@pytest.mark.parametrize("scale", [33.0, 3000.0])
def test_a_random_walk_keeps_the_tolerance_of_gins(scale):
    """Beside SciPy, from reading to reading."""
    rich = RicherGins(gyro_random_walk=0.05)
    rng = np.random.default_rng(5)
    increments = rich.nuisance_deviation * rng.normal(size=367)
    x = np.concatenate([scale * rng.normal(size=11), increments])[None]
    walk = np.cumsum(increments[7:].reshape(1, 4, 30, 3), axis=2)
    reference = velocities(x[:, :11], walk) - velocities(np.zeros((1, 11)))
    agreed(np.abs(rich.simulate(x) - reference), 1e-6)
    assert (rich.simulate_until(x, 7) == rich.simulate(x)[:, rich.rows(7)]).all()


def test_a_level_accelerometer_senses_the_other_axis_and_a_square():
    p, gravity = np.zeros(15), RicherGins().gravity
    p[11:] = (
        1e-3,
        2e-3,
        3e-4,
        5e-4,
    )  # quadratic x and y in 1 / (m/s^2), misalignment of x to y and of y to x in rad
    fx, fy = 0.02, -0.05
    shown = RicherGins().acceleration((fx / gravity, fy / gravity), p)
    np.testing.assert_allclose(
        shown, (fx + 1e-3 * fx**2 + 3e-4 * fy, fy + 2e-3 * fy**2 + 5e-4 * fx), rtol=1e-14
    )


def test_the_parameters_of_a_trial_are_those_of_the_plain_scenario():
    plain = Scenario(Gins(), NOISE, error_scale=33.0).draw(0, 5)
    rich = scenario(gyro_random_walk=0.01).draw(0, 5)
    assert (rich.x == plain.x).all()
    assert not (rich.z == plain.z).all()


def test_nuisances_do_not_scale_with_the_errors():
    """Twice the error scale doubles the parameters' readings, not those of the random walk."""
    noiseless = [
        Scenario(Gins(), NoNoise(0.0066), error_scale=s, truth=RicherGins(gyro_random_walk=0.01))
        .draw(0, 20)
        .z
        for s in (1e-6, 1e-3)
    ]
    assert abs(noiseless[0].std() / noiseless[1].std() - 1) < 0.01


def test_who_is_noticed():
    """Drifts that walk leave residuals; a misaligned platform looks like a bias and leaves none,
    however wrong the bias."""
    found = {}
    for name, errors in {
        "none": {},
        "walk": {"gyro_random_walk": 0.001},
        "platform": {"platform_misalignment": 5.0},
    }.items():
        given = scenario(**errors)
        trials = given.draw(0, 60)
        estimates = GaussNewton().estimate(given.problem, trials.z)
        deviation = np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2))
        rms = np.sqrt(np.mean(((estimates.x - trials.x) / deviation) ** 2))
        found[name] = rms, np.mean(estimates.extras["fit_p"] < 1e-3)
    assert found["none"][0] < 1.2
    assert found["none"][1] < 0.05
    assert found["walk"][0] > 5
    assert found["walk"][1] > 0.95
    assert found["platform"][0] > 30
    assert found["platform"][1] < 0.1


def test_a_truth_of_another_model_is_refused():
    with pytest.raises(UserError, match=r"^truth_measurement="):
        Scenario(Gins(), NOISE, error_scale=1.0, truth=Polynomial())
