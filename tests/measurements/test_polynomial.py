"""The polynomial model has its nonlinear part in closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipe_bench.basics.linalg import Covariance
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements import Polynomial
from ipe_bench.measurements.problem import Problem


@given(
    n=st.integers(1, 6),
    extra=st.integers(1, 20),
    strength=st.floats(-0.5, 0.5),
    seed=st.integers(0, 10_000),
)
def test_the_nonlinear_part_is_as_documented(n, extra, strength, seed):
    model = Polynomial(n, n + extra, strength)
    x = np.random.default_rng(seed).normal(size=(3, n))
    u = x @ model.linearization().T
    np.testing.assert_allclose(model.linearization(), model.matrix, atol=1e-15)
    np.testing.assert_allclose(
        model.simulate(x) - u,
        strength * u**2 / 2 + strength**2 * u**3 / 6,
        atol=1e-12 * (1 + np.abs(u).max() ** 3),
    )


def test_without_strength_it_is_linear_and_the_truth_is_the_root():
    model = Polynomial(3, 10, 0.0)
    x = np.random.default_rng(0).normal(size=(4, 3))
    system = FrozenSystem.at_nominal(Problem(model, Covariance(np.ones(10))), model.simulate(x))
    np.testing.assert_allclose(system.F(np.zeros((4, 3))), -x, atol=1e-14)


def test_readings_grow_with_u_whatever_the_strength():
    model = Polynomial(1, 5, 0.7)
    z = model.simulate(np.linspace(-30.0, 30.0, 400)[:, None])
    assert (np.diff(z, axis=0) > 0).all()


@pytest.mark.parametrize("few", [1, 7, 50])
def test_bits_of_a_jacobian_do_not_depend_on_how_many_trials_there_are(few):
    """NumPy multiplies large complex arrays in place, and rounds otherwise than it rounds small
    ones."""
    model = Polynomial(4, 40)
    x = np.random.default_rng(0).normal(size=(300, 4))
    parts = [model.jacobian(x[i : i + few]) for i in range(0, len(x), few)]
    np.testing.assert_array_equal(model.jacobian(x), np.concatenate(parts))
