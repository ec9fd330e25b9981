"""Terminal sets: derived ones are kept and as large as can be, stated ones are looked at."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SystemDefinitionError, define_problem
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.enclosures.intervals import Interval
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.proofs.backup_filter import BackupFilter
from safe_envs.proofs.backup_sets import (
    BallMatrix,
    Disturbance,
    derived_sets,
    exactly,
    held_law,
    interval_of,
    norm_bound,
    times,
    with_terminal_sets,
)
from safe_envs.registry import make_problem
from tests.oracles.carts import BRAKE, PULL, STRONGEST, cart_problem

x, v, w, u, k = sp.symbols("x v w u k", real=True)


def made(rates, law, barrier=10 - x, *, input_bounds=(-50.0, 50.0), dt=0.1, **rest):
    """Return a problem of x' (and v', w') with one backup law, and no noise."""
    states = (x, v, w)[: len(rates)]
    inputs = [[0]] * (len(rates) - 1) + [[1]]
    parameters = {k: rest.pop("gain")} if "gain" in rest else {}
    system = ControlAffineSDE(states, (u,), rates, inputs, [[0]] * len(states), parameters)
    given = {"start": [0.0] * len(states), "horizon": 10 * dt, **rest}
    backup = None if law is None else Backup((law,), 1.0)
    return define_problem(system, barrier, input_bounds=input_bounds, dt=dt, backup=backup, **given)


def to_zero(entry, extent=3.0, states=(x,), at=0):
    return BackupLaw(
        "said",
        (sp.sympify(entry),),
        equilibrium=dict.fromkeys(states, at),
        extent=dict.fromkeys(states, extent),
    )


def half_widths(problem):
    """Return how far the derived set of a problem's law reaches, by the names of states."""
    backup = problem.backup if isinstance(problem.backup, Backup) else problem.backup(problem)
    return {
        str(symbol): float(half)
        for symbols, e in derived_sets(problem, problem.plant, backup.laws[0])
        for symbol, half in zip(symbols, e.box().high - e.center, strict=True)
    }


def half_width(rate, entry, barrier=10 - x, extent=3.0, **rest):
    """Return the half width of the derived set of x' = rate(x) + u; 0 where none is proved."""
    problem = made([rate], to_zero(entry, extent), barrier, **rest)
    try:
        return half_widths(problem)["x"]
    except ConfigurationError:
        return 0.0


@pytest.mark.parametrize(
    ("rate", "entry", "limit", "share"),
    [
        # Held over a period, x becomes (1 - .1 gain) x: a gain above 20 turns it around. The
        # input bounds are 50.
        (0, -x, 3.0, 0.99),
        (0, -19.99 * x, 50 / 19.99, 0.9),
        (0, -20.01 * x, 0.0, 0.0),
        (0, x, 0.0, 0.0),
        # x' = x^3 - x_0 contracts as far as the mean of x^2 over a period is below 1/3.
        (x**3, -x, 1 / math.sqrt(3) + 0.02, 0.95),
        # The slope of x -> x - .2 sin(x) cos(x) is below 1 up to pi/4.
        (0, -2 * sp.sin(x) * sp.cos(x), math.pi / 4, 0.98),
        # Nothing is said where there is no value.
        (1 / (x - 0.5) + 2, -x, 0.5, 0.5),
    ],
)
def test_a_derived_set_reaches_to_where_the_law_contracts_and_no_further(rate, entry, limit, share):
    reach = half_width(sp.sympify(rate), entry)
    assert share * limit <= reach <= limit * (1 + 1e-3) + 1e-9


@pytest.mark.parametrize(
    "barrier",
    [1 - x**2, sp.Min(1 - x, 2 + x), sp.log(x + 1) + 10],
)
def test_a_derived_set_is_safe_to_its_edge(barrier):
    assert 0.9 < half_width(0, -x, barrier) <= 1.0


