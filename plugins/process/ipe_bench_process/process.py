"""An estimator in any language: a program that reads a problem and readings, and writes
estimates."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import MinLen

from ipe_bench import Estimates, Estimator, Problem, Status
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.estimators.base import Equation, Family, Need, one_by_one
from ipe_bench_process.program import MOST, Program, ProgramError, written

_running: dict[tuple[int, Process, str], Program] = {}
"""The programs of the last problems, by process, estimator and opening."""
_KEPT, _STRIKES = 2, 3
_TOGETHER = 4096
"""Points of a question that are computed at the same time."""
_COUNTS = ("iterations", "simulations", "jacobians")


@dataclass(frozen=True)
class Process(Estimator):
    """A program that estimates one trial after another, by blocks of numbers on its standard input
    and output.

    It is started once per worker and problem. If it ends, hangs or answers wrongly, that trial
    fails with a line, and it is started again; after three such trials in a row the rest of the
    block fails.
    """

    command: Annotated[tuple[str, ...], MinLen(1)] = field(compare=False)
    package: str | None = field(default=None, compare=False)
    files: tuple[str, ...] = field(default=(), compare=False)
    trial_timeout_s: Positive = 10.0
    needs: tuple[Need, ...] = ()
    equation: Equation | None = None
    family: Family | None = None
    program: tuple[str, ...] = field(init=False, default=())
    """The command with names in place of paths: with `digest` its identity, in any place."""
    digest: str = field(init=False, default="")
    """Of the contents of all its files."""
    folder: str = field(init=False, compare=False, default="")
    started: tuple[str, ...] = field(init=False, compare=False, default=())
    """The command with whole paths."""

    def __post_init__(self) -> None:
        super().__post_init__()
        spec = importlib.util.find_spec(self.package) if self.package else None
        if self.package and (spec is None or not spec.submodule_search_locations):
            raise UserError(f"package={self.package}: there is no such package; install it")
        folder = Path(
            spec.submodule_search_locations[0] if spec and spec.submodule_search_locations else ""
        ).resolve()
        words = [str(folder / word) if (folder / word).is_file() else word for word in self.command]
        if (program := shutil.which(words[0])) is None:
            raise UserError(
                f"command={list(self.command)}: {folder} has no such program that can run; build"
                " it first"
            )
        if lacking := [file for file in self.files if not (folder / file).is_file()]:
            raise UserError(f"files={lacking}: are not in {folder}")
        started = (program, *words[1:])
        names = tuple(Path(word).name if os.path.isabs(word) else word for word in started)
        for name, value in {"folder": str(folder), "started": started, "program": names}.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "digest", self._digest())

    def _digest(self) -> str:
        words = [word for word in self.started if os.path.isabs(word) and os.path.isfile(word)]
        paths = [*words, *(Path(self.folder, file) for file in self.files)]
        contents = (hashlib.sha256(Path(path).read_bytes()).digest() for path in paths)
        return hashlib.sha256(b"".join(contents)).hexdigest()[:16]

    def hindrance(self, problem: Problem) -> str | None:
        """Asks the program itself, with error-free readings of the start, twice."""
        with np.errstate(all="ignore"):
            z = np.repeat(problem.measurement.simulate(problem.x0[None]), 2, axis=0)
            if (lacking := super().hindrance(problem)) or not np.isfinite(z).all():
                return lacking
            return next(iter(self.estimate(problem, z).messages.values()), None)

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        n, text, failed = problem.measurement.n, _opening(problem, self.needs), list[str]()

        def one(readings: Array) -> Estimates:
            if not np.isfinite(readings).all():
                return Estimates(np.full((1, n), np.nan), np.array([Status.NONFINITE], np.int8))
            if len(failed) == _STRIKES:
                return Estimates.failed(
                    1, n, f"not tried, as {_STRIKES} trials in a row failed: {failed[-1]}"
                )
            program = self._program(text)
            try:
                found = self._answer(program, problem, readings)
            except BaseException as error:
                _running.pop((os.getpid(), self, text)).end()
                if not isinstance(error, ProgramError):
                    raise
                failed.append(f"{self.program[0]} {error}")
                return Estimates.failed(1, n, failed[-1])
            failed.clear()
            return found

        return one_by_one(z, one, n)

    def _program(self, text: str) -> Program:
        """Returns the program that was told this problem, and starts it unless it runs."""
        key = (os.getpid(), self, text)
        if (program := _running.pop(key, None)) is None:
            with suppress(OSError):
                if self._digest() == self.digest:
                    program = Program(self.started, self.folder, text)
            if program is None:
                raise UserError(
                    f"{' '.join(self.program)}: is not what it was where the run began; run it"
                    " again"
                )
        _running[key] = program  # the last used is the last to go
        while len(_running) > _KEPT:
            _running.pop(next(iter(_running))).end()
        return program

    def _answer(self, program: Program, problem: Problem, z: Array) -> Estimates:
        """Estimates from the readings z (m,) of one trial; what is asked counts besides what the
        program counts."""
        model, n, asked = (
            problem.measurement,
            problem.measurement.n,
            dict.fromkeys(map(str, _COUNTS), 0.0),
        )

        def points(values: Array, count: str, size: int) -> Iterator[Array]:
            """Yields the points asked for, a few at a time; each is answered by so many numbers."""
            if not len(values) or len(values) % n:
                raise ProgramError(f"asked with {len(values)} numbers, and not a multiple of {n}")
            number = len(values) // n
            if number * size > MOST:
                raise ProgramError(
                    f"asked for {number * size} numbers at once; ask for {MOST // size} points at"
                    " most"
                )
            asked[count] += number
            yield from np.array_split(values.reshape(-1, n), -(-number // _TOGETHER))

        def simulate(values: Array) -> str:
            h = [model.simulate(x) for x in points(values, "simulations", model.m)]
            return written({"h": model.near(np.concatenate(h), z)})

        def jacobian(values: Array) -> str:
            J = [model.jacobian(x) for x in points(values, "jacobians", model.m * n)]
            return written({"J": np.concatenate(J)})

        replies = {"simulate": simulate, "jacobian": jacobian}
        found = program.ask(f"{written({'z': z})}end\n", replies, self.trial_timeout_s)
        for name, values in found.items():
            if len(values) != (size := {"x": n, "P": n * n}.get(name, 1)):
                raise ProgramError(f"wrote {name} with {len(values)} numbers, and not {size}")
        if lacking := [name for name in ("x", "status") if name not in found]:
            raise ProgramError(f"answered without {' and '.join(lacking)}")
        x, status, P = (
            found.pop("x"),
            found.pop("status")[0],
            found.pop("P", np.full(n * n, np.nan)).reshape(n, n),
        )
        if status not in {status.value for status in Status if status != Status.RUNNING}:
            raise ProgramError(f"wrote status {status:g}, and not one of 0 to {max(Status).value}")
        if np.isfinite(P).all() and not np.allclose(P, P.T, rtol=1e-6, atol=1e-9 * np.abs(P).max()):
            raise ProgramError("wrote a P that is not symmetric")
        if status <= Status.MAX_ITERATIONS and not np.isnan(P).all() and not _definite(P):
            raise ProgramError("wrote a P that is not positive definite")
        counts = {name: found.pop(name, np.zeros(1)) + asked[name] for name in _COUNTS}
        for name, value in counts.items():
            if not 0 <= value[0] < 1e15 or (name == "iterations" and value[0] % 1):
                raise ProgramError(f"wrote {name} {value[0]:g}, which is no count")
        ended = np.array([status if np.isfinite(x).all() else Status.NONFINITE], np.int8)
        iterations, simulations, jacobians = counts.values()
        return Estimates(
            x[None],
            ended,
            P[None],
            iterations.astype(np.int64),
            simulations,
            jacobians,
            extras=found,
        )


def _definite(P: Array) -> bool:
    """Tells if P (n, n) is a covariance, whatever the units of its parameters."""
    with np.errstate(all="ignore"):
        deviation = np.sqrt(np.diag(P))
        correlation = P / np.outer(deviation, deviation)
    return bool(np.isfinite(correlation).all() and np.linalg.eigvalsh(correlation)[0] > 0)


def _opening(problem: Problem, needs: tuple[Need, ...]) -> str:
    """Writes the first line and the blocks of the problem: all that the program may know of it."""
    model, R, prior = problem.measurement, problem.R, problem.prior_covariance()
    told = [{"name": p.name, "unit": p.unit, "size": p.size} for p in model.parameters]
    blocks = {"n": np.array([model.n]), "m": np.array([model.m]), "nominal": problem.x0}
    blocks["size"] = np.array([p.size for p in model.parameters])
    blocks |= {"sigma": R.factor} if R.factor.ndim == 1 else {"R": R.matrix()}
    if "prior" in needs and prior is not None:
        blocks |= {"prior": prior.factor} if prior.factor.ndim == 1 else {"P0": prior.matrix()}
    if model.epochs is not None:
        blocks["epoch"] = np.empty(model.m)
        for k, rows in enumerate(model.epochs):
            blocks["epoch"][rows] = k
    facts = {f"index.{name}": column for name, column in model.index.items()}
    facts |= {
        f"option.{name}": getattr(model, name)
        for name in getattr(model, "__dataclass_fields__", ())
    }
    for name, values in facts.items():
        with suppress(TypeError, ValueError):
            numbers = np.atleast_1d(np.asarray(values, dtype=float))
            if numbers.size and np.isfinite(numbers).all():
                blocks[re.sub(r"[^\w.]", "_", name, flags=re.ASCII)] = numbers
    return (
        "ipe-bench 1"
        f" {json.dumps({'model': model.name, 'parameters': told})}\n{written(blocks)}end\n\n"
    )
