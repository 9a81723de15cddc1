"""What to measure next: brute force, closed forms, and the Monte Carlo that a designed model is put
to."""

import re
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from shared.oracles import agreed, assert_agrees

import ipe_bench as ib
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.measurements import Gins, Measurement, Parameter, RicherGins
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.noise import Gaussian
from ipe_bench.plugins.extensions import richer_models
from ipe_bench.priors import GaussianPrior
from ipe_bench.questions.design.answer import (
    READINGS,
    _findings,
    _further,
    design_parts,
    write_design,
)
from ipe_bench.questions.design.figure import draw_further
from ipe_bench.questions.design.maths import covariance_of, design
from ipe_bench.report.style import house_style
from ipe_bench.trials.observability import Observability, suspects
from ipe_bench.trials.scenario import Scenario

NOISE = ib.noise.Quantization()


@dataclass(frozen=True)
class Linear(Measurement):
    """h(x) = A x, of which today has the first `count` readings of `most`."""

    count: int = 5
    most: int = 9
    seed: int = 3
    analytic = True

    @property
    def A(self) -> Array:
        return np.random.default_rng(self.seed).normal(size=(self.most, 3))[: self.count]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name) for name in "abc")

    @property
    def index(self):
        return {"number": list(range(self.count))}

    @property
    def candidates(self) -> Measurement:
        return replace(self, count=self.most)

    def simulate(self, x: Array) -> Array:
        return np.matmul(self.A, x[..., None])[..., 0]


@dataclass(frozen=True)
class Curve(Measurement):
    """A polynomial of degree n - 1 on [-1, 1], each time to be read up to four times."""

    degree: int = 2
    times: tuple[float, ...] = tuple(np.linspace(-1, 1, 21).round(6))
    repeats: int = 4
    analytic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"c{i}") for i in range(self.degree + 1))

    @property
    def index(self):
        return {
            "time": [t for t in self.times for _ in range(self.repeats)],
            "repeat": [*range(self.repeats)] * 21,
        }

    def simulate(self, x: Array) -> Array:
        return np.matmul(
            np.vander(self.index["time"], self.degree + 1, increasing=True), x[..., None]
        )[..., 0]


def scenario(model: Measurement, noise=None, scale: float = 1.0) -> ib.Scenario:
    return ib.Scenario(model, noise or ib.noise.Gaussian(0.1), error_scale=scale)


def mean_bound(A: Array, today: Array, criterion: str) -> float:
    P, P0 = (np.linalg.inv(a.T @ a) for a in (A, today))
    if criterion == "D":
        return (np.linalg.det(P) / np.linalg.det(P0)) ** (1 / (2 * len(P)))
    return np.sqrt(np.mean(np.diag(P) / np.diag(P0)))


@pytest.mark.parametrize("criterion", ["A", "D"])
@pytest.mark.parametrize("seed", range(6))
def test_the_choice_is_near_that_of_brute_force(criterion, seed):
    model = Linear(seed=seed)
    today, everything = model.A, replace(model, count=9).A
    every = {
        rows: mean_bound(everything[list(rows)], today, criterion)
        for count in (3, 4, 5)
        for rows in combinations(range(9), count)
    }
    (way,) = design(scenario(model), criterion=criterion).ways
    assert way.sharpest.mean_bound == pytest.approx(every[way.sharpest.rows])
    assert (1 - 1e-9) * min(every.values()) <= way.sharpest.mean_bound <= 1.25 * min(every.values())
    assert (
        way.sharpest.mean_bound <= 1 + 1e-12
    )  # that of today's readings, which may be the best, up to round-off
    if way.saving:
        assert (
            way.saving.readings <= min(len(rows) for rows, bound in every.items() if bound <= 1) + 1
        )


@pytest.mark.parametrize("criterion", ["A", "D"])
def test_fewer_readings_than_parameters_are_no_choice(criterion):
    """One reading of three parameters leaves two directions unknown, whatever round-off says of
    them."""
    for seed in range(6):
        model = Linear(count=1, seed=seed)
        assert design(scenario(model), criterion=criterion).ways == ()