def test_a_linear_loops_set_reaches_to_what_bounds_it():
    problem = made([v, 0], to_zero(-x - 2 * v, 1.0, (x, v)), 1 - x, input_bounds=(-1.0, 1.0))
    ((symbols, e),) = derived_sets(problem, problem.plant, problem.backup.laws[0])
    assert symbols == (x, v)
    p = e.root @ e.root.T
    reach = np.array([math.sqrt(e.level * b @ np.linalg.solve(p, b)) for b in np.eye(2)])
    asked = math.sqrt(e.level * np.array([1, 2]) @ np.linalg.solve(p, [1, 2]))
    assert 0.9 <= max(*reach, asked) <= 1.0


def test_the_set_moves_with_the_equilibrium_and_its_parameters():
    law = BackupLaw("a", (-(x - 1 / k) - 2 * v,), equilibrium={x: 1 / k, v: 0}, extent={x: 1, v: 1})
    problem = made([v, 0], law, 1 - x, input_bounds=(-1.0, 1.0), gain=4.0)
    ((_, e),) = derived_sets(problem, problem.plant, law)
    assert e.center.tolist() == [0.25, 0.0]


def require_kept(problem, size=1500, periods=10):
    """Require that the env stays in the derived set under the law, within its bounds, and safe.

    Returns how far it reaches."""
    (stated,) = with_terminal_sets(problem, problem.plant).laws
    symbols, reach = problem.plant.states, half_widths(problem)
    barriers = [b.expression for b in problem.barriers]
    known = compile_function(symbols, [*stated.law, stated.terminal, *barriers], "arrays")
    step, m = Integrator(problem.plant, problem.dt, problem.substeps, "arrays"), problem.plant.m
    rng = np.random.default_rng(0)
    middle = np.array([5.0 if s.name == "z" else 0.0 for s in symbols])[:, None]
    half = np.array([reach.get(s.name, 3.0) for s in symbols])[:, None]
    y = middle + half * rng.uniform(-1, 1, (len(symbols), 40 * size))
    y = y[:, stacked(known(*y), 40 * size)[:, m] >= 0.0][:, :size]
    assert y.shape[1] > 100
    low, high = np.array(problem.input_bounds).T
    for _ in range(periods):
        found = stacked(known(*y), y.shape[1])
        assert (found[:, m:] >= 0.0).all()
        assert (found[:, :m] >= low).all()
        assert (found[:, :m] <= high).all()
        y = np.stack(step.step(tuple(y), tuple(found[:, :m].T), ()))
    return reach


@pytest.mark.parametrize(
    "make",
    [
        lambda: made([v, 0], to_zero(-x - 2 * v, 1.0, (x, v)), 1 - x, input_bounds=(-1.0, 1.0)),
        lambda: made([v, -sp.sin(x)], to_zero(-2 * v, 1.0, (x, v)), sp.Rational(1, 2) - x),
        lambda: made(
            [v, -sp.sin(x)], to_zero(-2 * v, 1.0, (x, v)), 1 - x, dt=0.3, substeps=3, horizon=3.0
        ),
        # w follows x, which is in another block: what pushes out of its set is taken into account.
        lambda: made([-x, x / 2 - v, x**2 - w], to_zero(0, 0.6, (x, v, w)), sp.Rational(3, 5) - w),
        # Saturated: the branch of the law at the equilibrium, as far as it is the law.
        lambda: made(
            [v, -x],
            to_zero(sp.Max(-1, sp.Min(1, -2 * v)), 1.0, (x, v)),
            2 - x,
            input_bounds=(-1.0, 1.0),
        ),
    ],
)
def test_derived_sets_are_kept(make):
    require_kept(make())


