"""Range-only navigation: motion along arcs in closed form, and refusals of a log."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_plaza import Plaza
from ipe_bench_plaza.compare import errors, turned
from ipe_bench_plaza.make_log import motion

import ipe_bench as ib
from ipe_bench.cli.main import main

PLUGIN = Path(__file__).parents[1]
LOG = PLUGIN / "ipe_bench_plaza/samples/plaza2.csv"
YARD = Plaza({"1": (8.0, 0.0), "2": (-5.0, 3.0), "7": (12.0, 20.0)}, beacon_spread=0.5)


def test_keeps_its_promises():
    assert not [finding for finding in ib.check(PLUGIN) if finding.complaint]


def test_motion_between_ranges_is_that_along_a_circle():
    """Of radius 5, at 1 rad a second, odometry ten times and ranges some four times a second."""
    t = np.arange(1, 201) / 10
    odometry = np.column_stack([t, np.full(200, 0.5), np.full(200, 0.1)])
    times = np.sort(np.random.default_rng(1).choice(t, 90, replace=False))
    forward, left, turn = motion(odometry, times).T
    h = np.diff(times, prepend=0.0)
    radius = 0.25 / np.sin(0.05)  # chords of the arcs are taken for the arcs
    np.testing.assert_allclose(turn, h, atol=1e-12)
    np.testing.assert_allclose(np.hypot(forward, left), 2 * radius * np.sin(h / 2), atol=1e-12)
    np.testing.assert_allclose(np.arctan2(left, forward), h / 2, atol=1e-12)


def test_a_drive_round_a_circle_ends_where_it_began():
    x = YARD.prior.mean[None]
    for k in range(YARD.epochs):
        x = YARD.transition(x, k)
    np.testing.assert_allclose(x[0, :3] - [0, 0, 2 * np.pi], YARD.prior.mean[:3], atol=1e-12)


@pytest.mark.parametrize(
    ("row", "column", "cell", "complaint"),
    [
        (
            4,
            1,
            "7",
            "row 4, column beacon: beacon 7 has no presumed place; give it one by"
            " +state_model.beacons.7=[X,Y]",
        ),
        (
            9,
            0,
            "3151.5",
            "row 9, column time [s]: is before the time of the row above; give rows in the"
            " order of",
        ),
        (
            5,
            5,
            "-3.1",
            "row 5, column range [m]: is negative; correct it, or leave the cell empty if it is"
            " missing",
        ),
        (6, 2, "", "row 6, column forward [m]: is empty; a known input has a value at each epoch"),
    ],
)
def test_wrong_rows_are_refused_in_a_line(
    row, column, cell, complaint, tmp_path, monkeypatch, capsys
):
    lines = [line.split(",") for line in LOG.read_text().splitlines()[:12]]
    lines[row - 1][column] = cell
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, lines)))
    (tmp_path / "plugins").symlink_to(PLUGIN.parent)
    monkeypatch.chdir(tmp_path)
    assert main(["estimate", "state_model=plaza", "readings=log.csv", "tracker=[ekf]"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"ipe-bench: readings=log.csv: {complaint}")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"beacons": {}}, "beacons: is empty"),
        ({"beacons": {"a": (0.0, 0.0)}}, "by its whole number in the log"),
    ],
)
def test_beacons_that_are_none_are_refused(options, complaint):
    with pytest.raises(ib.UserError, match=complaint):
        replace(YARD, **options)


def test_errors_are_those_beside_gps():
    gps, x = np.zeros((3, 2)), np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 1.0]])
    assert errors(x, gps) == pytest.approx((np.sqrt(26 / 3), 5.0, 1.0))


def test_a_path_that_is_moved_and_turned_comes_to_lie_on_gps():
    gps, c, s = np.random.default_rng(2).normal(size=(30, 2)), np.cos(1.3), np.sin(1.3)
    np.testing.assert_allclose(turned(gps @ [[c, s], [-s, c]] + [5.0, -3.0], gps), gps, atol=1e-12)
