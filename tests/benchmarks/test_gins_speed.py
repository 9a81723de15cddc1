"""What a GINS simulation costs, beside SciPy's integrator: pytest tests/benchmarks --benchmark-only."""

from time import process_time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ipe_bench.measurements import Gins
from ipe_bench.measurements.ode.integrator import threads

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
@pytest.mark.parametrize("batch", [1, 8, 64, 250])
def test_simulation_in_small_batches(benchmark, gins, truths, batch):
    benchmark(gins.simulate, truths[:batch])
    per_trial(benchmark, batch)


@pytest.mark.benchmark(group="gins: one simulation of 240 readings")
@pytest.mark.parametrize("scale", [300.0, 1000.0, 3000.0])
def test_simulation_with_the_search_for_its_steps(benchmark, truths, scale):
    """Nothing is remembered: every round has another model."""
    x = scale / 33.0 * truths[:250]
    benchmark.pedantic(lambda model: model.simulate(x), setup=lambda: ((Gins(),), {}), rounds=10, warmup_rounds=1)
    per_trial(benchmark, 250)


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


def in_simulations(benchmark, model, x, derivative):
    """Alternates simulations with the derivative, so that both meet the same machine: processor time, best of each."""

    def seconds(function):
        start = process_time()
        function(x)
        return process_time() - start

    pairs = [(seconds(model.simulate), seconds(derivative)) for _ in range(10)]
    simulation, own = np.min(pairs, axis=0)
    benchmark.extra_info["in_simulations"] = round(own / simulation, 2)


@pytest.mark.benchmark(group="gins: one Jacobian, 240 x 11")
@pytest.mark.parametrize("scale", [33.0, 1000.0, 3000.0])
@pytest.mark.parametrize("kind", ["jacobian", "coarse_jacobian"])
def test_jacobian_in_a_batch(benchmark, gins, truths, scale, kind):
    x = scale / 33.0 * truths[:250]
    gins.simulate(x)
    J = benchmark.pedantic(getattr(gins, kind), (x,), rounds=10, warmup_rounds=1)
    assert J.shape == (250, 240, 11)
    per_trial(benchmark, 250)
    in_simulations(benchmark, gins, x, getattr(gins, kind))
