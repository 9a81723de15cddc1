"""Models that are Python functions: beside the same law as a formula, by all ways to slopes, and
with mistakes."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit, least_squares
from shared.slopes import differentiate

import ipe_bench as ib
from ipe_bench.cli.main import main
from ipe_bench.measurements import Formula, function
from ipe_bench.runs.provenance import fingerprint
from ipe_bench.runs.store import _about

T = np.linspace(0.1, 4.0, 25)
LAW = """
from typing import Annotated
import math
import warnings
import numpy as np
from scipy.integrate import odeint

TIMES = []

def swing(t, length: Annotated[float, "m"] = 1.2, damping=0.1, *, g=9.80665):
    return np.exp(-damping * t / 2) * np.cos(np.sqrt(g / length) * t)

def by_math(t, length=1.2, damping=0.1):
    w = math.sqrt(9.80665 / length)
    return np.array([math.exp(-damping * s / 2) * math.cos(w * s) for s in t])

def absolute(t, k=0.7):
    return np.abs(np.sin(k * t))

def bell(t, height, centre, width, base):
    return height * np.exp(-0.5 * ((t - centre) / width) ** 2) + base

def high_by_abs(t, height=2.0, centre=1.5, width=0.5, base=0.3):
    y = bell(t, height, centre, width, base)
    return np.where(y > 2.5, np.abs(y), y)

def high_by_array(t, height=2.0, centre=1.5, width=0.5, base=0.3):
    y = bell(t, height, centre, width, base)
    z = np.empty(len(t), dtype=y.dtype if height.real < 2.5 else float)
    z[:] = y
    return z

def faint(t, height=2e-6, base=0.0):
    return base + np.exp(-t) * (height if height.real < 2.5e-6 else np.abs(height))

def rounded(t, a=2.3, b=1.5):
    return np.round(a * t) + b * t

def two_columns(t, k=1.0):
    return np.outer(t, [k, k])

def shrinking(t, k=1.0):
    return np.exp(-k * t)[: None if k == 1.0 else 5]

def scribbling(t, k=1.0):
    t *= k.real
    return np.exp(-t)

def leaving(t, k=1.0):
    if k != 1.0:
        raise SystemExit(3)
    return k * t

def integrated(t, a=2.0, b=0.8):
    TIMES.append(b)
    return odeint(lambda y, s: -b * y * (1 - 0.1 * y), a, np.append(0.0, t))[1:, 0]

def single(t, a=2.0, b=0.8):
    t = np.float32(t)
    return np.float32(a) * np.exp(-np.float32(b) * t)

def warning(t, k=1.0):
    warnings.warn("a long way", UserWarning)
    return k.real * t

def of_a_date(t, a=2.0, b=1.0):
    return a * np.exp(-b * t)

def silent(t, k=1.0):
    k * t

def no_parameter(t):
    return t

def text(t, k="a"):
    return t

def starred(t, *rest):
    return t

def needs(t, k=1.0, *, g):
    return g * k * t

def fix(east, north, x=3.0, y=4.0):
    return np.sqrt((x - east)**2 + (y - north)**2), np.angle(x - east + 1j * (y - north))

def pair(t, k=1.0):
    return np.exp(-k * t), k * t

def boom(t, k=1.0):
    return np.expp(-k * t)
"""
JAX = """
import jax.numpy as np

def swing(t, length=1.2, damping=0.1, *, g=9.80665):
    return np.exp(-damping * t / 2) * np.cos(np.sqrt(g / length) * t)

def pair(t, k=1.0):
    return np.exp(-k * t), k * t
"""


@pytest.fixture
def laws(tmp_path, monkeypatch):
    """A module of laws in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "some_laws.py").write_text(LAW)
    (tmp_path / "some_jax_laws.py").write_text(JAX)
    yield tmp_path
    for name in ("some_laws", "some_jax_laws"):
        sys.modules.pop(name, None)


def model(name, **options):
    return ib.measurements.Function(of=f"some_laws:{name}", columns={"t": T.tolist()}, **options)


