"""Stores of made-up trials for reports, and a label that would act if it were obeyed."""

from __future__ import annotations

import numpy as np
from shared.synthetic_store import Synthetic

HOSTILE = "<script>alert(1)</script>"


def fill(
    store: Synthetic,
    labels=("linear_lse", "one", "two"),
    scales=(1.0, 10.0, 100.0),
    trials=80,
    seeds=1,
    **model,
) -> None:
    """A linear estimate that is worse the larger the scale, and others that reach the bound."""
    rng = np.random.default_rng(0)
    for scale in scales:
        for seed in range(seeds):
            scenario = store.scenario(error_scale=scale, seed=seed, **model)
            base = 0.1 * rng.normal(size=(trials, scenario.measurement.n))
            for i, label in enumerate(labels):
                factor = scale if label == "linear_lse" else 1.0 + 0.05 * i
                store.add(scenario, label, factor * base, simulations=1.0 + 3 * i, iterations=i)
    store.record(trials)
