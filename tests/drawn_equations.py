"""Differential equations that are drawn, and the readings that SciPy computes of them.

`python tests/drawn_equations.py` draws them all and stores the readings, in ten minutes. Those from
`HARD` on have poles, pulses, or outputs that magnify the states, and ten readings far apart.
"""

from __future__ import annotations

import itertools
import multiprocessing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from ipe_bench.measurements import Ode

ANSWERS = Path(__file__).with_name("drawn_equations.npz")
COUNT, HARD = 1000, 500
_MOST = 500_000
"""Rates in one interval beyond which SciPy is not waited for."""
_KNOWN = {name: getattr(np, name) for name in ("sin", "cos", "exp", "log", "sqrt", "tanh")}
_KNOWN |= {"min": np.minimum, "max": np.maximum, "abs": np.abs}
_SHOWN = (
    *(
        "{y}",
        "{y}/(0.5+abs({y}))",
        "tanh({y})",
        "exp(-{y})",
        "1/(1+exp(-{y}))",
        "max({y},0)",
        "exp(0.2*{y})",
    ),
    *(
        "{y}**4/(0.0625+{y}**4)",
        "1/(1+{y}**2)",
        "sin({y})",
        "cos(3*{y})",
        "min(max({y},0.1),0.8)",
        "{y}*{z}+k0*t",
    ),
)
_FELT = (
    "{z}",
    "tanh({z})",
    "{z}/(1+{z}**2)",
    "1/(1+{z}**2)",
    "sin({z})",
    "k1",
    "sin(3*t)",
    "exp(-t)",
    "c",
)
_PULSES = (
    "exp(-((t-{m})/{w})**2)/{w}",
    "1/(1+((t-{m})/{w})**2)**2/{w}",
    "exp(-abs(t-{m})/{w})/{w}",
)


@dataclass(frozen=True)
class Drawn:
    """A model, and the x (n,) of a truth."""

    model: Ode
    x: np.ndarray
    halts: tuple[float, ...] = ()
    """Times at which SciPy begins anew, so that it meets a pulse."""
    exact: Any = None
    """The readings (m,) where a formula tells them; not numbers where they are below the last digit
    of a state."""


def drawn(number: int) -> Drawn:
    """Draws a model of the first kind, or, from `HARD` on, one with a pole, a pulse or an output
    that magnifies."""
    if HARD <= number < COUNT:
        r = np.random.default_rng(number)
        return (with_pole, with_pulse, magnifying)[number % 3](r)
    return easy(number)


def _far_apart(r: np.random.Generator) -> tuple[float, ...]:
    return tuple((float(r.choice([0.5, 1.0, 4.0])) * np.arange(1.0, 11.0)).tolist())


def with_pole(r: np.random.Generator) -> Drawn:
    """Saturating kinetics, whose fast decay ends at a pole just below 0, fed steadily, for a while
    or in waves, from 0 or from a dose; and a slower state behind it."""
    times = _far_apart(r)
    constants = {
        "L": float(f"{10 ** r.uniform(1.5, 3.7):.4g}"),
        "K": float(f"{10 ** r.uniform(-3.0, -0.5):.3g}"),
    }
    loss = str(
        r.choice(
            ["L*y/(K+y)", "L*y/(K+y)", "L*y/(K+y+y**2/20)", "L*y**2/(K**2+y**2)", "L*y*(K+y)**-1"]
        )
    )
    fed = str(r.choice(["k0", "k0", f"(k0 if t < {0.43 * times[-1]:.3f} else 0)", "k0*(1+sin(t))"]))
    rates = {"y": f"{fed}-{loss}", "z": f"{loss}-k1*z"}
    initial = {"y": str(r.choice(["0", "0", "2", "10"]))}
    shown = ("z", "z/(0.3+z)", "z/(0.3+z)", "tanh(z)", "1/(1+z)", "y/(K+y)", "exp(-z)")
    outputs = {f"z{i}": str(r.choice(shown)) for i in range(r.integers(1, 3))}
    start = {"k0": float(f"{r.uniform(0.5, 3.0):.3g}"), "k1": float(f"{r.uniform(0.3, 2.0):.3g}")}
    model = Ode(rates, start, initial, outputs, times, constants=constants)  # type: ignore[arg-type]
    return Drawn(model, np.exp(r.choice([0.05, 0.3, 1.0]) * r.standard_normal(2)))


