"""How fast must gyro drifts walk until a filter beats estimation from all readings at once?

    python plugins/examples/when_to_filter/when_to_filter.py 100 outputs/when_to_filter.png

The inertial system of the paper runs its four cases one after another on one platform, and its
three gyro drifts walk meanwhile (`state_model=walking_gins`). Scored are the eight parameters that
stand still, over all trials, in multiples of the error that a filter linearised at the truth has.
Least squares and iterated estimation take drifts for constants; modelled, the walk is in the
correlated errors of the readings, linearised at the start. The filters are extended Kalman
filters with and without the walk.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ipe_bench as ib
from ipe_bench.basics.linalg import Covariance
from ipe_bench.states import WalkingGins, bound_at_truth, ekf

WALKS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Multiples of a drift's size (0.01 deg/h about x and y, 0.1 deg/h about z) in an hour."""
SCALES = (1.0, 10.0, 33.0)
KINEMATIC = 11
"""States of the platform and the computer, which stand before the eleven errors."""
STANDING = [0, 1, 2, 3, 7, 8, 9, 10]
"""The parameters that do not walk."""
STYLES = {
    "least squares": ("#999999", "--", "s"),
    "least squares, modelled": ("#999999", "-", "s"),
    "iterated (IPE)": ("#0072B2", "--", "o"),
    "iterated (IPE), modelled": ("#0072B2", "-", "o"),
    "EKF": ("#D55E00", "--", "^"),
    "EKF, modelled": ("#D55E00", "-", "^"),
}


def errors_by_walk(model: WalkingGins) -> np.ndarray:
    """Covariance (m, m) of the readings by drifts that walk by one size in an hour, linearised at
    the start."""
    x = model.prior.mean
    S = np.zeros((model.n, 3 * model.epochs))
    rows = []
    for k in range(model.epochs):
        value, F = model.transition_into(k).slope(x[None])
        x, S = value[0], F[0] @ S
        S[:, 3 * k : 3 * k + 3] += replace(model, walk=1.0).gain(k)
        rows.append(S[:2].copy())
    A = np.concatenate(rows)
    return A @ A.T


def ratios(model: WalkingGins, scale: float, walked: np.ndarray, trials: int) -> dict[str, float]:
    """Root mean square over trials and standing parameters of error over bound, for each
    estimator."""
    wide, unaware = (
        ib.StateScenario(m, error_scale=scale).assumed for m in (model, replace(model, walk=0.0))
    )
    paths = wide.draw(0, trials)
    z, truth = paths.z.reshape(trials, -1), paths.start[:, KINEMATIC:]
    noise = ib.noise.Gaussian(model.deviation)
    problem = ib.Scenario(model.gins, noise, error_scale=scale).problem
    R = model.deviation**2 * np.eye(len(walked)) + model.walk**2 * walked
    told = replace(problem, R=Covariance(np.linalg.cholesky(R)))
    linear, iterated = ib.baselines.LinearLSE(), ib.baselines.GaussNewton()
    found = {
        "least squares": linear.estimate(problem, z).x,
        "least squares, modelled": linear.estimate(told, z).x,
        "iterated (IPE)": iterated.estimate(problem, z).x,
        "iterated (IPE), modelled": iterated.estimate(told, z).x,
        "EKF": ekf().track(unaware, paths.z).mean[:, -1, KINEMATIC:],
        "EKF, modelled": ekf().track(wide, paths.z).mean[:, -1, KINEMATIC:],
    }
    P = bound_at_truth(wide, paths)[:, -1, KINEMATIC:, KINEMATIC:]
    bound = np.sqrt(np.einsum("tii->ti", P)[:, STANDING].mean(axis=0))
    return {
        name: float(np.sqrt(np.mean(((x - truth)[:, STANDING] / bound) ** 2)))
        for name, x in found.items()
    }


def main(trials: int, figure: Path) -> None:
    fig, axes = plt.subplots(
        1, len(SCALES), figsize=(9.5, 3.4), sharex=True, sharey=True, layout="constrained"
    )
    for ax, scale in zip(axes, SCALES, strict=True):
        model = WalkingGins()
        walked = errors_by_walk(model)
        rows = [ratios(replace(model, walk=walk), scale, walked, trials) for walk in WALKS]
        print(f"error scale {scale:g}\n{'walk':>8}  " + "  ".join(f"{name:>20}" for name in STYLES))
        for walk, row in zip(WALKS, rows, strict=True):
            print(f"{walk:8g}  " + "  ".join(f"{row[name]:20.2f}" for name in STYLES), flush=True)
        for name, (color, line, marker) in STYLES.items():
            values = [row[name] for row in rows]
            ax.loglog(
                WALKS, values, color=color, linestyle=line, marker=marker, markersize=4, label=name
            )
        ax.axhline(1.0, color="black", linewidth=0.8, zorder=0)
        ax.set(
            title=f"error scale {scale:g}",
            xlabel="walk of a drift in an hour [its size]",
            ylim=(0.8, 200),
        )
    axes[0].set_ylabel("error over the bound")
    fig.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=6,
        frameon=False,
        fontsize=8,
    )
    figure.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(figure, dpi=150)


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
