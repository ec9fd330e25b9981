"""Images hold the next states, and weights the probabilities of boxes of noise."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, state_problem
from safe_envs.values.grid import Axis, Grid
from safe_envs.values.images import Step
from safe_envs.values.proved import ProvedImages, ProvedWeights
from safe_envs.values.reduction import reduced
from safe_envs.values.smoothing import noise_boxes
from tests.values.systems import u, x, y

RNG = np.random.default_rng(5)


def problem_of(gain):
    system = ControlAffineSDE(
        (x, y), (u,), [y - x**3, sp.sin(x)], [[0], [gain]], [[0.3 * x, 0], [0.1, 0.2]]
    )
    return state_problem(
        system,
        4 - x**2 - y**2,
        box=(-1.0, 1.0),
        start=(0.0, 0.0),
        dt=0.1,
        horizon=0.2,
        workspace={x: (-3.0, 3.0), y: (-3.0, 3.0)},
    )


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("gain", [1 + x, sp.cos(y)])
def test_next_states_lie_in_the_windows(gain, own):
    small = reduced(problem_of(gain))
    step = Step(small)
    grid = Grid((Axis(np.linspace(-2, 2, 80)), Axis(np.linspace(-2, 2, 70))))
    low = RNG.uniform(-2, 2, (2, 150))
    high = low + RNG.exponential(0.05, (2, 150))
    ends = np.sort(RNG.uniform(-1, 1, (150, 3, 1, 2) if own else (3, 1, 2)))
    images = ProvedImages(step, grid, (list(low), list(high)), ends, [0.0, 0.0])
    chosen = RNG.integers(0, 3, 150)
    windows = images.windows(np.arange(150), chosen)
    scenarios, boxes = images.shape
    assert scenarios == 1
    assert boxes > 1
    next_state = sp.lambdify((*small.symbols, *small.noise, *small.inputs), small.step)
    given = ends[np.arange(150), chosen] if own else ends[chosen]
    for _ in range(30):
        state = RNG.uniform(low, high)
        control = RNG.uniform(given[:, 0, 0], given[:, 0, 1])
        box = RNG.integers(0, boxes, 150)
        noise = {w: np.zeros(150) for w in small.noise}
        for w, a, b in zip(step.parts.boxed, step.noise.low, step.noise.high, strict=True):
            noise[w] = RNG.uniform(a[box], b[box])
        found = next_state(*state, *noise.values(), control)
        for i, axis in enumerate(grid.axes):
            # With a border, cells begin with 1.
            cell = np.searchsorted(axis.edges, found[i], side="right")
            place = np.arange(150) * boxes + box
            assert (windows.first[i, place] <= cell).all()
            assert (cell <= windows.last[i, place]).all()


def test_weights_are_bounds_of_probabilities():
    noise = noise_boxes([7, 5])
    weights = ProvedWeights(noise)
    total = mpmath.mpf(0)
    with mpmath.workdps(30):
        for j, (below, above) in enumerate(zip(weights.below, weights.above, strict=True)):
            true = mpmath.mpf(1)
            for low, high in zip(noise.low[:, j], noise.high[:, j], strict=True):
                true *= mpmath.ncdf(mpmath.mpf(high)) - mpmath.ncdf(mpmath.mpf(low))
            assert below <= true <= above
            assert above - below < 1e-14
            total += true
        assert 0 <= 1 - total <= weights.rest < 1e-6
    values = RNG.random((4, 2, len(weights.below)))
    true = (values @ noise.weights).min(axis=1)
    assert weights.expected(values) == pytest.approx(true, abs=1e-12)
    assert (weights.expected(values) < true + 1e-13).all()
    largest = (values @ noise.weights).max(axis=1)
    # Of negative values the noise outside of the boxes takes 1.
    assert -weights.expected(-values) == pytest.approx(largest + weights.rest, abs=1e-12)
