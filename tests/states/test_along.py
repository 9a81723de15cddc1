"""f and h of a state model along whole paths, against its own functions by epoch and quotients of differences."""

import numpy as np
import pytest
from shared.state_models import CoordinatedTurn, Growth

from ipe_bench.measurements.base import differentiate
from ipe_bench.states import Formulas, StateModel

DRIVEN = Formulas(
    next={"p": "p + dt*v + push*sin(v)", "v": "0.9*v + cos(k)*w + 0.01*t"},
    readings={"bearing": "arctan2(p, 3 + v*v)", "range": "sqrt(1 + p**2)"},
    noise={"w": 0.1},
    deviation={"bearing": 0.1, "range": 0.2},
    spread={"p": 1.0, "v": 2.0},
    inputs={"dt": 0.5, "push": (0.0, 1.0, -2.0, 0.3)},
    period={"bearing": 2 * np.pi},
    count=4,
)
MODELS = {
    "formulas": DRIVEN,
    "formulas read at the start": Formulas(
        **{n: getattr(DRIVEN, n) for n in ("next", "readings", "noise", "deviation", "spread")},
        inputs=DRIVEN.inputs,
        count=4,
        moved_first=False,
    ),
    "Python": CoordinatedTurn(count=3),
    "Python by epoch": Growth(count=5),
}


def path(model: StateModel, trials: int = 3):
    """True paths (trials, 1 + K, n), from before the first transition."""
    drawn = StateModel.draw(model, 0, trials)
    return np.concatenate([drawn.start[:, None], drawn.x], axis=1)


@pytest.mark.parametrize("name", MODELS)
def test_values_and_slopes_along_paths_are_those_of_each_epoch(name):
    model = MODELS[name]
    x, n = path(model), model.n
    along = model.slopes_along(x)
    f, h = model.values_along(x)
    for k in range(model.epochs):
        before, at = x[:, k], x[:, k + 1]
        if model.moves(k):
            own, slopes = (
                model.transition(before, k),
                differentiate(lambda s, k=k: model.transition(s, k), before, analytic=False),
            )
        else:
            own, slopes = before, np.broadcast_to(np.eye(n), (3, n, n))
        for f_k in (f[:, k], along.f[:, k]):
            np.testing.assert_allclose(f_k, own, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(along.F[:, k], slopes, rtol=1e-6, atol=1e-6)
        own = model.observe(at, k)
        for h_k in (h[:, k], along.h[:, k]):
            np.testing.assert_allclose(h_k, own, rtol=1e-13, atol=1e-13)
        slopes = differentiate(lambda s, k=k: model.observe(s, k), at, analytic=False)
        np.testing.assert_allclose(along.H[:, k], slopes, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_a_path_has_the_same_bits_alone_and_in_a_batch(name):
    model = MODELS[name]
    x = path(model, 7)
    whole = (*model.values_along(x), *model.slopes_along(x))
    for rows in (slice(0, 1), slice(2, 5)):
        part = (*model.values_along(x[rows]), *model.slopes_along(x[rows]))
        for a, b in zip(whole, part, strict=True):
            np.testing.assert_array_equal(a[rows], b)