def formula():
    text = "exp(-damping*t/2)*cos(sqrt(9.80665/length)*t)"
    return Formula(text, {"damping": 0.1, "length": 1.2}, {"t": T.tolist()})


def test_a_function_is_the_model_that_its_formula_is(laws):
    ours, beside = model("swing"), formula()
    x = ours.nominal + 0.2 * np.random.default_rng(0).standard_normal((9, 2))
    np.testing.assert_allclose(
        ours.simulate(x), beside.simulate(x[:, ::-1]), rtol=1e-14, atol=1e-14
    )
    np.testing.assert_allclose(
        ours.jacobian(x), beside.jacobian(x[:, ::-1])[:, :, ::-1], rtol=1e-12, atol=1e-12
    )
    assert [(p.name, p.unit, p.size) for p in ours.parameters] == [
        ("length", "m", 1.2),
        ("damping", "", 0.1),
    ]
    assert ours.jacobian_cost == 2.0 + 3.0
    assert len(ours.epochs) == len(T)


@pytest.mark.parametrize(("name", "cost"), [("by_math", 13.0), ("absolute", 7.0)])
def test_slopes_are_differences_where_the_complex_step_is_wrong(laws, name, cost):
    ours = model(name)
    x = ours.nominal[None] * 1.05
    expected = differentiate(ours.simulate, x, analytic=False)
    np.testing.assert_allclose(ours.jacobian(x), expected, rtol=1e-6, atol=1e-8)
    assert ours.jacobian_cost == cost


@pytest.mark.parametrize("name", ["high_by_abs", "high_by_array"])
def test_an_estimate_is_right_in_a_branch_that_the_start_is_not_in(laws, name):
    z = (
        3.0 * np.exp(-0.5 * ((T - 1.5) / 0.5) ** 2)
        + 0.3
        + np.random.default_rng(2).normal(0, 0.03, len(T))
    )
    (laws / "bell.csv").write_text(
        "t,reading\n" + "".join(f"{t},{value}\n" for t, value in zip(T, z, strict=True))
    )
    import some_laws

    law = getattr(some_laws, name)
    (fit,) = ib.estimate(function(law), "bell.csv", {"auto": ib.solvers.Auto()})
    expected, covariance = curve_fit(
        some_laws.bell, T, z, p0=[3.0, 1.5, 0.5, 0.3], xtol=1e-12, ftol=1e-12
    )
    np.testing.assert_allclose(fit.x, expected, rtol=1e-6)
    np.testing.assert_allclose(
        np.sqrt(np.diag(fit.covariance)), np.sqrt(np.diag(covariance)), rtol=1e-4
    )


