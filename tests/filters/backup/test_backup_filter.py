"""What the backup filter keeps, against exact kernels; one state and batches; the last resort."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, InvalidInputError, SystemDefinitionError
from safe_envs.agents import make_policy
from safe_envs.agents.evaluation.compiled_episodes import CompiledEpisodes
from safe_envs.agents.evaluation.episodes import play
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.integrators import Integrator
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings
from safe_envs.registry import make_problem
from safe_envs.values.promise_filter import PromiseSettings
from safe_envs.wrappers import SafetyFilterVectorWrapper, parse_conditions
from safe_envs.wrappers.filter_layers import settings_of
from tests.conftest import problem_of
from tests.oracles.carts import (
    BRAKE,
    DT,
    PULL,
    STRONGEST,
    a,
    backup,
    cart,
    cart_filter,
    cart_problem,
    drawn,
    highest,
    moved,
    settings,
    table_problem,
    v,
    x,
)

BOUNDS = (-STRONGEST, STRONGEST)


def test_the_kept_set_is_the_kernel_of_held_inputs():
    states, proposed = drawn(6000)
    found = cart_filter().filter(states, proposed)
    clear = np.abs(highest(states) - 1.0) > 1e-9
    kept = highest(states) <= 1.0
    assert (found.feasible == kept)[clear].all()
    assert 0.2 < kept.mean() < 0.9


def test_an_input_is_allowed_exactly_where_it_leads_into_the_kernel():
    states, proposed = drawn(6000)
    found = cart_filter().filter(states, proposed)
    reached = moved(states, proposed)
    level = np.maximum(reached[:, 0], highest(reached))
    clear = np.abs(level - 1.0) > 1e-8
    passed = (found.action == proposed)[:, 0]
    assert (passed == (level <= 1.0))[clear].all()
    # Where it is not, the largest input that does is missed by a step of the search at most.
    changed = ~passed & found.feasible & clear
    assert changed.sum() > 100
    u = found.action[changed, 0]
    reached = moved(states[changed], found.action[changed])
    assert np.maximum(reached[:, 0], highest(reached)).max() <= 1.0
    step = (proposed[changed, 0] + STRONGEST) / 64
    beyond = moved(states[changed], (u + step)[:, None])
    assert (np.maximum(beyond[:, 0], highest(beyond)) > 1.0 - 1e-8).all()


@pytest.mark.parametrize("dt", [0.1, 0.02])
def test_the_kept_set_approaches_that_of_continuous_control(dt):
    rng = np.random.default_rng(1)
    speed = rng.uniform(0.0, 2.0, 200)
    edge = 1.0 - speed**2 / (2 * STRONGEST)
    guard = cart_filter(dt=dt)
    # Between control instants the cart may be beyond by what it climbs in half a period.
    over = STRONGEST * dt**2 / 8
    rest = np.zeros((200, 1))
    inside = guard.filter(np.column_stack([edge - 1e-9, speed]), rest)
    outside = guard.filter(np.column_stack([edge + over + 1e-9, speed]), rest)
    stays = speed > STRONGEST * dt  # else it is in the terminal set one instant later
    assert inside.feasible.all()
    assert not outside.feasible[stays].any()


def test_from_the_kernel_nothing_makes_it_infeasible():
    """Steps of random and of hostile proposals, in the env's own arithmetic."""
    states, _ = drawn(4000, seed=3)
    states = states[highest(states) <= 1.0 - 1e-9][:300]
    guard, rng = cart_filter(), np.random.default_rng(4)
    lowest = np.inf
    for k in range(80):
        proposed = rng.uniform(-2 * STRONGEST, 2 * STRONGEST, (300, 1))
        proposed[::2] = STRONGEST
        found = guard.filter(states, proposed)
        assert found.feasible.all(), k
        assert np.abs(found.action).max() <= STRONGEST
        states = moved(states, found.action)
        lowest = min(lowest, (1.0 - states[:, 0]).min())
    assert lowest >= 0.0
    assert (states[::2, 0] > 0.99).mean() > 0.5  # it lets them come close


