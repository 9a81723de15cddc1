"""What a stored file belongs to: a scenario under an estimator, or its truth, and the digest that stands for it.

The digest is of the constructed objects and of the numerical source. How many trials there are, and how they were cut
into blocks, changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ipe_bench.basics.machine import library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.runs.parts import SCHEMA, TRUTH
from ipe_bench.runs.provenance import describe, digest, fingerprint
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.bounds import linear_correlation
from ipe_bench.trials.tracking import AnyScenario, Tracking


@dataclass(frozen=True)
class ResultKey:
    """One scenario under one estimator, or its truth: what a stored file belongs to."""

    scenario: AnyScenario
    label: str = TRUTH
    estimator: Estimator | Tracker | None = None

    @property
    def components(self) -> list[Any]:
        """The scenario, and the estimator if there is one."""
        return [self.scenario] if self.estimator is None else [self.scenario, self.estimator]

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What was computed, without the version of the program."""
        return {"scenario": describe(self.scenario), "label": self.label, "estimator": describe(self.estimator)}

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity, the schema and the numerical source.

        Not for the version: a release that changes no number leaves what is stored valid.
        """
        return digest({"schema": SCHEMA, "identity": self.identity, "source": self.made_by["source"]})

    @cached_property
    def identity_key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity alone."""
        return digest(self.identity)

    @cached_property
    def made_by(self) -> dict[str, Any]:
        """The versions of the packages and the digest of the numerical source."""
        return fingerprint(self.components)

    @property
    def names(self) -> dict[str, Any]:
        """What people call it by."""
        scenario, truth = self.scenario, self.scenario.truth
        return {
            "measurement": scenario.measurement.name,
            **({} if truth is None else {"truth_measurement": truth.name}),
            "noise": scenario.noise.name,
            "prior": scenario.prior.name,
            "error_scale": scenario.error_scale,
            "seed": scenario.seed,
            "estimator": self.label,
        }

    @cached_property
    def footer(self) -> dict[str, Any]:
        """All that a reader of the file needs to know."""
        scenario, model = self.scenario, self.scenario.measurement
        return {
            "schema": SCHEMA,
            "key": self.key,
            "identity": self.identity,
            "identity_key": self.identity_key,
            **self.made_by,
            "libraries": library_versions(),
            "names": self.names,
            "bound": "bayes" if self.estimator is not None and "prior" in self.estimator.needs else "crlb",
            "equation": None if self.estimator is None else self.estimator.equation,
            "family": None if self.estimator is None else self.estimator.family,
            "sequential": self.estimator is not None and "epochs" in self.estimator.needs,
            "jacobian_cost": float(getattr(model, "jacobian_cost", model.n)),
            "parameters": [describe(p) for p in model.parameters],
            "readings": model.m,
            "about": _first_sentence(model),
            "linear_bound": scenario.linear_bound.tolist(),
            **(
                {"times": scenario.model.times.tolist()}
                if isinstance(scenario, Tracking)
                else {"linear_correlation": linear_correlation(scenario.problem).round(4).tolist()}
            ),
        }


def _first_sentence(component: Any) -> str:
    """The first sentence of the docstring of a component's class; empty where it has none of its own."""
    kind = type(component)
    words = " ".join((kind.__doc__ or "").split())
    return "" if words.startswith(f"{kind.__name__}(") else words.partition(". ")[0].rstrip(".")
