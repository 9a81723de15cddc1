"""Anderson's acceleration: the roots of other solvers, without a Jacobian, in fewer steps."""

import numpy as np
from ipe_bench_zoo import Anderson

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Polynomial
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import FixedPoint, Newton
from ipe_bench.trials.scenario import Scenario


def test_it_finds_newton_s_roots_in_fewer_steps_than_the_iteration_that_it_accelerates():
    scenario = Scenario(Polynomial(), Gaussian(0.1), GaussianPrior(), 5.0)
    problem, z = scenario.problem, scenario.draw(0, 20).z
    found = Anderson(2).estimate(problem, z)
    exact = Newton(tolerance=1e-10).estimate(problem, z)
    assert (found.status == Status.CONVERGED).all()
    np.testing.assert_allclose(found.x, exact.x, atol=1e-6)
    assert (found.jacobians == 1).all()
    slow = FixedPoint().estimate(problem, z)
    assert found.iterations.mean() < slow.iterations.mean()