@pytest.mark.oracle(
    "published: D-optimal points of Smith (1918) and Guest (1958)",
    "times of readings, on a grid of 0.1",
    0.06,
)
@pytest.mark.parametrize(
    ("degree", "best"), [(2, (-1.0, 0.0, 1.0)), (3, (-1.0, -(5**-0.5), 5**-0.5, 1.0))]
)
def test_polynomials_are_best_read_where_theory_says(degree, best):
    """The D-optimal points of degree p are the ends and the zeros of P_p', equally often (Smith,
    Biometrika 12, 1918; Guest, Ann. Math. Stat. 29, 1958); the grid has 0.4 and 0.5 about
    1/sqrt(5)."""
    (way,) = design(
        scenario(Curve(degree)), by=["time", "repeat"], readings=4 * len(best), criterion="D"
    ).ways
    entries = np.array([way.units.entries[u][0] for u in way.sharpest.taken])
    apart = np.abs(entries[:, None] - np.array(best))
    agreed(apart.min(axis=1), 0.06)
    assert np.bincount(apart.argmin(axis=1)).tolist() == [4] * len(best)


@pytest.mark.oracle(
    "own second implementation: inverse of the normal matrix", "bounds and correlations", 1e-7
)
def test_bounds_and_correlations_are_those_of_the_covariance():
    model = Linear(count=9)
    R = Covariance(np.full(9, 0.1))
    seen = Observability.at(model, R, np.zeros((4, 3)))
    P = 0.01 * np.linalg.inv(model.A.T @ model.A)
    assert_agrees(seen.bound, np.sqrt(np.diag(P)), rtol=1e-7)
    assert_agrees(seen.correlation, P / np.sqrt(np.outer(np.diag(P), np.diag(P))), rtol=1e-7)
    # The multiple correlation of one error with the others, by regression of draws upon draws.
    e = np.random.default_rng(0).multivariate_normal(np.zeros(3), P, size=200_000)
    for i in range(3):
        others = np.delete(e, i, axis=1)
        fitted = others @ np.linalg.lstsq(others, e[:, i])[0]
        assert np.corrcoef(fitted, e[:, i])[0, 1] == pytest.approx(
            seen.multiple_correlation[i], abs=0.01
        )
    scatter = e @ seen.least_observable
    assert scatter.std() == pytest.approx(np.sqrt(np.linalg.eigvalsh(P)[-1]), rel=0.01)


@dataclass(frozen=True)
class Alike(Linear):
    """Only a + b and c are in the readings."""

    @property
    def A(self) -> Array:
        A = super().A.copy()
        A[:, 1] = A[:, 0]
        return A


def test_a_direction_that_no_reading_has_is_named_and_its_bounds_are_infinite():
    seen = Observability.at(Alike(count=9), Covariance(np.full(9, 0.1)), np.zeros((2, 3)))
    assert not seen.observable
    assert seen.words == "a - b"
    assert np.isinf(seen.bound[:2]).all()
    assert np.isfinite(seen.bound[2])
    assert design(scenario(Alike())).ways == ()


@dataclass(frozen=True)
class Hidden(Linear):
    """With two errors besides: one that looks like 2 a - c, and one that looks like nothing in the
    model."""

    @property
    def nuisance_deviation(self) -> Array:
        return np.array([0.5, 0.3])

    @property
    def nuisances(self) -> tuple[Parameter, ...]:
        return Parameter("twin", "m", 10.0, "twins"), Parameter("stranger", group="strangers")

    def simulate(self, x: Array) -> Array:
        A = self.A
        across = np.linalg.svd(A)[0][:, -1]
        z = np.matmul(A, x[:, :3, None])[..., 0]
        return z + x[:, 3:4] * (2 * A[:, 0] - A[:, 2]) + x[:, 4:5] * across if x.shape[1] > 3 else z


