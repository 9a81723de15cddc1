"""States that move: models with process noise, their filters and smoothers, and bounds."""

from ipe_bench.states.base import Gaussian, Paths, StateModel
from ipe_bench.states.bounds import bound_at_truth, posterior_bounds
from ipe_bench.states.formulas import Formulas, Recorded
from ipe_bench.states.grid import Grid
from ipe_bench.states.linearisation import Cubature, GaussHermite, SigmaPoints, Taylor, Unscented
from ipe_bench.states.trackers import (
    Bootstrap,
    Filter,
    IteratedSmoother,
    Smoother,
    Tracker,
    Tracks,
    ckf,
    ekf,
    ukf,
)

__all__ = [
    "Bootstrap",
    "Cubature",
    "Filter",
    "Formulas",
    "GaussHermite",
    "Gaussian",
    "Grid",
    "IteratedSmoother",
    "Paths",
    "Recorded",
    "SigmaPoints",
    "Smoother",
    "StateModel",
    "Taylor",
    "Tracker",
    "Tracks",
    "Unscented",
    "bound_at_truth",
    "ckf",
    "ekf",
    "posterior_bounds",
    "ukf",
]
