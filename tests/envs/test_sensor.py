"""Envs that are measured report noisy, biased, lost and late samples, and nothing else changes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import sympy as sp
from scipy.stats import binomtest, chi2, kstest

from safe_envs import SafeEnv, SafeVectorEnv
from safe_envs.dynamics.noise import NOISE, SENSOR, StreamReader, key_of
from safe_envs.problem.measurement import Channel, Measurement
from tests.conftest import problem_of

PENDULUM, ACC = "safe_envs/Pendulum-v0", "safe_envs/ACC-v0"
DUBINS = "safe_envs/StochasticDubins-v0"
COMPLETE = ["default:bias=.03:dropout=.3", "delay=2"]


def made(problem, num_envs):
    return SafeEnv(problem) if num_envs is None else SafeVectorEnv(problem, num_envs)


def walk(env, count, seed=3):
    """Return the samples, the infos and the other results of some steps."""
    rng = np.random.default_rng(0)
    _, info = env.reset(seed=seed)
    infos, samples, rest = [info], [env.measured], []
    for _ in range(count):
        _, reward, terminated, truncated, info = env.step(
            rng.uniform(-1.0, 1.0, env.action_space.shape)
        )
        infos.append(info)
        samples.append(env.measured)
        rest.append((reward, terminated, truncated))
    return samples, infos, rest


@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_sensor_changes_nothing_but_what_is_observed(env_id, num_envs):
    def walked(problem):
        env = made(problem, num_envs)
        _, infos, rest = walk(env, 6)
        return env.state.tobytes(), infos, [[np.array(v).tobytes() for v in row] for row in rest]

    plain, measured = (walked(problem_of(env_id, measurement=m)) for m in (None, COMPLETE))
    assert made(problem_of(env_id), num_envs).measured is None
    assert (plain[0], plain[2]) == (measured[0], measured[2])
    for mine, other in zip(plain[1], measured[1], strict=True):
        added = set(other) - set(mine)
        assert added - {f"_{name}" for name in added} == {"state", "received"}
        for key, value in mine.items():
            np.testing.assert_array_equal(value, other[key])
    np.testing.assert_array_equal(
        measured[1][-1]["state"], np.frombuffer(measured[0]).reshape(np.shape(other["state"]))
    )


def test_the_errors_are_the_numbers_of_a_stream_of_their_own():
    problem = problem_of(PENDULUM, measurement=["default:noise=.5:dropout=.4"])
    samples, infos, _ = walk(SafeEnv(problem), 50, seed=11)
    uniforms = StreamReader().seek(key_of(11), 0, SENSOR).uniforms((51, 4))
    assert not np.array_equal(uniforms, StreamReader().seek(key_of(11), 0, NOISE).uniforms((51, 4)))
    for (values, received), info, drawn in zip(samples, infos, uniforms, strict=True):
        # An independent route to the quantile: lost where the uniform is below the probability.
        assert list(received) == (drawn[2:] >= 0.4).tolist()
        for value, has, x, u in zip(values, received, info["state"], drawn[:2], strict=True):
            if has:
                assert sp.erf((value - x) / (0.5 * math.sqrt(2.0))) == pytest.approx(
                    2.0 * u - 1.0, abs=1e-12
                )


def test_errors_have_the_stated_mean_deviation_and_share_of_losses():
    channels = (Channel("y", problem_of(PENDULUM).states[0].symbol, 0.2, bias=0.7, dropout=0.3),)
    problem = problem_of(PENDULUM, measurement=Measurement(channels))
    env = SafeVectorEnv(problem, 500)
    _, info = env.reset(seed=1)
    errors, lost, seen = [], 0, 0
    for _ in range(40):
        received = env.measured.received[0]
        errors.append((env.measured.values[0] - info["state"][:, 0])[received])
        lost, seen = lost + int((~received).sum()), seen + received.size
        *_, info = env.step(np.zeros((500, 1)))
    scaled = (np.concatenate(errors) - 0.7) / 0.2
    assert kstest(scaled, "norm").pvalue > 1e-3
    n = scaled.size
    assert abs(scaled.mean()) < 4.0 / math.sqrt(n)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], n - 1)
    assert low < scaled.var(ddof=1) * (n - 1) < high
    interval = binomtest(lost, seen).proportion_ci(0.9999, "exact")
    assert interval.low < 0.3 < interval.high


@pytest.mark.parametrize("delay", [1, 5])
@pytest.mark.parametrize("num_envs", [None, 2])
def test_samples_arrive_exactly_so_many_periods_late(delay, num_envs):
    def samples(items):
        problem = problem_of(ACC, measurement=items)
        env = made(problem, num_envs)
        return walk(env, 20)[0]

    prompt, late = (
        samples(["default:dropout=.2"]),
        samples(["default:dropout=.2", f"delay={delay}"]),
    )
    for before in late[:delay]:
        assert not np.any(before.received)
        # The point of the Box nearest to 0, which holds 0 here.
        assert not np.any(before.values)
    for mine, other in zip(late[delay:], prompt, strict=False):
        np.testing.assert_array_equal(mine.received, other.received)
        np.testing.assert_array_equal(
            np.where(mine.received, mine.values, 0.0), np.where(other.received, other.values, 0.0)
        )


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_lost_sample_repeats_the_last_value(num_envs):
    problem = problem_of(PENDULUM, measurement="default:dropout=.7")
    for before, now in itertools.pairwise(walk(made(problem, num_envs), 40)[0]):
        same = np.equal(before.values, now.values)
        np.testing.assert_array_equal(same, ~np.array(now.received))


def test_observations_are_clipped_and_samples_are_not():
    x = problem_of(PENDULUM).states[0].symbol
    far = Measurement((Channel("y", 1e9 * x + 5e9, 0.0),))
    env = SafeEnv(problem_of(PENDULUM, measurement=far))
    observation, info = env.reset(seed=0)
    assert observation.tolist() == [1e6]
    assert env.measured.values == pytest.approx((1e9 * info["state"][0] + 5e9,))


def test_angles_are_known_modulo_a_turn():
    problem = problem_of(DUBINS, measurement=["turned=100*theta:noise=1:period=3"])
    box = SafeEnv(problem).observation_space
    assert (box.low.tolist(), box.high.tolist()) == ([-1.5], [1.5])
    env, batch = SafeEnv(problem), SafeVectorEnv(problem, 3)
    for values in ([s.values for s in walk(env, 200)[0]], [s.values for s in walk(batch, 50)[0]]):
        assert -1.5 < np.min(values) < -1.2
        assert 1.2 < np.max(values) <= 1.5


@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_sample_without_a_value_is_lost(num_envs):
    problem = problem_of(
        PENDULUM, measurement=["root=sqrt(theta):noise=.1", "default"], start=(0.3, -2.0)
    )
    env = made(problem, num_envs)
    samples, infos, _ = walk(env, 40)
    lost = 0
    for (values, received), info in zip(samples, infos, strict=True):
        np.testing.assert_array_equal(received[0], info["state"][..., 0] >= 0.0)
        assert np.all(received[1:])
        assert np.isfinite(values).all()
        lost += int(np.sum(~np.asarray(received[0])))
    assert lost


@pytest.mark.parametrize("num_envs", [None, 2])
def test_an_episode_from_a_later_time_has_the_errors_of_that_instant(num_envs):
    problem = problem_of(ACC, measurement=["default:dropout=.3"])
    env = made(problem, num_envs)
    samples, infos, _ = walk(env, 12)
    action = np.zeros(env.action_space.shape)
    env.reset(seed=3, options={"state": infos[5]["state"], "t": 5 * problem.dt})
    for k in (5, 6):
        np.testing.assert_array_equal(env.measured.received, samples[k].received)
        errors = [
            np.where(s.received, s.values, 0.0) - np.where(s.received, c, 0.0)
            for s, c in (
                (samples[k], _exact(infos[k]["state"])),
                (env.measured, _exact(env.state)),
            )
        ]
        np.testing.assert_allclose(*errors, atol=1e-9)
        env.step(action)


def _exact(x):
    own, lead, gap = np.moveaxis(x, -1, 0)
    return [own, lead - own, gap]


def test_a_state_that_is_set_is_measured_from_the_next_step_on():
    problem = problem_of(PENDULUM, measurement=["default:noise=0"])
    env, batch = SafeEnv(problem), SafeVectorEnv(problem, 2)
    for each in (env, batch):
        each.reset(seed=0)
        before = np.array(each.measured.values)
        each.state = np.array([0.1, 0.2])
        np.testing.assert_array_equal(each.measured.values, before)
        each.step(np.zeros(each.action_space.shape))
        np.testing.assert_array_equal(np.moveaxis(each.state, -1, 0), each.measured.values)


def test_a_violation_ends_the_episode_by_the_true_state():
    blind = Measurement((Channel("y", problem_of(DUBINS).states[0].symbol, 100.0),))
    ends = []
    for measurement in (None, blind):
        env = SafeEnv(problem_of(DUBINS, measurement=measurement), terminate_on_violation=True)
        env.reset(seed=0)
        steps = 0
        while not env.step(np.array([0.0]))[2]:
            steps += 1
        ends.append(steps)
    assert ends[0] == ends[1]