def test_a_margin_holds_at_every_instant():
    states, _ = drawn(4000, seed=5)
    states = states[highest(states) <= 0.9][:200]
    guard = cart_filter(settings=settings(margin=0.05))
    for _ in range(60):
        states = moved(states, guard.filter(states, np.full((200, 1), STRONGEST)).action)
    assert 0.05 <= (1.0 - states[:, 0]).min() < 0.06


def test_a_short_horizon_keeps_less_and_stays_feasible():
    states, proposed = drawn(1500, seed=6)
    long, short = cart_filter(), cart_filter(horizon=0.5)
    at_ease = short.filter(states, proposed).feasible
    assert (long.filter(states, proposed).feasible[at_ease]).all()
    # v <= 0 after 1 + 5 periods of full braking.
    assert (states[at_ease, 1] <= 0.6 * STRONGEST + 1e-12).all()
    states = states[at_ease]
    for _ in range(40):
        found = short.filter(states, np.full((len(states), 1), STRONGEST))
        assert found.feasible.all()
        states = moved(states, found.action)
    assert states[:, 0].max() <= 1.0


def walls(laws=(BRAKE, PULL)):
    """-1 <= x <= 1; to brake at one wall may lead to the other."""
    far = tuple(
        replace(law, terminal=sp.Min(law.terminal, (1 + x) - 3 * v**2 / 2 - v**2))
        if law is BRAKE
        else replace(law, terminal=sp.Min(law.terminal, (1 - x) - 3 * v**2 / 2 - v**2))
        for law in laws
    )
    return BackupFilter(cart(), (1 - x, 1 + x), Backup(far, 4.0), BOUNDS, DT)


@pytest.mark.parametrize("guard", [cart_filter(), walls(), walls((PULL,))])
def test_one_state_is_decided_as_in_a_batch(guard):
    states, proposed = drawn(60, seed=7)
    together = guard.filter(states, proposed)
    assert len(np.unique(together.active)) == len(np.unique(together.feasible)) == 2
    for i, (state, u) in enumerate(zip(states, proposed, strict=True)):
        alone = guard.filter(state, u)
        for name in ("action", "margin", "slack", "barrier"):
            np.testing.assert_allclose(
                getattr(alone, name), getattr(together, name)[i], atol=1e-12, err_msg=name
            )
        for name in ("active", "feasible", "cause"):
            assert np.array_equal(getattr(alone, name), getattr(together, name)[i]), name
        components = guard.decide_floats(state.tolist(), u.tolist())
        np.testing.assert_allclose(components.action, together.action[i], atol=1e-12)
        assert components.feasible == together.feasible[i]


def test_batches_of_any_shape_and_size():
    states, proposed = drawn(4200)
    flat = cart_filter().filter(states, proposed)
    shaped = cart_filter().filter(states.reshape(3, 1400, 2), proposed.reshape(3, 1400, 1))
    for part, other in zip(flat, shaped, strict=True):
        assert np.array_equal(part, np.reshape(other, np.shape(part)))
    assert shaped.action.shape == (3, 1400, 1)
    assert shaped.feasible.shape == shaped.cause.shape == (3, 1400)
    half = cart_filter().filter(states[2500:], proposed[2500:])
    assert np.array_equal(flat.action[2500:], half.action)


def test_a_proposal_that_is_allowed_passes_to_the_last_bit():
    found = cart_filter().filter([-1.0, 0.1], [0.123456789])
    assert found.action.tolist() == [0.123456789]
    assert (found.active.tolist(), found.cause, found.slack.tolist()) == ([False], -1, [0.0])
    assert found.margin[0] == pytest.approx(1.0 + 1.0 - 0.1 * 0.1 - 0.5 * 0.1**2 * 0.1234, abs=0.01)


def test_a_proposal_beyond_its_bounds_is_clipped():
    found = cart_filter().filter([-1.0, 0.1], [7.0])
    assert found.action.tolist() == [STRONGEST]
    assert found.proposed.tolist() == [7.0]


def test_the_cause_is_the_barrier_that_the_proposal_violates():
    guard = walls()
    assert guard.filter([0.9, 0.3], [STRONGEST]).cause == 0
    assert guard.filter([-0.9, -0.3], [-STRONGEST]).cause == 1