def with_pulse(r: np.random.Generator) -> Drawn:
    """One or two short pulses, of a fifth to a thousandth of the interval between readings, and a
    slower state."""
    times = _far_apart(r)
    pulses, halts = [], list[float]()
    for _ in range(r.integers(1, 3)):
        width, middle = (
            float(f"{times[0] * 10 ** r.uniform(-3.0, -0.7):.3g}"),
            float(f"{r.uniform(0, times[4]):.5g}"),
        )
        pulses.append(str(r.choice(_PULSES)).format(m=middle, w=width))
        halts += [middle + share * width for share in (-25, -12, -6, -3, -1, 0, 1, 3, 6, 12, 25)]
    rates = {"y": f"k0*({'+'.join(pulses)})-k1*y"}
    if r.random() < 0.5:
        rates["z"] = str(r.choice(["y-0.5*z", "k1*y-z", "y*(1-z)"]))
    shown = ("{y}", "{y}/(0.5+{y})", "tanh({y})", "exp(-{y})")
    outputs = {
        f"z{i}": str(r.choice(shown)).format(y=r.choice(list(rates)))
        for i in range(r.integers(1, 3))
    }
    start = {"k0": float(f"{r.uniform(0.5, 3.0):.3g}"), "k1": float(f"{r.uniform(0.05, 1.0):.3g}")}
    model = Ode(rates, start, {}, outputs, times)  # type: ignore[arg-type]
    x = np.exp(r.choice([0.05, 0.3, 1.0]) * r.standard_normal(2))
    return Drawn(model, x, tuple(sorted(halt for halt in halts if 0.0 < halt < times[-1])))


def magnifying(r: np.random.Generator) -> Drawn:
    """Outputs that tell apart what states of double precision do not: of a state that grows, or
    turns."""
    times, x = _far_apart(r), np.exp(r.choice([0.05, 0.3, 1.0]) * r.standard_normal(1))
    t, wide = np.array(times, dtype=np.longdouble), np.longdouble
    if r.random() < 0.5:
        k = float(f"{r.uniform(1.0, 60.0) / times[-1]:.3g}")
        rates, initial, y = {"y": "k*y"}, {"y": 1.0}, np.exp(wide(k) * wide(x[0]) * t)
    else:
        k = float(f"{r.uniform(0.3, 3.0):.3g}")
        rates, initial, y = {"y": "k*v", "v": "-k*y"}, {"y": 1.0}, np.cos(wide(k) * wide(x[0]) * t)
    factor = float(f"{10 ** r.uniform(0.0, 9.0):.3g}")
    outputs = {
        "z": str(r.choice([f"cos({factor}*y)", f"sin({factor}*y)", f"1/(1.5+cos({factor}*y))"]))
    }
    told = np.array(eval(outputs["z"], {"cos": np.cos, "sin": np.sin}, {"y": y}), dtype=float)
    hidden = np.abs(factor * y) > 1e13
    model = Ode(rates, {"k": k}, initial, outputs, times)  # type: ignore[arg-type]
    return Drawn(model, x, exact=np.where(hidden, np.nan, told))


