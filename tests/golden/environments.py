"""Golden rows of the envs themselves: observations, rewards, flags and every entry of info, bare
and behind the env's filter."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

_STEPS = 20
_NUM_ENVS = 3


def rows(env_id: str, filter_name: str, dt: float) -> dict[str, Any]:
    """Return what an env reports at reset and at 20 steps.

    Args:
        env_id: without namespace.
        filter_name: of the filter that is put around it.
        dt: control period in s.

    Returns:
        Records by kind of env: scalar or vector, bare or filtered; the vector env's episodes end
        within the steps in one.
    """
    name = f"safe_envs/{env_id}"
    short: dict[str, Any] = {"horizon": 8 * dt}
    return {
        "scalar": _run(gym.make(name)),
        "scalar filtered": _run(SafetyFilterWrapper(gym.make(name, noise=0.1), filter_name)),
        "scalar plant": _run(
            SafetyFilterWrapper(gym.make(name, substeps=2), filter_name, knowledge="plant")
        ),
        "vector": _run(gym.make_vec(name, num_envs=_NUM_ENVS)),
        "vector filtered": _run(SafetyFilterVectorWrapper(_vector(name), filter_name)),
        "vector short": _run(gym.make_vec(name, num_envs=_NUM_ENVS, **short)),
        "vector short filtered": _run(
            SafetyFilterVectorWrapper(
                _vector(name, autoreset_mode="SameStep", **short), filter_name
            )
        ),
    }


def _vector(name: str, **options: Any) -> Any:
    return gym.make_vec(name, num_envs=_NUM_ENVS, noise=0.1, **options)


def _run(env: Any) -> dict[str, Any]:
    observation, info = env.reset(seed=7)
    shape: Any = env.action_space.shape
    types = {key: _type(value) for key, value in {**info, "observation": observation}.items()}
    answers: list[dict[str, Any]] = [{"observation": observation, **info}]
    for step in range(_STEPS):
        action = np.sin(0.7 * step + np.arange(np.prod(shape)).reshape(shape)).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        answers.append(
            {
                "observation": observation,
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
                **info,
            }
        )
        if np.ndim(terminated) == 0 and (terminated or truncated):
            break
    env.close()
    # By key, so that a key that gets another name is one change of the file.
    keys = sorted(set().union(*answers))
    columns = {
        key: {str(i): _plain(answer[key]) for i, answer in enumerate(answers) if key in answer}
        for key in keys
    }
    always = {
        key: list(column.values()) if len(column) == len(answers) else column
        for key, column in columns.items()
    }
    return {"types": types, "values": always}


def _type(value: Any) -> str:
    return (
        f"{value.dtype}{list(value.shape)}"
        if isinstance(value, np.ndarray)
        else type(value).__name__
    )


def _plain(value: Any) -> Any:
    """Return a value as JSON has it."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value