def test_what_the_parameters_imitate_is_found_with_what_it_does():
    model, R = Linear(count=9), Covariance(np.full(9, 0.1))
    twin, stranger = suspects(model, R, Hidden(count=9), np.zeros((3, 3)))
    assert (twin.name, twin.deviation, twin.unit) == ("twin", 5.0, "m")
    np.testing.assert_allclose(twin.shift, [1.0, 0.0, -0.5], atol=1e-9)
    assert twin.noticed == pytest.approx(1e-3)
    assert twin.hidden
    assert twin.words == "twin - a + 0.50 c"
    np.testing.assert_allclose(stranger.shift, 0.0, atol=1e-9)
    assert not stranger.hidden
    # Its residuals have a noncentral chi-square law; over N(0, 3^2) of its size in deviations of a
    # reading.
    sizes = 3 * np.random.default_rng(1).standard_normal(4000)
    limit = stats.chi2.isf(1e-3, 6)
    assert stranger.noticed == pytest.approx(np.mean(stats.ncx2.sf(limit, 6, sizes**2)), abs=0.06)


def test_the_misaligned_platform_that_looks_like_a_bias_is_named_before_anything_is_measured():
    paper = scenario(Gins(), NOISE, 33.0)
    model, R, x = paper.measurement, paper.problem.R, paper.truths(0, 5)
    first, second, third = suspects(model, R, RicherGins(platform_misalignment=5.0), x)
    assert {first.name, second.name} == {"platform x", "platform y"}
    turns = {s.name: s for s in (first, second, third)}
    assert turns["platform y"].words == "platform y + 0.24 bx"
    assert turns["platform x"].words.startswith("platform x - 0.24 by")
    # A platform that leans by an angle feels that share of gravity: 5 arcsec are 0.242 of 1e-4 g.
    assert turns["platform y"].shift[0] == pytest.approx(
        -np.tan(np.deg2rad(5 / 3600)) / 1e-4, rel=0.02
    )
    assert all(s.hidden and s.noticed < 2e-3 for s in turns.values())


def test_a_richer_model_without_errors_is_refused():
    with pytest.raises(
        ib.UserError, match="errors: gins_richer has no errors besides the parameters"
    ):
        design(scenario(Gins(), NOISE, 33.0), errors=[RicherGins()], truths=1)


@dataclass(frozen=True)
class Crowded(Gins):
    """Has an error of its own where readings follow each other closely."""

    @property
    def nuisance_deviation(self) -> Array:
        return np.full(int(self.readings_per_case > 20), 0.1)


@pytest.mark.parametrize(("readings", "found"), [(30, [Crowded]), (15, [])])
def test_a_model_is_richer_if_it_has_errors_with_the_options_of_ones_own(readings, found):
    option = SimpleNamespace(name="crowded", fault=None, config={})
    home = "ipe_bench.plugins.extensions"
    with (
        patch(f"{home}.options", lambda group: [option]),
        patch(f"{home}.construct", lambda config, where: Crowded()),
    ):
        richer = richer_models(scenario(Gins(readings_per_case=readings), NOISE, 33.0))
    assert [type(one) for one in richer] == found


@pytest.fixture(scope="module")
def gins():
    """The paper's four cases, with half of its readings, at other times."""
    return design(scenario(Gins(readings_per_case=15), NOISE, 33.0), by=["time"], truths=2)


def test_fewer_readings_at_better_times_are_worth_more(gins):
    (way,) = gins.ways
    assert way.saving.readings < 120
    assert way.saving.mean_bound <= 1
    assert way.sharpest.readings <= 120
    assert way.sharpest.mean_bound < 0.95
    model = gins.measurement(way.saving)
    assert (model.n, model.m) == (11, way.saving.readings)
    x = 33.0 * np.random.default_rng(0).normal(size=(2, 11))
    np.testing.assert_allclose(
        model.simulate(x), gins.candidates.simulate(x)[:, list(way.saving.rows)], atol=1e-9
    )


