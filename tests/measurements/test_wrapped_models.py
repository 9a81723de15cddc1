"""A model inside of another: what is restricted, constrained or joined is the whole model in other
coordinates."""

import numpy as np
import pytest
from shared.small_models import Bent

from ipe_bench.measurements import Gins, RicherGins, SubsetModel

GINS = Gins()
COMPUTED = ("simulate", "jacobian", "coarse_jacobian")


def draw(model, trials=5, scale=3.0):
    return model.nominal + scale * np.random.default_rng(2).normal(size=(trials, model.n))


@pytest.mark.parametrize("kept", [(0, 3, 4), (1, 2, 7, 11), tuple(range(12)), (10, 11)])
@pytest.mark.parametrize("stop", [None, 4])
def test_a_subset_has_its_rows_of_everything(kept, stop):
    whole = Bent(0.03)
    model, x = SubsetModel(whole, kept, stop), draw(whole, scale=1.0)
    rows = list(kept)
    for name in COMPUTED:
        np.testing.assert_array_equal(getattr(model, name)(x), getattr(whole, name)(x)[:, rows])
    np.testing.assert_array_equal(model.linearization(), whole.linearization()[rows])
    np.testing.assert_array_equal(model.index["number"], np.array(whole.index["number"])[rows])
    numbers = [np.array(model.index["number"])[epoch].tolist() for epoch in model.epochs]
    assert numbers == [
        own for epoch in whole.epochs if (own := [r + 1 for r in epoch if r in rows])
    ]
    for k in range(1, len(model.epochs) + 1):
        np.testing.assert_array_equal(
            model.simulate_until(x, k), model.simulate(x)[:, model.rows(k)]
        )
        np.testing.assert_array_equal(
            model.jacobian_until(x, k), model.jacobian(x)[:, model.rows(k)]
        )


@pytest.mark.parametrize("kept", [(0, 5, 6, 9), (4, 13, 14, 15), (2, 3)])
def test_a_subset_of_a_window_takes_its_columns_of_what_has_arrived(kept):
    """Rows of GINS arrive case by case, so that a window's rows are not the first of all."""
    arrived = GINS.rows(3)
    rows = arrived[list(kept)]
    model, x = SubsetModel(GINS, tuple(rows.tolist()), 3), draw(GINS)
    np.testing.assert_array_equal(model.simulate(x), GINS.simulate(x)[:, rows])
    np.testing.assert_array_equal(model.jacobian(x), GINS.jacobian(x)[:, rows])
    np.testing.assert_array_equal(
        model.coarse_jacobian(x), GINS.coarse_jacobian_until(x, 3)[:, list(kept)]
    )


def test_readings_of_some_cases_are_computed_without_the_others():
    rows = [62, 70, 181, 239]  # of the second and the fourth case
    model, x = GINS.taking(rows), draw(GINS)
    assert len(model.whole.cases) == 2
    np.testing.assert_allclose(model.simulate(x), GINS.simulate(x)[:, rows], atol=1e-9)


def test_a_truth_that_is_richer_keeps_its_nuisances_in_a_subset():
    whole = RicherGins(accelerometer_quadratic=10.0)
    model = SubsetModel(whole, (3, 70))
    np.testing.assert_array_equal(model.nuisance_deviation, whole.nuisance_deviation)
    x = np.concatenate([np.zeros(11), whole.nuisance_deviation])[None]
    np.testing.assert_array_equal(model.simulate(x), whole.simulate(x)[:, [3, 70]])
