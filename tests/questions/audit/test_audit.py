"""Foreign covariances: planted faults are named, honest reports are left in peace, and files are
read or refused."""

import re

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import norm

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.questions import question_command
from ipe_bench.questions.audit.figure import MOST_POINTS, quantiles
from ipe_bench.questions.audit.maths import Claims, _tails, _worst_direction, audit, read_claims


def claims(rng, runs=200, n=4, *, factor=1.0, law="normal", stretched=1.0):
    """Errors whose covariance is `factor` times smaller than reported; one direction has
    `stretched` the variance."""
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
        names,
        error,
        np.broadcast_to(deviation, (runs, n)),
        np.broadcast_to(correlation, shape),
        np.arange(runs),
    )


@pytest.mark.parametrize(("factor", "said"), [(0.5, "too small"), (2.0, "too large")])
def test_a_wrong_scale_is_said_first(factor, said):
    found = audit(claims(np.random.default_rng(1), factor=factor))
    assert said in found.sentences[0]
    assert found.scale.low < factor**-0.5 < found.scale.high
    assert len(found.sentences) == 1


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_direction_is_named_as_a_combination_of_reported_deviations():
    """Errors of correlation C = [[1, .6], [.6, 1]] with the first whitened one three times too
    large: C^(-1/2) maps parameters to it by 1.19 and -.40."""
    rng, C = np.random.default_rng(6), np.array([[1.0, 0.6], [0.6, 1.0]])
    values, vectors = np.linalg.eigh(C)
    error = (rng.standard_normal((2000, 2)) * [3.0, 1.0]) @ ((vectors * values**0.5) @ vectors.T)
    found = audit(
        Claims(("a", "b"), error, np.ones_like(error), np.tile(C, (2000, 1, 1)), np.arange(2000))
    )
    (said,) = [s for s in found.sentences if s.startswith("In the worst direction")]
    assert float(re.search(r"a - ([\d.]+) b in reported", said)[1]) == pytest.approx(
        1 / 3, abs=0.05
    )


def test_heavy_tails_and_bias_are_told_apart_from_scale():
    rng = np.random.default_rng(4)
    heavy = audit(claims(rng, runs=400, law="t5")).sentences
    assert any("heavier tails" in s for s in heavy)
    honest = claims(rng, runs=400)
    error = honest.error + np.array([0.5, 0, 0, 0]) * honest.deviation
    biased = audit(Claims(honest.names, error, honest.deviation, honest.correlation, honest.run))
    assert any(s.startswith("a is biased by +0.") for s in biased.sentences)


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
    columns = {
        "x_true": truth[:, 0],
        "y_true": truth[:, 1],
        "x": estimate[:, 0],
        "y": estimate[:, 1],
    }
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


def test_a_file_is_read_to_the_last_digit(tmp_path):
    rng, file = np.random.default_rng(9), tmp_path / "runs.csv"
    error, deviation = rng.standard_normal((2, 1000)) * 10.0 ** rng.integers(-12, 12, (2, 1000))
    rows = [
        f"{a!r},{b!r}\n" for a, b in zip(error.tolist(), np.abs(deviation).tolist(), strict=True)
    ]
    file.write_text("x_error,x_std\n" + "".join(rows))
    found = read_claims(file)
    assert np.array_equal(found.error[:, 0], error)
    assert np.array_equal(found.deviation[:, 0], np.abs(deviation))


def changed(**columns):
    return frame().assign(**columns)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (frame().drop(columns=["x_true", "y_true"]), "has no truth"),
        (frame().drop(columns="x"), "no column x with the estimates"),
        (frame().drop(columns="x_std"), "has no deviation of x"),
        (changed(cov_x_y=0.07), "row 2: the covariance is not positive definite"),
        (changed(x_std=0.0), "row 2: the deviation of x is not above 0"),
        (changed(x_std="0,2"), "row 2, column x_std: '0,2' is not a number"),
        (changed(cov_y_x=0.01), "row 2: cov_x_y and cov_y_x differ"),
        (changed(y=frame()["y_true"]), "x, y are 0 in every run, or follow from one another"),
        (changed(run=1), "one log of dependent rows is too little evidence"),
        (frame(5), "there are 5 independent runs"),
        (changed(x_var=0.05), "row 2: x_std and x_var differ"),
        (changed(cov_y_y=[0.09] * 49 + [0.1]), "row 51: y_var and cov_y_y differ"),
        (pd.concat([frame(), frame()[["x_std"]]], axis=1), "column x_std is given twice"),
        (
            changed(x_std=np.inf, y_var=np.inf),
            "no row has an estimate with finite deviations of x, y",
        ),
        (
            pd.DataFrame({"x_error": np.linspace(-1, 1, 50) * 1e-300, "x_std": 0.2}),
            "errors of x are 0",
        ),
        (
            frame(200).drop(columns="cov_x_y").assign(x_std=0.2 * np.pi / 180),
            "the factor between degrees and radians",
        ),
    ],
)
def test_wrong_tables_are_refused_in_one_line(table, said):
    with pytest.raises(UserError) as refused:
        audit(read_claims(table))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("\n \n\n", "is empty"),
        (
            ";".join(f"p{i}_error;p{i}_std" for i in range(2049)),
            "has 4,098 columns; give at most 4,096",
        ),
        (
            "parameter,run,error,std\n" + "".join(f"p{i},1,1,1\n" for i in range(4097)),
            "has 4,097 parameters",
        ),
        ('x_error,x_std\n1,"2\n', "cannot be read as a table"),
    ],
    ids=["nothing", "blank lines", "columns", "parameters", "quotes"],
)
def test_files_without_a_table_or_with_too_large_a_one_are_refused(text, said, tmp_path):
    (tmp_path / "runs.csv").write_text(text)
    with pytest.raises(UserError, match=said):
        read_claims(tmp_path / "runs.csv")


