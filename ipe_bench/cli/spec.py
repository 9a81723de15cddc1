"""Reads a command's request as typed plain data: the keys of the config besides Hydra's own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cloudpickle

from ipe_bench.basics.definitions import pinned
from ipe_bench.basics.errors import UserError, describe_exception, refuse_unknown, unknown
from ipe_bench.basics.options import Component, Count, Positive, Quantile, Whole
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.noise import ModelNoise, Noise
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct, known_parameters
from ipe_bench.plugins.standard import of_run
from ipe_bench.priors import GaussianPrior, Prior
from ipe_bench.report.formats import PAGE
from ipe_bench.report.style import Which, file_formats, which_figures
from ipe_bench.runs.execution import Execution
from ipe_bench.runs.provenance import TARGET, canonical_json, describe
from ipe_bench.states.base import StateModel
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.paths import StateScenario
from ipe_bench.trials.scenario import MOST_TRIALS, TRIALS, Scenario

if TYPE_CHECKING:
    from ipe_bench.real.estimation import Question

PARTS: dict[str, type] = {
    "measurement": Measurement,
    "truth_measurement": Measurement,
    "noise": Noise,
    "prior": Prior,
    "state_model": StateModel,
    "execution": Execution,
}
"""Keys that hold a component, with its kind."""
OPTIONAL = ("truth_measurement", "state_model")
"""Keys of components that may be null."""


@dataclass(frozen=True, kw_only=True)
class Spec(Component):
    """One job; `ipe-bench run --help` says what its keys mean."""

    measurement: Measurement
    noise: Noise
    prior: Prior
    execution: Execution
    estimators: Mapping[str, Any]
    output: str
    state_model: StateModel | None = None
    trackers: Mapping[str, Any] = field(default_factory=dict)
    name: str = "${default_name}"
    default_name: str = "gins"
    """Short description of the request: names the output folder by default."""
    truth_measurement: Measurement | None = None
    error_scale: Positive = 1.0
    seed: Whole = 0
    trials: Count | None = None
    precision: Any = None
    time_limit: Positive | None = None
    figures: Which = "main"
    formats: Any = PAGE
    block_size: Count | None = None
    readings: str | tuple[str, ...] | None = None
    find: str | tuple[str, ...] | None = None
    gate: Quantile | None = None
    ignore_columns: str | tuple[str, ...] | None = None
    write_readings: str | None = None
    write_readings_trial: Whole = 0
    parameters: Mapping[str, Any] | None = None
    objective: str | None = None

    def __post_init__(self) -> None:
        which_figures(self.figures)
        if isinstance(self.gate, int | float) and 1 < self.gate <= 100:
            raise UserError(
                f"gate={self.gate:g}: is the share of good readings that pass, at most 1; write"
                f" gate={self.gate / 100:.6g} for {self.gate:g} %"
            )
        super().__post_init__()
        object.__setattr__(self, "formats", file_formats(self.formats))
        for key in ("name", "output"):
            if Path(getattr(self, key)).name in ("", ".."):
                raise UserError(f"{key}={getattr(self, key)}: name a folder")
        if ".." in Path(self.name).parts:
            raise UserError(
                f"name={self.name}: leaves the folder outputs; give another name, or the folder as"
                " output="
            )
        if "://" in self.output or self.output.startswith("file:"):
            raise UserError(f"output={self.output}: is an address; name a folder of this machine")
        if self.time_limit is not None and self.precision is None:
            raise UserError(
                f"time_limit={self.time_limit:g}: goes with precision=; give that, or leave it out"
            )
        if self.write_readings is None and self.write_readings_trial:
            raise UserError(
                f"write_readings_trial={self.write_readings_trial}: goes with write_readings=FILE"
            )
        if self.objective is not None:
            self._check_objective(*self.aim)

    def _check_objective(self, label: str, column: str) -> None:
        from ipe_bench.plugins.extensions import use_statistics
        from ipe_bench.statistics.records import SCORES
        from ipe_bench.statistics.registry import all_statistics
        from ipe_bench.statistics.statistic import frame_columns

        use_statistics()
        numbers = [one for one in (*all_statistics(), *SCORES) if one.kind != "word"]
        if not label:
            example = f"{next(iter(self.estimators), 'LABEL')}.capped_error"
            raise UserError(f"objective={self.objective}: write LABEL.COLUMN, such as {example}")
        key = f"objective={self.objective}"
        refuse_unknown(key, label, self.estimators, "estimator")
        refuse_unknown(key, column, frame_columns(numbers), "column")

    @property
    def aim(self) -> tuple[str, str]:
        """Label and column of the objective."""
        label, _, column = str(self.objective).rpartition(".")
        return label, column

    @property
    def count(self) -> int:
        """Number of trials, or the largest with a precision."""
        unless = TRIALS if self.precision is None else MOST_TRIALS
        return unless if self.trials is None else self.trials

    @cached_property
    def known(self) -> tuple[ParameterInfo, ...]:
        """Prior knowledge of each parameter."""
        return known_parameters(self.parameters or {})

    @cached_property
    def scenario(self) -> Any:
        """Simulated trials: a `Scenario`, or a `StateScenario` if there is a state model."""
        if self.state_model is not None:
            return pinned(StateScenario(self.state_model, self.seed, self.error_scale))
        measurement, truth = (
            m and informed(m, self.known) for m in (self.measurement, self.truth_measurement)
        )
        assert measurement is not None
        prior = self.prior
        if self.known:
            from ipe_bench.real.estimation import prior_stated

            prior = prior_stated(prior, measurement)
        return pinned(Scenario(measurement, self.noise, prior, self.error_scale, self.seed, truth))

    def suited(self) -> Spec:
        """Returns the job without those of the standard baselines that its model does not suit, as
        filters need epochs and a prior."""
        if isinstance(self.scenario, StateScenario):
            return self
        problem = self.scenario.problem
        kept = dict(self.estimators)
        for label in of_run("baseline"):
            if label in kept and kept[label].hindrance(problem):
                del kept[label]
        if len(kept) == len(self.estimators):
            return self
        return replace(self, estimators=kept)

    def question(self, stated: Collection[str]) -> Question:
        """Returns the question on real readings; `stated` are the keys that a user has given, so
        that a default part counts as unstated."""
        from ipe_bench.real.estimation import Question

        given = (self.readings,) if isinstance(self.readings, str) else self.readings
        if given == ():
            raise UserError("readings=[]: name a file, or several as readings=[a.csv,b.csv]")
        return Question(
            model=self.measurement,
            readings=None if given is None else tuple(map(Path, given)),
            estimators=self.estimators,
            noise=None if self.noise == ModelNoise() else self.noise,
            prior=None if self.prior == GaussianPrior() and "prior" not in stated else self.prior,
            error_scale=self.error_scale if "error_scale" in stated else None,
            known=self.known,
            ignored=self.ignored,
        )

    @property
    def ignored(self) -> tuple[str, ...]:
        """The columns of the files that are left out."""
        given = self.ignore_columns
        return (given,) if isinstance(given, str) else given or ()


KEYS = tuple(field.name for field in fields(Spec))
DEFAULTS = {
    field.name: "???" if field.default is MISSING else field.default for field in fields(Spec)
}
DEFAULTS |= {"estimators": {}, "trackers": {}}


def spec(config: Mapping[Any, Any]) -> Spec:
    """Constructs the job that a composed config describes."""
    for key in map(str, config):
        refuse_unknown(key, key, KEYS, "key")
    for key in PARTS:
        if key not in OPTIONAL or config.get(key) is not None:
            _require_part(key, config.get(key))
    chosen = "estimators" if config.get("state_model") is None else "trackers"
    of_chosen = config[chosen] or {}
    known = [one for one in plugins.options() if plugins.PACKAGES.get(one.group) == chosen]
    for label, options in of_chosen.items():
        _require_chosen(f"{chosen}.{label}", options, known)
    whole = {**config, "estimators": {}, "trackers": {}, chosen: of_chosen}
    parts = {key: construct(value, key) for key, value in whole.items()}
    for key, kind in PARTS.items():
        if parts.get(key) is not None:
            _require_kind(parts[key], key, kind)
    made = parts[chosen]
    for label, part in made.items():
        _require_kind(part, f"{chosen}.{label}", Estimator if chosen == "estimators" else Tracker)
    parts |= {"trackers": {}, "estimators": {label: pinned(part) for label, part in made.items()}}
    return Spec(**parts)


def _require_part(key: str, options: Any) -> None:
    """Refuses what names no component, where one belongs."""
    if not isinstance(options, Mapping) or TARGET not in options:
        raise UserError(
            f"{key}={options}: is not a part that can be used; choose one, see `ipe-bench list`"
        )


def _require_chosen(where: str, options: Any, known: Sequence[plugins.Option]) -> None:
    """Refuses options of an estimator that is not chosen, and another under the name of one."""
    label = where.partition(".")[2]
    if not isinstance(options, Mapping):
        raise UserError(f"{where}={options}: set its options, such as {where}.KEY=VALUE")
    if TARGET not in options:
        keys = ", ".join(f"{where}.{name}" for name in options) or where
        groups = {option.label: option.group for option in known}
        if label in groups:
            remedy = f"add it, as in {groups[label]}=[{label}]"
        else:
            remedy = unknown(label, groups, "estimator")
        raise UserError(f"{keys}: is set, but {label} is not chosen; {remedy}")
    for option in known:
        if option.label == label and option.target != str(options[TARGET]):
            # One estimator would be tabled under the name of another.
            name = f"{option.group}={label}"
            raise UserError(
                f"{where}: is {options[TARGET]}, under the name of {name}; choose another label"
            )


def _require_kind(part: Any, key: str, kind: type) -> None:
    """Refuses a part of another kind, and one that cannot be stored or sent to other processes."""
    if not isinstance(part, kind):
        name = type(part).__name__
        raise UserError(
            f"{key}: {name} is not a {kind.__name__.lower()}; choose one, see `ipe-bench list`"
        )
    try:
        canonical_json(describe(part))
        cloudpickle.dumps(part)
    except Exception as error:  # whatever a field's own methods raise
        raise UserError(
            f"{key}: a field of {type(part).__name__} can be neither stored nor sent to a worker "
            f"({describe_exception(error)}); use numbers, texts, lists and components"
        ) from None
