"""States what an estimator knows besides the readings: the model, R and the prior, but not the
truth."""

from __future__ import annotations

import copy
import inspect
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ipe_bench.basics.definitions import definition_of
from ipe_bench.basics.errors import UserError, definition, place_of
from ipe_bench.basics.linalg import Array, Covariance, pseudo_inverse, read_only
from ipe_bench.basics.options import component_classes
from ipe_bench.measurements.base import Measurement

_FIXED = 1e-9
"""A prior deviation of zero is taken for this share of the largest."""
_PATIENCE_S = 1.0
"""A model that takes longer for one call is not tried."""


@dataclass(frozen=True)
class Problem:
    """Holds all that an estimator may know besides the readings; its arrays are read-only."""

    measurement: Measurement
    R: Covariance
    prior_deviation: Array | None = None
    """Standard deviation (n,) of the parameters about the start; None where no prior is
    known."""
    prior_correlation: Array | None = None
    """Their correlation (n, n); None: they are independent."""
    doubted: float = 0.0
    """Residuals less probable than this are reason to look for a better fit; 1 if the level of the
    noise is not known, so that the size of residuals says nothing."""

    def __post_init__(self) -> None:
        require_nominal(self.measurement)
        for name in ("prior_deviation", "prior_correlation"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def x0(self) -> Array:
        """The start (n,)."""
        return read_only(self.measurement.nominal)

    @cached_property
    def H(self) -> Array:
        """H (m, n) of eq. (1)."""
        return read_only(self.measurement.linearization())

    @cached_property
    def H_plus(self) -> Array:
        """H+ (n, m) = (H' R^-1 H)^-1 H' R^-1; NaN where H has not full column rank."""
        return read_only(pseudo_inverse(self.H[None], self.R)[0][0])

    @property
    def rankless(self) -> bool:
        """Whether H has not full column rank, so that there is no linear estimate."""
        return bool(np.isnan(self.H_plus).all())

    def prior_used(self, inflation: float = 1.0) -> Array | None:
        """Computes the prior's standard deviations (n,) times `inflation`; one that is fixed gets
        nearly none."""
        deviation = self.prior_deviation
        if deviation is None:
            return None
        return inflation * np.maximum(deviation, _FIXED * deviation.max())

    def prior_covariance(self, inflation: float = 1.0) -> Covariance | None:
        """Computes P0 with its deviations times `inflation`, as `prior_used` has them."""
        deviation = self.prior_used(inflation)
        if deviation is None:
            return None
        if self.prior_correlation is None:
            return Covariance(deviation)
        return Covariance(deviation[:, None] * np.linalg.cholesky(self.prior_correlation))

    @property
    def scaled_prior(self) -> Array:
        """P0 (n, n) in the prior's own deviations: what a filter begins with that counts in
        them."""
        if self.prior_correlation is None:
            return np.eye(self.measurement.n)
        return np.array(self.prior_correlation)

    def without_prior(self) -> Problem:
        return replace(self, prior_deviation=None, prior_correlation=None)


def require_nominal(model: Measurement) -> None:
    """Refuses a model whose start is not (n,)."""
    shape = np.shape(model.nominal)
    if shape != (model.n,):
        names = ", ".join(p.name for p in model.parameters)
        wanted = f"({model.n},), one number for each of {names}"
        raise UserError(
            f"measurement={model.name}: nominal has shape {shape}; let it return {wanted}"
        )


def require_numbers(
    owner: str, method: Callable[..., Any], values: Any, shape: tuple[int, ...]
) -> None:
    """Refuses what a method of a part from outside returned unless it is an ordinary array of
    numbers of this shape."""
    complaint = _unfit(method, values, shape)
    if complaint:
        raise UserError(f"{owner}: {complaint}")


def _unfit(method: Callable[..., Any], values: Any, shape: tuple[int, ...]) -> str:
    """Says what is wrong with what a method returned, and where it is written; empty if it is
    right."""
    array = np.asarray(values)
    numbers = array.dtype.kind in "fiub"
    if isinstance(values, np.ndarray) and type(values) is not np.ndarray:
        found = f"a {type(values).__name__}"
        remedy = "return an ordinary array, with NaN for what is masked"
    elif array.shape != shape or not numbers:
        found = type(values).__name__
        if numbers and array.ndim:
            found = f"an array of shape {array.shape}"
        remedy = f"let it return numbers of shape {shape}"
    else:
        return ""
    return f"{definition(method)} returns {found}; {remedy}"


def require_function(model: Measurement) -> None:
    """Refuses a model from outside of this package that is no function of x alone: one that gives
    one x other readings or other slopes after another x, in another batch, or on a fresh object,
    returns other shapes than (trials, m) and (trials, m, n), writes into x, or ends the process."""
    if _all_ours(component_classes(model)):
        return
    try:
        complaint = _irregularity(model, definition_of(model).digest)
    except TypeError:  # options that cannot be hashed
        complaint = _irregularity.__wrapped__(model, "")
    if complaint:
        raise UserError(f"measurement={model.name}: {complaint}")


def _all_ours(parts: Iterable[Any]) -> bool:
    return all(part.__module__.startswith("ipe_bench.") for part in parts)


@lru_cache(maxsize=256)
def _irregularity(model: Measurement, definition: str) -> str:
    """Says what is irregular of a model by this definition; empty if the model is regular, and
    where a call raises, which its trials report."""
    rng = np.random.default_rng(11)
    x = read_only(model.nominal + 0.1 * rng.standard_normal((4, model.n)))
    other = read_only(model.nominal + 0.1 * rng.standard_normal((7, model.n)))
    fresh = copy.copy(model)
    if is_dataclass(model):
        fresh = replace(model)  # type: ignore[type-var]
    if component_classes(fresh) != component_classes(model):
        return "what its options name was defined anew since it was made; make the model anew"
    shapes: dict[str, tuple[int, ...]] = {"simulate": (len(x), model.m)}
    if not _all_ours(filter(inspect.isclass, component_classes(model))):
        # Slopes of a function alone are ours, and held against it wherever they are used.
        shapes["jacobian"] = (len(x), model.m, model.n)
    for method, shape in shapes.items():
        call = getattr(model, method)
        try:
            wrong = _unfit(call, call(x), shape)  # the first call may compile
            if wrong:
                return wrong
            began = time.perf_counter()
            first = call(x)
            if time.perf_counter() - began > _PATIENCE_S:
                continue
            call(other)
            ways = {
                "after another x": call(x),
                "in another batch": np.concatenate([call(x[:1]), call(x[1:])]),
                "on a fresh object": getattr(fresh, method)(x),
            }
        except SystemExit as error:
            return f"{place_of(error)}; raise an exception where there are no readings"
        except Exception as error:
            writes = isinstance(error, ValueError) and "read-only" in str(error)
            return place_of(error) if writes else ""
        differing = [way for way, z in ways.items() if not np.array_equal(z, first, equal_nan=True)]
        if differing:
            ways_said = " and ".join(differing)
            return (
                f"{method}(x) has other bits {ways_said};"
                " let h(x) depend on x and the options alone"
            )
    return ""
