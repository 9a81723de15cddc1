"""Two problems of smoothers: their equations, the experiment that compares on them, and SciPy's
minimum of a path."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

import ipe_bench as ib
from ipe_bench.basics.statuses import Status
from ipe_bench.cli.session import jobs_of, session
from ipe_bench.cli.words import read
from ipe_bench.states import LevenbergMarquardtSmoother
from ipe_bench.states.whole_paths import PathDensity

STEP = 16 / 164
TURN = 2 * np.pi


def model(name, **options):
    return ib.component(f"state_model/{name}", **options)


def test_the_oscillator_moves_by_eulers_steps_and_is_read_at_every_fourth():
    oscillator = model("van_der_pol")
    x, v = 0.7, -3.0
    moved = oscillator.transition(np.array([[x, v]]), 5)[0]
    np.testing.assert_allclose(
        moved, [x + STEP * v, v + STEP * (2 * (1 - x**2) * v - x)], rtol=1e-14
    )
    read = [k for k in range(oscillator.epochs) if oscillator.R(k)[0, 0] == 1.0]
    assert read == list(range(3, 164, 4))
    assert oscillator.times[-1] == pytest.approx(16 - STEP)


def test_the_target_has_a_white_acceleration_and_a_mirror_image():
    target = model("two_ranges")
    h = TURN / 50
    block = np.array([[h, h**2 / 2], [h**2 / 2, h**3 / 3]])
    G = target.gain(1)
    np.testing.assert_allclose(G @ G.T, np.kron(np.eye(2), block), atol=1e-16)
    ahead = np.array([[1.0, 2.0, 0.5, 0.3]])
    # The line through both points is y = -1.5.
    mirrored = ahead * [1, 1, -1, -1] - [0, 0, 0, 3.0]
    np.testing.assert_allclose(target.observe(mirrored, 1), target.observe(ahead, 1), rtol=1e-15)
    np.testing.assert_allclose(target.prior.mean, [1, h, np.cos(h), np.sin(h)], rtol=1e-15)


@pytest.mark.slow
def test_the_experiment_has_both_models_at_three_scales_and_seven_smoothers():
    with session():
        jobs = jobs_of(read("run", ["+experiment=smoothers", "trials=2"]), multirun=True)
        specs = jobs.specs
    found = {(s.scenario.model.name, s.scenario.error_scale) for s in specs}
    assert found == {(n, e) for n in ("van_der_pol", "two_ranges") for e in (1.0, 3.0, 6.0)}
    assert len(specs[0].estimators) == 7
    assert specs[0].estimators["ukf_near_rts"].filter.rule.alpha == 0.1


def test_a_short_oscillator_is_held_by_a_smoother_that_minimises():
    short = replace(model("van_der_pol"), count=12)
    paths = short.draw(0, 3)
    tracks = LevenbergMarquardtSmoother().track(short, paths.z)
    assert (tracks.status == Status.CONVERGED).all()
    off = tracks.mean - paths.x
    squares = np.linalg.solve(tracks.covariance, off[..., None])[..., 0] * off
    assert squares.sum(axis=2).mean(axis=1).max() < chi2.ppf(1 - 1e-6, 2)


def residuals(oscillator, z, flat):
    """Start, steps and readings of a path (K, 2), each in its standard deviations."""
    path = flat.reshape(-1, 2)
    m, P = oscillator.prior
    before = path[:-1]
    x, v = before[:, 0], before[:, 1]
    moved = np.stack([x + STEP * v, v + STEP * (2 * (1 - x**2) * v - x)], axis=1)
    deviation = np.sqrt([oscillator.R(k)[0, 0] for k in range(oscillator.epochs)])
    return np.concatenate(
        [
            (path[0] - m) / np.sqrt(np.diag(P)),
            ((path[1:] - moved) / 0.1).ravel(),
            (z[:, 0] - path[:, 0]) / deviation,
        ]
    )


@pytest.mark.slow
def test_scipy_finds_no_lower_path_from_the_optimised_one_or_from_the_truth():
    short = replace(model("van_der_pol"), count=60)
    scenario = ib.StateScenario(short, error_scale=1.0)
    oscillator = scenario.assumed
    paths = scenario.draw(0, 3)
    tracks = LevenbergMarquardtSmoother().track(oscillator, paths.z)
    assert tracks.cost is not None
    for path, truth, z, cost in zip(tracks.mean, paths.x, paths.z, tracks.cost, strict=True):
        for start in (path, truth):
            found = least_squares(
                lambda x, z=z: residuals(oscillator, z, x), start.ravel(), max_nfev=100
            )
            assert 2 * found.cost >= cost - 1e-3
        assert np.sum(residuals(oscillator, z, path.ravel()) ** 2) == pytest.approx(cost, abs=1e-6)


def test_covariances_of_the_oscillators_paths_are_never_below_those_of_tangents():
    """The cost beside a path rises far above that of a normal density where the rest of the path
    is not found in a step, as in trial 10."""
    oscillator = model("van_der_pol")
    z = oscillator.draw(9, 12).z
    density = PathDensity.of(oscillator, z)
    with np.errstate(all="ignore"):
        tracks = LevenbergMarquardtSmoother().track(oscillator, z)
    path = np.concatenate([tracks.start.mean[:, None], tracks.mean], axis=1)
    at = density.settled(path)
    P = density.spread(density.tangents(at), at).covariance
    root = np.linalg.inv(np.linalg.cholesky(P[:, -1]))
    relative = root @ tracks.covariance[:, -1] @ root.transpose(0, 2, 1)
    assert (np.linalg.eigvalsh(relative) > 0.75).all()
