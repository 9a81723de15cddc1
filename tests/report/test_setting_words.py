"""Settings are worded with units, and the right model is the one that estimators assume."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pandas as pd

import ipe_bench as ib
from ipe_bench.measurements import Gins, RicherGins
from ipe_bench.report.tables.settings import Wording
from ipe_bench.runs.provenance import describe

TRUTHS = (
    ({}, None),
    ({"truth": "Gins", "truth.latitude_deg": 36.35}, Gins()),
    ({"truth": "Gins", "truth.latitude_deg": 50.0}, Gins(latitude_deg=50.0)),
    ({"truth": "RicherGins", "truth.gyro_random_walk": 0.001}, RicherGins(gyro_random_walk=0.001)),
    (
        {"truth": "RicherGins", "truth.platform_misalignment": 5.0, "truth.gyro_random_walk": 0.0},
        RicherGins(platform_misalignment=5.0),
    ),
)


def worded(measurement: Any) -> list[str]:
    """Words a setting of each truth, as estimators see it who assume that model."""
    columns = [{"measurement": "gins", **own} for own, _ in TRUTHS]
    scenarios = [ib.Scenario(measurement, truth=truth) for _, truth in TRUTHS]
    groups: Any = [
        SimpleNamespace(columns=own, footer={"identity": {"scenario": describe(scenario)}})
        for own, scenario in zip(columns, scenarios, strict=True)
    ]
    rows = pd.DataFrame(columns)
    collection: Any = SimpleNamespace(groups=groups)
    wording = Wording.of(collection)
    settings = wording.settings(rows.to_dict("records"), list(rows.columns))
    assert [wording.is_right(row) for row in columns] == [s == "right model" for s in settings]
    return settings


def test_the_right_model_is_the_one_that_estimators_assume_and_units_stand_at_errors():
    assert worded(Gins()) == [
        "right model",
        "right model",
        "truth=Gins, truth.latitude_deg=50",
        "gyro random walk 0.001 deg/h/√h",
        "platform misalignment 5 arc seconds",
    ]


def test_a_model_of_the_same_class_with_other_options_is_not_right():
    assert worded(Gins(latitude_deg=50.0))[:3] == [
        "right model",
        "truth=Gins, truth.latitude_deg=36.35",
        "right model",
    ]
