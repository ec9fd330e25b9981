"""Compiled vector envs do what those of NumPy do; programs run as plain Python but for one."""

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
from safe_envs.engine.program import Program
from safe_envs.envs.compiled_batch import CompiledBatch
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilterVectorWrapper, filter_layers
from tests.envs.test_vector_env import assert_same

SCALAR, DUBINS = "safe_envs/Scalar-v0", "safe_envs/StochasticDubins-v0"


@pytest.fixture
def plain(monkeypatch):
    """Run programs as plain Python."""
    monkeypatch.setattr(Program, "compiled", Program.plain)


def pair(env_id, condition=None, mode="NextStep", num_envs=3, **arguments):
    """The same envs by NumPy and by the compiled engine."""
    envs = [
        gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=mode, engine=engine, **arguments)
        for engine in ("numpy", "compiled")
    ]
    return envs if condition is None else [SafetyFilterVectorWrapper(e, condition) for e in envs]


def assert_same_results(envs, act, where):
    """Do the same with both, and compare all that they give and all that they keep."""
    theirs, ours = (act(env) for env in envs)
    for name, mine, other in zip("abcdef"[: len(ours)], ours, theirs, strict=True):
        assert_same(mine, other, f"{where}: {name}")
    numpy_env, compiled = (env.unwrapped for env in envs)
    assert_same(compiled.state, numpy_env.state, f"{where}: state")
    began = numpy_env.episodes.begun
    np.testing.assert_array_equal(compiled.episodes.begun, began)
    for mine, other in zip(compiled.executed, numpy_env.executed, strict=True):
        np.testing.assert_allclose(mine[~began], other[~began], rtol=1e-9, atol=1e-12)
    return ours


def assert_same_steps(envs, steps, seed=7):
    """Reset and step both; return how many episodes ended at each step."""
    assert_same_results(envs, lambda env: env.reset(seed=seed), "reset")
    rng, ends = np.random.default_rng(0), []
    for k in range(steps):
        # Some actions lie beyond the bounds.
        actions = rng.uniform(-1.3, 1.3, envs[0].action_space.shape).astype(np.float32)
        found = assert_same_results(envs, lambda env, a=actions: env.step(a), f"step {k}")
        ends.append(int((found[2] | found[3]).sum()))
    return ends


def test_every_env(env_id, plain):
    dt = gym.make(env_id).unwrapped.problem.dt
    envs = pair(env_id, None, "SameStep", 2, noise=0.05, horizon=3 * dt)
    assert assert_same_steps(envs, 4)[2] == 2


@pytest.mark.parametrize(
    ("name", "condition"),
    [
        ("ACC", "hocbf"),
        ("CubicSDEDisk", "rcbf"),
        ("Quadrotor", "hocbf"),
        ("QuadrotorLimits", "hocbf"),
    ],
)
def test_filters(name, condition, plain):
    assert_same_steps(pair(f"safe_envs/{name}-v0", condition, "SameStep", 2, noise=0.05), 4)


