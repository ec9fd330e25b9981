"""Systems that mislead a search or a judge: hidden kinks, jumps, poles, thin peaks, far scales."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from tests.oracles import false_bounds

x, y, v, u, w = sp.symbols("x y v u w", real=True)
R = sp.Rational
SQUARE = {x: (-2, 2), y: (-2, 2)}


def _made(
    barrier: Any,
    text: str = "szcbf:alpha=0.5",
    *,
    states: Any = (x,),
    rows: Any = None,
    noise: Any = (0.5,),
    workspace: Any = None,
    start: Any = (0.1,),
    inputs: Any = (u,),
    high: float = 5.0,
    **rest: Any,
) -> Any:
    rows = [u, *[0] * (len(states) - 1)] if rows is None else rows
    noise = [[each] for each in (*noise, *[0] * (len(states) - len(noise)))]
    system = ControlAffineSDE.from_rate(states, inputs, rows, diffusion=noise)
    problem = define_problem(
        system,
        barrier if isinstance(barrier, list) else [barrier],
        input_bounds=[(-high, high)] * len(inputs),
        workspace={x: (-2, 2)} if workspace is None else workspace,
        start=start,
        dt=1e-3,
        horizon=0.5,
        nominal=[0] * len(inputs),
        **rest,
    )
    return problem, text


def _linear(n: int, seed: int) -> Any:
    """A plant with one unstable axis, turned, which its input holds almost everywhere in C."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.standard_normal((n, n)))[0]
    rates = axes.T @ np.diag([2.0] + [-1.0] * (n - 1)) @ axes
    xs = sp.symbols(f"x_1:{n + 1}", real=True)
    rows = [
        sum(round(float(a), 6) * s for a, s in zip(row, xs, strict=True)) + float(b) * u
        for row, b in zip(rates.tolist(), axes[0], strict=True)
    ]
    return _made(
        1 - sum(s**2 for s in xs),
        "cbf:alpha=0.1",
        states=xs,
        rows=rows,
        noise=(0.0,),
        workspace=dict.fromkeys(xs, (-2, 2)),
        start=tuple((0.97 * axes[0]).tolist()),
        high=1.9,
    )


def _saturated(switch: Any) -> Any:
    """An input that moves x at once, but only beyond 5: no point near 0 tells."""
    return _made(
        7 - x,
        "hocbf:alpha=0.1,1",
        states=(x, v),
        rows=[v - 3 * switch * u, u],
        noise=(0.0, 0.0),
        workspace={x: (5.5, 8), v: (-10, 10)},
        start=(6.5, 0.0),
    )


def _scales(ratio: int, noise: float) -> Any:
    return _made(
        1 - x**2 - y**2 / 4,
        "szcbf:alpha=1",
        states=(x, y),
        rows=[u - x, -y / ratio],
        noise=(noise, 1 / ratio),
        workspace=SQUARE,
        start=(0.2, 0.3),
    )


def _given(make: Any, text: str) -> Any:
    return lambda: (make(), text)