@pytest.mark.parametrize("name", ["high_by_abs", "high_by_array"])
def test_slopes_of_a_trial_in_a_branch_that_is_not_analytic_do_not_depend_on_others(laws, name):
    ours = model(name)
    x = ours.nominal + np.array([[0.0], [0.5]]) * np.array([1.0, 0.0, 0.0, 0.0])
    J = ours.jacobian(x)
    exact = ib.measurements.Function(
        of="some_laws:bell", columns={"t": T}, start=ours.starts
    ).jacobian(x)
    np.testing.assert_allclose(J[0], exact[0], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(J[1], exact[1], atol=1e-8)
    assert all(np.array_equal(J[i : i + 1], ours.jacobian(x[i : i + 1])) for i in range(2))


def test_a_wrong_slope_shows_beside_one_that_is_much_larger(laws):
    expected = np.stack([2e-6 * np.exp(-T), np.ones_like(T)], axis=-1)
    np.testing.assert_allclose(
        model("faint").jacobian(np.array([[1.5, 0.0]]))[0], expected, rtol=1e-9, atol=1e-13
    )


def test_a_function_in_jax_has_the_slopes_of_the_one_in_numpy_in_every_batch(laws):
    pytest.importorskip("jax")
    ours = ib.measurements.Function(of="some_jax_laws:swing", columns={"t": T.tolist()})
    x = ours.nominal + 0.2 * np.random.default_rng(0).standard_normal((19, 2))
    np.testing.assert_allclose(ours.jacobian(x), model("swing").jacobian(x), rtol=1e-11, atol=1e-11)
    assert np.array_equal(ours.jacobian(x)[11:12], ours.jacobian(x[11:12]))


def test_options_set_starts_sizes_units_constants_and_order(laws):
    ours = model(
        "swing",
        start={"damping": 0.5},
        size={"length": 0.1},
        units={"damping": "1/s"},
        constants={"g": 1.6},
    )
    np.testing.assert_allclose(ours.nominal, [12.0, 1.0])
    assert [p.unit for p in ours.parameters] == ["m", "1/s"]
    np.testing.assert_allclose(
        ours.simulate(ours.nominal[None])[0], np.exp(-T / 4) * np.cos(np.sqrt(1.6 / 1.2) * T)
    )
    assert model("swing", time="").epochs is None


def test_results_of_another_function_are_stale(laws):
    (laws / "changed_laws.py").write_text(LAW.replace("damping * t / 2", "damping * t / 3"))
    changed = ib.measurements.Function(of="changed_laws:swing", columns={"t": T.tolist()})
    assert fingerprint([changed])["source"] != fingerprint([model("swing")])["source"]


def test_readings_of_a_file_give_the_parameters_back(laws):
    z = np.exp(-0.15 * T / 2) * np.cos(np.sqrt(9.80665 / 1.1) * T) + np.random.default_rng(
        1
    ).normal(0, 0.01, len(T))
    rows = "\n".join(f"{t},{value}" for t, value in zip(T, z, strict=True))
    (laws / "swing.csv").write_text(f"t,reading\n{rows}\n")
    import some_laws

    answer = ib.estimate(function(some_laws.swing), "swing.csv")
    fit = {fit.label: fit for fit in answer}["auto"]
    deviations = np.sqrt(np.diag(fit.covariance))
    assert (np.abs(fit.x - [1.1, 0.15]) < 4 * deviations).all()
    assert (deviations < [0.01, 0.05]).all()


@pytest.mark.parametrize(
    ("of", "options", "said"),
    [
        ("some_laws", {}, "give MODULE:FUNCTION"),
        ("../laws:f", {}, "give MODULE:FUNCTION"),
        ("x/laws:f", {}, "without the folder of the file"),
        ("nowhere:h", {}, "there is no module nowhere here"),
        ("some_laws:swung", {}, "did you mean swing?"),
        ("some_laws:no_parameter", {}, "has no parameter"),
        ("some_laws:text", {}, "the default of k is no number"),
        ("some_laws:starred", {}, "takes *rest; give every argument a name"),
        ("some_laws:needs", {}, "constants.g: some_laws:needs needs it"),
        (
            "some_laws:swing",
            {"start": {"lenght": 1.0}},
            "start.lenght: there is no such argument; did you mean len",
        ),
        (
            "some_laws:swing",
            {"size": {"lenght": 1.0}},
            "size: lenght is not a parameter; did you mean length?",
        ),
        ("some_laws:swing", {"constants": {"h": 1.0}}, "constants.h: "),
        ("some_laws:swing", {"time": "s"}, "time=s: "),
    ],
)
def test_a_mistake_is_one_line(laws, of, options, said):
    with pytest.raises(ib.UserError) as refused:
        ib.measurements.Function(of=of, columns={"t": T.tolist()}, **options)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["two_columns", "shrinking"])
def test_another_shape_is_refused_by_the_function_s_name(laws, name):
    with pytest.raises(
        ib.UserError, match=f"measurement.of=some_laws:{name}: returns an array of shape"
    ):
        model(name).simulate(np.array([[1.0], [1.1]]))


def test_a_forgotten_return_is_said(laws):
    with pytest.raises(ib.UserError, match="returns nothing; let it return one number per"):
        model("silent").simulate(np.array([[1.0], [1.1]]))