@pytest.mark.slow
def test_gauss_newton_reaches_the_bound_of_the_designed_model():
    """The ratio of its error to that on the paper's four cases is the predicted one, on 400 trials
    each."""
    gins = design(scenario(Gins(), NOISE, 33.0), by=["time"], truths=10)
    (way,) = gins.ways
    assert way.saving.readings < 240
    assert way.sharpest.mean_bound < 0.9
    for choice in (way.saving, way.sharpest):
        ratio = []
        for model in (gins.measurement(choice), Gins()):
            table = ib.run(
                scenario(model, NOISE, 33.0), {"gn": ib.baselines.GaussNewton()}, trials=400
            )
            rows = table[table["parameter"] != "all"]
            assert (rows["solved"] == 1).all()
            ratio.append(rows["rmse_solved"].to_numpy())
        mean = np.sqrt(np.mean((ratio[0] / ratio[1]) ** 2))
        # Eleven ratios of deviations of 400 errors each: a standard deviation of 0.05 apiece, 0.02
        # together.
        assert mean == pytest.approx(choice.mean_bound, abs=0.05)


@pytest.mark.slow
def test_four_cases_of_the_paper_are_as_good_as_what_is_chosen():
    (way,) = design(scenario(Gins(), NOISE, 33.0), by=["case"], truths=10).ways
    assert way.sharpest.readings == 240
    assert 0.98 < way.sharpest.mean_bound <= 1


def test_mistakes_are_one_line():
    with pytest.raises(ib.UserError, match="the errors of readings are correlated"):
        ib.design(scenario(Linear(), ib.noise.Correlated(0.1, 0.5)))
    with pytest.raises(ib.UserError, match="without the level of the noise there are no bounds"):
        ib.design(scenario(Linear(), ib.noise.Unknown()))


def test_fewer_readings_than_the_smallest_choice_has_are_refused():
    """Rounds have seven readings each."""
    with pytest.raises(
        ib.UserError, match="readings=5: choices by round of so few do not determine all parameters"
    ):
        ib.design(scenario(ib.measurements.Ranging()), by=["round"], readings=5)
    (way,) = ib.design(scenario(ib.measurements.Ranging()), by=["round"], readings=7).ways
    assert way.sharpest.readings == 7
    assert way.sharpest.mean_bound == pytest.approx(np.sqrt(3), rel=1e-6)


def test_the_table_of_a_design_has_the_readings_of_each_choice(tmp_path):
    found = ib.design(scenario(ib.measurements.Ranging()), by=["round"], readings=7)
    write_design(tmp_path, "ranging", found)
    rows = pd.read_csv(tmp_path / READINGS)
    (way,) = found.ways
    choices = {word: choice for word in ("saving", "sharpest") if (choice := getattr(way, word))}
    assert set(rows["choice"]) == choices.keys()
    index = pd.DataFrame(dict(found.candidates.index))
    for word, choice in choices.items():
        taken = rows[rows["choice"] == word].reset_index(drop=True)
        wanted = index.iloc[list(choice.rows)].reset_index(drop=True)
        pd.testing.assert_frame_equal(taken[[*index]], wanted, check_dtype=False)
    assert set(rows["by"]) == {"round"}


# What to read next --------------------------------------------------------------------------------


DEMAND = {"expression": "b1*(1 - exp(-b2*t))", "start": {"b1": 20.0, "b2": 0.5}}


def demand(days):
    model = ib.measurements.Formula(**DEMAND, columns={"t": list(days)})
    return Scenario(model, Gaussian(2.5), GaussianPrior(), 0.3, 0)


@pytest.fixture(scope="module")
def six_days():
    return design(demand([1, 2, 3, 4, 5, 7]))


def bound_of(days):
    return design(demand(days)).observability.bound