@pytest.mark.parametrize(
    "options",
    [
        {},
        *(
            pytest.param(options, marks=pytest.mark.oracle)
            for options in (
                {"dt": 0.1},
                {"substeps": 2},
                {"plant": {"m": 0.8}, "model": {"m": 0.8}},
                {"floor": 4.5, "ceiling": 5.5},
                {"tilt": 0.2},
                {"input_bounds": (1e4, 9e4)},
            )
        ),
    ],
    ids=str,
)
def test_the_quadrotors_set_is_kept_whatever_its_numbers(options):
    problem = make_problem("safe_envs/QuadrotorLimits-v0", **options)
    reach = require_kept(problem)
    if not options:
        assert reach["z"] > 0.5
        assert reach["zdot"] > 0.8
        assert min(reach["phi"], reach["theta"]) > 0.04
        assert min(reach["phidot"], reach["thetadot"]) > 0.8


def test_laws_and_stated_sets_come_back_in_numbers():
    stated = BackupLaw("a", (-k * v,), terminal=1 - k * x)
    rates = [v, 0]
    found = with_terminal_sets(
        made(rates, stated, 1 - x, gain=2.0), made(rates, None, 1 - x, gain=3.0).plant
    )
    assert found.laws == (BackupLaw("a", (-3 * v,), terminal=1 - 3 * x),)
    bare = made(rates, None, 1 - x)
    assert with_terminal_sets(bare, bare.plant) is None


def test_derived_sets_keep_a_margin():
    problem = made([-x], to_zero(-x), input_bounds=(-3, 3))
    ends = {}
    for margin in (0.0, 8.0):
        terminal = with_terminal_sets(problem, problem.plant, margin).laws[0].terminal
        ends[margin] = float(sp.Max(*sp.solve(terminal, x)))
    assert ends[0.0] > 2.5
    assert 1.8 < ends[8.0] <= 2.0
    with pytest.raises(ConfigurationError, match="proved"):
        with_terminal_sets(problem, problem.plant, 11.0)


def test_a_constant_input_at_the_equilibrium_is_within_the_bounds():
    # x' = -x + u under u = 2 rests at 2; under 3, the most, x leaves for 3; 5 is clipped.
    problem = made([-x], to_zero(2, 0.5, at=2.0), input_bounds=(-3, 3), start=[2.0])
    terminal = with_terminal_sets(problem, problem.plant).laws[0].terminal
    assert terminal.subs({x: 2.0}) == 1
    problem = made([-x], to_zero(5, 0.5, at=5.0), input_bounds=(-3, 3), start=[2.0])
    with pytest.raises(ConfigurationError, match="proved"):
        with_terminal_sets(problem, problem.plant)


ANGLE = sp.atan2(x - 0.1, -1)


def test_a_law_that_jumps_elsewhere_is_kept_away_from_the_jump():
    # The angle is -3 below x = .1, and 3 above.
    problem = made([-x], to_zero(-sp.Max(x, ANGLE), 0.5), input_bounds=(-3, 3))
    terminal = with_terminal_sets(problem, problem.plant).laws[0].terminal
    assert float(terminal.subs({x: 0.09})) > 0.0 > float(terminal.subs({x: 0.11}))


PIECES = sp.Piecewise((-x - 1, x > 0.1), (-x, True))


def cart(**rest):
    given = {"extent": {x: 1.0, v: 1.0}, "gain": 2.0, "input_bounds": (-1.0, 1.0), **rest}
    given.setdefault("barrier", 1 - x)
    law = BackupLaw("rest", (-x - k * v,), equilibrium={x: 0, v: 0}, extent=given.pop("extent"))
    return made([v, 0], law, **given)


