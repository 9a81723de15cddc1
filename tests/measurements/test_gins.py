"""The gimballed INS: closed forms, other integrators, and the reference values of its linear bound."""

import numpy as np
import pytest
from gins_reference import velocities
from scipy.integrate import DOP853, solve_ivp

from ipe_bench.measurements import Gins
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.noise import Quantization
from ipe_bench.trials.scenario import Scenario

STEP = 0.075 * 0.3048
LINEAR_BOUND = [
    0.001105, 0.001321, 0.01559, 0.01560, 0.002182, 0.001645, 0.001446, 0.001660, 0.001549, 0.001558, 0.001663
]  # fmt: skip


@pytest.fixture(scope="module")
def gins():
    return Gins()


def draw(scale, trials=2, seed=0):
    return scale * np.random.default_rng(seed).normal(size=(trials, 11))


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
        np.testing.assert_allclose(velocity[axis, :, :, axis], np.tile(expected, (4, 1)), atol=1e-7)
        np.testing.assert_allclose(velocity[axis, :, :, 1 - axis], 0.0, atol=1e-7)


@pytest.mark.parametrize("scale", [1.0, 33.0, 100.0])
def test_readings_agree_with_an_adaptive_integrator(scale):
    model = Gins()
    x = draw(scale, 1, seed=int(scale))
    z = model.simulate(x).reshape(4, 30, 2)
    for p, sign in ((list(x[0] * model.si_sizes), 1.0), ([0.0] * 11, -1.0)):
        for k, c in enumerate(model.cases[:2]):
            solution = solve_ivp(
                lambda t, y, p=p, c=c: model.rhs(t, y, p, c),
                (0.0, model.times[-1]),
                model.start(p, c),
                "DOP853",
                t_eval=model.times,
                rtol=1e-12,
                atol=1e-12,
            )
            z[k] -= sign * solution.y[:2].T
    assert np.abs(z[:2]).max() < 1e-6


def errors_beside_scipy(scale, trials):
    x = draw(scale, trials, seed=int(scale))
    reference = np.concatenate([velocities(x[i : i + 10]) for i in range(0, trials, 10)])
    # The model is not told the scale: the step follows from each x.
    return np.abs(Gins().simulate(x) - (reference - velocities(np.zeros((1, 11))))).max(axis=1)


SLOW = [(scale, 60, 2e-6 if scale == 10000.0 else 1e-6) for scale in (300.0, 1000.0, 3000.0, 10000.0)]


@pytest.mark.parametrize(
    ("scale", "trials", "limit"),
    [(300.0, 4, 1e-6), (3000.0, 4, 1e-6), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)],
)
def test_every_step_keeps_its_promise_whatever_the_scale(scale, trials, limit):
    assert errors_beside_scipy(scale, trials).max() < limit


def lopsided(trials, seed):
    """Draws in which few parameters dominate, which a bound from their sizes alone would judge wrongly."""
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


def test_bits_of_a_trial_depend_on_itself_alone_where_steps_differ(monkeypatch):
    """In one batch of several levels, alone, in another order, up to a stop, and after other calls or none."""
    x = np.concatenate([draw(scale, 8, seed=9) for scale in (33.0, 1000.0, 3000.0, 10000.0)])
    model = Gins()
    z, J = model.simulate(x), model.jacobian(x)
    assert len(set(model._search(x, model.offset).places.tolist())) >= 5
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


def test_the_jacobian_is_that_of_the_same_formula_in_complex_arithmetic(gins):
    x = draw(33.0, 1, seed=2)[0]
    J = gins.jacobian(x[None])[0].reshape(4, 30, 2, 11)
    for k in (0, 3):
        p = list(((x + 1e-100j * np.eye(11)) * gins.si_sizes).T)
        y = np.stack([np.broadcast_to(v, 11) + 0j for v in gins.start(p, gins.cases[k])])
        for i in range(30):
            slopes = []
            for s in range(12):
                at = y + 180.0 * sum((DOP853.A[s, j] * slopes[j] for j in range(s)), np.zeros_like(y))
                slopes.append(np.array(gins.rhs(0.0, list(at), p, gins.cases[k])))
            y = y + 180.0 * sum(DOP853.B[s] * slopes[s] for s in range(12))
            exact = y[:2].imag / 1e-100
            assert np.abs(J[k, i] - exact).max() < 1e-9 * np.abs(exact).max()


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


@pytest.mark.parametrize("scale", [33.0, 300.0, 1000.0, 3000.0])
def test_steps_with_a_coarse_jacobian_contract(scale):
    model, x = Gins(), draw(scale, 40, seed=13)
    J, coarse = model.jacobian(x), model.coarse_jacobian(x)
    left = [np.linalg.norm(np.eye(11) - np.linalg.pinv(c) @ j, 2) for c, j in zip(coarse, J, strict=True)]
    assert max(left) < 0.01


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


@pytest.mark.parametrize("scale", [300.0, 3000.0, 10000.0])
def test_steps_with_a_coarse_jacobian_of_a_window_contract(scale):
    model, x = Gins(), draw(scale, 20, seed=13)
    for stop in (4, 16):
        J, coarse = model.jacobian_until(x, stop), model.coarse_jacobian_until(x, stop)
        size = np.linalg.norm(J, axis=1, keepdims=True)
        left = [np.eye(11) - np.linalg.lstsq(c, j)[0] for c, j in zip(coarse / size, J / size, strict=True)]
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
    x = Scenario(model, Quantization(0.02286), error_scale=5000.0).draw(0, 12).x
    for stop in (1, 8, 16):
        near = model.coarse_simulate_until(x, stop)
        exact = model.simulate_until(x, stop)
        off = np.abs(near - exact).max(axis=1)
        assert off.max() < 0.1 * 0.02286 / np.sqrt(12)
        assert (off > 0).any()
        np.testing.assert_array_equal(model.coarse_simulate_until(x[3:4], stop), near[3:4])
