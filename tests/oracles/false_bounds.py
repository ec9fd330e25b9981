"""Systems for which a search once found a bound far above the rate that was measured."""

from __future__ import annotations

import numpy as np
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem

x, y, u = sp.symbols("x y u", real=True)


def stated(system, barriers, bound, workspace, nominal=0, **given):
    given = {"input_bounds": (-bound, bound), "workspace": workspace, "nominal": nominal, **given}
    return define_problem(system, barriers, **given)


def kink():
    """A kink that no function name shows: sqrt(2 - 2 cos x) is 2 |sin(x/2)|. There the noise adds a
    local time, which pulls h down."""
    system = ControlAffineSDE.from_rate((x,), (u,), [u], diffusion=[0.5])
    barrier = 0.5 - sp.sqrt(2 - 2 * sp.cos(x))
    times = {"dt": 0.01, "horizon": 3.7}
    return stated(system, [barrier], 5, {x: (-2, 2)}, start=(0.1,), **times)


def pole():
    """A pole of h in the workspace: braking through v = 0 takes h from plus to minus infinity."""
    d, v = sp.symbols("d v", real=True)
    system = ControlAffineSDE.from_rate((d, v), (u,), [-v, u], diffusion=[0, 0])
    ranges = {d: (0, 200), v: (-30, 30)}
    given = {"start": (20.0, 7.03), "dt": 0.05, "horizon": 5.0, "nominal": -5}
    return stated(system, [d / v - 1.8], 30, ranges, **given)


def island():
    """A narrow second peak of h under the start, far from the rest of C."""
    system = ControlAffineSDE.from_rate((x, y), (u,), [u, 0], diffusion=[[0.1], [0.1]])
    barrier = 1 - x**2 - y**2 + 30 * sp.exp(-((x - 1.5) ** 2 + (y - 0.3) ** 2) / 1e-4**2)
    ranges = {x: (-2, 2), y: (-2, 2)}
    return stated(system, [barrier], 5, ranges, start=(1.5, 0.3), dt=0.01, horizon=0.5)


def rotated():
    """A linear plant with ten states and rotated axes: near the ends of its unstable one the box
    cannot hold it."""
    axes = np.linalg.qr(np.random.default_rng(0).standard_normal((10, 10)))[0]
    rates = axes.T @ np.diag([2.0] + [-1.0] * 9) @ axes
    xs = sp.symbols("x_1:11", real=True)
    drift = [
        sum(float(a) * s for a, s in zip(row, xs, strict=True)) + float(b) * u
        for row, b in zip(rates, axes[0], strict=True)
    ]
    system = ControlAffineSDE.from_rate(xs, (u,), drift, diffusion=[0] * 10)
    start, ranges = tuple((0.97 * axes[0]).tolist()), dict.fromkeys(xs, (-2, 2))
    barrier = 1 - sum(s**2 for s in xs)
    return stated(system, [barrier], 1.9, ranges, start=start, dt=0.01, horizon=0.5)


def corridor():
    """Two rows on one input, which overshoot at this period without margins of first order."""
    system = ControlAffineSDE.from_rate((x,), (u,), [u], diffusion=[0])
    ranges = {x: (-2, 2)}
    given = {"start": (0.0,), "dt": 0.3, "horizon": 3.0, "nominal": 90}
    return stated(system, [1 - x, 1 + x], 100, ranges, **given)