def test_several_laws_keep_more_than_each_of_them():
    states, proposed = drawn(1500, seed=8)
    both, brake, pull = (
        guard.filter(states, proposed) for guard in (walls(), walls((BRAKE,)), walls((PULL,)))
    )
    assert (both.feasible >= (brake.feasible | pull.feasible)).all()
    assert both.feasible.sum() > max(brake.feasible.sum(), pull.feasible.sum())
    # Of the segments from both laws, that one is taken which comes nearer to the proposal.
    sure = brake.feasible & pull.feasible
    away = [np.abs(found.action - proposed)[sure, 0] for found in (both, brake, pull)]
    assert (away[0] <= np.minimum(away[1], away[2]) + 2 * STRONGEST / 64).all()


def test_where_nothing_keeps_safe_the_best_plan_is_followed_and_told():
    found = cart_filter().filter([0.9, 2.0], [STRONGEST])
    assert not found.feasible
    assert found.action.tolist() == [-STRONGEST]
    k = np.arange(1, 40) * DT
    peak = (0.9 + 2.0 * k - STRONGEST * k**2 / 2).max()
    assert found.slack[0] == pytest.approx(peak - 1.0, abs=1e-12)


def test_too_short_a_horizon_is_told_without_a_slack():
    found = cart_filter(horizon=0.2).filter([-9.0, 3.0], [0.0])
    assert (found.feasible, found.cause, found.slack.tolist()) == (False, -1, [0.0])


def test_a_law_without_a_value_does_not_become_an_action():
    law = BackupLaw("root", (sp.sqrt(x),), terminal=sp.Min(-v, 1 - x))
    guard = BackupFilter(cart(), 1 - x, backup(laws=(law,)), BOUNDS, DT)
    for found in (guard.filter([-1.0, 0.5], [0.1]), guard.filter([[-1.0, 0.5]] * 2, [[0.1]] * 2)):
        assert np.isfinite(found.action).all()
        assert not np.any(found.feasible)


def test_a_plan_that_overflows_is_not_allowed():
    grows = replace(cart(), drift=sp.Matrix([v, sp.exp(sp.exp(v))]))
    guard = BackupFilter(grows, 1 - x, backup(), BOUNDS, DT)
    for found in (guard.filter([-1.0, 7.0], [0.1]), guard.filter([[-1.0, 7.0]] * 2, [[0.1]] * 2)):
        assert not np.any(found.feasible)
        assert np.isfinite(found.action).all()


def test_with_noise_plans_are_of_the_mean_and_promise_nothing():
    problem = cart_problem(noise=0.1)
    guard = BackupFilter.for_problem(problem)
    assert guard.filter([-1.0, 0.1], [0.2]).action.tolist() == [0.2]
    assert guard.filter([0.9, 0.5], [1.0]).action[0] < 0.5
    assert "noise" in guard.why_not(problem.plant)
    assert BackupFilter.for_problem(cart_problem()).why_not(cart()) == ""
    assert "differs" in BackupFilter.for_problem(cart_problem()).why_not(
        replace(cart(), drift=sp.Matrix([v, 1]))
    )


def test_knowledge_says_whose_plans_are_simulated():
    weak = replace(cart(), input_matrix=sp.Matrix([0, sp.Rational(1, 2)]))
    problem = cart_problem(model=weak)
    state = [0.6, 0.9]
    assert BackupFilter.for_problem(problem, knowledge="plant").filter(state, [0.0]).feasible
    assert not BackupFilter.for_problem(problem, knowledge="model").filter(state, [0.0]).feasible


def test_copies_and_pickles_decide_alike():
    guard = cart_filter()
    states, proposed = drawn(50)
    for other in (copy.deepcopy(guard), pickle.loads(pickle.dumps(guard))):
        assert np.array_equal(
            other.filter(states, proposed).action, guard.filter(states, proposed).action
        )


of = BackupFilter.for_problem


def made(system=None, barriers=1 - x, stated=None, bounds=BOUNDS, dt=DT):
    return BackupFilter(system or cart(), barriers, stated or backup(), bounds, dt)


ENDLESS = BackupLaw("endless", (-v,), equilibrium={x: 0, v: 0})
WITH_INPUT = BackupLaw("b", (a,), terminal=v)


