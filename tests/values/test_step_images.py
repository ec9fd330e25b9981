"""Boxes hold where steps lead: for random states, inputs, noise and parameters within theirs."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, state_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.values.images import Step
from safe_envs.values.reduction import reduced
from tests.values.systems import s, scalar, u, v, x, y


def coupled(noise=(0.3, 0.0)):
    system = ControlAffineSDE(
        states=[x, y],
        inputs=[u, v],
        drift=[sp.sin(y) - s * x, x * y],
        input_matrix=[[1, y], [0, sp.cos(x)]],
        diffusion=[[noise[0], 0], [0, noise[1] * x]],
        parameters={s: 0.5},
    )
    return state_problem(
        system,
        4 - x**2 - y**2,
        box=(-1.0, 2.0),
        start=(0.1, 0.2),
        dt=0.1,
        horizon=1.0,
        workspace={x: (-2.0, 2.0), y: (-2.0, 2.0)},
        name="coupled",
    )


CASES = {
    "additive": (scalar(), {}),
    "of the state": (scalar(-x, 0.2 + x**2, gain=1 + x), {}),
    "uncertain": (scalar(-s * x, s, gain=s), {"s": (0.2, 0.5)}),
    "coupled": (coupled((0.3, 0.2)), {"s": (0.0, 1.0)}),
    "without noise": (coupled((0, 0)), {"s": (0.1, 0.4)}),
}


@pytest.mark.filterwarnings("ignore:the input bounds")
@pytest.mark.parametrize("name", CASES)
def test_images_hold_where_steps_lead(name):
    problem, intervals = CASES[name]
    small = reduced(problem, "plant", intervals)
    step = Step(small)
    assert step.is_affine == (name != "without noise")
    rng = np.random.default_rng(0)
    n, count = len(small.coordinates), 300
    low = [rng.uniform(-1.5, 1.4, count) for _ in range(n)]
    high = [a + rng.choice([0, 1e-6, 0.2], count) for a in low]
    box = np.array(small.box)
    ends = np.sort(rng.uniform(box[:, :1], box[:, 1:], (count, 1, len(box), 2)), axis=-1)
    images, effects = step.images(low, high, ends)
    assert images.shape[1] == 1
    q = [a + (b - a) * rng.random(count) for a, b in zip(low, high, strict=True)]
    inputs = ends[:, 0, :, 0] + (ends[:, 0, :, 1] - ends[:, 0, :, 0]) * rng.random(
        (count, len(box))
    )
    w = rng.normal(size=(len(small.noise), count))
    values = [rng.uniform(*pair, count) for pair in intervals.values()]
    function = compile_function(
        (*small.symbols, *small.inputs, *small.noise, *small.intervals), small.step, "arrays"
    )
    moved = function(*q, *inputs.T, *w, *values)
    # The blurred noise is none of the boxes' business.
    boxed = [
        i
        for i, e in enumerate(small.noise)
        if sum(sp.diff(p, e) != 0 for p in small.step) != 1
        or not any(sp.diff(p, e).is_number and sp.diff(p, e) != 0 for p in small.step)
    ]
    assert len(step.noise.low) == len(boxed)
    still = w.copy()
    still[boxed] = 0
    blurred = [
        a - b
        for a, b in zip(
            function(*q, *inputs.T, *w, *values),
            function(*q, *inputs.T, *(w - still), *values),
            strict=True,
        )
    ]
    products = effects[..., :, None] * ends[:, :, None, :, None, :]
    below = images[..., 0] + products.min(axis=(-1, -2)).sum(axis=-1)[:, None, :, None]
    above = images[..., 1] + products.max(axis=(-1, -2)).sum(axis=-1)[:, None, :, None]
    inside = np.full(below.shape[:4], True)
    for i in range(n):
        target = np.broadcast_to(moved[i] - blurred[i], count)[:, None, None, None]
        inside &= (below[..., i] <= target + 1e-12) & (above[..., i] >= target - 1e-12)
    if boxed:
        chosen = w[boxed][:, :, None]
        own = ((chosen >= step.noise.low[:, None]) & (chosen < step.noise.high[:, None])).all(
            axis=0
        )
        assert (inside & own[:, None, None, :]).any(axis=(1, 2, 3)).all()
    else:
        assert inside.any(axis=(1, 2, 3)).all()


def test_what_is_blurred():
    assert Step(reduced(scalar())).blur == (pytest.approx(0.4 * 0.1**0.5),)
    assert Step(reduced(scalar(-x, 0.2 + x))).blur == (0.0,)
    assert Step(reduced(scalar(), intervals={"s": (0.1, 0.2)})).blur == (0.0,)
    assert len(Step(reduced(scalar(), intervals={"s": (0.1, 0.2)})).noise.low) == 1


def test_effects_are_finite():
    step = Step(reduced(scalar(0, gain=1 / x)))
    found = step.images([np.array([-0.1])], [np.array([0.1])], np.zeros((1, 1, 1, 2)))
    assert np.isfinite(found.effects).all()


def test_sub_steps_are_refused():
    with pytest.raises(ConfigurationError, match="substeps = 3"):
        Step(reduced(scalar(substeps=3)))
