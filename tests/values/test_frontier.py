"""Returns at prices of a violation, against quadratures and what must hold between prices."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from scipy.stats import norm

from safe_envs import ControlAffineSDE, state_problem
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from safe_envs.values.frontier import FrontierSettings, edge_rule, price_violations, smooth_rule
from safe_envs.values.grid import NodeGrid
from safe_envs.values.look_ahead import LookAhead, start_values
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings

x, y, u, w, a, b = sp.symbols("x y u w a b", real=True)
DT, NOISE, STEPS = 0.1, 0.5, 6
REWARD = sp.exp(-((2 * (x - 1)) ** 2)) - u**2 / 50


def _walk(reward=REWARD, **more):
    """A random walk with a push, which is safe below 1."""
    system = ControlAffineSDE.from_rate((x,), (u,), [u], diffusion=[NOISE])
    given = {"start": [0.2], "dt": DT, "horizon": STEPS * DT, "workspace": {x: (-3, 3)}}
    given |= {"box": (-2.0, 2.0), "name": "walk", "reward": reward, "nominal": -x}
    return state_problem(system, 1 - x, **{**given, **more})


def _exact(prices, inputs):
    """The same values by quadrature with 120 Gauss nodes on each side of the edge."""
    nodes, weights = np.polynomial.legendre.leggauss(120)

    def on(low, high):
        return low + (high - low) * (nodes + 1) / 2, weights * (high - low) / 2

    (safe, safe_weights), (unsafe, unsafe_weights) = on(-3.0, 1.0), on(1.0, 3.0)
    at = np.concatenate([safe, unsafe, [0.2]])
    mean = at[:, None] + DT * inputs
    spread = NOISE * np.sqrt(DT)
    points, shares = np.concatenate([safe, unsafe]), np.concatenate([safe_weights, unsafe_weights])
    density = norm.pdf(points, mean[:, :, None], spread) * shares
    # The reward of leaving the workspace counts too.
    fine, spaced = np.polynomial.hermite_e.hermegauss(80)
    reached = mean[:, :, None] + spread * fine
    reward = np.exp(-((2 * (reached - 1)) ** 2)) @ (spaced / spaced.sum()) - inputs**2 / 50
    leaving = 1 - norm.cdf((1 - mean) / spread) + norm.cdf((-3 - mean) / spread)
    violated = np.zeros(len(at))
    values = np.zeros((len(at), len(prices)))
    for _ in range(STEPS):
        after = reward + density @ violated[:-1]
        lost = density[:, :, 120:] @ violated[120:-1]
        gain = reward[:, :, None] + density[:, :, :120] @ values[:120]
        gain = gain + lost[:, :, None] - leaving[:, :, None] * prices
        violated, values = after.max(axis=1), gain.max(axis=1)
    return values[-1]


@pytest.fixture(scope="module")
def walked():
    return price_violations(_walk(), FrontierSettings(prices=8, cells=(161,)))


def test_values_are_those_of_a_quadrature(walked):
    exact = _exact(walked.prices, walked.inputs[:, 0])
    np.testing.assert_allclose(walked.values, exact, rtol=0, atol=0.012)
    assert exact[0] - exact[-1] > 2.0


def test_values_fall_with_the_price_and_are_convex_in_it(walked):
    slopes = np.diff(walked.values) / np.diff(walked.prices)
    assert (slopes <= 1e-6).all()
    assert (slopes >= -1.0 - 1e-6).all()
    assert (np.diff(slopes) >= -1e-5).all()


def test_the_curve_is_concave_and_rises(walked):
    chances = np.linspace(0.0, 1.0, 201)
    curve = walked.largest_return(chances)
    assert (np.diff(curve) >= 0.0).all()
    assert (np.diff(curve, 2) <= 1e-9).all()
    assert curve[-1] == pytest.approx(walked.values[0])


def test_without_a_price_nothing_depends_on_the_safe_set(walked):
    free = price_violations(_wide_walk(), FrontierSettings(prices=2, cells=(301,)))
    assert walked.values[0] == pytest.approx(free.values[0], abs=2e-3)


def _wide_walk():
    """The walk with a safe set that is never left within the workspace."""
    system = ControlAffineSDE.from_rate((x,), (u,), [u], diffusion=[NOISE])
    return state_problem(
        system,
        10 - x,
        start=[0.2],
        dt=DT,
        horizon=STEPS * DT,
        workspace={x: (-3, 3)},
        box=(-2.0, 2.0),
        name="walk",
        reward=REWARD,
        nominal=-x,
    )


def test_without_a_reward_the_slope_is_the_best_attainable_safety():
    problem = _walk(sp.Integer(0), start=[0.85])
    found = price_violations(problem, FrontierSettings(prices=3, cells=(161,)))
    table = solve(problem, ValueSettings(knowledge="plant", cells=(400,), inputs=21))
    lower, upper, *_ = start_values(LookAhead(table, problem), problem)
    assert lower - 1e-4 <= 1.0 - found.least_violations <= upper + 1e-4
    assert upper - lower < 0.02


def test_leaving_the_workspace_may_count_as_safe():
    reward = -((x + 2) ** 2)
    counted = [
        price_violations(
            _walk(reward, start=[-2.8]), FrontierSettings(4, 1, (101,), leaving)
        ).values[-1]
        for leaving in ("violation", "safe")
    ]
    assert counted[0] < counted[1] - 1.0


def test_a_reward_of_time_counts_at_its_time():
    t = sp.Symbol("t", nonnegative=True)
    found = price_violations(
        _walk(t + 0 * x, workspace={x: (-30, 30)}), FrontierSettings(2, 0, (101,))
    )
    times = DT * np.arange(1, STEPS + 1)
    assert found.values[0] == pytest.approx(times.sum(), rel=1e-5)


@pytest.mark.parametrize("env_id", ["Quadrotor-v0", "DubinsObstacle-v0"])
def test_what_no_grid_can_hold_is_refused(env_id):
    with pytest.raises(ConfigurationError, match=r"coordinates|moves by itself"):
        price_violations(make_problem(env_id))


@pytest.mark.parametrize(
    "given",
    [{"prices": 1}, {"cells": (3,)}, {"leaving": "maybe"}, {"policies": -1}],
)
def test_settings_are_checked(given):
    with pytest.raises(ConfigurationError):
        FrontierSettings(**given)


def test_a_frame_is_used_only_where_the_reward_is_a_function_of_it():
    from safe_envs.values.frontier import rewarded

    names = [str(s) for s in rewarded(make_problem("StochasticDubins-v0")).small.symbols]
    assert names == ["x", "y", "theta"]


def test_cubic_polynomials_are_interpolated_exactly():
    grid = NodeGrid.over([(-1.0, 2.0), (0.0, 1.0)], (12, 9), (False, False))
    p, q = grid.points(np.arange(grid.size))
    rng = np.random.default_rng(0)
    at = [rng.uniform(-0.5, 1.5, 50), rng.uniform(0.2, 0.8, 50)]
    numbers, shares = grid.around(at)
    found = ((p**3 - p * q**2 + q**3)[numbers] * shares).sum(axis=0)
    np.testing.assert_allclose(found, at[0] ** 3 - at[0] * at[1] ** 2 + at[1] ** 3, atol=1e-12)


def test_periodic_axes_go_on_at_the_other_end():
    grid = NodeGrid.over([(-np.pi, np.pi)], (64,), (True,))
    table = np.cos(grid.points(np.arange(64))[0])
    at = [np.array([3.1, -3.13, 9.0, -20.0])]
    for numbers, shares in (grid.around(at), grid.corners(at)):
        np.testing.assert_allclose((table[numbers] * shares).sum(axis=0), np.cos(at[0]), atol=2e-3)


@pytest.mark.parametrize("normals", [0, 1, 2, 3, 6])
def test_rules_have_the_moments_of_normals(normals):
    for rule in (smooth_rule(normals), edge_rule(normals)):
        assert rule.weights.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(rule.nodes @ rule.weights, 0.0, atol=1e-9)
        np.testing.assert_allclose(rule.nodes**2 @ rule.weights, 1.0, atol=1e-4)


def test_nodes_next_to_marked_ones_are_found_across_the_ends_of_every_periodic_axis():
    ends = [(0.0, 1.0)] * 3
    grid = NodeGrid.over(ends, (5, 6, 4), (True, True, False))
    marked = np.zeros(grid.counts, dtype=bool)
    marked[0, 5, 0] = True
    found = grid.around_marked(marked.ravel()).reshape(grid.counts)
    expected = {(i, j, k) for i in (4, 0, 1) for j in (4, 5, 0) for k in (0, 1)}
    assert set(zip(*map(np.ndarray.tolist, np.nonzero(found)), strict=True)) == expected


def test_more_memory_than_there_may_be_is_refused():
    with pytest.raises(ConfigurationError, match=r"cells = 90000000 take .* GB at 6 steps"):
        price_violations(_walk(), FrontierSettings(prices=2, cells=(90_000_000,)))
