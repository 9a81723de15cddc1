"""An estimation bench: which estimator to trust with nonlinear measurements."""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from ipe_bench.api import run
    from ipe_bench.scenario import Scenario

_HOMES = {"run": "ipe_bench.api", "Scenario": "ipe_bench.scenario"}
__all__ = ["Scenario", "__version__", "run"]


def __getattr__(name: str) -> Any:
    # Late, so that importing the package costs nothing until something is computed.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)