@pytest.mark.parametrize(
    ("make", "error", "fragment"),
    [
        (lambda: BackupFilter.for_problem(cart()), SystemDefinitionError, "SafetyProblem"),
        (lambda: of(cart_problem(backup=None)), ConfigurationError, "backup.*BackupLaw"),
        (lambda: of(cart_problem().configured(rate_limit=(-1, 1))), ConfigurationError, "rate_"),
        (lambda: of(cart_problem(), knowledge="all"), ConfigurationError, "'all'"),
        (lambda: made(stated=BRAKE), SystemDefinitionError, "Backup"),
        (lambda: made(stated=backup(laws=(ENDLESS,))), SystemDefinitionError, "endless"),
        (lambda: made(stated=backup(laws=(WITH_INPUT,))), SystemDefinitionError, "b"),
        (lambda: made(bounds=(-np.inf, 1.0)), ConfigurationError, "bounds of a"),
        (lambda: made(dt=0.0), ConfigurationError, "dt"),
        (lambda: made(barriers=1 - sp.Symbol("q")), SystemDefinitionError, "q"),
        (lambda: cart_filter(settings=settings(horizon=1e5)), ConfigurationError, "1000000"),
        (lambda: cart_filter().filter([0.0], [0.0]), InvalidInputError, "state"),
        (lambda: cart_filter().filter([0.0, np.nan], [0.0]), InvalidInputError, "finite"),
        (lambda: cart_filter().filter([0.0, 0.0], [np.inf]), InvalidInputError, "finite"),
    ],
)
def test_what_cannot_be_made_or_decided_is_refused(make, error, fragment):
    with pytest.raises(error, match=fragment):
        make()


def test_another_problem_is_refused():
    guard = BackupFilter.for_problem(cart_problem())
    guard.require_problem(cart_problem())
    for options, what in (
        ({"input_bounds": (-1, 1)}, "input bounds"),
        ({"dt": 0.05}, "control period"),
        ({"barriers": 2 - x}, "barriers"),
    ):
        with pytest.raises(ConfigurationError, match=what):
            guard.require_problem(cart_problem(**options))
    with pytest.raises(ConfigurationError, match="system"):
        guard.require_problem(cart_problem(noise=0.1))


def table_states(count):
    rng = np.random.default_rng(2)
    states = np.column_stack(
        [rng.uniform(lo, hi, count) for lo, hi in ((-1, 1), (0, 1.5), (-1, 0), (-1, 1))]
    )
    return states, rng.uniform(-STRONGEST, STRONGEST, (count, 2))


@pytest.fixture(scope="module")
def two_inputs():
    return BackupFilter.for_problem(table_problem())


def test_the_input_along_the_wall_is_left_as_it_was(two_inputs):
    states, proposed = table_states(1200)
    proposed[:, 0] = STRONGEST
    found = two_inputs.filter(states, proposed)
    alone = cart_filter().filter(states[:, :2], proposed[:, :1])
    changed = found.feasible & found.active[:, 0]
    assert changed.sum() > 60
    assert (np.abs(found.action) <= STRONGEST).all()
    along = np.abs(found.action - proposed)[changed, 1]
    assert np.median(along) < 1e-9
    # Where the instant of the peak changes on the way, the slopes are of another one.
    assert (along > 0.1).mean() < 0.1
    # And the other one is about as near as that of the cart on its own.
    lost = (alone.action - found.action)[changed, 0]
    assert np.abs(lost).max() < 2 * STRONGEST / 8
    assert np.mean(lost) < 2 * STRONGEST / 64


def test_nothing_is_executed_that_was_not_verified(two_inputs):
    states, proposed = table_states(300)
    found = two_inputs.filter(states, proposed)
    again = two_inputs.filter(states, found.action)
    assert np.array_equal(again.feasible, found.feasible)
    assert not again.active[found.feasible].any()
    np.testing.assert_allclose(
        again.margin[found.feasible], found.margin[found.feasible], atol=1e-12
    )