def test_a_report_introduces_a_function_without_the_example_of_its_class(laws):
    assert _about(model("swing")) == (
        "Computes z = h(parameters, columns), for a function h of a Python file"
    )


def test_what_the_function_raises_is_one_line_with_its_place(laws, capsys):
    line = LAW.splitlines().index("    return np.expp(-k * t)") + 1
    words = [
        "measurement=function",
        "measurement.of=some_laws:boom",
        "measurement.columns.t=[0,1,2]",
    ]
    assert (
        main(["run", *words, "noise=gaussian", "noise.deviation=0.01", "trials=2", "figures=none"])
        == 2
    )
    said = (
        f"measurement.of=some_laws:boom: some_laws.py, line {line}: AttributeError: module 'numpy'"
        " has no attribute"
    )
    assert capsys.readouterr().err.startswith(f"ipe-bench: {said} 'expp'")
    assert main(["check", *words[:2]]) == 2
    assert capsys.readouterr().err.startswith(f"ipe-bench: {said} 'expp'")


@pytest.mark.parametrize(
    ("name", "line", "said"),
    [
        (
            "scribbling",
            "t *= k.real",
            "ValueError: output array is read-only (it writes into what it is given",
        ),
        ("leaving", "raise SystemExit(3)", "SystemExit: 3"),
    ],
)
def test_a_function_that_writes_into_a_column_or_ends_the_process_is_refused_with_its_place(
    laws, capsys, tmp_path, name, line, said
):
    (tmp_path / "some.csv").write_text("t,reading\n0,1.0\n1,0.4\n2,0.1\n", encoding="utf-8")
    words = [
        "measurement=function",
        f"measurement.of=some_laws:{name}",
        "readings=some.csv",
        "noise.deviation=0.1",
    ]
    assert main(["estimate", *words]) == 2
    (number,) = (i for i, text in enumerate(LAW.splitlines(), 1) if text.strip() == line)
    expected = f"ipe-bench: measurement.of=some_laws:{name}: some_laws.py, line {number}: {said}"
    assert capsys.readouterr().err.startswith(expected)


def test_a_function_inside_another_is_refused():
    with pytest.raises(ib.UserError, match="that a module defines under its own name"):
        function(lambda t, k=1.0: k * t)


@pytest.mark.parametrize(
    ("kind", "file", "choice"),
    [
        (
            "function",
            "decay.py",
            ["measurement=function", "measurement.of=decay:decay", "measurement.columns.t=[0,1,2]"],
        ),
        ("ode", "decay.yaml", ["measurement=ode", "measurement.file=decay.yaml"]),
    ],
)
def test_a_new_model_of_one_file_runs_as_it_stands(laws, capsys, kind, file, choice):
    assert main(["new", kind, "decay"]) == 0
    said = capsys.readouterr().out
    assert all(word in said for word in choice[:2])
    assert main(["new", kind, "decay"]) == 2
    assert f"{file}: is there already" in capsys.readouterr().err
    noise = ["noise=gaussian", "noise.deviation=0.01"]
    assert (
        main(
            [
                "run",
                *choice,
                *noise,
                "error_scale=0.1",
                "trials=5",
                "figures=none",
                "execution=serial",
            ]
        )
        == 0
    )
    sys.modules.pop("decay", None)


def test_parameters_of_which_readings_are_constant_in_pieces_are_named(laws):
    (said,) = model("rounded").remarks(model("rounded").nominal)
    assert said.startswith("readings do not change with small changes of a, but with larger ones")
    assert model("swing").remarks(model("swing").nominal) == ()


