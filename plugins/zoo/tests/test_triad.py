"""Triads against a recorded calibration with a known answer, the algebraic fit of a quadric, and
SciPy."""

import numpy as np
import pytest
from ipe_bench_zoo import Accelerometer, Triad
from scipy.linalg import polar
from scipy.optimize import least_squares
from shared.oracles import assert_agrees

from ipe_bench.baselines import GaussNewton
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers import Newton

# A magnetometer with large offsets, turned by hand, in gauss: every fourth sample of the recording
# that the PX4 autopilot (BSD licence) tests its calibration with,
# src/modules/commander/mag_calibration_test_data.h. The field is 0.4.
RECORDED = np.array([
    (-0.4820143, 0.1520199, -0.4070847), (-0.4783235, 0.0037079, -0.3518451),
    (-0.3448502, -0.1334904, -0.2926220),
    (-0.2076591, -0.1557443, -0.2531449), (-0.0185417, -0.0778750, -0.2334291),
    (0.0593269, 0.0630349, -0.2727787),
    (0.0482083, 0.1965415, -0.3521219), (-0.0593280, 0.3263040, -0.4072448),
    (-0.2113560, 0.3670920, -0.4388755),
    (-0.3708661, 0.2558976, -0.8036815), (-0.1483385, 0.2373417, -0.8706421),
    (0.0037085, 0.2225078, -0.7994077),
    (0.1038370, 0.2299247, -0.5777897), (0.0074175, 0.2484848, -0.3603183),
    (-0.2299247, 0.2781348, -0.3205546),
    (-0.3522977, 0.2818382, -0.3759097), (-0.4524325, 0.2707179, -0.5817472),
    (-0.4116835, 0.2707468, -0.7445893),
    (-0.1965731, 0.2522070, -0.8595589), (-0.4562225, -0.1224012, -0.4319302),
    (-0.4784687, -0.1409443, -0.5824348),
    (-0.4339989, -0.1669226, -0.7176189), (-0.3338213, -0.2040019, -0.7925325),
    (-0.2077111, -0.2188384, -0.8281965),
    (-0.0704734, -0.2151293, -0.8083832), (0.0741839, -0.1780412, -0.6777043),
    (0.1038574, -0.1520769, -0.5588088),
    (0.0778986, -0.1187027, -0.4004919), (0.0, -0.0964476, -0.2974341),
    (0.0, -0.0556479, -0.2976297),
    (-0.0037099, 0.1261374, -0.2778243), (-0.0037099, 0.3079182, -0.4722392),
    (0.0259676, 0.3116113, -0.6664276),
    (0.0445151, 0.2225755, -0.7813630), (0.0593588, 0.1038779, -0.8453796),
    (0.0742012, -0.0630710, -0.8098725),
    (0.0445199, -0.2188895, -0.6192327), (0.0333875, -0.1891959, -0.4364088),
    (-0.4155339, -0.1298543, -0.7901266),
    (-0.4712366, 0.0593684, -0.8384346), (-0.4304364, 0.1744010, -0.8664783),
    (-0.3228157, 0.2634473, -0.8583027),
    (-0.1446975, 0.2931051, -0.8617089), (-0.0148408, 0.2597134, -0.8339118),
    (0.1187389, 0.0779224, -0.8067519),
    (0.0482368, -0.1669736, -0.7629357), (-0.2040678, -0.2560124, -0.7546902),
    (-0.3710324, -0.1558336, -0.8063270),
    (-0.4601216, -0.0148426, -0.3139990), (-0.4193044, -0.1744010, -0.4173404),
    (-0.3562360, -0.2449123, -0.6241878),
    (-0.3191281, -0.1781180, -0.7991194), (-0.3117065, -0.0185540, -0.9064639),
    (-0.3117065, 0.1187453, -0.9104395),
    (-0.3970547, 0.3154173, -0.7355080), (-0.4415842, 0.3042850, -0.5486492),
    (-0.4601548, 0.1707026, -0.3658625),
    (-0.4527247, 0.0296869, -0.3220756),
])  # fmt: skip
ANSWER = {"bias": (-0.18, 0.05, -0.58), "scale": (1.0, 1.06, 0.94)}
"""What that test states, with a tolerance of 0.01."""