def test_with_two_inputs_nothing_makes_it_infeasible(two_inputs):
    rng = np.random.default_rng(3)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(table_problem(horizon=10.0), 60), two_inputs)
    env.reset(seed=0)
    for k in range(40):
        proposed = rng.uniform(-1.0, 1.0, (60, 2))
        proposed[::2] = np.sign(proposed[::2])
        info = env.step(proposed)[-1]
        assert info["feasible"].all(), k
        assert (info["barrier"] > 0.0).all()


def test_the_compiled_text_plays_the_episodes_of_numpy():
    problem = table_problem(horizon=1.0)
    actor, guard = make_policy("nominal", problem), BackupFilter.for_problem(problem)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 4), "backup")
    program = CompiledEpisodes(problem, actor, guard, False)
    expected = list(play(env, actor, range(8), 3))
    found = list(program.play(program.program.plain(), range(8), 3, 1, lambda _: []))
    one, other = (
        type(batches[0].results).joined([batch.results for batch in batches])
        for batches in (expected, found)
    )
    assert one.interventions.sum() > 8
    for field in dataclasses.fields(one):
        pair = getattr(one, field.name), getattr(other, field.name)
        np.testing.assert_allclose(*pair, rtol=1e-7, atol=1e-12, err_msg=field.name)


# The text of the backup filter.


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("backup", BackupSettings()),
        ("backup:horizon=2", BackupSettings(2.0)),
        ("backup:margin=0.1", BackupSettings(margin=0.1)),
        ("backup:horizon=2.5:margin=1e-3", BackupSettings(2.5, 0.001)),
    ],
)
def test_text_and_settings_are_the_same(text, settings):
    assert BackupSettings.of_text(text) == settings == settings_of(text)
    assert BackupSettings.of_text(settings.text) == settings


def test_the_text_says_which_filter_is_meant():
    assert isinstance(settings_of("promise:p=0.9"), PromiseSettings)
    assert settings_of("scbf") is None
    assert settings_of("backups") is None


SCALAR = problem_of("safe_envs/Scalar-v0")


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        *(
            (lambda text=text: settings_of(text), fragment)
            for text, fragment in (
                ("backup:horizont=2", "'horizont'"),
                ("backup:horizon", "horizon no value"),
                ("backup:horizon=2:horizon=3", "twice"),
                ("backup:horizon=-1", "-1"),
                ("backup:horizon=nan", "horizon"),
                ("backup:horizon=x", "horizon"),
                ("backup:margin=-1", "margin = -1"),
                ("backup+scbf", "alone"),
                ("backup:horizon=2+hocbf:alpha=2,8", "alone"),
            )
        ),
        (lambda: parse_conditions("backup", cart_problem()), "backup"),
        (lambda: parse_conditions("hocbf+backup", cart_problem(barriers=(1 - x,) * 2)), "backup"),
        (lambda: BackupSettings().require_fit(SCALAR), "Scalar.*BackupLaw"),
        (lambda: BackupSettings().require_fit(cart_problem(), "clf"), "nearest"),
        (lambda: BackupSettings(horizon=1001.0).require_fit(cart_problem()), "10000 control"),
    ],
)
def test_what_is_no_backup_filter_of_the_problem_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


# From the domain of a system's backup no filtered step is infeasible, whatever is proposed.


SYSTEMS = {
    "DubinsDisk": ({}, (-1, -1, -4), (1, 1, 4)),
    "ACCGap": ({"noise": 0.0}, (0, 10), (50, 200)),
    "ACC": ({"noise": 0.0}, (0, 0, 0), (50, 50, 300)),
    "Pendulum": ({"noise": 0.0}, (-0.5, -0.5), (0.5, 0.5)),
    "QuadrotorAltitude": ({}, (3, -6), (7, 6)),
    "QuadrotorLimits": (
        {},
        (-5, -5, 3, -5, -5, -6, -0.5, -0.5, -3, -6, -6, -3),
        (5, 5, 7, 5, 5, 6, 0.5, 0.5, 3, 6, 6, 3),
    ),
}