@pytest.mark.parametrize("condition", [None, "scbf"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episodes_that_end_at_different_steps(condition, mode, plain):
    ends = assert_same_steps(pair(SCALAR, condition, mode, 5, noise=6.0, horizon=0.8), 40)
    assert {0, 1, 5} & set(ends) >= {0, 1}


@pytest.mark.parametrize("condition", [None, "scbf"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_violations_that_end_episodes(condition, mode, plain):
    envs = pair(SCALAR, condition, mode, 5, start=[0.95], noise=1.0, terminate_on_violation=True)
    ends = assert_same_steps(envs, 40)
    assert sum(ends) > 5


def test_disabled_autoreset_and_masked_resets(plain):
    envs = pair(DUBINS, "scbf", "Disabled", 4, horizon=0.2)
    assert_same_steps(envs, 4)
    for env in envs:
        with pytest.raises(gym.error.ResetNeeded):
            env.step(np.zeros((4, 1)))
    for mask, seed in (([True, False, True, False], None), ([False, True, False, True], 8)):
        options = {"reset_mask": np.array(mask)}
        observations, infos = zip(
            *(env.reset(seed=seed, options=options) for env in envs), strict=True
        )
        assert_same(*observations, "reset")
        for key, value in infos[0].items():
            assert_same(infos[1][key][np.array(mask)], value[np.array(mask)], key)
    for k in range(4):
        assert_same_results(envs, lambda env: env.step(np.full((4, 1), 0.3)), f"step {k}")


@pytest.mark.parametrize("seed", [None, 5, [4, None, 2**70]])
def test_snapshots_are_restored(seed, plain):
    envs = pair(DUBINS, "scbf")
    assert_same_steps(envs, 3)
    snapshots = [env.snapshot() for env in envs]
    for _ in range(2):
        assert_same_results(envs, lambda env: env.step(np.full((3, 1), 0.9)), "onwards")
    # Each gets what the other one kept.
    envs[0].restore(snapshots[1], seed)
    envs[1].restore(snapshots[0], seed)
    for k in range(10):
        assert_same_results(envs, lambda env: env.step(np.full((3, 1), 0.2)), f"step {k}")
    assert_same(envs[1].snapshot(), envs[0].snapshot(), "snapshot")


def test_the_size_of_the_batch_does_not_matter(plain):
    rows = []
    for num_envs in (1, 4):
        env = SafetyFilterVectorWrapper(
            gym.make_vec(DUBINS, num_envs=num_envs, engine="compiled", horizon=0.3), "scbf"
        )
        found = [env.reset(seed=11)[0][0]]
        found += [env.step(np.full((num_envs, 1), 0.2))[0][0] for _ in range(11)]
        rows.append(found)
    np.testing.assert_array_equal(*rows)


def test_programs_run_compiled():
    envs = pair(SCALAR, "scbf", "SameStep", 3, horizon=0.1)
    ends = assert_same_steps(envs, 25)
    assert sum(ends) >= 6


def test_what_was_handed_out_is_nobody_elses(plain):
    envs = pair(DUBINS, "scbf", "SameStep", horizon=0.2)
    assert_same_results(envs, lambda env: env.reset(seed=0), "reset")
    handed_out = []
    for k in range(6):
        found = assert_same_results(envs, lambda env: env.step(np.full((3, 1), 0.9)), f"step {k}")
        given = [found[0], found[1], found[2], found[3], *found[4].values()]
        arrays = [v for v in given if isinstance(v, np.ndarray) and v.dtype != object]
        handed_out += [(value, value.copy()) for value in arrays]
        if k == 2:
            for value, copy in handed_out:
                np.testing.assert_array_equal(value, copy)
            for value, _ in handed_out:
                value[...] = 0
            handed_out.clear()
    for value, copy in handed_out:
        np.testing.assert_array_equal(value, copy)
    assert not envs[1].unwrapped.components[0].flags.writeable


def test_refused_actions_change_nothing(plain):
    envs = pair(DUBINS, "scbf")
    assert_same_steps(envs, 2)
    for bad in (np.array([[0.0], [np.nan], [np.inf]]), np.zeros((3, 2)), [["a"], [0], [0]]):
        messages = []
        for env in envs:
            with pytest.raises(InvalidInputError) as error:
                env.step(bad)
            messages.append(str(error.value))
        assert messages[0] == messages[1]
    assert_same_results(envs, lambda env: env.step(np.zeros((3, 1))), "afterwards")


@pytest.mark.parametrize("condition", [None, "scbf"])
def test_actions_are_checked_where_an_episode_begins(condition, plain):
    envs = pair(DUBINS, condition, horizon=0.1)
    assert sum(assert_same_steps(envs, 2)) == 3
    for env in envs:
        with pytest.raises(InvalidInputError, match=r"envs \[1\] are not finite"):
            env.step(np.array([[0.0], [np.nan], [0.0]]))
    begun = assert_same_results(envs, lambda env: env.step(np.zeros((3, 1))), "afterwards")
    assert not begun[1].any()


def test_inputs_in_physical_units_are_held_as_they_are(plain):
    envs = [env.unwrapped for env in pair(DUBINS, horizon=0.1)]
    assert_same_results(envs, lambda env: env.reset(seed=0), "reset")
    for k in range(4):
        assert_same_results(envs, lambda env: env.step_physical((np.full(3, 3.0),)), f"step {k}")
        np.testing.assert_array_equal(envs[1].executed, [np.full(3, 3.0)])


def test_any_array_needs_one_compilation(monkeypatch):
    def checked(program):
        (step,) = program.plain().values()

        def call(*arguments):
            for k, argument in enumerate(arguments):
                assert not isinstance(argument, np.ndarray) or argument.flags.carray, k
            return step(*arguments)

        return {"step_batch": call}

    monkeypatch.setattr(Program, "compiled", checked)
    _, env = pair(DUBINS, "scbf")
    everywhere = np.broadcast_to(True, (3,))
    env.reset(seed=0, options={"reset_mask": everywhere})
    env.step(np.broadcast_to(0.5, (3, 1)))
    env.restore({key: np.asfortranarray(v) for key, v in env.snapshot().items()})
    env.step(np.zeros((6, 1))[::2])
    env.restore({key: v.tolist() for key, v in env.snapshot().items()})
    env.reset(options={"reset_mask": np.array([True, False] * 3)[::2]})
    env.step([[0.1]] * 3)


def test_a_filter_that_comes_late_tells_what_it_tells_at_rest(plain):
    _, env = pair(DUBINS)
    env.reset(seed=0)
    mask = np.array([False, True, False])
    _, info = SafetyFilterVectorWrapper(env, "scbf").reset(options={"reset_mask": mask})
    for key in ("nominal_action", "safe_action", "slacks", "slack", "episode_interventions"):
        np.testing.assert_array_equal(info[key], np.zeros_like(info[key]))
    np.testing.assert_array_equal(info["active_barrier"], [-1, -1, -1])
    assert info["feasible"].all()
    assert not info["intervention"].any()


def test_without_a_state_there_is_no_step(plain):
    for env in pair(SCALAR):
        for act in (lambda e=env: e.step(np.zeros((3, 1))), lambda e=env: e.unwrapped.components):
            with pytest.raises(gym.error.ResetNeeded):
                act()


@pytest.mark.parametrize("condition", [None, "scbf"])
def test_states_that_leave_the_finite_numbers(condition, plain):
    messages, envs = [], pair(DUBINS, condition)
    for env in envs:
        env.reset(seed=1)
        snapshot = env.snapshot()
        snapshot["state"][1] = [1e200, 0.0, 0.0]
        env.restore(snapshot)
        # Compiled code does not warn.
        with np.errstate(all="ignore"), pytest.raises(NumericalError) as error:
            env.step(np.full((3, 1), -1.0))
        messages.append(str(error.value))
        env.reset(options={"reset_mask": np.array([False, True, False])})
    assert messages[0] == messages[1]
    assert "envs [1]" in messages[0]
    assert_same_results(envs, lambda env: env.step(np.full((3, 1), -1.0)), "afterwards")


def test_constraints_without_a_finite_value(plain):
    messages = []
    envs = pair(DUBINS, "scbf")
    assert_same_steps(envs, 2)
    for env in envs:
        snapshot = env.snapshot()
        snapshot["state"][1, 0] = 1e308
        env.restore(snapshot)
        with np.errstate(all="ignore"), pytest.raises(NumericalError) as error:
            env.step(np.zeros((3, 1)))
        messages.append(str(error.value))
    assert messages[0] == messages[1]
    assert "scbf" not in messages[0]
    assert "has no finite value at x = 1e+308" in messages[0]


def test_wrappers_of_gymnasium(plain):
    shown = []
    for env in pair(DUBINS, "scbf", horizon=0.2):
        wrapped = DictInfoToList(RecordEpisodeStatistics(NormalizeObservation(env)))
        wrapped.reset(seed=0)
        found = [wrapped.step(np.full((3, 1), 0.9, dtype=np.float32)) for _ in range(9)]
        shown.append([(step[0], step[4]) for step in found])
    for (theirs, infos), (ours, my_infos) in zip(*shown, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
        for info, mine in zip(infos, my_infos, strict=True):
            assert mine.keys() == info.keys()
            np.testing.assert_allclose(mine["h_min"], info["h_min"], rtol=1e-9)
    assert shown[1][3][1][0]["episode"]["l"] == 4


def test_filters_that_cannot_be_compiled(plain, monkeypatch):
    def refuse(*_):
        raise NotCompilableError("no method for learned terms")

    monkeypatch.setattr(filter_layers, "filter_source", refuse)
    env_id = "safe_envs/QuadrotorLimits-v0"
    theirs, ours = (gym.make_vec(env_id, num_envs=2, engine=e) for e in ("numpy", "auto"))
    assert isinstance(ours.unwrapped._batch, CompiledBatch)
    envs = [SafetyFilterVectorWrapper(e, "hocbf") for e in (theirs, ours)]
    assert_same_steps(envs, 2)
    with pytest.raises(NotCompilableError, match="no method for learned terms"):
        pair(env_id, "hocbf")


def test_envs_with_pictures_are_filtered_by_numpy(plain):
    envs = pair(DUBINS, "scbf", render_mode="rgb_array")
    assert envs[1]._stepper is None
    assert_same_steps(envs, 2)
    np.testing.assert_array_equal(envs[1].render()[0], envs[0].render()[0])


def test_the_engine_is_part_of_the_spec(monkeypatch):
    env = gym.make_vec(SCALAR, num_envs=2, engine="auto")
    assert (
        gym.make_vec(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())).unwrapped.engine
        == "auto"
    )
    monkeypatch.setattr(engines, "is_available", lambda: False)
    assert not isinstance(gym.make_vec(SCALAR, engine="auto").unwrapped._batch, CompiledBatch)
    with pytest.raises(ConfigurationError, match="engine = 'fast'"):
        gym.make_vec(SCALAR, num_envs=2, engine="fast")
