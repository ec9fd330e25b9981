"""Returns at prices of a violation, against quadratures and what must hold between prices."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from scipy.stats import norm

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from safe_envs.values.frontier import FrontierSettings, price_violations
from safe_envs.values.look_ahead import LookAhead, start_values
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings

x, y, u, w, a, b = sp.symbols("x y u w a b", real=True)
DT, NOISE, STEPS = 0.1, 0.5, 6
REWARD = sp.exp(-((2 * (x - 1)) ** 2)) - u**2 / 50


def _walk(reward=REWARD, barrier=1 - x, **more):
    """A random walk with a push, which is safe below 1."""
    system = ControlAffineSDE.from_rate((x,), (u,), [u], diffusion=[NOISE])
    given = {"start": [0.2], "dt": DT, "horizon": STEPS * DT, "workspace": {x: (-3, 3)}}
    given |= {"input_bounds": (-2.0, 2.0), "name": "walk", "reward": reward, "nominal": -x}
    return define_problem(system, barrier, **{**given, **more})


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
    wide = _walk(barrier=10 - x)
    free = price_violations(wide, FrontierSettings(prices=2, cells=(161,)))
    assert walked.values[0] == pytest.approx(free.values[0], abs=4e-3)


def test_without_a_reward_the_slope_is_the_best_attainable_safety():
    problem = _walk(sp.Integer(0), start=[0.85])
    found = price_violations(problem, FrontierSettings(prices=2, cells=(121,)))
    table = solve(problem, ValueSettings(knowledge="plant", cells=(200,), inputs=9))
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


def test_an_angle_has_no_ends():
    values = []
    for turn in (0.0, 1.04):  # With an edge of the safe set within, and at pi.
        system = ControlAffineSDE.from_rate((x,), (u,), [u], diffusion=[NOISE])
        problem = define_problem(
            system,
            sp.cos(x - turn) + sp.Rational(1, 2),
            start=[turn + 1.6],
            units={x: "rad"},
            dt=DT,
            horizon=STEPS * DT,
            input_bounds=(-2.0, 2.0),
            reward=sp.cos(x - turn - 1.9),
            nominal=0,
        )
        values.append(price_violations(problem, FrontierSettings(3, 1, (121,))).values)
    np.testing.assert_allclose(*values, rtol=0, atol=4e-4)
    assert values[0][0] - values[0][-1] > 0.3


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (lambda: price_violations(make_problem("Quadrotor-v0")), "12 coordinates"),
        (lambda: price_violations(make_problem("DubinsObstacle-v0")), "moves by itself"),
        (lambda: FrontierSettings(prices=1), "prices = 1"),
        (lambda: FrontierSettings(cells=(3,)), "cells = 3"),
        (lambda: FrontierSettings(leaving="maybe"), "'maybe'"),
        (lambda: FrontierSettings(policies=-1), "policies = -1"),
        (
            lambda: price_violations(_walk(), FrontierSettings(prices=2, cells=(90_000_000,))),
            "cells = 90000000.* GB",
        ),
    ],
)
def test_what_cannot_be_priced_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()
