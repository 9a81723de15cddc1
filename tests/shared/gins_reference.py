"""The gimballed INS once more, written from its equations in vectors and integrated by SciPy to
round-off."""

import numpy as np
from scipy.integrate import solve_ivp

LATITUDE, RADIUS, GRAVITY, RATE = np.deg2rad(36.35), 6378137.0, 9.80665, 7.292115e-5
CASES = 457.2 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
ARC = np.pi / 180 / 3600
SI = np.array([1e-4 * GRAVITY] * 2 + [1e-4] * 2 + [0.01 * ARC] * 2 + [0.1 * ARC] + [0.2 * ARC] * 4)


def velocities(x, walk=None, rtol=1e-13):
    """Velocities (trials, 240) that the platform shows, with the velocities of the error-free
    system among them; x (trials, 11). `walk` (trials, 4, 30, 3) in rad/s is added to the drifts of
    each interval."""
    lanes = 4 * len(x)
    p = np.repeat(x * SI, 4, axis=0)
    axis = np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
    y = np.concatenate(
        [
            np.tile(CASES, (len(x), 1)),
            np.tile([0.0, 0.0, 1.0], (lanes, 1)),
            np.tile(axis, (lanes, 2)),
        ],
        1,
    )
    drifts = np.zeros((lanes, 30, 3)) if walk is None else walk.reshape(lanes, 30, 3)
    shown = []
    for k, piece in enumerate(
        [(0.0, 5400.0)] if walk is None else [(180.0 * i, 180.0 * (i + 1)) for i in range(30)]
    ):
        times = 180.0 * np.arange(1, 31) if walk is None else [piece[1]]
        solution = solve_ivp(
            _slope, piece, y.ravel(), "DOP853", times, args=(p, drifts[:, k]), rtol=rtol, atol=1e-13
        ).y.reshape(lanes, 11, -1)
        shown.append(solution[:, :2])
        y = solution[:, :, -1]
    return np.concatenate(shown, axis=2).swapaxes(1, 2).reshape(len(x), 240)


def _slope(t, y, p, walk):
    y = y.reshape(len(p), 11)
    v, u, e, c = y[:, :2], y[:, 2:5], y[:, 5:8], y[:, 8:]
    transport = np.stack([-v[:, 1], v[:, 0], 0.0 * v[:, 0]], axis=1) / RADIUS
    command = RATE * c + transport
    drift = p[:, 4:7] + walk
    drift[:, :2] += np.einsum("lij,lj->li", p[:, 7:].reshape(-1, 2, 2), u[:, :2])
    platform = command + drift
    coriolis = 2 * RATE * c[:, 2:]
    acceleration = (
        GRAVITY * (1 + p[:, 2:4]) * u[:, :2] + p[:, :2] + coriolis * v[:, ::-1] * [1.0, -1.0]
    )
    return np.concatenate(
        [
            acceleration,
            np.cross(RATE * e - platform, u),
            -np.cross(platform, e),
            -np.cross(command, c),
        ],
        axis=1,
    ).ravel()
