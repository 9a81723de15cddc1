"""What a GINS simulation costs, beside SciPy's integrator: pytest tests/benchmarks --benchmark-only."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ipe_bench.measurements import Gins
from ipe_bench.measurements.ode.kernel import threads

TRIALS = 4000


@pytest.fixture(scope="module")
def gins():
    return Gins()


@pytest.fixture(scope="module")
def truths():
    return 33.0 * np.random.default_rng(0).normal(size=(TRIALS, 11))


def per_trial(benchmark, trials):
    benchmark.extra_info["threads"] = threads()
    benchmark.extra_info["microseconds_per_trial"] = round(1e6 * benchmark.stats.stats.min / trials, 2)


@pytest.mark.benchmark(group="gins: one simulation of 240 readings")
def test_simulation_in_a_batch(benchmark, gins, truths):
    z = benchmark(gins.simulate, truths)
    assert z.shape == (TRIALS, 240)
    per_trial(benchmark, TRIALS)


@pytest.mark.benchmark(group="gins: one simulation of 240 readings")
def test_simulation_alone(benchmark, gins, truths):
    benchmark(gins.simulate, truths[:1])
    per_trial(benchmark, 1)


@pytest.mark.benchmark(group="gins: one simulation of 240 readings")
def test_simulation_by_solve_ivp(benchmark, gins, truths):
    p = list(truths[0] * gins.si_sizes)

    def simulate():
        return [
            solve_ivp(
                lambda t, y, c=c: gins.rhs(t, y, p, c),
                (0.0, gins.times[-1]),
                gins.start(p, c),
                "DOP853",
                t_eval=gins.times,
                rtol=1e-10,
                atol=1e-10,
            ).y[:2]
            for c in gins.cases
        ]

    velocities = np.stack(benchmark.pedantic(simulate, rounds=3)).swapaxes(1, 2).ravel()
    assert np.abs(velocities - gins.offset - gins.simulate(truths[:1])[0]).max() < 1e-4
    per_trial(benchmark, 1)


@pytest.mark.benchmark(group="gins: one Jacobian, 240 x 11")
def test_jacobian_in_a_batch(benchmark, gins, truths):
    J = benchmark(gins.jacobian, truths[:1000])
    assert J.shape == (1000, 240, 11)
    per_trial(benchmark, 1000)
