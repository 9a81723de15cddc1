"""Differential equations that are drawn, and the readings that SciPy computes of them.

`python tests/drawn_equations.py` draws them all and stores the readings, in ten minutes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from ipe_bench.measurements import Ode

ANSWERS = Path(__file__).with_name("drawn_equations.npz")
COUNT = 500
_MOST = 500_000
"""Rates in one interval beyond which SciPy is not waited for."""
_KNOWN = {name: getattr(np, name) for name in ("sin", "cos", "exp", "log", "sqrt", "tanh")}
_KNOWN |= {"min": np.minimum, "max": np.maximum, "abs": np.abs}
_SHOWN = (
    *("{y}", "{y}/(0.5+abs({y}))", "tanh({y})", "exp(-{y})", "1/(1+exp(-{y}))", "max({y},0)", "exp(0.2*{y})"),
    *("{y}**4/(0.0625+{y}**4)", "1/(1+{y}**2)", "sin({y})", "cos(3*{y})", "min(max({y},0.1),0.8)", "{y}*{z}+k0*t"),
)
_FELT = ("{z}", "tanh({z})", "{z}/(1+{z}**2)", "1/(1+{z}**2)", "sin({z})", "k1", "sin(3*t)", "exp(-t)", "c")


@dataclass(frozen=True)
class Drawn:
    """A model, and the x (n,) of a truth."""

    model: Ode
    x: np.ndarray


def drawn(number: int) -> Drawn:
    """Fast and slow states, readings that saturate, turn and are clipped, one reading and many, at t = 0, too, cases,
    inputs that are held or straight between rows, and rates that jump at known times."""
    r = np.random.default_rng(number)
    states = [f"y{i}" for i in range(r.integers(1, 4))]
    start = {"k0": r.uniform(0.2, 2.0), "k1": r.uniform(0.2, 2.0), "L": 10 ** r.uniform(1.0, 4.5)}
    driven, columns = {}, {}
    span = float(r.choice([1.0, 6.0, 20.0]))
    if r.random() < 0.25:
        driven = {"u": str(r.choice(["hold", "linear"]))}
        at = np.unique(np.round(np.append(0.0, r.uniform(0, span, 3)), 3))
        columns = {"time": tuple(at), "u": tuple(np.round(r.uniform(-1, 1, len(at)), 3))}
    jumps = f"({r.uniform(0, span):.3f} if t < {r.uniform(0.2, 0.8) * span:.3f} else 0.5)" if r.random() < 0.15 else "1"
    felt = [*_FELT, *(["u"] if driven else []), jumps]

    def term(i: int) -> str:
        others = [y for y in states if y != states[i]] or ["sin(t)"]
        return str(r.choice(felt)).format(z=r.choice(others))

    rates = {}
    for i, y in enumerate(states):
        fast = r.random() < 0.5
        target = f"{r.uniform(0.3, 1.5):.3f} + {r.uniform(0.1, 1.0):.3f}*{term(i)} + 0.3*{term(i)}"
        forms = (
            f"k0*({target}) - k1*{y}",
            f"k0*{y}*(1-{y}**2) + 0.2*{term(i)}",
            f"k1*cos(2*t) - 0.3*{y} + 0.1*{term(i)}",
        )
        rates[y] = f"-L*({y} - k0*({target}))" if fast else str(r.choice(forms))
    initial = {y: str(r.choice(["0", "k1", "0.2", "2", "c"])) for y in states}
    outputs = {
        f"z{i}": str(r.choice(_SHOWN)).format(y=r.choice(states), z=r.choice(states)) for i in range(r.integers(1, 3))
    }
    grids = (
        np.linspace(span / 12, span, 12),
        np.array([span]),
        np.append(0.0, np.sort(r.uniform(0, span, 5))),
        np.append(np.arange(1, 4) * 1e-2, span),
    )
    times = tuple(float(f"{t:.6g}") for t in grids[r.integers(4)])
    used = " ".join((*rates.values(), *initial.values(), *outputs.values()))
    names = set("".join(a if a.isalnum() else " " for a in used).split())
    start = {name: float(f"{value:.4g}") for name, value in start.items() if name in names}
    if not start:
        return drawn(number + 10_000)
    constants: dict[str, Any] = {}
    if "c" in names:
        constants["c"] = (0.5, 1.5) if r.random() < 0.5 and not driven else 0.7
    if "u" not in names:
        driven, columns = {}, {}
    model = Ode(rates, start, initial, outputs, times, constants=constants, driven_by=driven, columns=columns)  # type: ignore[arg-type]
    return Drawn(model, 1.0 + r.choice([0.05, 0.2]) * r.standard_normal(len(start)))


def solved(one: Drawn, method: str, rtol: float) -> np.ndarray:
    """The readings (m,) by SciPy and Python's own arithmetic, by intervals; ValueError if it does not get there."""
    model, z = one.model, []
    p = {name: value * x for (name, value), x in zip(model.start.items(), one.x, strict=True)}
    for case in range(len(model.cases)):
        known = _KNOWN | p
        for name, value in model.constants.items():
            known[name] = value[case] if isinstance(value, tuple) else value
        z.append(_case(model, known, method, rtol))
    return np.concatenate(z)