@pytest.mark.parametrize(
    ("build", "error", "fragment"),
    [
        (lambda: cart(gain=-1.0), ConfigurationError, "x, v"),
        (lambda: cart(dt=3.0), ConfigurationError, "dt"),
        (lambda: cart(barrier=-x - 1, start=[-2, 0]), ConfigurationError, "rest"),
        (lambda: cart(input_bounds=(0.5, 1.0)), ConfigurationError, "rest"),
        (lambda: cart(extent={x: 1.0}), SystemDefinitionError, "extent of v"),
        (lambda: made([v, 0], to_zero(-v, 1.0, (v,)), 1 - x), SystemDefinitionError, "x"),
        # What the coordinates depend on belongs to them.
        (lambda: made([v, -x], to_zero(-v, 1, (v,)), 1 - v), SystemDefinitionError, "depends on x"),
        (lambda: made([v, 0], to_zero(-x - v, 1, (v,)), 1 - v), SystemDefinitionError, "law itsel"),
        (lambda: made([-x], to_zero(-ANGLE + sp.atan2(-0.1, -1))), SystemDefinitionError, "jumps"),
        (lambda: made([-x], to_zero(PIECES)), SystemDefinitionError, "Piecewise"),
        (lambda: made([-x], to_zero(sp.floor(x))), SystemDefinitionError, "interval form"),
        (lambda: made([-x], to_zero(-sp.sqrt(x - 0.1))), ConfigurationError, "said"),
        (lambda: made([-x], to_zero(-x, 1e-300)), ConfigurationError, "extent.* said"),
        (lambda: made([-x], to_zero(-x, 1e300)), ConfigurationError, "extent.* said"),
        pytest.param(
            lambda: make_problem("safe_envs/QuadrotorLimits-v0", input_bounds=(0.0, 4e4)),
            ConfigurationError,
            "proved",
            marks=pytest.mark.oracle,
        ),
    ],
)
def test_a_law_of_which_nothing_is_proved_is_refused(build, error, fragment):
    problem = build()
    with pytest.raises(error, match=fragment):
        with_terminal_sets(problem, problem.plant)


@pytest.mark.parametrize("substeps", [1, 3])
def test_a_period_encloses_the_integrators_step_and_its_slopes(substeps):
    rng, nothing = np.random.default_rng(0), Interval(np.zeros(0), np.zeros(0))
    system = made([v, -sp.sin(x)], None).plant
    law = BackupLaw("hang", (-2 * v,), equilibrium={x: 0, v: 0})
    (block,) = held_law(system, law, 0.3 / substeps, substeps).blocks
    step = Integrator(system, 0.3, substeps, "arrays")

    def executed(y):
        return np.stack(step.step((y[0], y[1]), (-2.0 * y[1],), ()))

    for width in (0.0, 0.01, *rng.uniform(0, 0.3, 10)):
        low = rng.uniform(-2, 2, 2)
        high = low + rng.uniform(0, width, 2)
        found = block.period(Interval(low[None, :], high[None, :]), Disturbance(nothing, nothing))
        y = rng.uniform(low[:, None], high[:, None], (2, 200))
        after = executed(y)
        assert (found.after.low[0][:, None] <= after + 1e-12).all()
        assert (after - 1e-12 <= found.after.high[0][:, None]).all()
        if not width:
            assert (found.after.high - found.after.low < 1e-12).all()
            assert (found.slope.radius < 1e-12).all()
        for j in range(2):
            d = np.zeros((2, 1))
            d[j] = 1e-6
            slope = (executed(y + d) - executed(y - d)) / 2e-6
            center, radius = (part[0, :, j, None] for part in found.slope)
            assert (np.abs(slope - center) <= radius + 1e-8).all()


def test_ball_matrices_hold_exact_products_and_bound_norms_closely():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = rng.standard_normal((2, 5, 5)) * 10.0 ** rng.integers(-8, 8, (2, 5, 5))
        low, high = interval_of(times(exactly(a), exactly(b)))
        for i, j in np.ndindex(5, 5):
            exact = sum(Fraction(a[i, n]) * Fraction(b[n, j]) for n in range(5))
            assert Fraction(low[i, j]) <= exact <= Fraction(high[i, j])
    a, b = rng.standard_normal((2, 3, 3))
    r, s = np.abs(rng.standard_normal((2, 3, 3)))
    low, high = interval_of(times(BallMatrix(a, r), BallMatrix(b, s)))
    bound = norm_bound(BallMatrix(a, r))
    for _ in range(200):
        left, right = (c + w * rng.choice([-1, 1], (3, 3)) for c, w in ((a, r), (b, s)))
        assert (low <= left @ right + 1e-12).all()
        assert (left @ right - 1e-12 <= high).all()
        assert np.linalg.norm(left, 2) <= bound
    many = rng.standard_normal((100, 6, 6)) * np.exp(rng.standard_normal((100, 6, 6)) * 3)
    true, bound = np.linalg.norm(many, 2, axis=(-2, -1)), norm_bound(exactly(many))
    assert (bound >= true).all()
    assert (bound <= true * (1.0 + 1e-10)).all()
    assert norm_bound(BallMatrix(np.zeros((1, 1, 1)), np.full((1, 1, 1), np.inf)))[0] == np.inf


