"""A model inside of another: what is restricted, constrained or joined is the whole model in other coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from small_models import Bent

from ipe_bench.measurements import Gins, Gnss, RicherGins, SubsetModel
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.real.penalised import Penalised

GINS = Gins()
KNOWN = (
    ParameterInfo("bx", fixed=1e-4),
    ParameterInfo("kx", lower=-500.0, upper=600.0),
    ParameterInfo("dz", lower=-9.0),
)
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
    assert numbers == [own for epoch in whole.epochs if (own := [r + 1 for r in epoch if r in rows])]
    for k in range(1, len(model.epochs) + 1):
        np.testing.assert_array_equal(model.simulate_until(x, k), model.simulate(x)[:, model.rows(k)])
        np.testing.assert_array_equal(model.jacobian_until(x, k), model.jacobian(x)[:, model.rows(k)])


@pytest.mark.parametrize("kept", [(0, 5, 6, 9), (4, 13, 14, 15), (2, 3)])
def test_a_subset_of_a_window_takes_its_columns_of_what_has_arrived(kept):
    """Rows of GINS arrive case by case, so that a window's rows are not the first of all."""
    arrived = GINS.rows(3)
    rows = arrived[list(kept)]
    model, x = SubsetModel(GINS, tuple(rows.tolist()), 3), draw(GINS)
    np.testing.assert_array_equal(model.simulate(x), GINS.simulate(x)[:, rows])
    np.testing.assert_array_equal(model.jacobian(x), GINS.jacobian(x)[:, rows])
    np.testing.assert_array_equal(model.coarse_jacobian(x), GINS.coarse_jacobian_until(x, 3)[:, list(kept)])


def test_a_truth_that_is_richer_keeps_its_nuisances_in_a_subset():
    whole = RicherGins(accelerometer_quadratic=10.0)
    model = SubsetModel(whole, (3, 70))
    np.testing.assert_array_equal(model.nuisance_deviation, whole.nuisance_deviation)
    x = np.concatenate([np.zeros(11), whole.nuisance_deviation])[None]
    np.testing.assert_array_equal(model.simulate(x), whole.simulate(x)[:, [3, 70]])


@pytest.mark.parametrize("stop", [None, 4])
def test_a_constrained_model_has_the_slopes_of_its_own_coordinates(stop):
    model = ConstrainedModel(GINS, KNOWN)
    x, until = draw(model, 3), "" if stop is None else "_until"
    after = () if stop is None else (stop,)
    J = getattr(model, f"jacobian{until}")(x, *after)
    for k, direction in enumerate(np.eye(model.n)):
        ends = [getattr(model, f"simulate{until}")(x + h * direction, *after) for h in (1e-4, -1e-4)]
        np.testing.assert_allclose(J[:, :, k], (ends[0] - ends[1]) / 2e-4, atol=2e-5 * np.abs(J).max())
    coarse = getattr(model, f"coarse_jacobian{until}")(x, *after)
    assert 0 < np.abs(coarse - J).max() < 1e-2 * np.abs(J).max()
    assert (model.jacobian_cost, model.coarse_jacobian_cost) == (GINS.jacobian_cost, GINS.coarse_jacobian_cost)
    assert not model.by_differential_equations
    assert model.hindrance(x[0]) == ""


def test_a_joint_model_has_the_blocks_of_its_parts():
    parts = (Gnss(), Gnss(rounds=2))
    model = Joint(parts)
    assert [p.name for p in model.parameters[:3]] == ["east", "north", "up"]
    x = draw(model, scale=1.0)
    names = [p.name for p in model.parameters]
    for name in COMPUTED:
        found, start = getattr(model, name)(x), 0
        for k, part in enumerate(parts, 1):
            places = [
                names.index(f"{p.name}_{k}" if p.name in part.own_parameters else p.name) for p in part.parameters
            ]
            own, block = getattr(part, name)(x[:, places]), found[:, start : start + part.m]
            np.testing.assert_array_equal(own, block if name == "simulate" else block[:, :, places])
            if name != "simulate":
                assert not np.delete(block, places, axis=2).any()
            start += part.m
    assert parts[0].jacobian_cost < model.jacobian_cost < parts[1].jacobian_cost


def test_a_prior_behind_the_readings_is_x_itself():
    model, x = Penalised(Bent(0.03)), draw(Bent(0.03), scale=1.0)
    np.testing.assert_array_equal(model.simulate(x), np.concatenate([Bent(0.03).simulate(x), x], axis=1))
    for name in ("jacobian", "coarse_jacobian"):
        np.testing.assert_array_equal(getattr(model, name)(x)[:, -3:], np.broadcast_to(np.eye(3), (5, 3, 3)))