def test_bounds_with_further_readings_are_those_of_a_model_that_has_them(six_days):
    further = six_days.further
    days = [1, 2, 3, 4, 5, 7, *(float(further.entries[i]) for i in further.taken)]
    for k in (0, 1, 3):
        np.testing.assert_allclose(further.bounds[k], bound_of(days[: 6 + k]), rtol=1e-8)
    for g in (0, 20, 60):
        with_one = bound_of([1, 2, 3, 4, 5, 7, float(further.entries[g])])
        np.testing.assert_allclose(further.alone[g], with_one, rtol=1e-8)


def test_the_next_reading_cuts_bounds_most_and_may_lie_beyond_todays(six_days):
    further = six_days.further
    shares = ((further.alone / further.bounds[0]) ** 2).mean(axis=1)
    assert further.taken[0] == np.argmin(shares)
    assert further.entries.min() == 1
    assert further.entries.max() == 25
    assert further.entries[further.taken[0]] > 7
    (table,) = _further(six_days)
    number, where, bound = (cell.text for cell in next(iter(table.rows))[:3])
    assert number == "1"
    assert where == further.words[further.taken[0]]
    assert float(bound) == pytest.approx(np.sqrt(shares.min()), abs=6e-4)
    title, more, *_ = _findings(six_days)
    assert title.startswith(f"Read next at {further.words[further.taken[0]]}; the bound of b1 then")
    today, one = (20.0 * further.bounds[k, 0] for k in (0, 1))
    assert title.endswith(f"falls from {today:.3g} to {one:.3g}")
    most = int(np.argmin(further.bounds[3] / further.bounds[1]))
    size = six_days.observability.parameters[most].size
    high, low = (f"{size * further.bounds[k, most]:.3g}" for k in (1, 3))
    assert more.startswith("Two more after it: twice at t = 25; the bound of")
    assert more.endswith(f"b{most + 1} then falls from {high} to {low}")


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in range(1, 20))]
)
def test_the_title_of_a_design_is_so_of_the_model_with_that_reading(seed):
    """No other reading of the candidates cuts the mean square of the shares more, and the parameter
    that is named is the one whose bound falls most, by what it says."""
    days = sorted(np.random.default_rng(seed).uniform(1.0, 8.0, 5).tolist())
    found = design(demand(days))
    title = _findings(found)[0]
    words = r"Read next at t = (\S+); the bound of (b\d) then falls from (\S+) to (\S+)"
    (said,) = re.finditer(words, title)
    day, name, today, then = said.groups()
    sizes = np.array([parameter.size for parameter in found.observability.parameters])
    shares = bound_of([*days, float(day)]) / bound_of(days)
    at = int(np.argmin(shares))
    assert name == f"b{at + 1}"
    before = sizes[at] * bound_of(days)[at]
    assert [float(today), float(then)] == pytest.approx([before, before * shares[at]], rel=0.02)
    cut = (shares**2).mean()
    others = [bound_of([*days, one]) / bound_of(days) for one in found.further.entries[::12]]
    assert cut <= 1.02 * min((other**2).mean() for other in others)


def test_where_further_readings_are_offered_todays_are_not_called_the_only_candidates(six_days):
    assert not [said for said in _findings(six_days) if "candidates" in said]
    said = [part for part in design_parts("", six_days) if isinstance(part, str)]
    every = "Every choice without further readings is among the present 6. `readings=NUMBER`"
    assert [part for part in said if "the present" in part] == [f"{every} chooses fewer of them."]


def test_truths_without_readings_are_left_out_of_a_design_and_counted():
    """The root of a + t has no real value where a is below -1."""
    model = ib.measurements.Formula("sqrt(a + t)", {"a": 0.5}, {"t": [1.0, 2.0, 3.0]})
    wide = Scenario(model, Gaussian(0.1), GaussianPrior(), 4.0, 0)
    lost = int((model.sizes[0] * wide.truths(0, 30) <= -1.0).sum())
    assert 0 < lost < 30
    told = " ".join(str(ib.design(wide)).split())
    assert f"{lost} of 30 true parameters from the prior have no finite readings" in told