def _case(model: Ode, known: dict[str, Any], method: str, rtol: float) -> np.ndarray:
    names, rows = list(model.rates), model.columns
    rates, outputs = ([_compiled(str(f)) for f in part.values()] for part in (model.rates, model.outputs))

    def values(t: float, y: Any, inside: float) -> dict[str, Any]:
        """`inside` lies in the interval: what jumps at its ends is taken from within."""
        found = {**known, **dict(zip(names, y, strict=True)), "t": t, "inside": inside}
        if rows:
            k = int(np.searchsorted(rows["time"], inside, side="right")) - 1
            held = model.driven_by["u"] == "hold"
            found["u"] = rows["u"][k] if held else np.interp(t, rows["time"], rows["u"])
        return found

    y = np.array([float(eval(_compiled(str(model.initial[name])), {}, known)) for name in names])
    jumps = [float(text.split("t < ")[1].split()[0]) for text in map(str, model.rates.values()) if "t < " in text]
    ends = sorted({*model.times, *(t for t in (*rows.get("time", ()), *jumps) if t < model.times[-1])})
    found, t = {}, 0.0
    for end in ends:
        if end > t:
            middle = (t + end) / 2

            calls = itertools.count()

            def slope(t: float, y: Any, middle: float = middle, calls: Any = calls) -> list[float]:
                if next(calls) > _MOST:
                    raise ValueError
                here = values(t, y, middle)
                return [eval(code, {}, here) for code in rates]

            run = solve_ivp(slope, (t, end), y, method, (end,), rtol=rtol, atol=rtol * 0.01)
            if not run.success:
                raise ValueError
            y, t = run.y[:, -1], end
        here = values(end, y, end)
        found[end] = [float(eval(code, {}, here)) for code in outputs]
    return np.concatenate([found[time] for time in model.times])


def _compiled(formula: str) -> Any:
    return compile(formula.replace("t < ", "inside < "), formula, "eval")


def answer(number: int) -> np.ndarray:
    """The readings (m,); none where SciPy does not get there, or two of its methods do not agree."""
    one = drawn(number)
    try:
        with np.errstate(all="ignore"):
            z, other = (solved(one, method, rtol) for method, rtol in (("LSODA", 1e-11), ("Radau", 1e-7)))
    except ValueError:
        return np.empty(0)
    return z if np.abs(z - other).max() < 1e-4 * np.abs(z).max(initial=1e-9) else np.empty(0)


def store() -> None:
    """Writes the readings of all draws."""
    answers = [answer(number) for number in range(COUNT)]
    np.savez_compressed(ANSWERS, z=np.concatenate(answers), count=list(map(len, answers)))


if __name__ == "__main__":
    store()