NASTY: dict[str, Any] = {
    "hidden kink": _given(false_bounds.kink, "szcbf:alpha=0.1"),
    "pole d/v": _given(false_bounds.pole, "cbf:alpha=1"),
    "second peak": _given(false_bounds.island, "scbf"),
    "turned axes, 10 states": _given(false_bounds.rotated, "cbf:alpha=0.1"),
    "corridor": _given(false_bounds.corridor, "cbf:alpha=10"),
    "turned axes, 7 states": lambda: _linear(7, 1),
    "turned axes, 12 states": lambda: _linear(12, 2),
    "root of a square": lambda: _made(
        1 - sp.sqrt(x**2 + y**2 - 2 * x * y), states=(x, y), noise=(0.5, 0.5), workspace=SQUARE,
        start=(0.1, 0.0),
    ),
    "saturated tanh": lambda: _saturated((1 + sp.tanh(10**6 * (x - 5))) / 2),
    "saturated erf": lambda: _saturated((1 + sp.erf(10**3 * (x - 5))) / 2),
    "identity in an input": lambda: _made(
        1 - x, "hocbf:alpha=1,2", states=(x, v),
        rows=[v + (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1) * u, u], noise=(0.0, 0.0),
        workspace={x: (-2, 2), v: (-3, 3)}, start=(0.0, 0.0),
    ),
    "1/x": lambda: _made(1 / x, "cbf:alpha=1", rows=[u - 1], noise=(0.0,), start=(0.3,)),
    "tanh(1/x)": lambda: _made(
        sp.tanh(1 / x), "cbf:alpha=1", rows=[u - 1], noise=(0.0,), start=(0.3,)
    ),
    "atan(1/x)": lambda: _made(
        sp.atan(1 / x), "cbf:alpha=1", rows=[u - 1], noise=(0.0,), start=(0.3,)
    ),
    "atan(1/x) at no middle": lambda: _made(
        sp.atan(1 / (x - R(1, 3))), "szcbf:alpha=1", noise=(0.5,), start=(0.5,)
    ),
    "jump at an edge of the workspace": lambda: _made(
        sp.atan(1 / x) + R(1, 10), "szcbf:alpha=1", workspace={x: (0, 2)}, start=(0.5,)
    ),
    "cut of atan2": lambda: _made(
        R(5, 2) - sp.atan2(y, x), states=(x, y), noise=(0.5, 0.5), workspace=SQUARE,
        rows=[0, u], start=(-1.0, -0.2),
    ),
    "sawtooth": lambda: _made(sp.asin(sp.sin(x)) + R(1, 2), start=(0.3,), workspace={x: (-4, 4)}),
    "logarithm": lambda: _made(sp.log(x) + 1, start=(0.8,)),
    "tanh(log x)": lambda: _made(sp.tanh(sp.log(x)) + R(1, 2), start=(0.8,)),
    "root": lambda: _made(sp.sqrt(x) - R(1, 10), workspace={x: (0, 2)}, start=(0.3,)),
    "flat": lambda: _made(R(1, 2) - sp.exp(-1 / (x**2 + R(1, 10**6))), start=(0.1,)),
    "unbounded": lambda: _made(x, workspace={}, start=(0.5,)),
    "bounded without a workspace": lambda: _made(1 - x**2, workspace={}, start=(0.5,)),
    "positive beyond the workspace": lambda: _made(1 - (x - 5) ** 2 / 20, start=(1.0,)),
    "high frequency": lambda: _made(1 + sp.sin(1000 * x) / 2 - x**2, start=(0.1,)),
    "wave": lambda: _made(1 + sp.sin(40 * x) / 20 - x**2, high=200.0, start=(0.1,)),
    "minimum": lambda: _made(sp.Min(1 - x, 1 + x)),
    "maximum": lambda: _made(sp.Max(1 - x**2, 1 - 2 * x)),
    "size": lambda: _made(1 - x * sp.Abs(x) ** 3),
    "sign": lambda: _made(1 + sp.sign(x) / 2 - x**2, start=(0.3,)),
    "floor": lambda: _made(sp.floor(x) + 1 - x**2 / 8, start=(0.3,)),
    "drift with a jump": lambda: _made(
        1 - x**2, rows=[u - 8 * sp.sign(x - R(1, 3))], start=(0.2,)
    ),
    "noise with a pole": lambda: _made(
        1 - y, states=(x, y), rows=[0, u], noise=(0.3, 0.1 / x), workspace=SQUARE, start=(0.3, 0.0)
    ),
    "period of two turns": lambda: _made(
        sp.sin(x / 2) + R(1, 2), "szcbf:alpha=1", workspace={}, start=(3.0,), units={x: "rad"}
    ),
    "angle": lambda: _made(
        sp.cos(x) + R(1, 2), "szcbf:alpha=1", workspace={}, start=(0.3,), units={x: "rad"}
    ),
    "scales of a million": lambda: _scales(10**6, 0.5),
    "scales without noise": lambda: _scales(10**6, 0.0),
    "input that fades at the edge": lambda: _made(
        1 - x**2, "cbf:alpha=1", rows=[R(1, 10) + (1 - x**2) * u], noise=(0.0,), start=(0.5,)
    ),
    "tiny barrier": lambda: _made((1 - x**2) / 10**12, start=(0.3,)),
    "huge barrier": lambda: _made((1 - x**2) * 10**12, start=(0.3,)),
    "reciprocal": lambda: _made(1 - x**2, "rcbf", noise=(0.0,), start=(0.3,)),
    "two barriers on one input": lambda: _made([1 - x, 1 + x], "szcbf:alpha=1", start=(0.2,)),
    "two of degree two": lambda: _made(
        [1 - x, 1 + x], "hocbf:alpha=1,2", states=(x, v), rows=[v, u], noise=(0.0, 0.0),
        workspace={x: (-2, 2), v: (-4, 4)}, start=(0.0, 0.0), high=2.0,
    ),
}  # fmt: skip

REFUSED = ("saturated tanh", "saturated erf", "maximum", "sign", "floor")
"""Those that are no problems, or whose filter is none."""

UNPROVED = (
    *("hidden kink", "pole d/v", "1/x", "tanh(1/x)", "atan(1/x)", "atan(1/x) at no middle"),
    *("jump at an edge of the workspace", "sawtooth", "logarithm", "tanh(log x)"),
    *("drift with a jump", "noise with a pole"),
)
"""Those with a kink, a jump or a pole that the judge has to see by itself."""