def test_a_start_or_a_prior_without_readings_is_refused():
    model = ib.measurements.Formula("sqrt(a - t)", {"a": 3.5}, {"t": [1.0, 2.0, 3.0]})
    with pytest.raises(ib.UserError, match=r"at: formula has no finite .* at the start"):
        ib.design(replace(model, start={"a": 2.5}), noise=Gaussian(0.1))
    with pytest.raises(ib.UserError, match=r"at: formula has no finite .* at the estimate"):
        ib.design(model, noise=Gaussian(0.1), at={"a": 2.5})
    here = type(model).jacobian

    def only_at_the_start(self, x):
        return np.where((x == model.nominal).all(axis=1)[:, None, None], here(self, x), np.nan)

    nowhere = patch.object(type(model), "jacobian", only_at_the_start)
    with nowhere, pytest.raises(ib.UserError, match="at none of 30 true parameters"):
        ib.design(model, noise=Gaussian(0.1))


def bounds_of_demand(b1, b2, days, deviation=2.5):
    """The bounds of b1 and b2 by the slopes of b1 (1 - exp(-b2 t))."""
    t = np.array(days, dtype=float)
    J = np.stack([1 - np.exp(-b2 * t), b1 * t * np.exp(-b2 * t)], axis=1) / deviation
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


SIX = [1, 2, 3, 4, 5, 7]


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_the_bound_is_that_at_the_start_whatever_the_seed_and_the_prior(seed):
    """Far truths, of which some have nearly no slope, raised it to 136 by the mean of squares."""
    wide = replace(demand(SIX), error_scale=1.0, seed=seed)
    seen = design(wide).observability
    right = bounds_of_demand(20.0, 0.5, SIX)
    np.testing.assert_allclose(seen.bound * [20.0, 0.5], right, rtol=1e-9)
    # Of two parameters the multiple correlation is that of the pair.
    assert seen.correlation[0, 1] < 0
    np.testing.assert_allclose(seen.multiple_correlation, np.abs(seen.correlation[0, 1]), rtol=1e-9)
    truths = wide.truths(0, 30) * [20.0, 0.5]
    each = np.sort([bounds_of_demand(*x, SIX) for x in truths], axis=0)
    # The quartiles of 30 numbers are the 8th, the 15th and the 23rd.
    np.testing.assert_allclose(seen.quartiles * [20.0, 0.5], each[[7, 14, 22]], rtol=1e-6)
    (low, middle, high) = each[[7, 14, 22], 0]
    told = " ".join(str(ib.design(wide)).split())
    assert f"{right[0]:.3g} {middle:.3g} ({low:.3g} to {high:.3g})" in told


def test_at_an_estimate_all_is_of_that_point():
    wide = replace(demand(SIX), error_scale=1.0)
    found = ib.design(wide, at={"b1": 19.14, "b2": 0.531})
    seen = found.observability
    right = bounds_of_demand(19.14, 0.531, SIX)
    np.testing.assert_allclose(seen.bound * [20.0, 0.5], right, rtol=1e-9)
    assert len(seen.quartiles) == 0
    told = str(found)
    assert "function" not in told
    assert "b1*(1 - exp(-b2*t)), gaussian, at the estimate: what 6 readings determine" in told
    assert "over the prior" not in told
    longer = bounds_of_demand(19.14, 0.531, [*SIX, 25])
    np.testing.assert_allclose(found.further.bounds[1] * [20.0, 0.5], longer, rtol=1e-9)
    with pytest.raises(ib.UserError, match="at: has no estimate of b2"):
        ib.design(wide, at={"b1": 19.14})


def test_an_estimate_of_a_parameter_that_is_positive_is_taken_in_its_own_unit():
    plain = demand(SIX)
    model = informed(plain.measurement, [ParameterInfo("b2", positive=True)])
    point = {"b1": 19.14, "b2": 0.531}
    found = ib.design(replace(plain, measurement=model), at=point)
    np.testing.assert_allclose(model.physical(found.x)[0], [19.14, 0.531], rtol=1e-12)