def easy(number: int) -> Drawn:
    """Fast and slow states, readings that saturate, turn and are clipped, one reading and many, at
    t = 0, too, cases, inputs that are held or straight between rows, and rates that jump at known
    times."""
    r = np.random.default_rng(number)
    states = [f"y{i}" for i in range(r.integers(1, 4))]
    start = {"k0": r.uniform(0.2, 2.0), "k1": r.uniform(0.2, 2.0), "L": 10 ** r.uniform(1.0, 4.5)}
    driven, columns = {}, {}
    span = float(r.choice([1.0, 6.0, 20.0]))
    if r.random() < 0.25:
        driven = {"u": str(r.choice(["hold", "linear"]))}
        at = np.unique(np.round(np.append(0.0, r.uniform(0, span, 3)), 3))
        columns = {"time": tuple(at), "u": tuple(np.round(r.uniform(-1, 1, len(at)), 3))}
    jumps = (
        f"({r.uniform(0, span):.3f} if t < {r.uniform(0.2, 0.8) * span:.3f} else 0.5)"
        if r.random() < 0.15
        else "1"
    )
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
        f"z{i}": str(r.choice(_SHOWN)).format(y=r.choice(states), z=r.choice(states))
        for i in range(r.integers(1, 3))
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
    model = Ode(
        rates,
        start,
        initial,
        outputs,
        times,
        constants=constants,
        driven_by=driven,
        columns=columns,
    )  # type: ignore[arg-type]
    return Drawn(model, 1.0 + r.choice([0.05, 0.2]) * r.standard_normal(len(start)))


def solved(one: Drawn, method: str, rtol: float) -> np.ndarray:
    """The readings (m,) by SciPy and Python's own arithmetic, by intervals; ValueError if it does
    not get there."""
    model, z = one.model, []
    p = {name: value * x for (name, value), x in zip(model.start.items(), one.x, strict=True)}
    for case in range(len(model.cases)):
        known = _KNOWN | p
        for name, value in model.constants.items():
            known[name] = value[case] if isinstance(value, tuple) else value
        z.append(_case(one, known, method, rtol))
    return np.concatenate(z)


def _case(one: Drawn, known: dict[str, Any], method: str, rtol: float) -> np.ndarray:
    model = one.model
    names, rows = list(model.rates), model.columns
    rates, outputs = (
        [_compiled(str(f)) for f in part.values()] for part in (model.rates, model.outputs)
    )

    def values(t: float, y: Any, inside: float) -> dict[str, Any]:
        """`inside` lies in the interval: what jumps at its ends is taken from within."""
        found = {**known, **dict(zip(names, y, strict=True)), "t": t, "inside": inside}
        if rows:
            k = int(np.searchsorted(rows["time"], inside, side="right")) - 1
            held = model.driven_by["u"] == "hold"
            found["u"] = rows["u"][k] if held else np.interp(t, rows["time"], rows["u"])
        return found

    y = np.array(
        [float(eval(_compiled(str(model.initial.get(name, 0.0))), {}, known)) for name in names]
    )
    jumps = [
        float(text.split("t < ")[1].split()[0])
        for text in map(str, model.rates.values())
        if "t < " in text
    ]
    changes = (*rows.get("time", ()), *jumps, *one.halts)
    ends = sorted({*model.times, *(t for t in changes if t < model.times[-1])})
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
    """The readings (m,); none where SciPy does not get there, or two of its methods do not
    agree."""
    one = drawn(number)
    if one.exact is not None:
        return one.exact
    try:
        with np.errstate(all="ignore"):
            z, other = (
                solved(one, method, rtol) for method, rtol in (("LSODA", 1e-11), ("Radau", 1e-7))
            )
    except ValueError:
        return np.empty(0)
    return z if np.abs(z - other).max() < 1e-4 * np.abs(z).max(initial=1e-9) else np.empty(0)


def store() -> None:
    """Writes the readings of all draws."""
    with multiprocessing.Pool() as pool:
        answers = pool.map(answer, range(COUNT), chunksize=5)
    np.savez_compressed(ANSWERS, z=np.concatenate(answers), count=list(map(len, answers)))


if __name__ == "__main__":
    store()
