"""Makes the log, and the files of the truth, from one of the MATLAB files of the data set, as GTSAM
ships them:

    python plugins/plaza/ipe_bench_plaza/make_log.py Plaza2_.mat
    plugins/plaza/ipe_bench_plaza/samples/plaza2

Odometry comes ten times a second, ranges at times of their own. The log has a row per range, with
the motion since the range before: odometry is summed along arcs, and its path read at the times of
the ranges.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.io import loadmat

from ipe_bench.basics.linalg import Array


def motion(odometry: Array, times: Array) -> Array:
    """Returns forward and left in m and turn in rad (K, 3) from each of the times (K,) to the next,
    0 before the first, by odometry (rows, 3): time, distance and turn since the row before."""
    at, distance, turn = odometry.T
    heading = np.cumsum(turn)
    along = heading - turn / 2
    path = np.stack(
        [np.cumsum(distance * np.cos(along)), np.cumsum(distance * np.sin(along)), heading]
    )
    x, y, heading = (np.interp(times, at, one, left=0.0) for one in path)
    dx, dy, turned = (np.diff(one, prepend=0.0) for one in (x, y, heading))
    before = heading - turned
    cos, sin = np.cos(before), np.sin(before)
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, turned], axis=1)


def write(name: str, odometry: Array, ranges: Array, truth: Array, beacons: Array) -> None:
    """Writes NAME.csv, NAME_gps.csv and NAME_beacons.csv."""
    time, _, beacon, distance = ranges.T
    moved = motion(odometry, time)
    log = np.column_stack([time, beacon, moved, distance])
    gps = np.column_stack([time, *(np.interp(time, truth[:, 0], truth[:, i]) for i in (1, 2))])
    for end, header, form, rows in (
        (
            "",
            "time [s],beacon,forward [m],left [m],turn [rad],range [m]",
            "%.4f,%d,%.6f,%.6f,%.7f,%.4f",
            log,
        ),
        ("_gps", "time [s],x [m],y [m]", "%.4f,%.4f,%.4f", gps),
        ("_beacons", "beacon,x [m],y [m]", "%d,%.4f,%.4f", beacons),
    ):
        np.savetxt(f"{name}{end}.csv", rows, form, header=header, comments="")


if __name__ == "__main__":
    found = loadmat(sys.argv[1])
    write(sys.argv[2], *(found[key].astype(float) for key in ("DR", "TD", "GT", "TL")))