def test_a_table_may_begin_with_blank_lines_and_have_4096_columns(tmp_path):
    (tmp_path / "runs.csv").write_text("\n\nx_error;x_std\n1.5;2\n")
    assert read_claims(tmp_path / "runs.csv").error.tolist() == [[1.5]]
    others = ",".join(f"c{i}" for i in range(4094))
    (tmp_path / "runs.csv").write_text(f"x_error,x_std,{others}\n{','.join(['1'] * 4096)}\n")
    assert read_claims(tmp_path / "runs.csv").names == ("x",)


def test_a_column_that_a_file_has_twice_is_refused(tmp_path):
    table = pd.concat([frame(), frame()[["x"]]], axis=1)
    table.to_csv(tmp_path / "runs.csv", index=False)
    with pytest.raises(UserError, match="column x is given twice"):
        read_claims(tmp_path / "runs.csv")
    named = pd.DataFrame(
        {"x_error": [0.1, 0.2], "x_std": 1.0, "x.1_error": [0.1, 0.3], "x.1_std": 1.0}
    )
    named.to_csv(tmp_path / "runs.csv", index=False)
    assert read_claims(tmp_path / "runs.csv").names == ("x", "x.1")


@pytest.mark.parametrize("far", [np.inf, -np.inf, 1e200, 1e307])
def test_an_infinite_error_is_the_worst_there_is(far, tmp_path):
    """Of 50 runs one: the covariance is too small, however well it suits the others."""
    table = frame()
    table.loc[3, "x"] = far
    found = audit(read_claims(table))
    assert found.verdict == "too small"
    assert "in 1 of 50 runs: the covariance is too small" in found.sentences[0]
    whole = audit(read_claims(table.drop(index=3)))
    assert found.sentences[1] == f"In the others: {whole.sentences[0]}"
    assert found.table()["covariance"].tolist() == ["too small", whole.each[1].verdict]
    assert found.claims.left_out == 0
    table.to_csv(tmp_path / "runs.csv", index=False)
    assert question_command("audit", [str(tmp_path / "runs.csv")]) == 1
    assert (
        audit(read_claims(table.head(15)))
        .sentences[0]
        .endswith("in 1 of 15 runs: the covariance is too small.")
    )


@pytest.mark.parametrize("far", [1e6, 1e11])
def test_errors_of_any_finite_size_have_a_factor(far):
    table = frame()
    table["x"] = table["x_true"] + far * np.linspace(-1, 1, 50) ** 3
    found = audit(read_claims(table))
    assert found.verdict == "too small"
    assert np.isfinite(found.each[0].value)


def test_the_farther_of_two_directions_counts_the_other_one():
    """Twice the share of own draws whose least eigenvalue is smaller, or whose largest is larger,
    than that found."""
    rng = np.random.default_rng(7)

    def ends(w):
        u = w / np.linalg.norm(w, axis=-1, keepdims=True)
        return np.linalg.eigvalsh(4 * np.swapaxes(u, -1, -2) @ u / 60)[..., [0, -1]]

    drawn = ends(rng.standard_normal((4000, 60, 4)))
    shares = []
    for _ in range(8):
        one = claims(rng, 60, 4)
        least, most = ends(one.w)
        share = min(np.mean(drawn[:, 0] <= least), np.mean(drawn[:, 1] >= most))
        assert _worst_direction(one)[0] == pytest.approx(min(1.0, 2 * share), abs=0.1)
        shares.append(share)
    assert min(shares) < 0.4


