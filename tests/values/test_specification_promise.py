"""The promise filter for specifications: what it keeps against a hostile policy, and remembers."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.agents.evaluation.bounds import PromiseBound
from safe_envs.agents.evaluation.notes import computed_notes
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.filters.conditions.text import files_of, with_absolute_paths
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.render import split_filters
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.promise_filter import (
    PromiseFilter,
    PromiseMemory,
    PromiseSettings,
    promise_filter_for,
    why_not_of_safety,
)
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings, ValueTable
from safe_envs.wrappers import SafetyFilterVectorWrapper, SpecificationMonitorVector
from tests.oracles.walks import NOISE, PERIOD, STEPS, walk

REACH = "always safe & eventually goal"
ORDER = "always safe & eventually (left then right)"
WINDOW = "eventually[3,9] right"
TOUCH = "eventually left"


@functools.cache
def table_of(text: str, moves: bool = False) -> tuple[ValueTable, SafetyProblem]:
    """Return the table of a walk, which has a goal for one of the specifications only."""
    problem = walk(moves=moves, goal=text == REACH)
    return solve(problem, ValueSettings(specification=text, cells=(160,), inputs=17)), problem


def filter_of(text: str, p: float, moves: bool = False) -> PromiseFilter:
    table, problem = table_of(text, moves)
    return PromiseFilter(LookAhead(table, problem), PromiseSettings(p, specification=text), problem)


def memory_of(chosen: PromiseFilter, x: np.ndarray) -> tuple[PromiseMemory, np.ndarray]:
    """Return the memory of episodes that begin at x, and p_0."""
    memory = PromiseMemory(chosen, len(x))
    memory.begin((x,))
    return memory, memory.levels


def memory_in(envs: SafetyFilterVectorWrapper) -> PromiseMemory:
    assert isinstance(envs._filter, PromiseMemory)
    return envs._filter


def hostile(chosen: PromiseFilter, k: int, x, a) -> np.ndarray:
    """Return the inputs under which the least is expected of the table."""
    ahead = chosen.look_ahead
    q = ahead.scanned(np.full(len(a), k), (*x, a))
    return ahead.inputs[q.argmin(axis=1), 0]


def play(text: str, p: float, moves: bool, episodes: int = 3000):
    """Play episodes under the hostile policy.

    Returns:
        Which met the specification, p_0, and of each step where an episode goes on: p_k, where the
        filter intervened, where it could keep p_k, and the verdicts before.
    """
    chosen = filter_of(text, p, moves)
    env = SafeVectorEnv(chosen.problem, episodes)
    filtered = SafetyFilterVectorWrapper(env, chosen)
    monitor, memory = SpecificationMonitorVector(filtered, text), memory_in(filtered)
    _, info = monitor.reset(seed=0)
    begun, rows = info["promise"], []
    met, alive = np.zeros(episodes, dtype=bool), np.ones(episodes, dtype=bool)
    for k in range(STEPS):
        # Also of the episodes that began anew meanwhile.
        np.testing.assert_array_equal(memory._states, info["automaton_state"])
        u, before = hostile(chosen, k, env.components, memory._states), info["verdict"]
        *_, terminated, truncated, info = monitor.step(u[:, None] / 2.0)
        over = (terminated | truncated) & alive
        # Leaving the workspace is a violation, unless all was met before.
        lost = (np.abs(env.components[0]) > 1.0) & (before < 1)
        met[over] = (info["satisfied"] & ~lost)[over]
        assert not info["promise"][over & ~met].any()
        found = info["promise"], info["intervention"], info["feasible"], before
        rows.append([part[alive] for part in found])
        alive &= ~over
    assert not alive.any()
    return met, begun, [np.concatenate(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize(
    ("text", "p", "moves"),
    [(REACH, 0.5, True), (REACH, 0.9, False), (ORDER, 0.9, True), (WINDOW, 0.5, False)],
)
def test_a_hostile_policy_leaves_what_was_asked_for(text, p, moves):
    met, begun, _ = play(text, p, moves)
    error = 3.0 * np.sqrt(p * (1.0 - p) / len(met))
    assert begun == pytest.approx(p)
    # The policy takes all that it is left: the filter does not do more than it has to.
    assert p - error <= met.mean() <= p + error + 0.05


def test_from_every_start_the_mean_of_p_0_is_kept():
    chosen = filter_of(REACH, 0.98)
    x = np.linspace(-1.1, 0.9, 4001)
    memory, begun = memory_of(chosen, x)
    look_ahead = LookAhead(*table_of(REACH))
    zeros = np.zeros(len(x), dtype=int)
    first = look_ahead.scanned(zeros, (x,)).max(axis=1).clip(0.0, 0.98)
    np.testing.assert_array_equal(begun[x < 0.69], first[x < 0.69])
    # Unsafe and outside, and at the goal.
    assert not begun[x <= -0.8].any()
    assert (begun[(x > 0.7) & (x < 0.8)] == 1.0).all()
    assert 0.5 < begun.mean() < 0.9
    rng, met = np.random.default_rng(0), (x >= 0.7) & (x <= 1.0)
    going = (x > -0.8) & (x < 0.7)
    for k in range(STEPS):
        u = memory.decide_arrays((x,), (hostile(chosen, k, (x,), memory._states),)).action[0]
        x = np.where(going, x + PERIOD * u + NOISE * np.sqrt(PERIOD) * rng.normal(size=len(x)), x)
        met |= going & (x >= 0.7) & (x <= 1.0)
        memory.advance((x,), ~going)
        going &= (x > -0.8) & (x < 0.7)
    assert met.mean() >= begun.mean() - 3.0 * np.sqrt(0.25 / len(x))
    assert memory.losses == 0


def test_what_is_met_for_sure_is_left_alone_and_what_is_violated_is_given_up():
    met, _, (levels, intervened, _, verdict) = play(TOUCH, 0.9, False, 500)
    assert (levels[verdict > 0] == 1.0).all()
    assert not intervened[verdict > 0].any()
    assert np.count_nonzero(verdict > 0) > 100
    assert intervened[verdict == 0].any()
    assert met.any()
    _, _, (levels, intervened, feasible, verdict) = play(WINDOW, 0.5, False, 500)
    over = verdict < 0
    assert np.count_nonzero(over) > 100
    for part in (levels, intervened, feasible):
        assert not part[over].any()


def test_a_proposed_input_is_executed_where_nothing_can_be_kept():
    x, u = np.array([-0.9, -0.7]), np.array([0.3, -2.0])
    memory, begun = memory_of(filter_of(REACH, 0.9), x)
    found = memory.decide_arrays((x,), (u,))
    assert begun[0] == 0.0 < begun[1]
    assert found.action[0][0] == 0.3
    assert found.action[0][1] > -2.0
    assert found.active[0].tolist() == [False, True]
    assert found.feasible.tolist() == [False, True]


@pytest.mark.parametrize(
    "mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]
)
def test_the_automaton_begins_anew_with_every_episode(mode):
    chosen = filter_of(ORDER, 0.9)
    env = SafeVectorEnv(dataclasses.replace(chosen.problem), 40, autoreset_mode=mode)
    filtered = SafetyFilterVectorWrapper(env, chosen)
    monitor, memory = SpecificationMonitorVector(filtered, ORDER), memory_in(filtered)
    _, info = monitor.reset(seed=1)
    start, rng, begun = memory._states.copy(), np.random.default_rng(0), 0
    fresh, seen = np.zeros(40, dtype=bool), set()
    for _ in range(2 * STEPS + 4):
        *_, terminated, truncated, info = monitor.step(rng.uniform(-1.0, 1.0, (40, 1)))
        over = terminated | truncated
        np.testing.assert_array_equal(memory._states, info["automaton_state"])
        if mode == AutoresetMode.DISABLED and over.any():
            _, info = monitor.reset(options={"reset_mask": over})
        new = fresh if mode == AutoresetMode.NEXT_STEP else over
        np.testing.assert_array_equal(memory._states[new], start[new])
        np.testing.assert_allclose(memory.levels[new], 0.9)
        begun, fresh = begun + np.count_nonzero(new), over
        seen |= set(memory._states.tolist())
    assert begun >= 60
    assert len(seen) > 2


def test_a_snapshot_has_the_automaton():
    chosen = filter_of(ORDER, 0.9)
    envs = SafetyFilterVectorWrapper(SafeVectorEnv(chosen.problem, 20), chosen)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 20, 1))
    for action in actions[:6]:
        envs.step(action)
    snapshot = envs.snapshot()
    assert len(np.unique(snapshot["promise_automaton"])) > 1

    def goes_on():
        return [envs.step(action)[-1]["promise"] for action in actions[6:]]

    envs.restore(snapshot, seed=9)
    first = goes_on()
    envs.restore(snapshot, seed=9)
    np.testing.assert_array_equal(goes_on(), first)
    without = {k: v for k, v in snapshot.items() if k != "promise_automaton"}
    with pytest.raises(InvalidInputError, match="has no promise_automaton"):
        envs.restore(without)


def test_one_state_is_a_batch_of_one():
    chosen = filter_of(REACH, 0.9)
    x = np.array([0.0, 0.3, -0.5])
    memory, begun = memory_of(chosen, x)
    found = memory.decide_arrays((x,), (np.full(3, -2.0),))
    assert found.active[0].any()
    for i, each in enumerate(x):
        one = PromiseMemory(chosen, 1)
        one.begin((each.item(),))
        assert one.levels[0] == begun[i]
        alone = one.decide_floats((each.item(),), [-2.0])
        assert alone.action == [found.action[0][i].item()]


@pytest.mark.parametrize(
    ("text", "specification"),
    [
        ("promise:p=0.9:spec=always safe & eventually goal", REACH),
        ("promise:p=0.9:spec=eventually[0,50] goal", "eventually[0,50] goal"),
        ("promise:p=0.5:leaving=safe:spec=!(A | B) until C then D:table=/a/b,c.npz", None),
        ("promise:p=0.9:robust=v:1.0..2.0:spec=not A and (B or eventually[1,2] C)", None),
    ],
)
def test_the_text_of_settings_makes_them_again(text, specification):
    settings = PromiseSettings.of_text(text)
    assert settings.text == text
    assert PromiseSettings.of_text(settings.text) == settings
    assert specification in (None, settings.specification)
    assert split_filters(f"none,{text},scbf") == ["none", text, "scbf"]
    assert with_absolute_paths(text) == text
    assert [str(path) for path in files_of(text)] == ([settings.table] if settings.table else [])


def test_spaces_do_not_count():
    settings = PromiseSettings.of_text("promise:spec= always  safe&eventually goal :p=.9")
    assert settings.text == "promise:p=0.9:spec=always safe&eventually goal"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("promise:p=.9:spec=", "spec has no specification; give one, like always safe"),
        ("promise:p=.9:spec= ", "spec has no specification"),
        ("promise:p=.9:spec=always safe:spec=always safe", "names 'spec' twice"),
        ("promise:p=.9:spc=always safe", "did you mean 'spec'"),
    ],
)
def test_what_cannot_be_read_is_explained(text, says):
    with pytest.raises(ConfigurationError, match=says):
        PromiseSettings.of_text(text)
    with pytest.raises(ConfigurationError, match="specification = 3"):
        PromiseSettings(0.9, specification=3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("specification", "says"),
    [
        ("always safe & eventually nowhere", "nowhere"),
        ("always (safe", "specification"),
        ("eventually[0,99] left", "99"),
    ],
)
def test_what_is_no_specification_of_the_problem_is_refused_before_long_work(specification, says):
    settings = PromiseSettings(0.9, specification=specification)
    with pytest.raises(ConfigurationError, match=says):
        promise_filter_for(walk(), settings)


def test_a_table_of_another_specification_is_refused():
    table, problem = table_of(REACH)
    look_ahead = LookAhead(table, problem)
    for other in ("", "always safe"):
        with pytest.raises(ConfigurationError, match=r"the table is of 'always safe & eventually"):
            PromiseFilter(look_ahead, PromiseSettings(0.9, specification=other), problem)
    wider = {**problem.regions, "left": problem.regions["left"] + 0.01}
    with pytest.raises(ConfigurationError, match="another regions"):
        filter_of(REACH, 0.9).require_problem(dataclasses.replace(problem, regions=wider))


def test_its_bound_is_one_of_being_safe_where_unsafe_episodes_do_not_meet_it():
    problem = walk()
    starts = np.array([[0.0], [0.5], [-0.9]])
    with pytest.MonkeyPatch.context() as patch:
        made = "safe_envs.values.promise_filter.promise_filter_for"
        patch.setattr(made, lambda problem, settings, knowledge: filter_of(REACH, 0.9))
        bound = PromiseBound(PromiseSettings(0.9, specification=REACH), problem, "model")
        assert (bound.why_none, bound.at(starts).mean()) == ("", pytest.approx(0.6))
        settings = PromiseSettings(0.9, specification="eventually goal")
        assert "unsafe episodes may meet" in why_not_of_safety(problem, settings)
        assert (
            PromiseBound(settings, problem, "model").why_none
            == "it is of meeting 'eventually goal', which unsafe episodes may meet too"
        )
    assert why_not_of_safety(problem, PromiseSettings(0.9)) == ""
    first, second = computed_notes(["promise:p=0.9", f"promise:p=0.9:spec={REACH}"])
    assert first.startswith("held input, comp.: bounds of promise filters are computed")
    assert "at least the mean of min(p, L_0)" in second
    assert len(computed_notes(["promise:p=0.9"])) == 1


@pytest.mark.parametrize("text", [REACH, WINDOW])
def test_from_states_that_are_set_is_kept_what_can_be_after_the_trace(text):
    chosen, episodes, late = filter_of(text, 0.9), 2000, 2
    env = SafeVectorEnv(chosen.problem, episodes)
    filtered = SafetyFilterVectorWrapper(env, chosen)
    monitor, memory = SpecificationMonitorVector(filtered, text), memory_in(filtered)
    _, info = monitor.reset(seed=1, options={"state": [-0.2]})
    for _ in range(late):
        *_, info = monitor.step(np.zeros((episodes, 1)))
    before, a = memory.levels, info["automaton_state"]
    env.state = x = np.linspace(-0.75, 0.65, episodes)[:, None]
    filtered.follow()
    best = chosen.look_ahead.scanned(np.full(episodes, late), (x[:, 0], a)).max(axis=1)
    levels = memory.levels
    np.testing.assert_array_equal(levels, np.clip(best, 0.0, 0.9))
    assert (levels < before).any()
    met, alive = np.zeros(episodes, dtype=bool), np.ones(episodes, dtype=bool)
    for k in range(late, STEPS):
        u = hostile(chosen, k, env.components, memory._states)
        *_, terminated, truncated, info = monitor.step(u[:, None] / 2.0)
        over = (terminated | truncated) & alive
        met[over] = info["satisfied"][over]
        alive &= ~over
    assert met.mean() >= levels.mean() - 3.0 * np.sqrt(0.25 / episodes)


def test_a_goal_that_a_state_is_set_into_is_not_yet_an_end():
    text = "always safe & eventually left"
    problem = walk(moves=False, goal=True)
    table = solve(problem, ValueSettings(specification=text, cells=(160,), inputs=17))
    settings = PromiseSettings(0.9, specification=text)
    memory, _ = memory_of(PromiseFilter(LookAhead(table, problem), settings, problem), np.zeros(2))
    # Both have been on the left: if their episodes ended now, they had met the specification.
    memory.advance((np.full(2, -0.4),), np.zeros(2, dtype=bool))
    memory.resume((np.array([0.75, 0.5]),), np.ones(2, dtype=bool), 1)
    assert memory.levels[0] == 0.0
    assert memory.levels[1] > 0.0


def test_a_late_start_is_no_whole_episode():
    chosen = filter_of(REACH, 0.9)
    envs = SafetyFilterVectorWrapper(SafeVectorEnv(chosen.problem, 2), chosen)
    envs.reset(seed=0, options={"t": 0.0})
    with pytest.raises(ConfigurationError, match="is of whole episodes, from time 0 on"):
        envs.reset(options={"t": PERIOD})
