"""The inertial system whose drifts walk: against GINS where they stand still, and by how far they
walk."""

from dataclasses import replace

import numpy as np
import pytest
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.measurements import Gins
from ipe_bench.states import Cubature, IteratedSmoother, Smoother, Taylor, WalkingGins, ekf, ukf
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.trials.paths import StateScenario


@pytest.mark.oracle(
    "own second implementation: Runge-Kutta steps of NumPy", "velocities, m/s", 5e-4
)
def test_the_inertial_system_with_drifts_that_stand_still_reads_what_gins_does():
    """Four Runge-Kutta steps of 45 s leave 2e-4 m/s of 450 m/s at error scale 10."""
    model = WalkingGins(walk=0.0)
    p = 10.0 * np.random.default_rng(0).standard_normal((3, 11))
    x, z = np.hstack([np.zeros((3, 11)), p]), []
    for k in range(model.epochs):
        x = model.transition(x, k)
        z.append(model.observe(x, k))
    assert_agrees(np.stack(z, axis=1).reshape(3, -1), model.gins.simulate(p), atol=5e-4)


def test_drifts_walk_as_fast_as_is_said_and_nothing_else_does():
    model = replace(WalkingGins(walk=0.5), gins=Gins(readings_per_case=5))
    paths = model.draw(0, 300)
    moved = paths.x[:, -1, 11:] - paths.start[:, 11:]
    hours = model.times[-1] / 3600.0
    np.testing.assert_allclose(moved[:, 4:7].std(axis=0), 0.5 * np.sqrt(hours), rtol=0.15)
    assert np.abs(np.delete(moved, [4, 5, 6], axis=1)).max() == 0.0


TRACKERS = {
    "ekf": ekf(),
    "ukf": ukf(),
    "rts": Smoother(ukf()),
    "ieks": IteratedSmoother(ukf(), Taylor(), 2),
    "ipls": IteratedSmoother(ukf(), Cubature(), 2),
}


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(("ekf", "ukf", "rts"), marks=pytest.mark.slow),
        pytest.param(("ieks", "ipls"), marks=pytest.mark.campaign),
    ],
    ids=", ".join,
)
def test_trackers_of_singular_covariances_are_calibrated(names):
    """The motion follows from the parameters after each first reading of a run: ranks of 11 to 22
    of 22. Of each kind of tracker machine code is made, which takes most of the time."""
    trackers = {name: TRACKERS[name] for name in names}
    table = ib.run(
        StateScenario(WalkingGins(gins=Gins(readings_per_case=4)), error_scale=10.0), trackers, 12
    )
    rows = table[table["parameter"] == "all"].set_index("estimator")
    assert (rows["converged"] == 1).all()
    assert rows["nees_mean"].between(*mean_limits(11, 12, 0.9999)).all(), rows["nees_mean"]
    assert np.isnan(rows["van_trees"]).all()
    assert len(table) == len(trackers) * (len(Gins().parameters) + 1)  # the motion is not scored


@pytest.mark.slow
def test_a_smoothed_covariance_stays_definite_where_readings_leave_little_of_a_wide_prior():
    """It was indefinite by round-off, and posterior linearisation about it lost every trial."""
    model = StateScenario(WalkingGins(), error_scale=100.0).assumed
    z = model.draw(0, 1).z
    with np.errstate(all="ignore"):
        P = Smoother(ukf()).track(model, z).covariance[0]
    deviations = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    size = np.where(deviations > 0, deviations, 1.0)
    correlations = P / (size[:, :, None] * size[:, None, :])
    assert np.linalg.eigvalsh(correlations).min() > -1e-12
