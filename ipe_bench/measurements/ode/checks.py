"""Refuses descriptions of differential equations that contradict themselves."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ipe_bench.basics.errors import UserError, refuse_unknown
from ipe_bench.measurements.arithmetic import parse

if TYPE_CHECKING:
    from ipe_bench.measurements.ode.described import Ode

_COLUMNS = ("case", "time", "output", "reading", "sigma")
"""Columns that mean something else than a constant."""


def check(model: Ode) -> None:
    """Raises a `UserError` for the first contradiction."""
    _check_present(model)
    _check_initial(model)
    _check_names(model, "start", (*model.rates, "t"))
    columns = (*_COLUMNS, model.reading)
    _check_names(model, "driven_by", (*model.start, *model.rates, *columns, "t"))
    _check_times(model.times)
    _check_tolerance(model)
    _check_constants(model)
    inputs = ["case", "time", *model.driven_by]
    for name in model.columns:
        refuse_unknown(f"columns.{name}", name, inputs, "input")


def _check_present(model: Ode) -> None:
    if not model.rates:
        raise UserError(
            "rates: is empty; give each state its rate, such as measurement.rates.y=-k*y"
        )
    if not model.start:
        raise UserError(
            "start: is empty, so no parameter is estimated; give each parameter a start:"
            " measurement.start.NAME=1"
        )


def _check_initial(model: Ode) -> None:
    for name in model.initial:
        if name not in model.rates:
            states = ", ".join(model.rates)
            raise UserError(f"initial.{name}: there is no such state; these have rates: {states}")
    changing = {*model.rates, *model.driven_by, "t"}
    for name, formula in model.initial_formulas.items():
        for used in formula.names:
            if used in changing:
                raise UserError(
                    f"initial.{name}: {used} changes with time, and a start cannot depend on it"
                )


def _check_names(model: Ode, key: str, taken: Sequence[str]) -> None:
    """Refuses names under a key of the description that something else has, or that nothing
    uses."""
    for name in getattr(model, key):
        if name in taken:
            raise UserError(
                f"{key}.{name}: the state, parameter, column or time has this name; choose another"
            )
        if name not in model.used_names:
            raise UserError(f"{key}.{name}: appears in no formula")


def _check_times(times: Sequence[float]) -> None:
    negative = any(time < 0 for time in times)
    if negative or any(after <= before for before, after in itertools.pairwise(times)):
        raise UserError(f"times={list(times)}: give ascending numbers from 0 on")


def _check_tolerance(model: Ode) -> None:
    if not isinstance(model.tolerance, str):
        return
    for name in parse(model.tolerance, "tolerance").names:
        if name not in (*model.constant_names, "t"):
            raise UserError(f"tolerance: {name} is neither a constant nor t")


def _check_constants(model: Ode) -> None:
    for name in model.constant_names:
        if name in (*_COLUMNS, model.reading):
            remedy = "the time is t" if name == "time" else "rename it"
            raise UserError(
                f"{name}: is a column of every readings file, and not known in a formula; {remedy}"
            )
    for name in model.constants:
        if name in model.constant_names:
            continue
        if name in model.used_names:
            raise UserError(f"constants.{name}: is a state, a parameter or the time")
        raise UserError(f"constants.{name}: appears in no formula")
    per_case = {name: v for name, v in model.constants.items() if isinstance(v, tuple | list)}
    lengths = {name: len(values) for name, values in per_case.items()}
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        raise UserError(
            f"constants: have different lengths: {lengths}; give one number for each case"
        )
