"""NIST's certified problems: the data, the formulas and the certified numbers belong together."""

import numpy as np
import pytest
from shared.oracles import agreed, assert_agrees

from ipe_bench.measurements import Nist
from ipe_bench.measurements.nist import FORMULAS, digits, score

# What NIST's headers say: observations and parameters.
SIZES = {
    "Misra1a": (14, 2), "Chwirut2": (54, 3), "Chwirut1": (214, 3), "Lanczos3": (24, 6),
    "Gauss1": (250, 8),
    "Gauss2": (250, 8), "DanWood": (6, 2), "Misra1b": (14, 2), "Kirby2": (151, 5),
    "Hahn1": (236, 7),
    "Nelson": (128, 3), "MGH17": (33, 5), "Lanczos1": (24, 6), "Lanczos2": (24, 6),
    "Gauss3": (250, 8),
    "Misra1c": (14, 2), "Misra1d": (14, 2), "Roszman1": (25, 4), "ENSO": (168, 9), "MGH09": (11, 4),
    "Thurber": (37, 7), "BoxBOD": (6, 2), "Rat42": (9, 3), "MGH10": (16, 3), "Eckerle4": (35, 3),
    "Rat43": (15, 4), "Bennett5": (154, 3),
}  # fmt: skip


def least_squares_deviations(model, x):
    """Of (J' R^-1 J)^-1, by QR, so that Bennett5's ill-conditioned J keeps its digits."""
    U = np.linalg.qr(model.jacobian(x[None])[0] / model.certified.residual_deviation)[1]
    return np.linalg.norm(np.linalg.inv(U), axis=1)


def test_all_27_problems_are_there_with_their_sizes():
    assert {name: (Nist(name).m, Nist(name).n) for name in FORMULAS} == SIZES
    assert len(SIZES) == 27


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets, 27 problems",
    "standard deviations and residual sum of squares at the certified parameters",
    6.3e-10,
)
@pytest.mark.parametrize("dataset", FORMULAS)
def test_certified_parameters_reproduce_the_certified_residuals_and_deviations(dataset):
    model = Nist(dataset)
    x = model.certified.parameters / model.sizes
    reached = score(model, x, least_squares_deviations(model, x))
    assert reached.parameters == 11.0
    if dataset == "Lanczos1":
        # Residuals of 1e-13 from parameters near 1: eleven printed digits cannot reproduce their
        # squares.
        residuals = model.readings - model.simulate(x[None])[0]
        agreed(np.abs(residuals), 1e-10)
        return
    agreed(10.0**-reached.residual_sum_of_squares, 1.2e-10)
    agreed(10.0**-reached.deviations, 6.3e-10)


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets, 27 problems",
    "residual standard deviation",
    2e-10,
)
@pytest.mark.parametrize("dataset", FORMULAS)
def test_the_certified_residual_deviation_follows_from_m_minus_n_degrees_of_freedom(dataset):
    certified = Nist(dataset).certified
    deviation = np.sqrt(certified.residual_sum_of_squares / certified.degrees_of_freedom)
    assert_agrees(deviation, certified.residual_deviation, rtol=2e-10)


def test_known_errors_of_well_known_copies_are_corrected():
    assert Nist("Roszman1").certified.parameters[0] == 0.20196866396
    assert Nist("Rat43").certified.degrees_of_freedom == 11


@pytest.mark.parametrize("start", [1, 2])
def test_the_nominal_point_is_the_certified_start(start):
    model = Nist("Bennett5", start)
    assert (model.nominal * model.sizes).tolist() == {1: [-2000, 50, 0.8], 2: [-1500, 45, 0.85]}[
        start
    ]


def test_digits_are_the_fewest_over_the_parameters_capped_and_zero_where_wrong():
    assert digits([1.0, 1.001], [1.0, 1.0]) == pytest.approx(3.0)
    assert digits([2.0], [2.0]) == 11.0
    assert digits([1.5], [1.0]) == 0.0
    assert digits([np.nan, 1.0], [1.0, 1.0]) == 0.0
