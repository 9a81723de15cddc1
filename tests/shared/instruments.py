"""Files as instruments give them, and SciPy's solution of the same problem."""

import csv
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.real.fits import Fit, fit

SATURATION = "b1*(1-exp(-b2*t))"
START = {"b1": 250.0, "b2": 5e-4}
ESTIMATORS = {"lm": LevenbergMarquardt(tolerance=1e-10, max_iterations=300)}
EXACT = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}


def write(path: Path, **columns: list[float]) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([list(columns), *zip(*columns.values(), strict=True)])
    return path


def simulated(path: Path, b1: float, seed: int, readings: int = 16) -> tuple[Path, np.ndarray]:
    """A file t, y, sigma of unequal weights, and its columns (readings, 3)."""
    rng = np.random.default_rng(seed)
    t, sigma = np.linspace(50, 700, readings), 0.1 * (1 + 4 * rng.random(readings))
    y = b1 * -np.expm1(-5.6e-4 * t) + sigma * rng.standard_normal(readings)
    return write(path, t=t.tolist(), y=y.tolist(), sigma=sigma.tolist()), np.column_stack(
        [t, y, sigma]
    )


def solution(residuals, start) -> tuple[np.ndarray, np.ndarray]:
    """SciPy's minimum, polished by Gauss-Newton steps with complex-step slopes, and the deviations
    there."""
    found = least_squares(residuals, start, x_scale=np.abs(start), **EXACT).x
    for _ in range(4):
        steps = np.eye(len(found)) * 1e-100j
        J = np.column_stack([np.imag(residuals(found + step)) * 1e100 for step in steps])
        found = found - np.linalg.lstsq(J, np.real(residuals(found)), rcond=None)[0]
    scale = np.linalg.norm(J, axis=0)
    return found, np.sqrt(np.diag(np.linalg.inv((J / scale).T @ (J / scale)))) / scale


def estimate(found, **options) -> Fit:
    R = Gaussian(tuple(found.deviations)).covariance(len(found.z))
    return fit(Problem(found.model, R), found.z, ESTIMATORS, **options)[0]
