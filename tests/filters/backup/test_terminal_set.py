"""Derived terminal sets are as large as exact ones, follow the problem's numbers, and are kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SystemDefinitionError, state_problem
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.proofs.backup_sets import derived_sets, with_terminal_sets
from safe_envs.registry import make_problem

x, v, u, k = sp.symbols("x v u k", real=True)


def made(backup, barrier=1 - x, box=(-1.0, 1.0), dt=0.1, gain=2.0, **rest):
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1], [[0], [0]], {k: gain})
    given = {"start": [0.0, 0.0], "horizon": 1.0, **rest}
    return state_problem(system, barrier, box=box, dt=dt, backup=backup, **given)


def law(**rest):
    given = {"equilibrium": {x: 0, v: 0}, "extent": {x: 1.0, v: 1.0}, **rest}
    return BackupLaw("rest", (-x - k * v,), **given)


def half_widths(sets):
    return {
        str(s): w
        for symbols, e in sets
        for s, w in zip(symbols, e.box().high - e.center, strict=True)
    }


def test_a_linear_loops_set_reaches_to_what_bounds_it():
    problem = made(Backup((law(),), 1.0))
    ((symbols, e),) = derived_sets(problem, problem.plant, problem.backup.laws[0])
    assert symbols == (x, v)
    p = e.root @ e.root.T
    reach = np.array([math.sqrt(e.level * b @ np.linalg.solve(p, b)) for b in np.eye(2)])
    asked = math.sqrt(e.level * np.array([1, 2]) @ np.linalg.solve(p, [1, 2]))
    assert max(*reach, asked) <= 1.0
    assert max(*reach, asked) >= 0.9


def test_the_set_moves_with_the_equilibrium_and_its_parameters():
    moved = BackupLaw(
        "a", (-(x - 1 / k) - 2 * v,), equilibrium={x: 1 / k, v: 0}, extent={x: 1, v: 1}
    )
    problem = made(Backup((moved,), 1.0), gain=4.0)
    ((_, e),) = derived_sets(problem, problem.plant, moved)
    assert e.center.tolist() == [0.25, 0.0]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"dt": 0.1},
        {"substeps": 2},
        {"plant": {"m": 0.8}, "model": {"m": 0.8}},
        {"floor": 4.5, "ceiling": 5.5},
        {"tilt": 0.2},
        {"box": (1e4, 9e4)},
    ],
    ids=str,
)
@pytest.mark.slow
def test_the_quadrotors_set_is_kept_whatever_its_numbers(options):
    problem = make_problem("safe_envs/QuadrotorLimits-v0", **options)
    (stated,) = with_terminal_sets(problem, problem.plant).laws
    symbols, size = problem.plant.states, 4000
    barriers = [b.expression for b in problem.barriers]
    known = compile_function(symbols, [*stated.law, stated.terminal, *barriers], "arrays")
    step = Integrator(problem.plant, problem.dt, problem.substeps, "arrays")
    reach = half_widths(derived_sets(problem, problem.plant, problem.backup(problem).laws[0]))
    rng = np.random.default_rng(0)
    middle = np.array([5.0 if s.name == "z" else 0.0 for s in symbols])[:, None]
    half = np.array([reach.get(s.name, 3.0) for s in symbols])[:, None]
    y = middle + half * rng.uniform(-1, 1, (len(symbols), 40 * size))
    y = y[:, stacked(known(*y), 40 * size)[:, 4] >= 0.0][:, :size]
    assert y.shape[1] > 200
    low, high = problem.box[0]
    for _ in range(60):
        found = stacked(known(*y), y.shape[1])
        assert (found[:, 4:] >= 0.0).all()
        assert (found[:, :4] >= low).all()
        assert (found[:, :4] <= high).all()
        y = np.stack(step.step(tuple(y), tuple(found[:, :4].T), ()))


def test_the_quadrotors_set_is_of_a_size_to_reach():
    problem = make_problem("safe_envs/QuadrotorLimits-v0")
    reach = half_widths(derived_sets(problem, problem.plant, problem.backup(problem).laws[0]))
    assert reach["z"] > 0.5
    assert reach["zdot"] > 0.8
    assert min(reach["phi"], reach["theta"]) > 0.04
    assert min(reach["phidot"], reach["thetadot"]) > 0.8


def test_laws_and_stated_sets_come_back_in_numbers():
    stated = BackupLaw("a", (-k * v,), terminal=1 - k * x)
    found = with_terminal_sets(made(Backup((stated,), 1.0)), made(None, gain=3.0).plant)
    assert found.laws == (BackupLaw("a", (-3 * v,), terminal=1 - 3 * x),)
    assert with_terminal_sets(made(None), made(None).plant) is None


@pytest.mark.parametrize(
    ("build", "complaint"),
    [
        (lambda: made(Backup((law(),), 1.0), gain=-1.0), "does not bring x, v back"),
        (lambda: made(Backup((law(),), 1.0), dt=3.0, horizon=30.0), "a shorter dt"),
        (lambda: made(Backup((law(),), 1.0), barrier=-x - 1, start=[-2, 0]), "could not be proved"),
        (lambda: made(Backup((law(),), 1.0), box=(0.5, 1.0)), "could not be proved"),
    ],
)
def test_a_law_that_keeps_nothing_is_told(build, complaint):
    problem = build()
    with pytest.raises(ConfigurationError, match=complaint):
        with_terminal_sets(problem, problem.plant)


@pytest.mark.slow
def test_a_quadrotor_that_cannot_hover_is_told():
    problem = make_problem("safe_envs/QuadrotorLimits-v0", box=(0.0, 4e4))
    with pytest.raises(ConfigurationError, match="could not be proved"):
        with_terminal_sets(problem, problem.plant)


def test_an_endless_workspace_needs_an_extent():
    problem = made(Backup((law(extent={x: 1.0}),), 1.0))
    with pytest.raises(SystemDefinitionError, match="needs an extent of v"):
        with_terminal_sets(problem, problem.plant)


def test_a_barrier_of_other_states_is_told():
    only = BackupLaw("a", (-v,), equilibrium={v: 0}, extent={v: 1.0})
    problem = made(Backup((only,), 1.0))
    with pytest.raises(SystemDefinitionError, match="unknown symbol x"):
        with_terminal_sets(problem, problem.plant)


DECAY = ControlAffineSDE((x,), (u,), [-x], [1], [0])


def decaying(entry, at=0.0, extent=0.5, system=DECAY, margin=0.0):
    """The derived set of x' = -x + u, u in [-3, 3], under a law; x <= 10 is safe."""
    stated = BackupLaw("said", (sp.sympify(entry),), equilibrium={x: at}, extent={x: extent})
    backup, times = Backup((stated,), 1.0), {"dt": 0.1, "horizon": 1.0}
    problem = state_problem(system, 10 - x, box=(-3, 3), start=[0.0], backup=backup, **times)
    return with_terminal_sets(problem, system, margin).laws[0].terminal


