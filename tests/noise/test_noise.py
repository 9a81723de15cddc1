"""Noises have the statistics that they state."""

import numpy as np
import pytest
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements.base import UsualNoise
from ipe_bench.noise import (
    Colored,
    Correlated,
    Gaussian,
    NoNoise,
    Outliers,
    Quantization,
    StudentT,
    Unknown,
)

TRIALS = 4000


def errors(noise, m=40, h=None, offset=None):
    """Errors (trials, m) of readings h."""
    rng = np.random.default_rng(11)
    h = np.zeros(m) if h is None else h
    offset = np.zeros(m) if offset is None else offset
    return np.stack([noise.corrupt(h, offset, rng) for _ in range(TRIALS)]) - h


INDEPENDENT = [
    Gaussian(0.3),
    StudentT(0.3, 5.0),
    Outliers(0.3, share=0.1, factor=5.0, assumed="total"),
]
COLORED = Colored(0.3, 0.8, channels=2, length=10, assumed="full")


@pytest.mark.parametrize(
    "noise",
    [
        COLORED,
        Correlated(0.3, 0.6, block=8),
        Correlated(matrix=((2.0, -0.5, 0.1), (-0.5, 1.0, 0.3), (0.1, 0.3, 0.5))),
    ],
    ids=["colored", "blocks", "matrix"],
)
def test_the_sample_covariance_is_the_full_r(noise):
    m = 3 if isinstance(noise, Correlated) and noise.matrix else 40
    R = noise.covariance(m).matrix()
    deviation = np.sqrt(np.diag(R))
    sample = np.cov(errors(noise, m).T) / np.outer(deviation, deviation)
    assert np.abs(sample - R / np.outer(deviation, deviation)).max() < 6 / np.sqrt(TRIALS)


def test_coloured_noise_runs_along_the_times_of_each_channel():
    R = Colored(2.0, 0.5, channels=2, length=3, assumed="full").covariance(12).matrix() / 4.0
    assert R[0, 1] == 0.0  # two instruments at one time
    assert R[0, 2] == pytest.approx(0.5)  # one instrument, one time later
    assert R[0, 4] == pytest.approx(0.25)
    assert R[4, 6] == pytest.approx(0.0)  # the next series starts anew


@pytest.mark.slow
def test_whitening_with_the_full_r_makes_coloured_noise_white():
    noise = Colored(0.3, 0.9, assumed="full")
    white = noise.covariance(40).whiten(errors(noise))
    assert np.abs(np.cov(white.T) - np.eye(40)).max() < 6 / np.sqrt(TRIALS)


def test_what_is_told_is_an_option():
    assert (Colored(0.3, 0.9).covariance(4).factor == 0.3).all()
    np.testing.assert_allclose(Correlated(0.3, 0.9, assumed="white").covariance(4).factor, 0.3)
    assert (Outliers(0.3, 0.5, 10.0).covariance(4).factor == 0.3).all()
    assert Outliers(0.3, 0.5, 3.0, "total").covariance(1).factor == pytest.approx(
        0.3 * np.sqrt(5.0)
    )


def test_students_tails_are_heavy_and_outliers_are_as_many_as_stated():
    v = errors(StudentT(1.0, 3.0))
    assert np.mean(np.abs(v) > 5.0) > 50 * 5.7e-7
    v = errors(Outliers(1.0, share=0.05, factor=1e6))
    assert np.mean(np.abs(v) > 100.0) == pytest.approx(0.05, abs=0.003)


def test_quantisation_rounds_the_whole_read_out():
    step, offset = 0.02286, np.linspace(-450.0, 450.0, 40) * 1.0001
    h = np.linspace(-3.0, 3.0, 40)
    z = Quantization(step).corrupt(h, offset, np.random.default_rng(0))
    steps = (offset + z) / step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(z - h).max() <= step / 2 * (1 + 1e-9)


def test_equal_readings_beside_different_read_outs_are_rounded_apart():
    # Rounding h alone would give all of them one error, and would correlate the cases of a model.
    v = (
        Quantization(1.0).corrupt(
            np.full(40, 0.3), np.linspace(0.0, 1.0, 40), np.random.default_rng(0)
        )
        - 0.3
    )
    assert np.ptp(v) > 0.9


@pytest.mark.oracle(
    "closed form: variance of a uniform error", "variance of 20,000 rounding errors", 0.03
)
def test_quantisation_errors_are_uniform_with_variance_step_squared_over_twelve():
    rng = np.random.default_rng(0)
    h = rng.uniform(-100, 100, 20000)
    v = Quantization(0.5).corrupt(h, np.zeros_like(h), rng) - h
    assert_agrees(np.var(v), 0.5**2 / 12, rtol=0.03)
    assert Quantization(0.5).covariance(1).factor == pytest.approx(0.5 / np.sqrt(12))
    assert Quantization(0.5, deviation=0.5).covariance(1).factor == 0.5