def test_tails_of_any_of_eight_parameters_are_found_by_chance_as_often_as_those_of_one():
    """Of eight parameters without covariances one has a p below .1 in .57 of cases."""
    rng, ones = np.random.default_rng(8), np.ones((60, 8))
    drawn = [
        Claims(tuple("abcdefgh"), rng.standard_normal((60, 8)), ones, None, np.arange(60))
        for _ in range(100)
    ]
    p = np.array([_tails(one)[0] for one in drawn])
    assert np.mean(p <= 0.1) <= 0.1 + 3 * np.sqrt(0.1 * 0.9 / 100)


# One verdict --------------------------------------------------------------------------------------


def test_sentence_verdict_and_exit_code_say_the_same(tmp_path, capsys):
    """Near the edge of the interval, where a test of the scale alone refuses more reports than the
    sentences do."""
    rng, seen = np.random.default_rng(0), set()
    for _ in range(20):
        table = pd.DataFrame({"x_error": rng.normal(0, 1, 60), "x_std": 0.78})
        table.to_csv(tmp_path / "runs.csv", index=False)
        found = audit(read_claims(table))
        wrong = found.verdict in ("too small", "too large")
        assert (f"the covariance is {found.verdict}" in found.sentences[0]) == wrong
        assert wrong == (not found.scale.low <= 1 <= found.scale.high)
        assert (
            [f.verdict for f in found.each]
            == [found.verdict]
            == found.table()["covariance"].tolist()
        )
        assert question_command("audit", [str(tmp_path / "runs.csv")]) == wrong
        assert found.sentences[0] in " ".join(capsys.readouterr().out.split())
        seen.add(found.verdict)
    assert {"too small", "undecided"} <= seen


# A bundle adjustment ------------------------------------------------------------------------------

SIGMA = 0.5
"""Standard deviation of the image points in pixels."""
POINTS = np.array(
    [
        [-1, -1, 5],
        [1, -1, 6],
        [1, 1, 5],
        [-1, 1, 7],
        [0.3, -0.4, 4],
        [-0.5, 0.2, 6.5],
        [0.8, 0.1, 5.5],
    ]
)
CENTRES = np.array([[-1.0, 0.0, 0.0], [1.0, 0.2, 0.0]])
KNOWN = 3
"""Control points, which fix where the scene stands, how it is turned, and its size."""