def stated(law, terminal, **options):
    said = BackupLaw("said", (sp.sympify(law),), terminal=terminal)
    return BackupFilter.for_problem(cart_problem(laws=(said,), **options))


@pytest.mark.parametrize(
    ("law", "terminal", "said"),
    [
        (-STRONGEST, 1 - x, "leaves it"),
        (-STRONGEST, 10 - x - v, "unsafe state"),
        (0, 1 - x - sp.Max(v, 0) ** 2, "leaves it"),
        # What full braking keeps in continuous control, with a third of the way too little.
        (-STRONGEST, 1 - x - sp.Max(v, 0) ** 2 / (3 * STRONGEST), "leaves it"),
        (-STRONGEST, sp.Float(0.2) - (x - 0.5) ** 2 - v**2, "leaves it"),
        (-STRONGEST - sp.sqrt(x + 0.2), sp.Min(-v, 1 - x), "no finite input"),
    ],
)
def test_a_set_that_is_not_kept_is_refused(law, terminal, said):
    with pytest.raises(SystemDefinitionError, match=said) as error:
        stated(law, terminal)
    names = dict(re.findall(r"(\w+) = (-?[\d.e-]+),", str(error.value)))
    at = {x: float(names["x"]), v: float(names["v"])}
    assert float(terminal.subs(at)) >= -1e-5


@pytest.mark.parametrize("terminal", [-v, sp.Min(-v, 1 - x), sp.Integer(-1), -v - 1000])
def test_a_set_whose_safe_part_is_kept_is_taken(terminal):
    assert stated(-STRONGEST, terminal).stated == ("said",)


def test_each_law_is_looked_at():
    with pytest.raises(SystemDefinitionError, match="backup law wrong: at x = "):
        BackupFilter.for_problem(
            cart_problem(laws=(BRAKE, BackupLaw("wrong", (sp.Integer(1),), terminal=1 - x - v)))
        )
    with pytest.raises(SystemDefinitionError, match="backup law brake: at"):
        BackupFilter.for_problem(cart_problem(laws=(BRAKE, PULL), barriers=(1 - x, x + 1)))


def test_with_noise_only_the_numbers_of_the_law_are_looked_at():
    assert stated(0, 1 - x, noise=0.1).stated == ("said",)
    with pytest.raises(SystemDefinitionError, match="no finite input"):
        stated(sp.log(x), 1 - x, noise=0.1)


def test_a_margin_beyond_the_set_is_refused():
    problem = cart_problem(laws=(BackupLaw("said", (-STRONGEST,), sp.Min(-v, 1 - x, x + 3)),))
    with pytest.raises(SystemDefinitionError, match="leaves it"):
        BackupFilter.for_problem(problem, "backup:margin=0.1")
    with pytest.raises(ConfigurationError, match=r"margin = 1000 .* smallest barrier is"):
        BackupFilter.for_problem(cart_problem(), "backup:margin=1000")


def test_a_function_of_a_backup_that_fails_is_told():
    problem = cart_problem(backup=lambda problem: problem.missing)
    with pytest.raises(SystemDefinitionError, match="failed: AttributeError"):
        BackupFilter.for_problem(problem)
