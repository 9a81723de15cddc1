"""Constants of a state model by the largest likelihood of a log (Schweppe, IEEE Trans. Information Theory 11, 1965)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import ndtri

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.real.tracks import Constant, Log, Tracked
from ipe_bench.states.formulas import Formulas
from ipe_bench.states.trackers import Bootstrap, Tracker
from ipe_bench.trials.tracking import track_safely

_KEYS = ("constants", "noise", "deviation")
"""The numbers of a model that can be found; the latter two are positive, and found by their logarithms."""
_STEP = 0.02
"""Step of differences, in standard errors."""
_ROUNDS, _DONE = 20, 1e-8
"""Newton steps at most behind the search, and the squared step, in standard errors, that ends them."""
_FAR, _VAGUE = 30.0, 5.0
"""Logarithms of factors beyond which nothing is looked for, and their standard errors where there is no maximum."""


def found_and_tracked(log: Log, label: str, tracker: Tracker, find: Sequence[str]) -> Tracked:
    """The constants `find` under which a tracker finds the log most likely, and its track with them.

    Raises:
        UserError: the model has no such constant, or the tracker has no likelihood that can be maximised.
    """
    model = log.model
    if not isinstance(model, Formulas):
        raise UserError(f"find: is for models by formulas; {model.name} is written in Python")
    places = [_place(model, name) for name in find]
    start = np.array([getattr(model, key)[name] for key, name in places])
    positive = np.array([key != "constants" for key, _ in places])
    if (positive & ~(start > 0)).any():
        raise UserError(f"find={find[int(np.argmax(positive & ~(start > 0)))]}: is 0; give a value above to start from")
    size = np.where(start == 0, 1.0, np.abs(start))

    def values(u: Array) -> Array:
        return np.where(positive, start * np.exp(np.where(positive, u, 0.0)), start + size * u)

    def model_at(u: Array) -> Formulas:
        parts = {key: dict(getattr(model, key)) for key in _KEYS}
        for (key, name), value in zip(places, values(u).tolist(), strict=True):
            parts[key][name] = value
        return replace(model, **parts)

    def cost(u: Array) -> float:
        if not (np.abs(u[positive]) < _FAR).all() or tracker.hindrance(model_at(u)):
            return np.inf
        tracks, _ = track_safely(tracker, model_at(u), log.z[None])
        value = -float(tracks.log_likelihood[0])
        return value if tracks.degrees.any() and np.isfinite(value) else np.inf

    u = np.zeros(len(find))
    if isinstance(tracker, Bootstrap) or not np.isfinite(cost(u)):
        raise UserError(f"find: trackers.{label} has no likelihood that can be maximised; choose a filter")
    with np.errstate(invalid="ignore"):
        u, error = _minimum(cost, u)
    if not (np.isfinite(error).all() and (error[positive] < _VAGUE).all()):
        message = f"the likelihood has no maximum in {', '.join(find)}: the log does not determine them"
        return replace(Tracked.of(log, label, tracker), message=message, passes=False)
    ends = [values(u + sign * float(ndtri(0.975)) * error) for sign in (-1, 1)]
    rows = zip(find, values(u), np.where(positive, values(u), size) * error, *ends, strict=True)
    constants = [Constant(name, *map(float, numbers)) for name, *numbers in rows]
    return replace(Tracked.of(replace(log, model=model_at(u)), label, tracker), constants=constants)


def _place(model: Formulas, name: str) -> tuple[str, str]:
    """The key and the name of a constant, which may be written KEY.NAME."""
    known = [(key, label) for key in _KEYS for label in getattr(model, key)]
    found = [one for one in known if name in (one[1], ".".join(one))]
    if len(found) > 1:
        raise UserError(f"find={name}: is a name of two numbers; write {' or '.join(map('.'.join, found))}")
    if not found:
        raise UserError(f"find={name}: {unknown(name, [label for _, label in known], 'constant')}")
    return found[0]


def _minimum(cost: Callable[[Array], float], u: Array) -> tuple[Array, Array]:
    """Where the cost is least, and standard errors by its second derivatives there; NaN if it has no such minimum."""
    from scipy.optimize import minimize

    n = len(u)
    options = {"initial_simplex": np.vstack([u, u + 0.5 * np.eye(n)]), "xatol": 1e-2, "fatol": 1e-2}
    u, h = np.asarray(minimize(cost, u, method="Nelder-Mead", options=options).x), np.full(n, 1e-2)
    for _ in range(_ROUNDS):
        E, here = np.diag(h), cost(u)
        up, down = (np.array([cost(u + sign * e) for e in E]) for sign in (1, -1))
        g, H = (up - down) / (2 * h), np.diag((up - 2 * here + down) / h**2)
        for i, j in combinations(range(n), 2):
            both = cost(u + E[i] + E[j]) + cost(u - E[i] - E[j]) + 2 * here
            H[i, j] = H[j, i] = (both - up[i] - up[j] - down[i] - down[j]) / (2 * h[i] * h[j])
        if not (np.isfinite(H).all() and np.linalg.eigvalsh(H)[0] > 0):
            break
        P = np.linalg.inv(H)
        u, h = u - P @ g, _STEP * np.sqrt(np.diagonal(P))
        if g @ P @ g < _DONE:
            return u, h / _STEP
    return u, np.full(n, np.nan)
