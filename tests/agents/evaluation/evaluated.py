"""Policies that evaluations are tested with, and an evaluation by brute force."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from safe_envs import SafeEnv
from safe_envs.agents import make_policy
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.wrappers import SafetyFilterWrapper


class Constant:
    """A policy of anybody's: it has `predict` and nothing else."""

    def __init__(self, action):
        self.action = action

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((len(observation), 1), self.action), state


class Schedule:
    """Physical inputs by the step, which it counts in the hidden state."""

    def __init__(self, problem, inputs):
        low, high = problem.input_bounds[0]
        self.actions = [(u - low) / (high - low) * 2 - 1 for u in inputs]
        self.starts = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.starts.append((state is None, bool(np.all(episode_start)), deterministic))
        k = 0 if state is None else state
        return np.full((len(observation), 1), self.actions[k]), k + 1


class Levelling:
    """ACC with A h = 0: the gap's rate equals tau times the acceleration."""

    def __init__(self, problem, tau):
        self.half = problem.input_bounds[0][1]
        self.tau = tau

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        own, lead, _ = observation.astype(np.float64).T
        force = 1650.0 * (lead - own) / self.tau + 0.1 + 5.0 * own + 0.25 * own**2
        return (force / self.half)[:, None], state


def bare_env(env_id, options):
    env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
    assert isinstance(env, SafeEnv)
    return env


def replay(env_id, options, spec, policy_name, episodes, seed, knowledge="model"):
    """The row of an evaluation by brute force: the scalar env, an episode at a time, whole
    trajectories in lists."""
    safe, lowest, returns, efforts, kept = 0, [], [], [], []
    counted = intervened = infeasible = 0
    env = bare_env(env_id, options)
    policy = make_policy(policy_name, env.problem)
    run = env if spec == "none" else SafetyFilterWrapper(env, spec, knowledge)
    for i in range(episodes):
        policy.begin(range(i, i + 1), seed)
        observation, info = run.reset(seed=episode_seed(seed, i))
        h, steps, ended = [info["barrier"].min()], [], False
        while not ended:
            action = policy.predict(observation[None])[0][0]
            executed = env.physical_action(action)
            observation, reward, terminated, truncated, info = run.step(action)
            h.append(info["barrier"].min())
            executed = info["safe_action"] if spec != "none" else np.array(executed)
            steps.append(
                (
                    float(executed @ executed),
                    info.get("intervention", False),
                    not info.get("feasible", True),
                    reward,
                )
            )
            ended = terminated or truncated
        first = next((k for k, value in enumerate(h) if value <= 0), len(h))
        before = steps[:first]
        safe += first == len(h)
        lowest.append(min(h))
        returns.append(sum(s[3] for s in steps))
        counted += len(before)
        intervened += sum(s[1] for s in before)
        infeasible += sum(s[2] for s in before)
        efforts += [np.mean([s[0] for s in before])] if before else []
        kept.append(h)
    low, high = rate_interval(safe, episodes)
    row = {
        "episodes": episodes,
        "safe": safe,
        "safety_rate": safe / episodes,
        "ci_low": low,
        "ci_high": high,
        "min_h_median": np.median(lowest),
        "min_h_p05": np.quantile(lowest, 0.05),
        "violations": episodes - safe,
        "intervention_rate": intervened / counted,
        "infeasible_rate": infeasible / counted,
        "effort_mean": np.mean(efforts),
        "return_mean": np.mean(returns),
    }
    return row, kept


def safe_so_far(trajectories, times, dt):
    """Count the trajectories of h that are positive up to each time; ended ones stay the same."""
    return [sum(min(h[: round(t / dt) + 1]) > 0 for h in trajectories) for t in times]
