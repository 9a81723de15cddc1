"""Draws error scale, bound and NEES, each by trials of the bench itself, for the page that explains
the words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

import ipe_bench as ib
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.function import function
from ipe_bench.report.figures.setup import picture
from ipe_bench.report.style import house_style

NOISE = 2.5
SCALES = (0.1, 0.3, 1.0)
DAYS = (1, 2, 3, 4, 5, 7)
TRIALS = 400
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#8a8a8a"


def demand(t, b1=20.0, b2=0.5):
    """Returns the oxygen demand of the first hour."""
    return b1 * (1 - np.exp(-b2 * t))


def scenario(error_scale: float) -> ib.Scenario:
    """Returns the first hour's six readings, their truths drawn at an error scale."""
    model = function(demand, columns={"t": DAYS})
    return ib.Scenario(model, ib.noise.Gaussian(NOISE), error_scale=error_scale)


def error_scale() -> Figure:
    """Draws true parameters at three error scales, and the readings that they would give without
    noise."""
    fig, axes = _axes(2)
    days = np.linspace(0, 20, 100)
    for scale, color in zip(reversed(SCALES), (ORANGE, BLUE, "black"), strict=True):
        bench = scenario(scale)
        sizes = [one.size for one in bench.measurement.parameters]
        b1, b2 = (bench.draw(0, 60).x * sizes).T
        axes[0].plot(b1, b2, "o", color=color, markersize=3, label=f"error scale {scale:g}")
        curves = demand(days[:, None], b1[:12], b2[:12])
        axes[1].plot(days, curves, color=color, linewidth=0.7)
    axes[0].plot(20, 0.5, "+", color="white", markersize=14, markeredgewidth=3)
    axes[0].plot(20, 0.5, "+", color="black", markersize=12, markeredgewidth=1.5, label="start")
    axes[0].set(xlabel="b1", ylabel="b2", title="True parameters")
    axes[1].set(xlabel="t [days]", ylabel="demand", ylim=(-20, 70), title="Their readings")
    axes[0].legend()
    return fig


def estimates(estimator: ib.Estimator, scale: float) -> tuple[Array, Array]:
    """Returns whitened errors (trials, n) and squared errors over the reported variance
    (trials,)."""
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=scale)
    trials = bench.draw(0, TRIALS)
    found = estimator.estimate(bench.problem, trials.z)
    assert found.covariance is not None
    error = found.x - trials.x
    J = bench.measurement.jacobian(trials.x)
    root = np.linalg.cholesky(np.matmul(J.swapaxes(1, 2), J) / 0.01**2)
    whitened = np.einsum("tji,tj->ti", root, error)
    claimed = np.linalg.solve(found.covariance, error[:, :, None])[:, :, 0]
    return whitened, np.sum(error * claimed, axis=1)


def bound() -> Figure:
    """Draws errors of an efficient and of a linear estimator beside the ellipse of the Cramér-Rao
    bound."""
    fig, axes = _axes(2)
    angle = np.linspace(0, 2 * np.pi, 200)
    radius = np.sqrt(chi2.ppf(0.95, 2))
    parts = (
        (ib.solvers.Newton(), "newton: on the bound"),
        (ib.baselines.LinearLSE(), "linear_lse: far outside"),
    )
    for ax, (estimator, title) in zip(axes, parts, strict=True):
        error, _ = estimates(estimator, 1.0)
        ax.plot(error[:, 0], error[:, 1], "o", color=BLUE, markersize=2.5, alpha=0.6)
        ax.plot(
            radius * np.cos(angle),
            radius * np.sin(angle),
            color=ORANGE,
            label="95 % of efficient estimates",
        )
        ax.set(title=title, xlabel="error of one combination, over its bound", aspect="equal")
        reach = max(4.0, float(np.quantile(np.abs(error[:, :2]), 0.99)))
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes[0].set_ylabel("error of another, over its bound")
    axes[1].legend(loc="upper left")
    return fig


def nees() -> Figure:
    """Draws squared errors over the reported variance, where it is right and where it is four times
    too small."""
    fig, axes = _axes(2)
    _, square = estimates(ib.solvers.Newton(), 1.0)
    n = ib.measurements.Polynomial().n
    line = np.linspace(0, 30, 300)
    bins = np.linspace(0, 30, 31)
    for ax, factor, title in zip(axes, (1, 4), ("right: NEES", "overconfident: NEES"), strict=True):
        median = np.median(factor * square) / chi2.median(n)
        ax.hist(factor * square, bins=bins, density=True, color=BLUE, alpha=0.6)
        ax.plot(line, chi2.pdf(line, n), color=ORANGE, label="if the claim is right")
        ax.set(title=f"{title} {median:.2g}", xlabel="squared error over the reported variance")
    axes[0].set_ylabel("density")
    axes[1].legend()
    return fig


def track() -> Figure:
    """Draws the true angle of the stored pendulum between the bands of a filter and of its
    smoother."""
    model = ib.component("state_model/pendulum_book")
    trackers = {label: ib.component(f"tracker/{label}") for label in ("ukf", "ukf_rts")}
    seen = slice(0, 200)
    times = np.asarray(model.times)[seen]
    truth = model.draw(0, 1).x[0, seen, 0]
    fig = Figure(figsize=(7.5, 3), layout="constrained")
    ax = fig.subplots()
    for one, color in zip(ib.estimate(model, estimators=trackers), (ORANGE, BLUE), strict=True):
        mean, deviation = one.mean[seen, 0], one.deviation[seen, 0]
        low, high = mean - 1.96 * deviation, mean + 1.96 * deviation
        ax.fill_between(times, low, high, color=color, alpha=0.35, label=one.label, linewidth=0)
    ax.plot(times, truth, color="black", linewidth=1, label="truth")
    ax.set(xlabel="t [s]", ylabel="angle [rad]")
    ax.legend(loc="upper right", ncols=3)
    return fig


def setup() -> Figure:
    """Draws the paper's set-up, and the velocities of its first trial at error scale 33."""
    model = ib.measurements.Gins()
    bench = ib.Scenario(model, ib.noise.Quantization(step=0.02286), error_scale=33.0)
    trials = bench.draw(0, 1)
    return picture(model, trials.z[0], model.simulate(trials.x)[0])


DRAWINGS = {
    "explanation": {"error_scale": error_scale, "bound": bound, "nees": nees, "setup": setup},
    "howto": {"track": track},
}
"""Drawings by name, by the folder of the pages that show them."""


def write_drawings(source: Path) -> None:
    """Writes each drawing as pictures/NAME.png beside the page that shows it."""
    with house_style():
        for folder, drawings in DRAWINGS.items():
            pictures = source / folder / "pictures"
            pictures.mkdir(parents=True, exist_ok=True)
            for name, draw in drawings.items():
                draw().savefig(pictures / f"{name}.png", dpi=150)


def _axes(number: int) -> tuple[Figure, list]:
    fig = Figure(figsize=(7.5, 3.2), layout="constrained")
    return fig, list(fig.subplots(1, number))
