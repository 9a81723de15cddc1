"""Sets the tracks of `ipe-bench estimate state_model=plaza output=FOLDER` beside GPS and the
surveyed beacons:

python compare.py FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from ipe_bench.basics.linalg import Array

SAMPLES = Path(__file__).parent / "samples"


def errors(x: Array, gps: Array) -> tuple[float, float, float]:
    """Returns root mean square, largest and last distance in m of a path (K, 2) from that of
    GPS."""
    distance = np.hypot(*(x - gps).T)
    return float(np.sqrt(np.mean(distance**2))), float(distance.max()), float(distance[-1])


def turned(x: Array, gps: Array) -> Array:
    """Returns a path (K, 2) moved and turned as a whole next to that of GPS, by least squares
    (Kabsch, 1976)."""
    path, true = (one @ np.array([1.0, 1j]) for one in (x, gps))
    path, middle = path - path.mean(), true.mean()
    across = np.sum(path.conj() * (true - middle))
    path = middle + path * across / np.abs(across)
    return np.stack([path.real, path.imag], axis=1)


def compared(folder: Path, samples: Path = SAMPLES) -> pd.DataFrame:
    """Returns a row per tracker: errors of path and beacons in m, and the verdict on its
    innovations."""
    gps = pd.read_csv(samples / "plaza2_gps.csv")
    surveyed = pd.read_csv(samples / "plaza2_beacons.csv")
    said = json.loads((folder / "track.json").read_text(encoding="utf-8"))["trackers"]
    tracks, rows = pd.read_csv(folder / "track.csv"), []
    for label, track in tracks.groupby("tracker", sort=False):
        x = track[["x [m]", "y [m]"]].to_numpy()
        true = gps.iloc[:, 1:].to_numpy()
        rms, largest, end = errors(x, true)
        claimed = float(
            np.sqrt((track[["x_deviation [m]", "y_deviation [m]"]] ** 2).sum(axis=1).mean())
        )
        row = {"path rms": rms, "claimed": claimed, "turned": errors(turned(x, true), true)[0]}
        last, row = track.iloc[-1], {**row, "largest": largest, "last": end}
        for number, *place in surveyed.itertuples(index=False):
            at = [last[f"{axis}{number:.0f} [m]"] for axis in "xy"]
            row[f"beacon {number:.0f}"] = float(np.hypot(*np.subtract(at, place)))
        rows.append({"tracker": label, **row, "verdict": said[label]["verdict"]})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    found = pd.concat([compared(Path(folder)) for folder in sys.argv[1:]])
    print(found.round(2).to_string(index=False))
