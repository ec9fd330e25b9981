"""A control period of a closed loop encloses what the env's integrator and its slopes are."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, SystemDefinitionError
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.enclosures.intervals import Interval
from safe_envs.problem.backup import BackupLaw, backup_of
from safe_envs.proofs.backup_sets import Disturbance, held_law
from safe_envs.registry import make_problem

x, v, w, u, k = sp.symbols("x v w u k", real=True)
NOTHING = Disturbance(*[Interval(np.zeros(0), np.zeros(0))] * 2)
RNG = np.random.default_rng(0)


def swing(rate=0, **parameters):
    """Return a pendulum whose torque is u, with a third state that it drives."""
    return ControlAffineSDE(
        (x, v, w),
        (u,),
        [v, -sp.sin(x), x**2 - w + rate],
        [0, 1, 0],
        [[0]] * 3,
        {k: 2.0, **parameters},
    )


HANG = BackupLaw("hang", (-k * v,), equilibrium={w: 0, x: 0, v: 0})


def test_coordinates_fall_into_blocks_in_the_order_of_their_dependence():
    blocks = held_law(swing(), HANG, 0.1, 1).blocks
    assert [block.symbols for block in blocks] == [(x, v), (w,)]
    assert blocks[1].outer == (x, v)
    assert blocks[0].nonlinear.tolist() == [True, False]


@pytest.mark.parametrize("substeps", [1, 3])
def test_a_period_encloses_the_integrators_step_and_its_slopes(substeps):
    system = swing()
    block = held_law(system, HANG, 0.3 / substeps, substeps).blocks[0]
    step = Integrator(system, 0.3, substeps, "arrays")

    def executed(y):
        moved = step.step((y[0], y[1], np.zeros_like(y[0])), (-2.0 * y[1],), ())
        return np.stack(moved[:2])

    for _ in range(20):
        low = RNG.uniform(-2, 2, 2)
        high = low + RNG.uniform(0, 0.3, 2)
        found = block.period(Interval(low[None, :], high[None, :]), NOTHING)
        y = RNG.uniform(low[:, None], high[:, None], (2, 200))
        after = executed(y)
        assert (found.after.low[0][:, None] <= after + 1e-12).all()
        assert (after - 1e-12 <= found.after.high[0][:, None]).all()
        assert (found.within.low[:, None] <= y).all()
        for j in range(2):
            d = np.zeros((2, 1))
            d[j] = 1e-6
            slope = (executed(y + d) - executed(y - d)) / 2e-6
            center, radius = (part[0, :, j, None] for part in found.slope)
            assert (np.abs(slope - center) <= radius + 1e-8).all()


def test_a_point_is_enclosed_tightly():
    block = held_law(swing(), HANG, 0.1, 1).blocks[0]
    y = np.array([[0.3, -0.4]])
    found = block.period(Interval(y, y), NOTHING)
    assert (found.after.high - found.after.low < 1e-12).all()
    assert (found.slope.radius < 1e-12).all()


def test_a_disturbance_widens_what_depends_on_it():
    block = held_law(swing(), HANG, 0.1, 1).blocks[1]
    point = Interval(np.zeros((1, 1)), np.zeros((1, 1)))
    for half in (0.0, 0.5):
        bounds = Interval(np.full(2, -half), np.full(2, half))
        found = block.period(point, Disturbance(bounds, bounds))
        # w' = x^2 - w: the step of Runge and Kutta has the weight (1 - exp(-dt)) to 1e-7.
        assert found.after.high[0, 0] >= half**2 * (1 - np.exp(-0.1)) - 1e-6
        assert found.after.high[0, 0] <= half**2 * 0.11 + 1e-12


def test_the_laws_branch_at_the_equilibrium_is_taken_and_its_limits_are_conditions():
    law = BackupLaw("held", (sp.Max(-1, sp.Min(1, -k * v)),), equilibrium={x: 0, v: 0})
    loop = held_law(swing(), law, 0.1, 1)
    assert loop.law == (-2 * v,)
    assert {sp.expand(e) for e in loop.switches} == {1 - 2 * v, 1 + 2 * v}


def test_the_rotors_of_a_quadrotor_cancel_exactly():
    problem = make_problem("safe_envs/QuadrotorLimits-v0")
    (law,) = backup_of(problem).laws
    blocks = held_law(problem.plant, law, problem.dt, 1).blocks
    assert [{s.name for s in block.symbols} for block in blocks] == [
        {"psidot"},
        {"phi", "theta", "phidot", "thetadot"},
        {"z", "zdot"},
    ]


def test_near_the_equilibrium_the_law_is_the_stated_one():
    problem = make_problem("safe_envs/QuadrotorLimits-v0")
    (law,) = backup_of(problem).laws
    loop = held_law(problem.plant, law, problem.dt, 1)
    symbols = problem.plant.states
    wanted = [problem.plant.numeric(e) for e in law.law]
    values = compile_function(symbols, [*wanted, *loop.law, *loop.switches], "arrays")
    points = RNG.uniform(-0.2, 0.2, (12, 500))
    points[2] += 5.0
    found = stacked(values(*points), 500)
    near = (found[:, 8:] >= 0).all(axis=1)
    assert near.mean() > 0.2
    np.testing.assert_allclose(found[near, :4], found[near, 4:8], rtol=1e-12)


@pytest.mark.parametrize(
    ("law", "complaint"),
    [
        (BackupLaw("a", (-v,), equilibrium={v: 0}), "the rate of v depends on x too"),
        (BackupLaw("a", (-v - w,), equilibrium={x: 0, v: 0}), "the law itself depends on w too"),
    ],
)
def test_coordinates_that_do_not_close_are_told(law, complaint):
    with pytest.raises(SystemDefinitionError, match=complaint):
        held_law(swing(), law, 0.1, 1)