def test_dither_makes_the_error_of_a_constant_reading_uniform():
    constant = np.full(40, 0.1)
    assert np.ptp(errors(Quantization(1.0), h=constant)) == 0.0
    v = errors(Quantization(1.0, dither=True), h=constant)
    assert np.var(v) == pytest.approx(1 / 12, rel=0.02)
    assert abs(v.mean()) < 0.005


def test_no_noise_adds_nothing_while_r_stays_nominal():
    assert (errors(NoNoise(0.3), h=np.arange(40.0)) == 0.0).all()
    assert (NoNoise(0.3).covariance(2).factor == 0.3).all()


@pytest.mark.parametrize(
    "noise",
    [*INDEPENDENT, Quantization(0.3, dither=True), COLORED],
    ids=lambda noise: type(noise).__name__,
)
def test_the_stated_law_is_that_of_whitened_errors(noise):
    """Mean, variance and kurtosis, the last from many draws of what it should be."""
    w = noise.covariance(40).whiten(errors(noise, h=np.linspace(0.0, 7.0, 40)))
    stated = noise.whitened(w.shape, np.random.default_rng(5))
    law = np.random.default_rng(6).standard_normal(w.shape) if stated is None else stated
    assert law.mean() == pytest.approx(0.0, abs=0.01)
    assert law.var() == pytest.approx(1.0, rel=0.03)
    tails = [np.mean(np.abs(values) > limit) for values in (w, law) for limit in (0.5, 1.5, 3.0)]
    np.testing.assert_allclose(tails[:3], tails[3:], rtol=0.05, atol=0.0005)


def test_outliers_that_estimators_are_not_told_of_leave_the_law_normal():
    assert Outliers(0.3).whitened((4, 4), np.random.default_rng(0)) is None


# What is left out ---------------------------------------------------------------------------------

SCALED = [
    ib.noise.Gaussian(),
    ib.noise.NoNoise(),
    ib.noise.StudentT(),
    ib.noise.Outliers(),
    ib.noise.Colored(),
]


@pytest.mark.parametrize(
    "noise", [*SCALED, ib.noise.Correlated(assumed="white")], ids=lambda noise: noise.name
)
def test_a_deviation_that_is_left_out_is_that_of_the_model_and_of_no_other(noise):
    """That of GINS is its read-outs' step over the root of 12."""
    for model, deviation in (
        (ib.measurements.Ranging(), 0.1),
        (ib.measurements.Gins(), 0.02286 / 12**0.5),
    ):
        assert ib.Scenario(model, noise).problem.R.deviations == pytest.approx(deviation, rel=1e-12)
    own = ib.measurements.Formula("a*t", {"a": 1.0}, {"t": (1.0, 2.0)})
    with pytest.raises(UserError, match=rf"noise.deviation: is not given for noise={noise.name}"):
        ib.Scenario(own, noise)
    with pytest.raises(UserError, match=r"noise.deviation: is not given"):
        noise.covariance(2)


def test_a_step_that_is_left_out_is_that_of_the_model():
    assert ib.Scenario(
        ib.measurements.Gins(), ib.noise.Quantization()
    ).noise == ib.noise.Quantization(0.02286)
    with pytest.raises(UserError, match=r"noise.step: is not given for noise=quantization"):
        _ = ib.Scenario(ib.measurements.Ranging(), ib.noise.Quantization()).problem


def test_estimate_asks_for_a_deviation_that_nobody_has_stated(tmp_path):
    (tmp_path / "z.csv").write_text("t,reading\n1,2\n2,4\n3,6.1\n")
    model = ib.measurements.Formula("a*t", {"a": 1.0})
    with pytest.raises(UserError, match=r"noise.deviation: is not given for noise=gaussian"):
        ib.estimate(model, tmp_path / "z.csv", noise=ib.noise.Gaussian())


@pytest.mark.slow
def test_noise_with_true_levels_grows_with_the_reading_as_its_formula_says():
    """With the reading itself, in whatever place the read-out begins."""
    h = np.array([0.0, 1.0, -10.0, 100.0])
    for offset in (np.zeros(4), np.array([50.0, 0.0, 7.0, -100.0])):
        v = errors(Unknown(sigma="a + b*h", levels=(0.1, 0.02)), h=h, offset=offset)
        assert v.std(axis=0) == pytest.approx(0.1 + 0.02 * np.abs(h), rel=5 / np.sqrt(2 * TRIALS))


def test_a_usual_noise_without_a_size_is_none():
    with pytest.raises(UserError, match="names no noise of its own"):
        Gaussian().completed(UsualNoise())
    assert Gaussian().completed(UsualNoise(step=6.0)).deviation == pytest.approx(np.sqrt(3))
