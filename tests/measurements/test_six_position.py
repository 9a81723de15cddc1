"""A unit on a turntable, against the linear regression of each of its sensors."""

import numpy as np
import pytest

from ipe_bench.baselines import GaussNewton
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import SixPosition
from ipe_bench.measurements.base import differentiate
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import open_together, write_readings

BIAS = np.array([120.0, -340.0, 55.0, -12.0, 30.0, 7.0])
SCALE = np.array([0.00241, 0.00237, 0.00246, 0.0075, 0.0077, 0.00761])
TA = np.array([[1.0, -0.0047, 0.0121], [0.003, 1.0, 0.0088], [-0.001, 0.002, 1.0]])
TG = np.array([[1.0, 0.011, -0.004], [-0.006, 1.0, 0.009], [0.002, -0.013, 1.0]])
"""A unit with the errors of consumer sensors."""


def counts(f, w):
    """What all six sensors show (readings, 6)."""
    force, rate = (np.linalg.solve(T * k, v.T).T for T, k, v in ((TA, SCALE[:3], f), (TG, SCALE[3:], w)))
    return BIAS + np.column_stack([force, rate])


def regression(sensors, f, w, z):
    """The parameters (24,) in their units, as functions of r = b + M shown for each sensor by itself."""
    values = []
    for kind, shown in (("a", f), ("g", w)):
        found = []
        for axis in "xyz":
            rows = np.array([name == kind + axis for name in sensors])
            A = np.column_stack([np.ones(rows.sum()), shown[rows]])
            found.append(np.linalg.lstsq(A, z[rows], rcond=None)[0])
        found = np.array(found)
        TK = np.linalg.inv(found[:, 1:])
        k = np.diag(TK)
        T = TK / k
        presumed = 0.0024 if kind == "a" else 0.0076
        angles = [-T[0, 1], T[0, 2], T[1, 0], -T[1, 2], -T[2, 0], T[2, 1]]
        values += [*found[:, 0], *(1e6 * (k / presumed - 1)), *(1e3 * np.array(angles))]
    return np.array(values)


def test_readings_are_those_of_the_matrices_and_regressions_give_them_back():
    model = SixPosition()
    sensors, f, w = model._readings
    z = counts(f, w)[np.arange(model.m), [["ax", "ay", "az", "gx", "gy", "gz"].index(s) for s in sensors]]
    p = regression(sensors, f, w, z)
    assert p[:3] == pytest.approx(BIAS[:3])
    assert model.simulate((p / model.sizes)[None])[0] == pytest.approx(z, rel=1e-12)
    assert 1e-3 * p[6:12] == pytest.approx([0.0047, 0.0121, 0.003, -0.0088, 0.001, 0.002])


def test_a_file_of_positions_and_rates_is_estimated_as_by_regression(tmp_path):
    """Eight positions and rates of no particular kind, rows in no order, one gyro reading missing."""
    rng = np.random.default_rng(3)
    v, w = rng.normal(size=(12, 3)), rng.uniform(-80, 80, (12, 3))
    w[:4] = 0
    f = 9.81 * v / np.linalg.norm(v, axis=1)[:, None]
    model = SixPosition(
        sensors=("ax", "ay", "az", "gx", "gy", "gz") * 12,
        force=tuple(map(tuple, np.repeat(f, 6, axis=0).tolist())),
        rate=tuple(map(tuple, np.repeat(w, 6, axis=0).tolist())),
    )
    z = counts(f, w).ravel() + 0.4 * rng.standard_normal(72)
    z[10] = np.nan
    write_readings(tmp_path / "table.csv", model, z)
    heading, *rows = (tmp_path / "table.csv").read_text().splitlines()
    assert heading == ("row,sensor,fx [m/s^2],fy [m/s^2],fz [m/s^2],wx [deg/s],wy [deg/s],wz [deg/s],reading [counts]")
    order = rng.permutation(72)
    (tmp_path / "own.csv").write_text("\n".join([heading[4:], *(rows[i].partition(",")[2] for i in order)]))
    found = open_together([tmp_path / "own.csv"], SixPosition())
    (result,) = fit(Problem(found.model, Gaussian(0.4).covariance(72)), found.z, {"gn": GaussNewton(tolerance=1e-9)})
    there = np.isfinite(z)
    sensors = np.array(model.sensors)[there]
    given = np.repeat(f, 6, axis=0)[there], np.repeat(w, 6, axis=0)[there]
    expected = regression(sensors, *given, z[there])
    assert result.x == pytest.approx(expected, rel=1e-8, abs=1e-8)
    # Errors by the linear propagation of each reading's through the regressions.
    step = 1e-3
    G = np.array([(regression(sensors, *given, z[there] + step * e) - expected) / step for e in np.eye(there.sum())])
    assert result.standard_errors == pytest.approx(0.4 * np.sqrt(np.sum(G**2, axis=0)), rel=1e-4)


def test_standard_readings_tell_all_parameters_and_are_epochs_of_a_position():
    model = SixPosition()
    assert (model.n, model.m) == (24, 108)
    assert [len(rows) for rows in model.epochs] == [6] * 18
    J = Covariance(np.ones(108)).whiten_jacobian(model.jacobian(model.nominal[None]))[0]
    assert np.linalg.matrix_rank(J) == 24
    x = model.nominal + 0.3 * np.random.default_rng(0).standard_normal((2, 24))
    assert model.jacobian(x) == pytest.approx(differentiate(model.simulate, x, analytic=False), abs=1e-5)


def test_a_scale_factor_of_nothing_spoils_its_own_trial_only():
    model = SixPosition()
    x = np.repeat(model.nominal[None], 2, axis=0)
    x[0, 4] = -1e6 / model.sizes[4]
    z = model.simulate(x)
    assert not np.isfinite(z[0]).all()
    assert np.array_equal(z[1], model.simulate(x[1:])[0])