def quadric(outputs, field):
    """Bias b and symmetric matrix M with |M (r - b)| = field for every output r, by the linear fit
    of a quadric."""
    x, y, z = outputs.T
    D = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z])
    a, b, c, d, e, f, *g = np.linalg.lstsq(D, np.ones(len(D)), rcond=None)[0]
    A = np.array([[a, d, e], [d, b, f], [e, f, c]])
    centre = -np.linalg.solve(A, g)
    values, vectors = np.linalg.eigh(A * field**2 / (1.0 + centre @ A @ centre))
    return centre, vectors @ np.diag(np.sqrt(values)) @ vectors.T


def estimate(model, z, deviation):
    estimates = Newton(tolerance=1e-9).estimate(
        Problem(model, Covariance(np.full(model.m, deviation))), z
    )
    assert (estimates.status == 0).all()
    p = estimates.x * model.sizes * np.repeat([1.0, 1e-6, 1e-3], 3)
    (xy, xz, yz), (kx, ky, kz) = p[0, 6:], 1.0 + p[0, 3:6]
    return p[0, :3], np.array([[kx, xy, xz], [xy, ky, yz], [xz, yz, kz]])


@pytest.mark.oracle(
    "published: calibration in the tests of the PX4 autopilot",
    "bias, gauss, and scale factors",
    0.01,
)
def test_a_recorded_magnetometer_calibration_gives_the_known_answer():
    # Newton needs a rough centre: the middle of the extremes, as calibrations begin.
    centre = tuple(((RECORDED.max(axis=0) + RECORDED.min(axis=0)) / 2).tolist())
    model = Triad(
        outputs=tuple(map(tuple, RECORDED.tolist())), field=0.4, unit="gauss", bias=centre
    )
    b, M = estimate(model, np.full((1, model.m), 0.4), 0.002)
    assert_agrees(b, ANSWER["bias"], atol=0.01)
    # The answer's field is its own estimate, so scale factors are compared by their ratios.
    scale = np.diag(M) / np.diag(M).mean()
    assert_agrees(scale, ANSWER["scale"], atol=0.01)
    residual = np.linalg.norm((RECORDED - b) @ M.T, axis=1) - 0.4
    assert np.mean(residual**2) < 1e-3  # the fit that the recorded test asks for


@pytest.mark.oracle("closed form: algebraic fit of a quadric", "bias and matrix", 1e-8)
def test_exact_magnitudes_give_the_algebraic_fit_of_the_quadric():
    rng = np.random.default_rng(0)
    M = np.eye(3) + 0.03 * (lambda a: a + a.T)(rng.normal(size=(3, 3)))
    b = np.array([0.05, -0.02, 0.03])
    directions = rng.normal(size=(40, 3))
    applied = 9.8 * directions / np.linalg.norm(directions, axis=1)[:, None]
    outputs = applied @ np.linalg.inv(M) + b
    model = Triad(outputs=tuple(map(tuple, outputs.tolist())), field=9.8, unit="m/s^2")
    own = estimate(model, np.full((1, 40), 9.8), 1e-4)
    for values in zip(own, quadric(outputs, 9.8), (b, M), strict=True):
        for value in values[:2]:
            assert_agrees(value, values[2], atol=1e-8)


def test_nothing_but_magnitude_and_bias_is_seen_without_errors():
    model = Triad()
    np.testing.assert_allclose(model.simulate(np.zeros((1, 9))), 1.0, atol=1e-15)
    assert np.linalg.cond(model.linearization()) < 2.0


# Accelerometers: the source's matrices, the symmetric form of the same model, and SciPy