def test_slopes_of_an_integrator_take_few_calls_and_are_booked(laws):
    ours = model("integrated")
    x = ours.nominal + np.random.default_rng(5).uniform(-0.3, 0.3, (40, 2))
    ours.jacobian(x[:1])
    import some_laws

    some_laws.TIMES.clear()
    J = ours.jacobian(x)
    assert len(some_laws.TIMES) == ours.jacobian_cost * len(x) == 5.0 * len(x)

    def logistic(x):
        a, b = (x * ours.sizes).T[..., None]
        g = np.exp(-b * T)
        return a * g / (1 - 0.1 * a * (1 - g))

    exact = differentiate(logistic, x, analytic=True)
    assert (np.abs(J - exact) <= 2e-5 * np.abs(exact).max(axis=1, keepdims=True)).all()
    assert all(np.array_equal(J[i : i + 1], ours.jacobian(x[i : i + 1])) for i in (0, 7))


def test_slopes_in_single_precision_are_found_and_named(laws):
    ours = model("single")
    (said,) = ours.remarks(ours.nominal)
    assert said.endswith("it computes in single precision (float32); compute in float64")
    J = ours.jacobian(ours.nominal[None])[0] / ours.sizes
    g = np.exp(-0.8 * T)
    np.testing.assert_allclose(J, np.stack([g, -2 * T * g], axis=-1), atol=1e-4)


def test_why_complex_steps_fail_is_said_only_where_it_is_known(laws):
    (said,) = model("by_math").remarks(model("by_math").nominal)
    assert said.endswith("as it takes no complex numbers (ComplexWarning)")
    (said,) = model("absolute").remarks(model("absolute").nominal)
    assert said.endswith("as complex steps find other slopes")


def test_a_warning_of_a_function_is_given_once(laws):
    ours = model("warning")
    x = np.repeat(ours.nominal[None], 3, axis=0)
    with pytest.warns(UserWarning, match="a long way") as given:
        ours.jacobian(x)
    assert len(given) == 1


def test_a_column_far_from_0_is_named_where_readings_do_not_change(laws):
    ours = ib.measurements.Function(of="some_laws:of_a_date", columns={"t": 2460000.5 + T})
    (said,) = ours.remarks(ours.nominal)
    assert "t is far from 0: subtract 2460000 from it" in said


# A tuple of arrays


def fixes(tmp_path):
    """Ranges and bearings to a point from twelve places, one of which sees it across the cut."""
    rng = np.random.default_rng(4)
    places = rng.uniform(-5, 5, (12, 2))
    places[0] = 7.0, 4.4
    x, y = (np.array([2.5, 4.4]) - places).T
    ranges = np.hypot(x, y) + rng.normal(0, 0.1, 12)
    bearings = np.angle(np.exp(1j * (np.arctan2(y, x) + rng.normal(0, 0.02, 12))))
    bearings[0] = -np.pi + 0.01
    rows = np.column_stack([places, ranges, bearings])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    path = tmp_path / "fixes.csv"
    path.write_text("\n".join(["east,north,range,bearing", *lines]) + "\n")
    return path, rows


def test_ranges_and_bearings_of_one_function_are_fitted_as_by_scipy(laws):
    path, rows = fixes(laws)
    east, north, ranges, bearings = rows.T

    def residuals(p):
        x, y = p[0] - east, p[1] - north
        turned = np.angle(np.exp(1j * (np.arctan2(y, x) - bearings)))
        return np.concatenate([(np.hypot(x, y) - ranges) / 0.1, turned / 0.02])

    found = least_squares(residuals, [3.0, 4.0], "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    law = ib.measurements.Function(
        of="some_laws:fix", outputs=("range", "bearing"), circular=("bearing",)
    )
    noise = ib.noise.Gaussian(tuple([0.1, 0.02] * 12))
    lm = {"lm": ib.baselines.LevenbergMarquardt()}
    fit = ib.estimate(law, path, lm, noise=noise, examine=False)[0]
    expected = np.linalg.inv(found.jac.T @ found.jac)
    np.testing.assert_allclose([fit.values[name] for name in "xy"], found.x, rtol=1e-8)
    np.testing.assert_allclose(fit.covariance, expected, rtol=1e-6)


