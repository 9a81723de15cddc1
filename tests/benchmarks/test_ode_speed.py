"""The generated integrator beside a loop that is written by hand for one model, with the same method and steps.

pytest tests/benchmarks --benchmark-only
"""

import os

import numba
import numpy as np
import pytest
from scipy.integrate import DOP853

from ipe_bench.measurements import LotkaVolterra

TRIALS = 4000
A, B = DOP853.A[:12, :12].copy(), DOP853.B[:12].copy()


@numba.njit(error_model="numpy", fastmath={"contract", "nsz"})
def by_hand(p, years, substeps, A, B, out):
    """Predators and prey for every row of p, by DOP853 at a fixed step in plain loops."""
    k = np.empty((12, 2))
    h = 1.0 / substeps
    for i in range(p.shape[0]):
        birth, hunting, death, growth, u, v = p[i]
        for year in range(years):
            for _ in range(substeps):
                for s in range(12):
                    du = 0.0
                    dv = 0.0
                    for j in range(s):
                        du += A[s, j] * k[j, 0]
                        dv += A[s, j] * k[j, 1]
                    us, vs = u + h * du, v + h * dv
                    k[s, 0] = birth * us - hunting * us * vs
                    k[s, 1] = growth * us * vs - death * vs
                for s in range(12):
                    u += h * B[s] * k[s, 0]
                    v += h * B[s] * k[s, 1]
            out[i, 2 * year] = u
            out[i, 2 * year + 1] = v


@pytest.fixture
def one_thread(monkeypatch):
    monkeypatch.setenv("IPE_BENCH_THREADS", "1")
    assert os.environ["IPE_BENCH_THREADS"] == "1"


@pytest.fixture(scope="module")
def trials():
    model = LotkaVolterra(step=0.125)
    x = model.nominal + np.random.default_rng(0).normal(size=(TRIALS, 6))
    return model, x


@pytest.mark.benchmark(group="predators and prey: 4000 simulations on one thread")
def test_generated(benchmark, trials, one_thread):
    model, x = trials
    benchmark(model.simulate, x)
    benchmark.extra_info["microseconds_per_trial"] = round(1e6 * benchmark.stats.stats.min / TRIALS, 2)


@pytest.mark.benchmark(group="predators and prey: 4000 simulations on one thread")
def test_by_hand(benchmark, trials, one_thread):
    model, x = trials
    out = np.empty((TRIALS, 40))
    benchmark(by_hand, x * model.sizes, 20, 8, A, B, out)
    np.testing.assert_allclose(out, model.simulate(x), rtol=1e-10)
    benchmark.extra_info["microseconds_per_trial"] = round(1e6 * benchmark.stats.stats.min / TRIALS, 2)
