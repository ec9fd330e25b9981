"""The vector env by itself: seeds, masks, refused actions and states, in each engine.

That it plays as its envs do is in `tests/wrappers/test_batches.py`.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import (
    DictInfoToList,
    NormalizeObservation,
    RecordEpisodeStatistics,
)

from safe_envs import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.engine import choice as engines
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilterVectorWrapper, filter_layers
from tests.wrappers.cases import assert_close as assert_same

pytestmark = pytest.mark.usefixtures("plain")

SCALAR, DUBINS = "safe_envs/Scalar-v0", "safe_envs/StochasticDubins-v0"
ENGINES = ("numpy", "compiled")
each_engine = pytest.mark.parametrize("engine", ENGINES)
with_and_without = pytest.mark.parametrize("condition", [None, "scbf"])


def made(env_id=DUBINS, condition=None, count=3, engine="numpy", **options):
    env = gym.make_vec(env_id, count, engine=engine, **options)
    return env if condition is None else SafetyFilterVectorWrapper(env, condition)


@each_engine
@with_and_without
def test_refused_actions_change_nothing(engine, condition):
    env, twin = (made(condition=condition, engine=engine, horizon=0.15) for _ in range(2))
    env.reset(seed=0)
    twin.reset(seed=0)
    for _ in range(5):  # also where an episode begins, and the action is not used
        for bad in (
            np.array([[0.0], [np.nan], [np.inf]]),
            np.zeros((3, 2)),
            np.zeros(3),
            [["a"], [0], [0]],
        ):
            with pytest.raises(InvalidInputError, match="action"):
                env.step(bad)
        ours, theirs = (each.step(np.full((3, 1), 0.2)) for each in (env, twin))
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[3], theirs[3])


@each_engine
@with_and_without
def test_states_that_leave_the_finite_numbers_are_errors(engine, condition):
    env = made(condition=condition, engine=engine)
    env.reset(seed=1)
    snapshot = env.snapshot()
    snapshot["state"][1] = [1e200, 0.0, 0.0]
    env.restore(snapshot)
    with np.errstate(all="ignore"), pytest.raises(NumericalError, match=r"envs \[1\]"):
        env.step(np.full((3, 1), -1.0))
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.isfinite(env.step(np.full((3, 1), -1.0))[0]).all()


@each_engine
def test_constraints_without_a_finite_value_are_errors(engine):
    env = made(condition="scbf", engine=engine)
    env.reset(seed=1)
    snapshot = env.snapshot()
    snapshot["state"][1, 0] = 1e308
    env.restore(snapshot)
    with np.errstate(all="ignore"), pytest.raises(NumericalError, match=r"x = 1e\+308"):
        env.step(np.zeros((3, 1)))


@each_engine
def test_inputs_in_physical_units_are_held_as_they_are(engine):
    env = made(engine=engine, horizon=0.1).unwrapped
    env.reset(seed=0)
    for _ in range(4):
        env.step_physical((np.full(3, 3.0),))
        np.testing.assert_array_equal(env.executed, [np.full(3, 3.0)])


@each_engine
def test_without_a_state_there_is_no_step(engine):
    env = made(engine=engine)
    for act in (
        lambda: env.step(np.zeros((3, 1))),
        lambda: env.unwrapped.components,
        lambda: env.reset(options={"reset_mask": np.array([True, False, False])}),
    ):
        with pytest.raises(gym.error.ResetNeeded):
            act()


@each_engine
def test_a_filter_that_comes_late_says_what_it_says_at_rest(engine):
    env = made(engine=engine)
    env.reset(seed=0)
    mask = np.array([False, True, False])
    _, info = SafetyFilterVectorWrapper(env, "scbf").reset(options={"reset_mask": mask})
    for key in ("nominal_action", "safe_action", "slacks", "slack", "episode_interventions"):
        np.testing.assert_array_equal(info[key], np.zeros_like(info[key]))
    np.testing.assert_array_equal(info["active_barrier"], [-1, -1, -1])
    assert info["feasible"].all()
    assert not info["intervention"].any()


@pytest.mark.parametrize("seed", [None, 5, [4, None, 2**70]])
def test_each_engine_goes_on_from_the_snapshot_of_the_other(seed):
    """Without a seed the noise goes on where it is."""
    envs = [made(condition="scbf", engine=engine) for engine in ENGINES]
    for env in envs:
        env.reset(seed=7)
        for _ in range(3):
            env.step(np.full((3, 1), 0.4))
    snapshots = [env.snapshot() for env in envs]
    for env, snapshot in zip(envs, snapshots[::-1], strict=True):
        for _ in range(2):
            env.step(np.full((3, 1), 0.9))
        env.restore(snapshot, seed)
    for k in range(10):
        theirs, ours = (env.step(np.full((3, 1), 0.2)) for env in envs)
        assert_same(ours[0], theirs[0], f"step {k}")
        assert_same(ours[4]["safe_action"], theirs[4]["safe_action"], f"step {k}")
    for key, value in envs[0].snapshot().items():
        assert_same(envs[1].snapshot()[key], value, key)


@each_engine
@with_and_without
def test_a_seed_forgets_the_noise_that_was_drawn_before(engine, condition):
    env, fresh = (made(condition=condition, engine=engine) for _ in range(2))
    env.reset(seed=1)
    for _ in range(3):
        env.step(np.full((3, 1), 0.4))
    np.testing.assert_array_equal(env.reset(seed=2)[0], fresh.reset(seed=2)[0])
    for _ in range(3):
        given = np.full((3, 1), 0.2)
        np.testing.assert_array_equal(env.step(given)[0], fresh.step(given)[0])
    snapshot = fresh.snapshot()
    for each in (env, fresh):
        each.restore(snapshot, seed=[None, 9, 9])
    ours, theirs = (each.step(given)[0] for each in (env, fresh))
    np.testing.assert_array_equal(ours, theirs)


def test_wrappers_of_gymnasium_take_both_engines():
    shown = []
    for engine in ENGINES:
        env = made(condition="scbf", engine=engine, horizon=0.2)
        wrapped = DictInfoToList(RecordEpisodeStatistics(NormalizeObservation(env)))
        wrapped.reset(seed=0)
        found = [wrapped.step(np.full((3, 1), 0.9, dtype=np.float32)) for _ in range(9)]
        shown.append([(step[0], step[4]) for step in found])
    for (theirs, infos), (ours, my_infos) in zip(*shown, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
        for info, mine in zip(infos, my_infos, strict=True):
            assert mine.keys() == info.keys()
            assert_same(mine["h_min"], info["h_min"], "h_min")
    assert shown[1][3][1][0]["episode"]["l"] == 4


@pytest.mark.parametrize(
    ("options", "fragment"),
    [
        ({"delay": 1}, "delay"),
        ({"slew_limit": (-9.0, 9.0)}, "slew"),
        ({"measurement": "default"}, "sensor"),
    ],
)
def test_what_has_no_compiled_form_is_left_to_numpy_or_refused(options, fragment):
    with pytest.raises(NotCompilableError, match=fragment):
        made(engine="compiled", **options)
    plain, auto = (made(engine=engine, **options) for engine in ("numpy", "auto"))
    for env in (plain, auto):
        env.reset(seed=0)
    given = np.full((3, 1), 0.5)
    np.testing.assert_array_equal(plain.step(given)[0], auto.step(given)[0])


@pytest.mark.parametrize("given", [{"delay": 1}, {"render_mode": "rgb_array"}, {}])
def test_a_filter_without_compiled_form_is_left_to_numpy(given, monkeypatch):
    def refuse(*_):
        raise NotCompilableError("no method for learned terms")

    if not given:
        monkeypatch.setattr(filter_layers, "filter_source", refuse)
    options = {key: given[key] for key in ("render_mode",) if key in given}
    over = {key: given[key] for key in ("delay",) if key in given}
    found = []
    for engine in ("numpy", "auto"):
        env = SafetyFilterVectorWrapper(made(engine=engine, **options), "scbf", **over)
        env.reset(seed=0)
        found.append([env.step(np.full((3, 1), 0.7))[0] for _ in range(3)])
        if options:
            found[-1].append(np.array(env.render()))
    for ours, theirs in zip(*found, strict=True):
        assert_same(ours, theirs, "filtered")
    if not options:
        with pytest.raises(NotCompilableError):
            SafetyFilterVectorWrapper(made(engine="compiled"), "scbf", **over)


def test_the_engine_is_part_of_the_spec(monkeypatch):
    env = made(SCALAR, engine="auto")
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.engine == "auto"
    monkeypatch.setattr(engines, "is_available", lambda: False)
    made(SCALAR, engine="auto").reset(seed=0)


MASKS = (np.array([True]), np.array([1, 0]), np.array([False, False]))


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        (lambda: made(SCALAR, count=0), "num_envs = 0"),
        (lambda: made(SCALAR, autoreset_mode="never"), "'never'"),
        (lambda: made(SCALAR, engine="fast"), "'fast'"),
        (lambda: made(count=2).reset(seed=[1, 2, 3]), "3 seeds"),
        *(
            (lambda seed=seed: made(count=2).reset(seed=seed), "seed")
            for seed in (1.5, [4, 9.7], "ab", [True, 1], [-1, 1], -1)
        ),
        *((lambda mask=mask: _reset(made(count=2), mask), "reset_mask") for mask in MASKS),
    ],
)
def test_arguments_out_of_range_are_named(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


def _reset(env, mask):
    env.reset(seed=0)
    return env.reset(options={"reset_mask": mask})


def test_reset_masks_may_be_used_again():
    mask = np.array([True, False])
    _, info = _reset(made(SCALAR, count=2), mask)
    mask[:] = False
    np.testing.assert_array_equal(info["_cost"], [True, False])
