"""Pseudo-ranges against the flight of light in inertial axes, the ellipsoid's formulas, SciPy and
Bancroft."""

import numpy as np
import pytest
from ipe_bench_zoo import Gnss
from ipe_bench_zoo.gnss import east_north_up
from scipy.optimize import brentq, least_squares
from shared.instruments import solution
from shared.oracles import assert_agrees

from ipe_bench.baselines import GaussNewton
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Ranging
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import ModelNoise
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import open_together, write_readings
from ipe_bench.solvers import Newton

LIGHT, EARTH_RATE = 299792458.0, 7.2921151467e-5


def flight(satellite, receiver):
    """The distance to a receiver that the Earth carries along while light flies, in axes that do
    not turn."""

    def late(tau):
        a = EARTH_RATE * tau
        x, y, z = receiver
        carried = np.array([np.cos(a) * x - np.sin(a) * y, np.sin(a) * x + np.cos(a) * y, z])
        return np.linalg.norm(carried - satellite) - LIGHT * tau

    return LIGHT * brentq(late, 0.0, 1.0, xtol=1e-17, rtol=1e-15)


def on_ellipsoid(latitude, longitude, height):
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    N = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    r = (N + height) * np.cos(latitude)
    return np.array(
        [r * np.cos(longitude), r * np.sin(longitude), (N * (1 - e2) + height) * np.sin(latitude)]
    )


def sky(model):
    """Satellites (m, 3) of the default sky, found from the readings' directions: the model's own
    table."""
    return model._columns[2]


def given(model, **others):
    """The same readings with everything in fields."""
    labels = zip(
        model.index["epoch"], model.index["constellation"], sky(model).tolist(), strict=True
    )
    return Gnss(tuple((epoch, name, *place) for epoch, name, place in labels), **others)


@pytest.mark.oracle(
    "own second implementation: flight of light in inertial axes", "pseudo-ranges, m", 1e-6
)
def test_distances_are_those_of_light_in_axes_that_do_not_turn():
    model = Gnss(frame="ecef")
    x = model.nominal + np.random.default_rng(0).normal(size=(3, model.n))
    for row, z in zip(x, model.simulate(x), strict=True):
        p = row * model.sizes
        clock = p[3] + np.where(np.array(model.index["constellation"]) == "galileo", p[4], 0.0)
        assert_agrees(z - clock, [flight(s, p[:3]) for s in sky(model)], atol=1e-6)


@pytest.mark.oracle("closed form: Sagnac's term", "difference of pseudo-ranges, m", 1e-3)
def test_the_rotation_is_worth_the_sagnac_term():
    turning, still = Gnss(), Gnss(earth_rate=0.0)
    x, y, _ = sky(turning).T
    px, py, _ = turning.position
    difference = (turning.simulate(turning.nominal[None]) - still.simulate(still.nominal[None]))[0]
    assert_agrees(difference, EARTH_RATE / LIGHT * (x * py - y * px), atol=1e-3)
    assert 10.0 < np.abs(difference).max() < 45.0


def test_local_axes_are_the_tangents_of_the_ellipsoid():
    latitude, longitude, height, h = 0.6344, 2.2230, 120.0, 1e-6
    place = on_ellipsoid(latitude, longitude, height)
    east = on_ellipsoid(latitude, longitude + h, height) - on_ellipsoid(
        latitude, longitude - h, height
    )
    north = on_ellipsoid(latitude + h, longitude, height) - on_ellipsoid(
        latitude - h, longitude, height
    )
    up = on_ellipsoid(latitude, longitude, height + 1.0) - place
    expected = np.array([v / np.linalg.norm(v) for v in (east, north, up)])
    np.testing.assert_allclose(east_north_up(place), expected, atol=1e-8)


def test_satellites_stand_where_the_default_says():
    model = Gnss()
    towards = (sky(model) - model.position) @ east_north_up(np.array(model.position)).T
    elevation = np.rad2deg(np.arcsin(towards[:, 2] / np.linalg.norm(towards, axis=1)))
    azimuth = np.rad2deg(np.arctan2(towards[:, 0], towards[:, 1])) % 360
    np.testing.assert_allclose((azimuth[0], elevation[0]), (20.0, 65.0), atol=1e-9)
    radii = np.linalg.norm(sky(model), axis=1)
    np.testing.assert_allclose(
        radii, np.where(np.array(model.index["constellation"]) == "gps", 26560e3, 29600e3)
    )


def test_east_north_up_and_ecef_are_one_model():
    local = Gnss(rounds=2)
    fixed = given(local, frame="ecef")
    x = local.nominal + np.random.default_rng(1).normal(size=(3, local.n))
    values = x * local.sizes
    values[:, :3] = np.array(local.position) + values[:, :3] @ east_north_up(
        np.array(local.position)
    )
    np.testing.assert_allclose(fixed.simulate(values / fixed.sizes), local.simulate(x), atol=1e-6)


def test_without_rotation_and_with_one_clock_it_is_ranging():
    beacons = Ranging(rounds=2)
    model = Gnss(
        tuple((1, "gps", *beacon) for beacon in beacons.beacons * 2),
        frame="ecef",
        position=(0.0, 0.0, 0.0),
        earth_rate=0.0,
    )
    values = 10.0 * np.random.default_rng(2).normal(size=(5, 4))
    np.testing.assert_allclose(
        model.simulate(values / model.sizes), beacons.simulate(values / beacons.sizes), rtol=1e-14
    )