def test_a_folder_without_an_estimate_is_refused(ipe_bench):
    asked = ["design", "measurement=polynomial", "noise=gaussian", "noise.deviation=1"]
    Path("failed").mkdir()
    Path("failed/estimate.json").write_text('{"examination": null, "fixed": {}}')
    Path("other").mkdir()
    Path("other/estimate.json").write_text("[]")
    Path("null").mkdir()
    Path("null/estimate.json").write_text('{"examination": {"estimates": {}}, "fixed": null}')
    for folder, why in {
        "nowhere": "has no estimate.json of an answer; give a folder that `ipe-bench estimate`",
        "other": "has no estimate.json of an answer; give a folder that `ipe-bench estimate`",
        "null": "has no estimate.json of an answer; give a folder that `ipe-bench estimate`",
        "failed": "no estimate there passes; design at the start, without at=",
    }.items():
        done, _, err = ipe_bench(*asked, f"at={folder}")
        assert done == 2
        assert why in err


@pytest.mark.slow
def test_a_design_at_the_estimate_of_a_folder(ipe_bench):
    Path("z.csv").write_text("t,reading\n1,8.3\n2,10.3\n3,19.0\n4,16.0\n5,15.6\n7,19.8\n")
    model = ["measurement=formula", "measurement.expression=b1*(1-exp(-b2*t))"]
    model += ["measurement.start.b1=20", "measurement.start.b2=0.5"]
    done, _, _ = ipe_bench("estimate", *model, "readings=z.csv", "figures=none", "output=found")
    assert done == 0
    asked = ["design", *model, "measurement.columns.t=[1,2,3,4,5,7]"]
    asked += ["noise=gaussian", "noise.deviation=2.5"]
    done, out, _ = ipe_bench(*asked, "at=found")
    assert done == 0
    assert re.search(r"b1 +2\.45 +0\.85 +b2 -0\.85", out)


def test_a_title_writes_small_bounds_in_three_figures_as_the_table_does():
    found = design(Scenario(Linear(), Gaussian(4e-4), GaussianPrior(), 1.0, 0))
    assert found.further is not None
    title = next(s for s in _findings(found) if s.startswith("Read next"))
    numbers = re.search(r"falls from (\S+) to (\S+)", title)
    assert numbers is not None
    assert all(re.fullmatch(r"\d\.\d\de-\d+", one) for one in numbers.groups()), title


def test_the_title_of_a_design_first_says_what_readings_leave_open():
    open_ = design(scenario(Linear(count=2)))
    assert _findings(open_)[0].startswith("The readings do not determine")
    # Before what further readings would do, which is first where nothing is open.
    with patch("ipe_bench.questions.design.answer._further_findings", lambda _: iter(["Read"])):
        assert _findings(open_)[0].startswith("The readings do not determine")
        assert _findings(open_)[1] == "Read"
        assert _findings(design(scenario(Linear())))[0] == "Read"


def test_shares_of_bounds_are_drawn_over_number_and_place(six_days):
    further = six_days.further
    with house_style():
        drawing = draw_further(six_days.scenario.measurement, further)
    number, place = drawing.figure.axes
    shares = further.bounds / further.bounds[0]
    drawn = {line.get_label(): line.get_ydata() for line in number.lines}
    np.testing.assert_array_equal(drawn["b1"], shares[:, 0])
    along = {line.get_label(): line for line in place.lines}
    np.testing.assert_array_equal(
        along["b2"].get_ydata(), (further.alone / further.bounds[0])[:, 1]
    )
    assert list(along["today's readings"].get_xdata()) == [1, 2, 3, 4, 5, 7]
    assert along["next"].get_xdata()[0] == further.entries[further.taken[0]]


def test_a_model_without_inputs_is_read_next_among_the_readings_that_it_offers():
    model = Linear()
    scenario = Scenario(model, Gaussian(1.0), GaussianPrior(), 1.0, 0)
    further = design(scenario).further
    offered, today = model.candidates.A, model.A.T @ model.A
    cost = [
        (np.diag(np.linalg.inv(today + np.outer(a, a))) / np.diag(np.linalg.inv(today))).mean()
        for a in offered
    ]
    assert further.taken[0] == np.argmin(cost)
    assert further.words[further.taken[0]] == f"number {np.argmin(cost)}"
    assert further.column == ""


