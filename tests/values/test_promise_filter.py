"""The promise filter keeps what it says against a hostile policy, and changes little."""

from __future__ import annotations

import copy
import dataclasses
import functools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from gymnasium.vector import AutoresetMode

from safe_envs import ConfigurationError, ControlAffineSDE, InvalidInputError, define_problem
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.filters.conditions.syntax import (
    files_of,
    learned_parts,
    with_absolute_paths,
)
from safe_envs.filters.specification import problem_automaton
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.render import split_filters
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.promise_filter import (
    PromiseFilter,
    PromiseSettings,
    promise_filter_for,
    why_not_of_safety,
)
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings, ValueTable, save_table
from safe_envs.wrappers import (
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SpecificationMonitorVector,
)
from tests.conftest import problem_of
from tests.oracles.walks import PERIOD, STEPS, exact_values, place_of, walk, worst_inputs
from tests.values.systems import scalar, solved, x

SAFETY = ""
REACH = "always safe & eventually goal"
ORDER = "always safe & eventually (left then right)"
WINDOW = "eventually[3,9] right"
TOUCH, NESTED = "eventually left", "not A and (B or eventually[1,2] C)"


@functools.cache
def table_of(text: str, moves: bool = False) -> tuple[ValueTable, SafetyProblem]:
    """Return the table of a walk, which has a goal for one of the specifications only."""
    problem = walk(moves=moves, goal=text == REACH)
    return solve(problem, ValueSettings(specification=text, cells=(160,), inputs=17)), problem


def promised(table: ValueTable, problem: SafetyProblem, p: float, text: str = "") -> PromiseFilter:
    return PromiseFilter(LookAhead(table, problem), PromiseSettings(p, specification=text), problem)


def filter_of(text: str, p: float, moves: bool = False) -> PromiseFilter:
    return promised(*table_of(text, moves), p, text)