def test_outputs_that_share_no_unit_have_a_deviation_and_a_level_each(laws):
    """The means of two columns: their deviations are those of NumPy."""
    (laws / "means.py").write_text("def h(t, a=1.0, b=1.0):\n    return a + 0 * t, b + 0 * t\n")
    rng = np.random.default_rng(2)
    long = 500 + 30 * rng.normal(size=9)
    angle = 20 + 0.1 * rng.normal(size=9)
    rows = [
        f"{k},{d!r},{a!r}"
        for k, (d, a) in enumerate(zip(long.tolist(), angle.tolist(), strict=True))
    ]
    table = laws / "means.csv"
    table.write_text("\n".join(["t,long [m],angle [deg]", *rows]) + "\n")
    law = ib.measurements.Function(
        of="means:h", outputs=("long", "angle"), unit="deg", circular=("angle",)
    )
    lm = {"lm": ib.baselines.LevenbergMarquardt()}
    noise = ib.noise.Unknown(by="output")
    (fit,) = ib.estimate(law, table, lm, noise=noise, examine=False)
    expected = {"long": np.std(long, ddof=1), "angle": np.std(angle, ddof=1)}
    assert fit.residual_deviations == pytest.approx(expected)
    units = {p.name: p.unit for p in fit.model.physical_parameters}
    assert units == {"a": "", "b": "", "sigma_long": "", "sigma_angle": "deg"}
    named = replace(law, circular=("long", "angle"))
    assert {named.unit_of("long"), named.reading_unit} == {"deg"}


@pytest.mark.parametrize("of", ["some_laws:pair", "some_jax_laws:pair"])
def test_readings_of_a_tuple_stand_row_by_row(laws, of):
    if "jax" in of:
        pytest.importorskip("jax")
    law = ib.measurements.Function(of=of, columns={"t": [0.5, 2.0]}, outputs=("decay", "line"))
    assert law.index["output"] == ("decay", "line", "decay", "line")
    np.testing.assert_allclose(
        law.simulate(np.array([[3.0]])), [[np.exp(-1.5), 1.5, np.exp(-6), 6]], rtol=1e-12
    )
    slopes = [[[-0.5 * np.exp(-1.5)], [0.5], [-2 * np.exp(-6)], [2.0]]]
    np.testing.assert_allclose(law.jacobian(np.array([[3.0]])), slopes, rtol=1e-9)


def test_a_function_of_a_tuple_is_told_each_row_once(laws):
    (laws / "summed.py").write_text(
        "import numpy as np\ndef h(t, k=2.0):\n    return k * np.cumsum(t), [k * u for u in t]\n"
    )
    table = laws / "summed.csv"
    table.write_text("t,total,each\n1,2,2\n2,6,4\n2,10,4\n3,16,\n")
    law = ib.measurements.Function(of="summed:h", outputs=("total", "each"))
    fit = ib.estimate(law, table, {"lm": ib.baselines.LevenbergMarquardt()}, examine=False)[0]
    np.testing.assert_allclose(fit.residuals[:7], 0.0, atol=1e-12)
    below = replace(law, columns={"t": [1, 2, 2, 1, 2]}, output=("total",) * 3 + ("each",) * 2)
    np.testing.assert_allclose(below.simulate(below.nominal[None]), [[2, 6, 10, 2, 4]])


@pytest.mark.parametrize(
    ("of", "options", "said"),
    [
        ("pair", {"outputs": ("a", "b", "c")}, "outputs names 3 arrays; let it return a tuple"),
        ("swing", {"outputs": ("a", "b")}, "outputs names 2 arrays; let it return a tuple"),
        ("pair", {"outputs": ("a", "b"), "circular": ("c",)}, "circular=c: there is no such"),
        ("pair", {}, "returns an array of shape"),
    ],
)
def test_a_tuple_that_is_not_that_of_the_outputs_is_refused(laws, of, options, said):
    with pytest.raises(ib.UserError, match=said):
        model(of, **options).simulate(np.array([[1.0]]))
