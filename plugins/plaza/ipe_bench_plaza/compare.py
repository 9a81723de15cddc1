"""Sets the tracks of `ipe-bench estimate state_model=plaza output=FOLDER` beside GPS and the surveyed beacons:

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
    """Returns root mean square, largest and last distance in m of a path (K, 2) from that of GPS."""
    distance = np.hypot(*(x - gps).T)
    return float(np.sqrt(np.mean(distance**2))), float(distance.max()), float(distance[-1])


def compared(folder: Path, samples: Path = SAMPLES) -> pd.DataFrame:
    """Returns a row per tracker: errors of path and beacons in m, and the verdict on its innovations."""
    gps = pd.read_csv(samples / "plaza2_gps.csv")
    surveyed = pd.read_csv(samples / "plaza2_beacons.csv")
    said = json.loads((folder / "track.json").read_text(encoding="utf-8"))["trackers"]
    tracks, rows = pd.read_csv(folder / "track.csv"), []
    for label, track in tracks.groupby("tracker", sort=False):
        x = track[["x [m]", "y [m]"]].to_numpy()
        rms, largest, end = errors(x, gps.iloc[:, 1:].to_numpy())
        last, row = track.iloc[-1], {"path rms": rms, "largest": largest, "last": end}
        for number, *place in surveyed.itertuples(index=False):
            at = [last[f"{axis}{number:.0f} [m]"] for axis in "xy"]
            row[f"beacon {number:.0f}"] = float(np.hypot(*np.subtract(at, place)))
        rows.append({"tracker": label, **row, "verdict": said[label]["verdict"]})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    print(compared(Path(sys.argv[1])).round(2).to_string(index=False))