class Episodes:
    """Episodes behind a promise filter, and what a hostile policy knows about them.

    Args:
        chosen: the filter.
        count: of envs.
        mode: of resets.
    """

    def __init__(self, chosen: PromiseFilter, count: int, mode: Any = AutoresetMode.NEXT_STEP):
        problem, text = chosen.problem, chosen.settings.specification
        self.env = SafeVectorEnv(dataclasses.replace(problem), count, autoreset_mode=mode)
        self.filtered = SafetyFilterVectorWrapper(self.env, chosen)
        self.monitor = SpecificationMonitorVector(self.filtered, text or "always safe")
        self._low, self._high = np.array(problem.input_bounds).T

    def reset(self, x: Any = None, seed: int = 0) -> dict[str, Any]:
        options = None if x is None else {"state": np.reshape(x, (-1, self.env.problem.plant.n))}
        return self.monitor.reset(seed=seed, options=options)[1]

    def step(self, u: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Propose physical inputs; return whose episodes end, and the info."""
        u = np.reshape(u, (self.env.num_envs, -1))
        scaled = (2.0 * u - self._low - self._high) / (self._high - self._low)
        *_, terminated, truncated, info = self.monitor.step(scaled)
        return terminated | truncated, info

    def met(self, worst: np.ndarray, info: dict[str, Any], first: int = 0):
        """Play on under the hostile policy from an instant on.

        Returns:
            Which episodes met the specification, and of each step where one goes on: p_k, where the
            filter intervened, where it could keep p_k, and the verdicts before.
        """
        count = self.env.num_envs
        met, alive, rows = np.zeros(count, dtype=bool), np.ones(count, dtype=bool), []
        for k in range(first, STEPS):
            before = info["verdict"]
            u = worst[k, place_of(self.env.components[0]), info["automaton_state"]]
            ended, info = self.step(u)
            over = ended & alive
            # Leaving the workspace is a violation, unless all was met before.
            lost = (np.abs(self.env.components[0]) > 1.0) & (before < 1)
            met[over] = (info["satisfied"] & ~lost)[over]
            assert not info["promise"][over & ~met & (before >= 0)].any()
            found = info["promise"], info["intervention"], info["feasible"], before
            rows.append([part[alive] for part in found])
            alive &= ~over
        assert not alive.any()
        return met, [np.concatenate(column) for column in zip(*rows, strict=True)]


@functools.cache
def hostile(text: str, moves: bool = False) -> np.ndarray:
    automaton = problem_automaton(table_of(text, moves)[1], text or "always safe")
    return worst_inputs(automaton, moves=moves, goal=text == REACH)


def play(text: str, p: float, moves: bool = False, starts: Any = None, episodes: int = 2000):
    """Play episodes under the hostile policy; return what `Episodes.met` does, and p_0."""
    chosen = filter_of(text, p, moves)
    played = Episodes(chosen, episodes if starts is None else len(starts))
    info = played.reset(starts)
    return *played.met(hostile(text, moves), info), info["promise"]


def test_its_bound_is_one_of_being_safe_where_unsafe_episodes_do_not_meet_it():
    problem = walk()
    for text, fragment in (("", ""), (REACH, ""), ("eventually goal", "'eventually goal'")):
        why = why_not_of_safety(problem, PromiseSettings(0.9, specification=text))
        assert fragment in why
        assert bool(why) == bool(fragment)


CASES = [
    (SAFETY, 0.6, False),
    (REACH, 0.5, True),
    (REACH, 0.9, False),
    (ORDER, 0.9, True),
    (WINDOW, 0.5, False),
]


@pytest.mark.parametrize(("text", "p", "moves"), CASES)
def test_a_hostile_policy_leaves_what_was_asked_for(text, p, moves):
    met, _, begun = play(text, p, moves)
    error = 3.0 * np.sqrt(p * (1.0 - p) / len(met))
    assert begun == pytest.approx(p)
    # The policy takes all that it is left: the filter does not do more than it has to.
    assert p - error <= met.mean() <= p + error + 0.05


@pytest.mark.parametrize("text", [SAFETY, REACH])
def test_from_every_start_the_mean_of_p_0_is_kept(text):
    # Without the goal itself: a table takes it to be an end, an env not before the next step.
    p, starts = 0.98, np.linspace(-0.999, 0.69 if text else 0.999, 3001)
    met, _, begun = play(text, p, starts=starts)
    automaton = problem_automaton(table_of(text)[1], text or "always safe")
    exact = exact_values(automaton, goal=bool(text))[0][place_of(starts)]
    a = int(automaton.step(0, automaton.initial, automaton.label([1, 0][: len(automaton.atoms)])))
    # p_0 is what one step of look-ahead has, in the safe set.
    assert not begun[starts <= -0.8].any()
    inside = starts > -0.79
    assert (begun[inside] <= np.minimum(exact[inside, a], p) + 2e-3).all()
    assert (np.minimum(exact[inside, a], p) - begun[inside]).mean() < 0.03
    assert met.mean() >= begun.mean() - 3.0 * np.sqrt(0.25 / len(starts))
    assert 0.3 < begun.mean() < 0.95


def test_what_is_met_for_sure_is_left_alone_and_what_is_violated_is_given_up():
    met, (levels, intervened, _, verdict), _ = play(TOUCH, 0.9, episodes=500)
    assert (levels[verdict > 0] == 1.0).all()
    assert not intervened[verdict > 0].any()
    assert np.count_nonzero(verdict > 0) > 100
    assert intervened[verdict == 0].any()
    assert met.any()
    _, (levels, intervened, feasible, verdict), _ = play(WINDOW, 0.5, episodes=500)
    over = verdict < 0
    assert np.count_nonzero(over) > 100
    for part in (levels, intervened, feasible):
        assert not part[over].any()


def test_the_input_is_the_nearest_that_keeps_p():
    # Next to the wall only inputs from some u* on keep p, and these are executed as proposed.
    proposed = np.linspace(-2.0, 2.0, 81)
    at = np.full(81, -0.6)
    best = Episodes(filter_of(SAFETY, 0.999), 1).reset(at[:1])["promise"].item()
    p = 0.97 * best
    played = Episodes(filter_of(SAFETY, p), 81)
    assert played.reset(at)["promise"] == pytest.approx(p)
    _, info = played.step(proposed)
    executed, changed = info["safe_action"][:, 0], info["intervention"]
    assert info["feasible"].all()
    assert 10 < changed.sum() < 70
    np.testing.assert_allclose(executed[~changed], proposed[~changed], atol=1e-6)
    edge = proposed[~changed].min()
    assert (changed == (proposed < edge)).all()
    # To the resolution of the search: a 64th of the distance of scanned inputs.
    assert np.ptp(executed[changed]) < 0.25 / 64 + 1e-5
    assert edge - 0.05 - 0.25 / 64 < executed[changed].min() <= edge + 1e-6
    # u* is where the exact expectation is p, but for the error of the table.
    problem = table_of(SAFETY)[1]
    automaton = problem_automaton(problem, "always safe")
    after = exact_values(automaton, goal=False)[1].max(axis=1)
    draws = np.random.default_rng(0).normal(size=40_000) * 0.5 * np.sqrt(PERIOD)
    kept = after[place_of(-0.6 + PERIOD * executed[0] + draws)].mean()
    assert p - 0.01 < kept < p + 0.03


def test_outside_of_the_safe_set_it_takes_the_best_input_and_says_so():
    played, going, returned = Episodes(filter_of(SAFETY, 0.5), 60), np.ones(60, dtype=bool), 0
    starts = np.append(np.full(59, -0.9), 0.0)
    assert played.reset(starts)["promise"].tolist() == [0.0] * 59 + [0.5]
    for k in range(4):
        ended, info = played.step(np.full(60, -2.0))
        lost = np.flatnonzero(going[:59])
        assert info["feasible"][59]
        assert not info["feasible"][lost].any()
        if k == 0:  # The best input leads away from the wall.
            np.testing.assert_allclose(info["safe_action"][lost, 0], 2.0)
        # Back inside nothing is kept.
        assert not info["promise"][lost].any()
        assert not info["slack"][lost].any()
        returned += int((played.env.components[0][lost] > -0.8).sum())
        going &= ~ended
    assert returned > 50


def test_for_a_specification_the_proposed_input_is_executed_where_nothing_can_be_kept():
    played = Episodes(filter_of(REACH, 0.9), 2)
    begun = played.reset([-0.9, -0.7])["promise"]
    _, info = played.step([0.3, -2.0])
    assert begun[0] == 0.0 < begun[1]
    assert info["safe_action"][0, 0] == pytest.approx(0.3)
    assert info["safe_action"][1, 0] > -2.0
    assert info["intervention"].tolist() == [False, True]
    assert info["feasible"].tolist() == [False, True]


def test_p_is_spent_evenly_and_its_mean_does_not_fall():
    # Noise in boxes shows what the next states have: p_1 = min(c, L_1), with one c for all.
    problem = scalar(-x, 0.3 + 0.3 * x, start=(0.3,), horizon=0.5)
    played = Episodes(promised(solved(problem, 120, inputs=9), problem, 0.6), 1000)
    begun = played.reset()["promise"]
    _, info = played.step(np.full(1000, -1.0))
    levels, most = info["promise"], info["promise"].max()
    assert 0.02 < (np.abs(levels - most) < 1e-6).mean() < 1.0
    error = 3.0 * levels.std() / np.sqrt(1000)
    assert begun[0] - error <= levels.mean() <= begun[0] + error + 0.06


def test_a_table_of_zeros_gives_nothing_and_no_nan():
    table, problem = table_of(SAFETY)
    nothing = dataclasses.replace(table, lower=0.0 * table.lower)
    played = Episodes(promised(nothing, problem, 0.9), 2)
    assert not played.reset([0.0, -0.5])["promise"].any()
    for _ in range(3):
        _, info = played.step([0.0, 1.0])
        assert not info["feasible"].any()
        for name in ("safe_action", "promise", "slack"):
            assert np.isfinite(info[name]).all()


def test_what_a_false_table_loses_is_told():
    table, problem = table_of(SAFETY)
    # The next values are too high, and those after them are not: p_1 cannot be kept.
    lower = np.array(table.lower)
    lower[1] = np.minimum(1.0, 1.2 * lower[1])
    played = Episodes(promised(dataclasses.replace(table, lower=lower), problem, 0.95), 50)
    played.reset(np.full(50, -0.7))
    told = 0.0
    for _ in range(3):
        _, info = played.step(np.zeros(50))
        told = max(told, info["slack"].max())
    assert told > 1e-3
    exact = Episodes(promised(table, problem, 0.95), 50)
    exact.reset(np.full(50, -0.7))
    for _ in range(3):
        assert exact.step(np.zeros(50))[1]["slack"].max() < 1e-6


def two_inputs(gain, barrier, box, start, dt=1.0, noise=0.02):
    u, v = sp.symbols("u v", real=True)
    inputs, row = ((u, v), [[1, gain]]) if gain else ((u,), [[1]])
    system = ControlAffineSDE((x,), inputs, [0.5], row, [[noise]])
    given = {"start": start, "dt": dt, "horizon": dt, "workspace": {x: (-3.0, 3.0)}}
    return define_problem(system, barrier, input_bounds=box, **given)


def test_two_inputs_move_in_the_euclidean_distance():
    problem = two_inputs(1, 1 - x, [(-1.0, 1.0), (-2.0, 2.0)], [0.4])
    chosen = promised(solved(problem, 300, inputs=9), problem, 0.6)
    played, rng = Episodes(chosen, 400), np.random.default_rng(0)
    played.reset()
    u = rng.uniform(-1.0, 1.0, (400, 2)) * [1.0, 2.0]
    _, info = played.step(u)
    executed, changed = info["safe_action"], info["intervention"]
    # Allowed is u1 + u2 <= c: the distance to that line is the least that can be had.
    total = u.sum(axis=1)
    assert total[~changed].max() < total[changed].min()
    c = executed.sum(axis=1).max()
    assert abs(c - 0.1) < 0.05  # From .4 + .5 to 1.
    distance = np.linalg.norm(executed - u, axis=1)
    least = np.maximum(total - c, 0.0) / np.sqrt(2.0)
    assert (distance >= least - 1e-6).all()
    assert (distance - least).max() < 0.35
    assert (np.abs(executed[:, 0]) <= 1.0).all()


def test_all_scanned_inputs_are_looked_at_before_anything_is_lost():
    # Of the inputs from -.4 on only a few between .3 and .33 lead to the second part.
    barrier = sp.Max(sp.Rational(1, 400) - x**2, (x - 0.8) * (0.83 - x))
    problem = two_inputs(0, barrier, (-0.4, 1.0), [0.0], noise=0.003)
    chosen = promised(solved(problem, 3000, inputs=57), problem, 0.9)
    played = Episodes(chosen, 3)
    begun = played.reset()["promise"]
    assert begun == pytest.approx(0.9)
    _, info = played.step([-0.4, 0.5, 0.315])
    assert info["feasible"].all()
    assert (info["slack"] == 0.0).all()
    executed = info["safe_action"][:, 0]
    assert ((executed > 0.3) & (executed < 0.33)).all()
    assert executed[0] < executed[2] < executed[1]
    assert executed[2] == pytest.approx(0.315)


@pytest.mark.parametrize(
    "mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]
)
def test_promises_begin_anew_with_every_episode(mode):
    played = Episodes(filter_of(ORDER, 0.9), 40, mode)
    info = played.reset(seed=1)
    start, rng, begun = info["automaton_state"].copy(), np.random.default_rng(0), 0
    fresh, seen = np.zeros(40, dtype=bool), set()
    for _ in range(2 * STEPS + 4):
        over, info = played.step(rng.uniform(-2.0, 2.0, (40, 1)))
        if mode == AutoresetMode.DISABLED and over.any():
            _, info = played.monitor.reset(options={"reset_mask": over})
        new = fresh if mode == AutoresetMode.NEXT_STEP else over
        np.testing.assert_array_equal(info["automaton_state"][new], start[new])
        np.testing.assert_allclose(info["promise"][new], 0.9)
        begun, fresh = begun + np.count_nonzero(new), over
        seen |= set(info["automaton_state"].tolist())
    assert begun >= 60
    assert len(seen) > 2


@pytest.mark.parametrize("text", [SAFETY, REACH, WINDOW])
def test_from_states_that_are_set_is_kept_what_can_be_after_the_trace(text):
    p, count, late = 0.9, 2000, 2
    chosen = filter_of(text, p)
    played = Episodes(chosen, count)
    played.reset(np.full(count, -0.2), seed=1)
    for _ in range(late):
        _, info = played.step(np.zeros(count))
    before, a, good = info["promise"], info["automaton_state"], info["verdict"] >= 0
    assert good.mean() > 0.9
    played.env.state = x = np.linspace(-0.75, 0.65, count)[:, None]
    played.filtered.follow()
    levels = played.filtered.snapshot()["promise"]
    problem = chosen.problem
    automaton = problem_automaton(problem, text or "always safe")
    exact = exact_values(automaton, goal=text == REACH)[late, place_of(x[:, 0]), a]
    assert (levels <= np.minimum(exact, p) + 2e-3)[good].all()
    assert (np.minimum(exact, p) - levels)[good].mean() < 0.05
    assert (levels < before).any()
    met, _ = played.met(hostile(text), info, late)
    assert met[good].mean() >= levels[good].mean() - 3.0 * np.sqrt(0.25 / count)


def test_a_goal_that_a_state_is_set_into_is_not_yet_an_end():
    text, problem = "always safe & eventually left", walk()
    table = solve(problem, ValueSettings(specification=text, cells=(160,), inputs=17))
    played = Episodes(promised(table, problem, 0.9, text), 2)
    # Both have been on the left: if their episodes ended now, they had met the specification.
    played.reset(np.full(2, -0.4))
    played.env.state = np.array([[0.75], [0.5]])
    played.filtered.follow()
    levels = played.filtered.snapshot()["promise"]
    assert levels[0] == 0.0
    assert levels[1] > 0.0


def test_a_late_start_is_no_whole_episode():
    envs = Episodes(filter_of(REACH, 0.9), 2).filtered
    envs.reset(seed=0, options={"t": 0.0})
    with pytest.raises(ConfigurationError, match="time 0"):
        envs.reset(options={"t": PERIOD})


def test_a_snapshot_has_all_that_is_remembered():
    played = Episodes(filter_of(ORDER, 0.6), 20)
    envs = played.filtered
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 20, 1))
    for action in actions[:6]:
        envs.step(action)
    snapshot = envs.snapshot()

    def goes_on():
        return [envs.step(action)[-1]["promise"] for action in actions[6:]]

    envs.restore(snapshot, seed=9)
    first = goes_on()
    envs.restore(snapshot, seed=9)
    np.testing.assert_array_equal(goes_on(), first)
    now = envs.snapshot()
    with pytest.raises(InvalidInputError, match="promise_automaton"):
        envs.restore({k: v for k, v in snapshot.items() if k != "promise_automaton"})
    for name, value in (
        ("promise", np.full(20, np.nan)),
        ("promise", np.full(20, 1.5)),
        ("promise", np.full(19, 0.5)),
        ("instant", np.full(20, -1)),
        ("promise_ended", np.zeros(21, dtype=bool)),
    ):
        with pytest.raises(InvalidInputError):
            envs.restore({**snapshot, name: value})
    np.testing.assert_array_equal(envs.snapshot()["promise"], now["promise"])


def test_one_env_is_a_batch_of_one():
    chosen = filter_of(ORDER, 0.6)
    one, batch = SafetyFilterWrapper(SafeEnv(chosen.problem), chosen), Episodes(chosen, 1)
    _, info = one.reset(seed=0)
    infos = batch.reset(seed=0)
    for k in range(6):
        assert type(info["promise"]) is float
        assert info["promise"] == infos["promise"][0]
        if k:
            for name in ("safe_action", "feasible", "intervention", "slack"):
                assert np.array_equal(info[name], infos[name][0]), name
        *_, terminated, _, info = one.step(np.array([-1.0]))
        ended, infos = batch.step([-2.0])
        assert ended[0] == terminated
        if terminated:
            assert k > 1
            break


def test_copies_and_pickles_decide_alike():
    chosen, infos = filter_of(REACH, 0.6), []
    assert copy.deepcopy(chosen) is chosen  # Its table may be of gigabytes.
    for each in (chosen, pickle.loads(pickle.dumps(chosen))):
        played = Episodes(each, 50)
        played.reset(np.linspace(-0.7, 0.6, 50))
        infos.append([played.step(np.linspace(-2.0, 2.0, 50))[1] for _ in range(3)])
    for one, other in zip(*infos, strict=True):
        for name in ("promise", "safe_action", "intervention", "feasible"):
            np.testing.assert_array_equal(one[name], other[name])


def test_the_file_of_a_table_is_read(tmp_path):
    table, problem = table_of(REACH)
    settings = dataclasses.replace(table.settings, knowledge="plant")
    save_table(dataclasses.replace(table, settings=settings), tmp_path / "walk.npz")
    text = f"promise:p=0.9:spec={REACH}:table={tmp_path / 'walk.npz'}"
    infos = []
    for chosen in (
        filter_of(REACH, 0.9),
        promise_filter_for(problem, PromiseSettings.of_text(text)),
    ):
        played = Episodes(chosen, 20)
        played.reset()
        infos.append(played.step(np.full(20, -2.0))[1]["safe_action"])
    np.testing.assert_array_equal(*infos)


def test_a_table_of_something_else_is_refused():
    table, problem = table_of(REACH)
    for other in ("", "always safe"):
        with pytest.raises(ConfigurationError, match="eventually goal"):
            promised(table, problem, 0.9, other)
    wider = {**problem.regions, "left": problem.regions["left"] + 0.01}
    with pytest.raises(ConfigurationError, match="regions"):
        filter_of(REACH, 0.9).require_problem(dataclasses.replace(problem, regions=wider))
    table, problem = table_of(SAFETY)
    longer = dataclasses.replace(problem, horizon=problem.horizon + PERIOD)
    with pytest.raises(ConfigurationError, match=f"{STEPS + 1} steps"):
        PromiseFilter(LookAhead(table, problem), PromiseSettings(0.9), longer)
    shorter = dataclasses.replace(problem, horizon=problem.horizon - PERIOD)
    PromiseFilter(LookAhead(table, problem), PromiseSettings(0.9), shorter)


@pytest.mark.parametrize(
    ("specification", "fragment"),
    [
        ("always safe & eventually nowhere", "nowhere"),
        ("always (safe", "specification"),
        ("eventually[0,99] left", "99"),
    ],
)
def test_what_is_no_specification_of_the_problem_is_refused(specification, fragment):
    settings = PromiseSettings(0.9, specification=specification)
    with pytest.raises(ConfigurationError, match=fragment):
        promise_filter_for(walk(), settings)


# The text of the promise filter, and where it is known.


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("promise:p=0.99", PromiseSettings(0.99)),
        ("promise:p=0.5:table=a,b.npz", PromiseSettings(0.5, table="a,b.npz")),
        (
            "promise:p=0.9:robust=v:0.8..2.4;w:-1.0..-0.5:leaving=safe:table=/a/b+c.npz",
            PromiseSettings(0.9, (("v", 0.8, 2.4), ("w", -1.0, -0.5)), "safe", table="/a/b+c.npz"),
        ),
        (f"promise:p=0.9:spec={REACH}", PromiseSettings(0.9, specification=REACH)),
        (
            "promise:p=0.5:leaving=safe:spec=!(A | B) until C then D:table=/a/b,c.npz",
            PromiseSettings(0.5, (), "safe", "/a/b,c.npz", "!(A | B) until C then D"),
        ),
        (
            f"promise:p=0.9:robust=v:1.0..2.0:spec={NESTED}",
            PromiseSettings(0.9, (("v", 1.0, 2.0),), specification=NESTED),
        ),
    ],
)
def test_the_text_of_settings_makes_them_again(text, settings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert PromiseSettings.of_text(text) == settings
    assert settings.text == text
    assert split_filters(f"none,{text},scbf") == ["none", text, "scbf"]
    # A sweep reads the table, wherever it runs.
    files = [Path(settings.table)] if settings.table else []
    assert list(files_of(text)) == files
    assert list(files_of(with_absolute_paths(text))) == [tmp_path / file for file in files]
    assert learned_parts(text) == []


def test_spaces_do_not_count():
    settings = PromiseSettings.of_text(" promise:leaving=safe:robust= v :1..3:p=.25 ")
    assert settings == PromiseSettings(0.25, (("v", 1.0, 3.0),), "safe")
    assert settings.intervals == {"v": (1.0, 3.0)}
    settings = PromiseSettings.of_text("promise:spec= always  safe&eventually goal :p=.9")
    assert settings.text == "promise:p=0.9:spec=always safe&eventually goal"


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("promise", "probability"),
        ("promise:p", "p no value"),
        ("promise:q=3:p=.9", "'q'.*robust"),
        ("promise:robst=v:1..2:p=.9", "'robust'"),
        ("promise:0.99", "'0.99'"),
        ("promise:p=0", "p = 0 "),
        ("promise:p=-.1", "p = -0.1"),
        ("promise:p=high", "'high'"),
        ("promise:p=.9:p=.8", "'p' twice"),
        ("promise:p=.9:leaving=later", "'later'.*violation, safe"),
        ("promise:p=.9:robust=v", "'v'"),
        ("promise:p=.9:robust=v:2..1", "v:2..1"),
        ("promise:p=.9:robust=v:1..inf", "finite"),
        ("promise:p=.9:robust=v:1..2;v:3..4", "v twice"),
        ("promise:p=.9:table=", "table"),
        ("promise:p=.9:spec=", "spec has no"),
        ("promise:p=.9:spec=always safe:spec=always safe", "'spec' twice"),
        ("promise:p=.9+scbf", "alone"),
        ("promise+promise:p=.9", "alone"),
    ],
)
def test_what_cannot_be_read_is_refused(text, fragment):
    with pytest.raises(ConfigurationError, match=f"(?s){fragment}"):
        PromiseSettings.of_text(text)


def test_settings_that_are_none_are_refused():
    with pytest.raises(ConfigurationError, match="specification = 3"):
        PromiseSettings(0.9, specification=3)  # pyright: ignore[reportArgumentType]
    problem = problem_of("safe_envs/Scalar-v0")
    with pytest.raises(ConfigurationError, match="'speed'"):
        PromiseSettings(0.9, (("speed", 0.8, 2.4),)).require_fit(problem)