@pytest.mark.oracle("library: SciPy's least_squares", "position and clocks, m", 1e-3)
def test_an_epoch_of_two_constellations_from_the_centre_of_the_earth_is_scipys_solution():
    model = Gnss()
    truth = np.array([*on_ellipsoid(0.6344, 2.2230, 120.0), 3e5, -25.0])
    galileo = np.array(model.index["constellation"]) == "galileo"

    def ranges(p):
        return (
            np.array([flight(s, p[:3]) for s in sky(model)]) + p[3] + np.where(galileo, p[4], 0.0)
        )

    z = ranges(truth) + np.random.default_rng(3).normal(size=model.m)
    scale = np.array([1e6, 1e6, 1e6, 1e6, 10.0])
    theirs = least_squares(
        lambda p: z - ranges(p), np.array([1e6, 1e6, 1e6, 0, 0]), x_scale=scale, xtol=1e-15
    ).x
    centre = given(model, frame="ecef", position=(0.0, 0.0, 0.0))
    estimates = GaussNewton(start="nominal").estimate(
        Problem(centre, Covariance(np.ones(model.m))), z[None]
    )
    assert estimates.status[0] == 0
    assert_agrees((estimates.x * centre.sizes)[0], theirs, atol=1e-3)
    assert np.linalg.norm(theirs[:3] - truth[:3]) < 10.0


def test_clocks_belong_to_epochs_and_offsets_to_constellations():
    model = Gnss(rounds=2)
    assert [p.name for p in model.parameters[3:]] == ["clock_1", "clock_2", "offset_galileo"]
    moved = model.simulate(model.nominal + np.vstack([np.zeros(6), np.diag(1 / model.sizes)[3:]]))
    difference = np.round(moved[1:] - moved[0], 6)
    epoch, galileo = (
        np.array(model.index["epoch"]),
        np.array(model.index["constellation"]) == "galileo",
    )
    np.testing.assert_array_equal(
        difference, np.array([epoch == 1, epoch == 2, galileo], dtype=float)
    )
    assert [len(rows) for rows in model.epochs] == [10, 10]


# Ranging against the closed form of the same problem


def bancroft(beacons, pseudoranges):
    """Position and clock bias (4,) from pseudoranges, algebraically (Bancroft 1985); the root that
    fits better."""
    B = np.column_stack([beacons, pseudoranges])
    lorentz = np.array([1.0, 1.0, 1.0, -1.0])
    a = (B**2) @ lorentz / 2
    u, v = np.linalg.lstsq(B, np.column_stack([np.ones(len(B)), a]), rcond=None)[0].T
    inner = [u @ (lorentz * u), 2 * (u @ (lorentz * v) - 1), v @ (lorentz * v)]
    solutions = [lorentz * (root * u + v) for root in np.real(np.roots(inner))]

    def misfit(s):
        return np.abs(np.linalg.norm(beacons - s[:3], axis=1) + s[3] - pseudoranges).max()

    return min(solutions, key=misfit)


@pytest.mark.oracle("closed form: Bancroft (1985)", "position and clock, m", 1e-6)
def test_the_iterated_estimate_is_bancrofts_and_the_truth_where_readings_are_exact():
    model = Ranging(rounds=1)
    x = model.nominal + 3.0 * np.random.default_rng(4).normal(size=(20, 4))
    z = model.simulate(x)
    estimates = Newton(tolerance=1e-9).estimate(
        Problem(model, Covariance(np.full(model.m, 0.1))), z
    )
    assert (estimates.status == 0).all()
    closed = np.stack([bancroft(np.array(model.beacons), ranges) for ranges in z])
    np.testing.assert_allclose(closed, x * model.sizes, atol=1e-6)
    assert_agrees(estimates.x * model.sizes, closed, atol=1e-6)


def test_a_clock_bias_adds_to_every_range_and_rounds_repeat():
    model = Ranging(rounds=2)
    z = model.simulate(np.array([[0.0, 0, 0, 0], [0.0, 0, 0, 1.5]]))
    np.testing.assert_allclose(z[1] - z[0], 15.0, atol=1e-12)
    assert z[0, 0] == np.hypot(1000.0, 300.0)
    assert (z[:, :7] == z[:, 7:]).all()
    assert [len(rows) for rows in model.epochs] == [7, 7]


def test_a_satellite_file_brings_its_own_sky(tmp_path):
    """Position and clock of a file with a sky, an order and an epoch of its own, within their
    intervals, at the answer of an independent solution."""
    rng = np.random.default_rng(5)
    places = Gnss(rounds=1)._columns[2][[3, 0, 5, 1, 2, 4]] + rng.normal(0, 3e5, (6, 3))
    sky = tuple((1, "gps", *place) for place in places.tolist())
    truth = Gnss(sky, earth_rate=0.0)
    p = np.array([120.0, -40.0, 30.0, 2500.0])
    z = truth.simulate((p / truth.sizes)[None])[0] + rng.normal(size=6)
    write_readings(tmp_path / "g.csv", truth, z)
    found = open_together([tmp_path / "g.csv"], Gnss(earth_rate=0.0))
    assert found.model.m == 6
    result = fit(
        Problem(found.model, ModelNoise().of(found.model).covariance(6)),
        found.z,
        {"gn": GaussNewton()},
    )[0]
    low, high = result.interval(0.9999)
    assert ((low < p) & (p < high)).all()
    here = np.asarray(truth.position)
    axes = east_north_up(here)

    def residuals(q):
        place = here + axes.T @ q[:3]
        ranges = np.array([np.sqrt(np.sum((np.array(s[2:]) - place) ** 2)) for s in sky])
        return ranges + q[3] - z

    expected, deviations = solution(residuals, [1.0, 1.0, 1.0, 1000.0])
    assert result.x == pytest.approx(expected, abs=1e-5)
    assert result.standard_errors == pytest.approx(deviations, rel=1e-6)