def test_readings_of_own_deviations_and_inputs_that_are_words_have_no_further_ones():
    days = [1, 2, 3, 4, 5, 7]
    model = demand(days).measurement
    own = Scenario(model, Gaussian((2.0, 2.0, 2.5, 2.5, 3.0, 3.0)), GaussianPrior(), 0.3, 0)
    assert design(own).further is None
    refused = replace(model, columns={"t": days})
    with patch.object(type(refused), "with_inputs", side_effect=ib.UserError("no such input")):
        assert design(replace(own, measurement=refused, noise=Gaussian(2.5))).further is None


def test_more_readings_than_a_file_has_are_refused_with_what_to_do():
    """One's own readings have no options that make room for more, and the answer has the next."""
    model = ib.measurements.Formula(
        "b1*(1-exp(-b2*t))", {"b1": 20.0, "b2": 0.5}, {"t": [1.0, 2.0, 3.0, 4.0]}
    )
    own = Scenario(model, Gaussian(1.0))
    with pytest.raises(ib.UserError, match="remove the key: the answer says which two") as refused:
        ib.design(own, readings=12)
    assert "options" not in str(refused.value)
    assert "What to read next" in str(ib.design(own))


def test_readings_that_are_nearly_alike_offer_no_choice():
    """Three parameters from two times that differ by 1e-5: the bound is known, and is large."""
    start = {"a": 1.0, "b": 0.3, "c": 0.1}
    t = np.array([1.0, 1.00001, 3.0])
    model = ib.measurements.Formula("a*exp(-b*t)+c", start, {"t": t.tolist()})
    found = ib.design(Scenario(model, Gaussian(0.1), error_scale=0.1))
    e = np.exp(-0.3 * t)
    J = np.stack([e, -t * e, np.ones(3)], axis=1) / 0.1
    bound = np.linalg.norm(np.linalg.inv(J), axis=1) / [1.0, 0.3, 0.1]
    np.testing.assert_allclose(found.observability.bound, bound, rtol=1e-4)
    assert found.ways == ()
    with pytest.raises(ib.UserError, match="do not determine all parameters"):
        ib.design(Scenario(model, Gaussian(0.1), error_scale=0.1), readings=3)


@dataclass(frozen=True)
class Chosen(Linear):
    """Candidates are today's readings without the first."""

    rows: tuple[int, ...] = (0, 1, 2, 3, 4)

    @property
    def A(self) -> Array:
        return super().A[list(self.rows)]

    @property
    def index(self):
        return {"number": list(self.rows)}

    @property
    def candidates(self) -> Measurement:
        return replace(self, rows=(1, 2, 3, 4))


def test_each_candidate_among_todays_readings_keeps_its_own_deviation():
    deviations = np.array([0.5, 1.0, 2.0, 3.0, 4.0])
    model = Chosen(most=5)
    found = design(Scenario(model, Gaussian(tuple(deviations))))
    best = found.ways[-1].sharpest
    A = model.A[1:][list(best.rows)] / deviations[1:][list(best.rows), None]
    after = np.linalg.inv(A.T @ A).diagonal()
    today = np.linalg.inv((model.A.T / deviations**2) @ model.A).diagonal()
    assert best.mean_bound == pytest.approx(np.sqrt((after / today).mean()), rel=1e-12)


class Repeated(Chosen):
    """Two readings have the same labels."""

    @property
    def index(self):
        return {"number": [row // 2 for row in self.rows]}


def test_repeated_candidates_keep_their_own_deviations():
    deviations = (0.5, 1.0, 2.0, 3.0, 4.0)
    model = Repeated(most=5)
    R = covariance_of(Scenario(model, Gaussian(deviations)), model)
    assert tuple(R.deviations) == deviations
