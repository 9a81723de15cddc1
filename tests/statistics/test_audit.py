"""Foreign covariances: planted faults are named, honest reports are left in peace, and files are read or refused."""

import re

import numpy as np
import pandas as pd
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.statistics.audit import Claims, audit, read_claims


def claims(rng, runs=200, n=4, *, factor=1.0, law="normal", stretched=1.0):
    """Errors whose covariance is `factor` times smaller than reported; one direction has `stretched` the variance."""
    a = rng.standard_normal((n, n))
    covariance = a @ a.T / n + 0.3 * np.eye(n)
    s = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(s, s))
    root = (vectors * values**0.5) @ vectors.T
    v = np.zeros(n)
    v[0] = 1.0
    white = rng.standard_normal((runs, n)) @ (np.eye(n) + (np.sqrt(stretched) - 1) * np.outer(v, v))
    if law == "t5":
        white *= np.sqrt(3 / rng.chisquare(5, (runs, 1)))
    error = white @ root * s
    deviation = np.sqrt(factor) * s
    correlation = covariance / np.outer(s, s)
    shape = (runs, n, n)
    names = tuple("abcdefgh"[:n])
    return Claims(
        names, error, np.broadcast_to(deviation, (runs, n)), np.broadcast_to(correlation, shape), np.arange(runs)
    )


@pytest.mark.parametrize(("factor", "said"), [(0.5, "too small"), (2.0, "too large")])
def test_a_wrong_scale_is_said_first(factor, said):
    found = audit(claims(np.random.default_rng(1), factor=factor))
    assert said in found.sentences[0]
    assert found.scale.low < factor**-0.5 < found.scale.high
    assert len(found.sentences) == 1


@pytest.mark.parametrize("law", ["normal", "t5"])
def test_honest_reports_are_believed_or_left_open(law):
    rng = np.random.default_rng(2)
    false = 0
    for _ in range(100):
        first, *more = audit(claims(rng, law=law)).sentences
        wrong = "the covariance is too" in first
        false += wrong or any("tails" not in sentence or law == "normal" for sentence in more)
    assert false <= 11  # at most 5 % are; 12 of 100 would be a chance of 0.4 %


def test_a_planted_direction_is_named():
    rng = np.random.default_rng(3)
    told = [audit(claims(rng, stretched=3.0)).sentences for _ in range(10)]
    named = [s for sentences in told for s in sentences if s.startswith("In the worst direction")]
    assert len(named) >= 9
    factors = [float(re.search(r"errors are ([\d.]+) times", s)[1]) for s in named]
    assert all(1.4 < factor < 2.1 for factor in factors)  # the root of 3 is planted
    assert not any("tails" in s for sentences in told for s in sentences)


def test_heavy_tails_bias_and_trend_are_told_apart_from_scale():
    rng = np.random.default_rng(4)
    heavy = audit(claims(rng, runs=400, law="t5")).sentences
    assert any("heavier tails" in s for s in heavy)
    honest = claims(rng, runs=400)
    error = honest.error + np.array([0.5, 0, 0, 0]) * honest.deviation
    biased = audit(Claims(honest.names, error, honest.deviation, honest.correlation, honest.run))
    assert any(s.startswith("a is biased by +0.") for s in biased.sentences)
    late = np.linspace(0.3, 1.7, 400)
    error = honest.error * late[:, None]
    drifting = audit(Claims(honest.names, error, honest.deviation, honest.correlation, honest.run, {"time": late}))
    assert any("changes with time" in s for s in drifting.sentences)


def test_rows_of_one_run_count_once():
    """Ten equal rows a run are no more than one: the interval is that of the runs."""
    one = claims(np.random.default_rng(5), runs=60)
    parts = [np.repeat(part, 10, axis=0) for part in (one.error, one.deviation, one.correlation)]
    many = Claims(one.names, *parts, np.repeat(one.run, 10))
    first, second = audit(one).scale, audit(many).scale
    assert (first.low, first.high) == pytest.approx((second.low, second.high))


def frame(runs=50, seed=0):
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(runs, 2))
    estimate = truth + rng.multivariate_normal([0, 0], [[0.04, 0.03], [0.03, 0.09]], runs)
    columns = {"x_true": truth[:, 0], "y_true": truth[:, 1], "x": estimate[:, 0], "y": estimate[:, 1]}
    return pd.DataFrame(columns | {"x_std": 0.2, "y_var": 0.09, "cov_x_y": 0.03})


def test_wide_and_long_tables_are_the_same_claims(tmp_path):
    wide = frame()
    wide.to_csv(tmp_path / "wide.csv", index=False)
    rows = [
        {"run": i, "parameter": p, "true": row[f"{p}_true"], "estimate": row[p], "std": s}
        for i, row in wide.iterrows()
        for p, s in (("x", 0.2), ("y", 0.3))
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "long.csv", index=False)
    first, second = read_claims(tmp_path / "wide.csv"), read_claims(tmp_path / "long.csv")
    np.testing.assert_allclose(first.z, second.z)
    assert first.correlation is not None
    np.testing.assert_allclose(first.correlation[:, 0, 1], 0.5)
    assert second.correlation is None
    assert audit(first).table()["parameter"].tolist() == ["x", "y"]


def changed(**columns):
    return frame().assign(**columns)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (frame().drop(columns=["x_true", "y_true"]), "has no truth"),
        (frame().drop(columns="x"), "no column x with the estimates"),
        (frame().drop(columns="x_std"), "how sure x is"),
        (changed(cov_x_y=0.07), "row 2: the covariance is not positive definite"),
        (changed(x_std=0.0), "row 2: the deviation of x is not above 0"),
        (changed(run=1), "one log of dependent rows says too little"),
        (frame(5), "there are 5 independent runs"),
        (frame(200).drop(columns="cov_x_y").assign(x_std=0.2 * np.pi / 180), "the factor between degrees and radians"),
    ],
)
def test_wrong_tables_are_refused_in_one_line(table, said):
    with pytest.raises(UserError) as refused:
        audit(read_claims(table))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