class Pressed:
    """A system behind its backup filter, and those that propose its inputs."""

    def __init__(self, name, size, seed):
        options, low, high = SYSTEMS[name]
        self.problem = make_problem(f"safe_envs/{name}-v0", **options)
        plant = self.problem.plant
        self.filter = BackupFilter.for_problem(self.problem, knowledge="plant")
        self.rng, self.size = np.random.default_rng(seed), size
        self.low, self.high = np.array(self.problem.input_bounds).T
        self._step = Integrator(plant, self.problem.dt, self.problem.substeps, "arrays")
        expressions = [b.expression for b in self.problem.barriers]
        self._barriers = compile_function(plant.states, expressions, "arrays")
        self.corners = np.array(list(itertools.product(*self.problem.input_bounds)))
        self.held = self.corners[self.rng.integers(len(self.corners), size=size)]
        self.start = np.empty((0, plant.n))
        while len(self.start) < size:
            x = self.rng.uniform(low, high, (size, plant.n))
            at_rest = np.broadcast_to(0.5 * (self.low + self.high), (size, plant.m))
            kept = self.filter.filter(x, at_rest).feasible & (self.barrier(x) >= 0.0)
            self.start = np.concatenate([self.start, x[kept]])[:size]

    def barrier(self, x):
        return stacked(self._barriers(*x.T), len(x)).min(axis=1)

    def moved(self, x, u):
        columns = (tuple(np.ascontiguousarray(part.T)) for part in (x, u))
        return np.stack(self._step.step(*columns, ()), axis=1)

    def random(self, x):
        return self.rng.uniform(self.low, self.high, (len(x), len(self.low)))

    def bang_bang(self, x):
        switched = self.rng.random((len(x), 1)) < 0.1
        drawn = self.corners[self.rng.integers(len(self.corners), size=len(x))]
        self.held = np.where(switched, drawn, self.held)
        return self.held

    def adversary(self, x):
        """Propose the extreme input that brings the system nearest to the edge in two periods."""
        worst, chosen = np.full(len(x), np.inf), np.empty((len(x), len(self.low)))
        for corner in self.corners:
            u = np.broadcast_to(corner, chosen.shape)
            h = self.barrier(self.moved(self.moved(x, u), u))
            chosen[h < worst] = corner
            worst = np.minimum(worst, h)
        return chosen

    def run(self, proposes, steps):
        """Return the numbers of infeasible and of unsafe steps."""
        x, infeasible, unsafe = self.start, 0, 0
        for _ in range(steps):
            found = self.filter.filter(x, proposes(x))
            infeasible += int((~found.feasible).sum())
            assert (found.action >= self.low).all()
            assert (found.action <= self.high).all()
            x = self.moved(x, found.action)
            unsafe += int((self.barrier(x) < 0.0).sum())
        return infeasible, unsafe


POLICIES = ("random", "bang_bang", "adversary")
QUICK = [("DubinsDisk", "adversary"), ("ACCGap", "bang_bang")]


@pytest.mark.parametrize(("name", "policy"), QUICK)
def test_no_step_is_infeasible_or_unsafe(name, policy):
    pressed = Pressed(name, 40, seed=0)
    assert pressed.run(getattr(pressed, policy), 20) == (0, 0)


@pytest.mark.oracle
@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", SYSTEMS)
def test_no_step_of_a_million_is_infeasible_or_unsafe(name, policy):
    pressed = Pressed(name, 4000, seed=1)
    assert pressed.run(getattr(pressed, policy), 250) == (0, 0)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n == "DubinsDisk" else pytest.mark.oracle) for n in SYSTEMS],
)
def test_every_start_of_the_env_is_in_the_domain(name):
    pressed = Pressed(name, 10, seed=2)
    problem = pressed.problem
    x = problem.starts[problem.start].proposals(1000)
    x = x[pressed.barrier(x) >= 0.0]
    at_rest = np.broadcast_to(0.5 * (pressed.low + pressed.high), (len(x), problem.plant.m))
    kept = pressed.filter.filter(x, at_rest).feasible
    if name == "DubinsDisk":  # Starts near the edge, heading outwards, are lost for every law.
        r_dot = x[:, 0] * np.cos(x[:, 2]) + x[:, 1] * np.sin(x[:, 2])
        assert kept[r_dot < 0].mean() > 0.99
        assert kept.mean() > 0.8
    elif name == "Pendulum":  # So are those that fall towards the edge.
        assert kept.mean() > 0.8
    else:
        assert kept.all()
