"""States that move: models with process noise, their filters and smoothers, and bounds."""

from typing import Any

from ipe_bench.basics.errors import unknown
from ipe_bench.states.auto import AutoTracker
from ipe_bench.states.base import Fault, Normal, Paths, StateModel
from ipe_bench.states.bounds import bound_at_truth, posterior_bounds
from ipe_bench.states.damped import LevenbergMarquardtSmoother
from ipe_bench.states.formulas import Formulas, RecordedFormulas
from ipe_bench.states.grid import Grid
from ipe_bench.states.ipe import PathIPE
from ipe_bench.states.linearisation import Cubature, GaussHermite, SigmaPoints, Taylor, Unscented
from ipe_bench.states.particles import Bootstrap
from ipe_bench.states.smoothers import IteratedSmoother, Smoother
from ipe_bench.states.trackers import Filter, Tracker, Tracks, ckf, ekf, ukf
from ipe_bench.states.walking_gins import WalkingGins

__all__ = [
    "AutoTracker",
    "Bootstrap",
    "Cubature",
    "Fault",
    "Filter",
    "Formulas",
    "GaussHermite",
    "Grid",
    "IteratedSmoother",
    "LevenbergMarquardtSmoother",
    "Normal",
    "PathIPE",
    "Paths",
    "RecordedFormulas",
    "SigmaPoints",
    "Smoother",
    "StateModel",
    "Taylor",
    "Tracker",
    "Tracks",
    "Unscented",
    "WalkingGins",
    "bound_at_truth",
    "ckf",
    "ekf",
    "posterior_bounds",
    "ukf",
]


def __getattr__(name: str) -> Any:
    raise AttributeError(f"{__name__}.{name}: {unknown(name, __all__, 'name')}")