def test_a_constant_input_beyond_the_bounds_is_not_taken_for_one_within():
    assert decaying(2, at=2.0).subs({x: 2.0}) == 1  # Under 3, the most, x leaves for 3.
    with pytest.raises(ConfigurationError, match="could not be proved"):
        decaying(5, at=5.0)


def test_what_jumps_is_refused():
    angle = sp.atan2(x - 0.1, -1)
    with pytest.raises(SystemDefinitionError, match="jumps"):
        decaying(-angle + sp.atan2(-0.1, -1))
    found = decaying(-sp.Max(x, angle))  # The angle is -3 below x = .1, and 3 above.
    assert float(found.subs({x: 0.09})) > 0.0 > float(found.subs({x: 0.11}))


@pytest.mark.parametrize("entry", [sp.Piecewise((-x - 1, x > 0.1), (-x, True)), sp.floor(x)])
def test_what_has_no_enclosure_is_refused(entry):
    with pytest.raises(SystemDefinitionError, match="no interval form"):
        decaying(entry)


def test_laws_without_slope_and_extents_without_squares_are_told():
    with pytest.raises(ConfigurationError, match="could not be proved"):
        decaying(-sp.sqrt(x - 0.1))
    for extent in (1e-300, 1e300):
        with pytest.raises(ConfigurationError, match="extent of backup law said"):
            decaying(-x, extent=extent)


def test_derived_sets_keep_a_margin():
    ends = {m: float(sp.Max(*sp.solve(decaying(-x, 0.0, 3.0, margin=m), x))) for m in (0.0, 8.0)}
    assert ends[0.0] > 2.5
    assert 1.8 < ends[8.0] <= 2.0
    with pytest.raises(ConfigurationError, match="could not be proved"):
        decaying(-x, margin=11.0)
