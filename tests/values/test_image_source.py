import numpy as np
import pytest

from safe_envs.engine.program import is_available
from safe_envs.registry import make_problem
from safe_envs.values.images import Step
from safe_envs.values.reduction import reduced


@pytest.mark.skipif(not is_available(), reason="needs Numba")
@pytest.mark.parametrize("name", ["StochasticDubins", "Pendulum", "CubicSDEDisk"])
def test_compiled_images_of_states_are_those_of_interval_arithmetic(name):
    small = reduced(make_problem(f"safe_envs/{name}-v0"))
    step, rng = Step(small), np.random.default_rng(0)
    q = [rng.uniform(c.low, c.high, 200) for c in small.coordinates]
    inputs = np.repeat(rng.uniform(-1.0, 1.0, (200, 1, len(small.inputs), 1)), 2, axis=3)
    for found, wanted in zip(step.of_points(q, inputs, 0), step.images(q, q, inputs), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-13)