def bundle_adjustments(runs: int, assumed: float, seed: int) -> pd.DataFrame:
    """Errors of the first camera's rotation over simulated images of two cameras, and the
    covariance (J' J)^-1 of residuals that are divided by `assumed`: what a solver reports that
    takes them for independent of variance 1.

    A rotation's error is the rotation vector from the true to the estimated one, in which the
    solver steps, too.
    """

    def images(x: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(x[:6].reshape(2, 3))
        points = np.vstack([POINTS[:KNOWN], x[12:].reshape(-1, 3)])
        seen = [
            one.apply(points - centre)
            for one, centre in zip(turned, x[6:12].reshape(2, 3), strict=True)
        ]
        return np.concatenate([(500 * p[:, :2] / p[:, 2:]).ravel() for p in seen])

    truth = np.concatenate([np.zeros(6), CENTRES.ravel(), POINTS[KNOWN:].ravel()])
    rng, exact, rows = np.random.default_rng(seed), images(truth), []
    for _ in range(runs):
        z = exact + rng.normal(0, SIGMA, len(exact))
        found = least_squares(lambda x, z=z: (images(x) - z) / assumed, truth, method="lm")
        P = np.linalg.inv(found.jac.T @ found.jac)
        row = {f"r{a}_error": found.x[i] for i, a in enumerate("xyz")}
        rows.append(
            row
            | {f"cov_r{a}_r{b}": P[i, j] for i, a in enumerate("xyz") for j, b in enumerate("xyz")}
        )
    return pd.DataFrame(rows)


@pytest.mark.slow
def test_a_bundle_adjustment_in_pixels_reports_the_covariance_of_errors_of_one_pixel():
    """The question of users of such solvers: 'the covariance is larger than that of a Monte Carlo
    simulation'. The residuals were in pixels, and the image points half a pixel wrong; divided by
    that, it is right."""
    found = audit(read_claims(bundle_adjustments(200, assumed=1.0, seed=1)))
    assert found.verdict == "too large"
    assert found.scale.low < SIGMA < found.scale.high
    assert found.sentences[0].startswith("True errors are only 0.")
    assert found.sentences[0].endswith("the covariance is too large.")
    assert len(found.sentences) == 1  # neither direction, bias nor tails: a factor mends it
    whitened = audit(read_claims(bundle_adjustments(200, assumed=SIGMA, seed=2)))
    assert whitened.verdict not in ("too small", "too large")
    assert whitened.scale.low < 1 < whitened.scale.high
    assert len(whitened.sentences) == 1


def test_drawn_quantiles_are_those_of_the_normal_law_and_infinite_errors_keep_their_ranks():
    rng = np.random.default_rng(0)
    z = np.append(2.0 * rng.standard_normal(197), [np.inf, -np.inf, np.inf])
    expected, errors = quantiles(z)
    ranks = (np.arange(200) + 0.5) / 200
    np.testing.assert_allclose(expected, norm.ppf(ranks)[1:-2])
    np.testing.assert_array_equal(errors, np.sort(z[np.isfinite(z)]))
    # Of many errors the extremes are among those that are drawn.
    many = rng.standard_normal(50_000)
    expected, errors = quantiles(many)
    assert len(errors) <= MOST_POINTS
    assert {many.min(), many.max()} <= set(errors)
    assert np.abs(errors - expected)[5:-5].max() < 0.3


@pytest.mark.parametrize("lost", [np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("rows", [4, 40])
def test_a_parameter_with_infinite_errors_is_the_worst_and_has_a_page(tmp_path, lost, rows):
    """In some runs, and in all, where nothing is left to draw of it."""
    errors = np.random.default_rng(0).standard_normal((40, 2)) * [1.0, 3.0]
    errors[:rows, 0] = lost
    columns = {"a_error": errors[:, 0], "b_error": errors[:, 1], "a_std": 1.0, "b_std": 1.0}
    found = ib.audit(pd.DataFrame(columns), output=tmp_path)
    assert "Worst parameter: errors of a are infinite in some runs." in found.facts()
    assert f"in {rows} of 40 runs" in str(found)
    assert "nan" not in str(found)
    assert (tmp_path / "audit.html").is_file()


def test_an_undecided_audit_of_enough_runs_does_not_call_them_too_few():
    """An interval from 1.00 to 1.10 leaves both open, although 1000 runs would detect 1.10."""
    error = 1.05 * norm.ppf((np.arange(1000) + 0.5) / 1000)[:, None]
    found = audit(Claims(("a",), error, np.ones((1000, 1)), None, np.arange(1000)))
    assert found.verdict == "undecided"
    assert found.sentences[0].endswith(
        "1000 runs show neither that the covariance is right nor that it is wrong."
    )


def long_table(changed):
    """Returns 25 runs of two parameters, with some rows as they are `changed`."""
    rows = {(run, p): f"{run},{p},0,{run - 12.0},8" for run in range(25) for p in "ab"}
    return "\n".join(["run,parameter,true,estimate,std", *(rows | changed).values(), ""])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({(3, "b"): "3,b,0,1,-1"}, "run 3: the deviation of b is not above 0"),
        ({(3, "b"): "3,b,0,1,x"}, "row 9, column std: 'x' is not a number"),
        ({(3, "b"): "3,,0,1,8"}, "row 9: has no parameter"),
    ],
)
def test_an_error_names_the_run_or_the_row_of_a_long_table(tmp_path, changed, said):
    path = tmp_path / "long.csv"
    path.write_text(long_table(changed))
    with pytest.raises(UserError, match=said):
        read_claims(path)


@pytest.mark.parametrize(
    "changed",
    [
        {(0, "a"): ",a,0,1,8", (0, "b"): ",b,0,1,8"},
        {(0, "a"): "0,a,,,", (0, "b"): "0,b,,,"},
        {(0, "a"): "0,a,0,,", (0, "b"): "0,b,0,,"},
    ],
    ids=["no run", "nothing at all", "no estimate"],
)
def test_a_run_of_a_long_table_that_says_nothing_is_counted(tmp_path, changed):
    path = tmp_path / "long.csv"
    path.write_text(long_table(changed))
    found = read_claims(path)
    assert (found.runs, found.left_out) == (24, 1)
    assert found.names == ("a", "b")


def test_rows_of_a_wide_table_without_a_run_are_left_out_and_not_one_run():
    runs = [None, None, *range(20)]
    found = read_claims(pd.DataFrame({"run": runs, "a_error": np.arange(22.0), "a_std": 8.0}))
    assert (found.runs, found.left_out) == (20, 2)


@pytest.mark.parametrize("separator", [",", ";", "\t", "|", " "])
def test_a_header_is_split_at_separators_alone(tmp_path, separator):
    """Letters and underscores repeat as evenly in a header as its separator does."""
    path = tmp_path / "claims.csv"
    lines = [("run", "k_true", "k", "k_std"), *((str(i), "0", "1", "2") for i in range(20))]
    path.write_text("\n".join(map(separator.join, lines)))
    found = read_claims(path)
    assert (found.names, found.runs) == (("k",), 20)
