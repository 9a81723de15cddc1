"""Where true parameters are drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import NonNegative
from ipe_bench.priors.base import Prior


@dataclass(frozen=True)
class GaussianPrior(Prior):
    """N(x0, (error_scale x unit)^2), independent parameters; `deviations` widens or narrows some of them.

    Estimators that use a prior are told this distribution.
    """

    deviations: tuple[NonNegative, ...] | None = None
    """Per parameter, in multiples of its unit, at error scale 1; None: 1 for each."""
    name: ClassVar[str] = "gaussian"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.deviations is not None and not any(self.deviations):
            raise UserError("deviations: give at least one that is above 0")

    def deviation(self, n: int, error_scale: float) -> Array:
        """Standard deviations (n,) of the parameters in multiples of their units."""
        if self.deviations is not None and len(self.deviations) != n:
            raise UserError(
                f"prior.deviations: has {len(self.deviations)} numbers; give one for each of {n} parameters"
            )
        return error_scale * (np.ones(n) if self.deviations is None else np.asarray(self.deviations, dtype=float))

    def draw(self, x0: Array, error_scale: float, rng: np.random.Generator) -> Array:
        """One parameter vector (n,)."""
        return x0 + self.deviation(len(x0), error_scale) * rng.standard_normal(len(x0))