GRAVITY = 9.8
BIAS = np.array([33124.0, 33275.0, 32364.0])
K = np.diag([0.00241, 0.00237, 0.00246])
T = np.array([[1.0, -0.0047, 0.0121], [0.0, 1.0, 0.0088], [0.0, 0.0, 1.0]])
"""A triad with the errors of consumer sensors."""


@pytest.fixture
def held():
    """The counts of that triad at rest in 35 attitudes of no particular kind."""
    v = np.random.default_rng(0).normal(size=(35, 3))
    force = GRAVITY * v / np.linalg.norm(v, axis=1)[:, None]
    return force @ np.linalg.inv(T @ K).T + BIAS


def model_of(counts, **options):
    return Accelerometer(counts=tuple(map(tuple, counts.tolist())), gravity=GRAVITY, **options)


def x_of(model, bias, K, T):
    values = [
        *bias,
        *(1e6 * (np.diag(K) / model.scale - 1.0)),
        -1e3 * T[0, 1],
        1e3 * T[0, 2],
        -1e3 * T[1, 2],
    ]
    return np.array(values) / model.sizes


def test_the_true_triad_sees_gravity_in_every_attitude(held):
    model = model_of(held)
    np.testing.assert_allclose(model.simulate(x_of(model, BIAS, K, T)[None]), GRAVITY, rtol=1e-13)


def test_magnitudes_are_those_of_the_matrices_and_of_the_symmetric_form(held):
    model = model_of(held)
    bias, scale = BIAS + np.array([40.0, -20.0, 10.0]), K * np.diag([1.01, 0.98, 1.02])
    z = model.simulate(x_of(model, bias, scale, T)[None])[0]
    np.testing.assert_allclose(z, np.linalg.norm((held - bias) @ (T @ scale).T, axis=1), rtol=1e-13)
    # |M v| = |S v| for M = U S; the triad counts in units in which S is near I.
    S = polar(T @ scale)[1] / 0.0024
    triad = Triad(outputs=tuple(map(tuple, held.tolist())), field=GRAVITY / 0.0024, unit="counts")
    values = np.array([*bias, *(1e6 * (np.diag(S) - 1.0)), *(1e3 * S[[0, 0, 1], [1, 2, 2]])])
    np.testing.assert_allclose(
        triad.simulate((values / triad.sizes)[None])[0] * 0.0024, z, rtol=1e-12
    )


@pytest.mark.oracle("library: SciPy's least_squares", "estimates", 1e-6)
def test_a_calibration_with_noise_is_scipys(held):
    counts = held + np.random.default_rng(1).normal(size=held.shape)
    model = model_of(counts)
    problem = Problem(model, Covariance(np.full(model.m, 0.0025)))
    estimates = GaussNewton(start="nominal").estimate(problem, np.full((1, 35), GRAVITY))
    assert estimates.status[0] == 0

    def residuals(p):
        upper = np.array([[1.0, -p[6], p[7]], [0.0, 1.0, -p[8]], [0.0, 0.0, 1.0]]) * p[3:6]
        return np.linalg.norm((counts - 1e4 * p[:3]) @ upper.T * 1e-3, axis=1) - GRAVITY

    start = np.array([3.2768, 3.2768, 3.2768, 2.4, 2.4, 2.4, 0.0, 0.0, 0.0])
    p = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    theirs = x_of(
        model,
        1e4 * p[:3],
        np.diag(1e-3 * p[3:6]),
        np.array([[1, -p[6], p[7]], [0, 1, -p[8]], [0, 0, 1]]),
    )
    assert_agrees(estimates.x[0], theirs, atol=1e-6)
    # One count is 2.4e-3 m/s^2, and 35 attitudes average it.
    np.testing.assert_allclose((estimates.x[0] * model.sizes)[:3], BIAS, atol=2.0)


def test_the_presumed_triad_of_the_default_sees_gravity():
    model = Accelerometer(misalignment=(0.01, -0.02, 0.005), scale=(0.002, 0.003, 0.0025))
    np.testing.assert_allclose(model.simulate(model.nominal[None]), 9.80665, rtol=1e-13)
