"""The state of a learner of Stable-Baselines3 as arrays; reading them runs no code.

A learner is restored into a new one with the same hyperparameters. So a checkpoint holds only what
training changes, and its arrays must have the names, shapes and types of those of the new learner.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import ReplayBuffer
    from stable_baselines3.common.vec_env import VecEnv

Arrays = dict[str, np.ndarray]

_OBSERVED = ("_last_obs", "_last_original_obs", "_last_episode_starts")
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
_ROWS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "costs")
_EPISODES = {"r": np.float32, "l": np.int32}
"""Entries of the last episodes that a VecMonitor reports, which the logged means are taken of in
these types."""


def counters(model: Any) -> dict[str, int]:
    """Return the counters of a model, JSON-able."""
    return {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}


def begin(model: Any) -> None:
    """Reset the envs of a new model, so that only the states of its optimizers are missing."""
    envs, scales = model.get_env(), model.get_vec_normalize_env()
    model._last_obs = envs.reset()
    model._last_episode_starts = np.ones(envs.num_envs, dtype=bool)
    if scales is not None:
        model._last_original_obs = scales.get_original_obs()
    elif hasattr(model, "replay_buffer"):
        model._last_original_obs = model._last_obs


def learner_arrays(model: Any) -> Arrays:
    """Return the learned arrays of a model, and those from which it goes on, by name.

    Args:
        model: between two rollouts, or after `begin`.
    """
    found = {
        f"{name}/{key}": tensor for name, state in _networks(model) for key, tensor in state.items()
    }
    found |= {name: getattr(model, name) for name in _variables(model)}
    for name, optimizer in _optimizers(model):
        for i, entries in optimizer.state_dict()["state"].items():
            found |= {f"{name}/{i}/{key}": tensor for key, tensor in entries.items()}
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in found.items()}
    arrays |= {
        name: getattr(model, name) for name in _OBSERVED if getattr(model, name, None) is not None
    }
    for layer, moments in _moments(model.get_vec_normalize_env()):
        arrays |= {
            f"{layer}/{key}": np.asarray(getattr(moments, key), dtype=float)
            for key in ("mean", "var", "count")
        }
    episodes = model.ep_info_buffer or ()
    return arrays | {
        f"episodes/{key}": np.array([e[key] for e in episodes], dtype=kind)
        for key, kind in _EPISODES.items()
    }


def restore_learner(
    model: Any, arrays: Mapping[str, np.ndarray], counts: Mapping[str, int]
) -> None:
    """Restore a new model from the `learner_arrays` and `counters` of another one.

    Args:
        model: with the same hyperparameters, after `begin`.
        arrays: see `learner_arrays`.
        counts: see `counters`.

    Raises:
        ValueError: they are not those of such a model.
    """
    _require_whole(model, arrays)
    if set(counts) != set(counters(model)) or any(
        type(count) is not int or count < 0 for count in counts.values()
    ):
        raise ValueError(f"the counters are {dict(counts)}")
    for name, value in counts.items():
        setattr(model, name, value)
    _restore_tensors(model, arrays)
    for name in _OBSERVED:
        if name in arrays:
            # In the memory layout of the envs' arrays, on which the rounding of sums depends.
            setattr(model, name, np.empty_like(getattr(model, name)))
            getattr(model, name)[...] = arrays[name]
    for layer, moments in _moments(model.get_vec_normalize_env()):
        moments.mean, moments.var = (arrays[f"{layer}/{key}"].copy()[()] for key in ("mean", "var"))
        moments.count = arrays[f"{layer}/count"].item()
    rows = zip(*(arrays[f"episodes/{key}"] for key in _EPISODES), strict=True)
    model.ep_info_buffer = deque(
        [dict(zip(_EPISODES, row, strict=True)) for row in rows], model._stats_window_size
    )
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)


def buffer_arrays(buffer: ReplayBuffer) -> Arrays:
    """Return the rows of a replay buffer that are filled, as views.

    A buffer that saves memory has the last next observation in the row after them, which the next
    step's observation overwrites.
    """
    rows = buffer.buffer_size if buffer.full else buffer.pos
    return {name: getattr(buffer, name)[:rows] for name in _ROWS if hasattr(buffer, name)}


def restore_buffer(
    buffer: ReplayBuffer, arrays: Mapping[str, np.ndarray], pos: Any, full: Any
) -> None:
    """Restore a new replay buffer from the `buffer_arrays` of one with the same arguments.

    Args:
        buffer: to fill.
        arrays: see `buffer_arrays`.
        pos: that of the other buffer.
        full: that of the other buffer.

    Raises:
        ValueError: they are not those of such a buffer.
    """
    if type(pos) is not int or type(full) is not bool or not 0 <= pos < buffer.buffer_size:
        raise ValueError(
            f"the replay buffer of {buffer.buffer_size} rows is at row {pos!r}, full: {full!r}"
        )
    buffer.pos, buffer.full = pos, full
    _require_alike(arrays, buffer_arrays(buffer))
    for name, rows in buffer_arrays(buffer).items():
        rows[...] = arrays[name]


def env_arrays(envs: VecEnv) -> Arrays:
    """Return the states of the episodes of a `SB3VecEnv` and of the wrappers over it, by name."""
    found = dict(envs.unwrapped.snapshot())  # pyright: ignore[reportAttributeAccessIssue]
    return found | {f"{name}_of_layers": getattr(layer, name) for layer, name in _sums(envs)}


def restore_envs(envs: VecEnv, arrays: Mapping[str, np.ndarray], seed: int) -> None:
    """Restore the `env_arrays`, with the randomness of a seed.

    Args:
        envs: that were reset, or that go on with their episodes.
        arrays: see `env_arrays`.
        seed: of the noise and of the starts from then on.

    Raises:
        ValueError: the arrays are not those of such envs.
    """
    _require_alike(arrays, env_arrays(envs))
    envs.unwrapped.restore(arrays, seed)  # pyright: ignore[reportAttributeAccessIssue]
    for layer, name in _sums(envs):
        setattr(layer, name, arrays[f"{name}_of_layers"].copy())


def _require_whole(model: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError unless arrays are those of a model in training."""
    of_optimizers = _shapes_by_parameter(model)
    begun = {
        name: array
        for name, array in learner_arrays(model).items()
        if not name.startswith("episodes/")
    }
    extra = {name: array for name, array in arrays.items() if name not in begun}
    _require_alike({name: array for name, array in arrays.items() if name in begun}, begun)
    lengths = {extra.pop(f"episodes/{key}", np.empty(())).shape for key in _EPISODES}
    if len(lengths) != 1 or len(shape := lengths.pop()) != 1 or shape[0] > model._stats_window_size:
        raise ValueError("the last episodes are missing, or too many")
    for name, array in extra.items():
        shape = of_optimizers.get(name.rpartition("/")[0])
        if shape is None or array.shape not in ((), shape) or array.dtype != np.float32:
            raise ValueError(f"{name} belongs to no parameter")


def _restore_tensors(model: Any, arrays: Mapping[str, np.ndarray]) -> None:
    import torch

    with torch.no_grad():
        for name, state in _networks(model):
            for key, tensor in state.items():
                tensor.copy_(torch.tensor(arrays[f"{name}/{key}"]))
        for name in _variables(model):
            getattr(model, name).copy_(torch.tensor(arrays[name]))
    for name, optimizer in _optimizers(model):
        entries: dict[int, dict[str, Any]] = {}
        for key, array in arrays.items():
            if key.startswith(f"{name}/"):
                i, entry = key.removeprefix(f"{name}/").split("/")
                entries.setdefault(int(i), {})[entry] = torch.tensor(array)
        # Learning rates follow from schedules before each update; all else in the groups from the
        # hyperparameters.
        optimizer.load_state_dict({**optimizer.state_dict(), "state": entries})


def _networks(model: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the tensors of each network, which share memory with it, by name."""
    optimizers = dict(_optimizers(model))
    yield from (
        (name, state) for name, state in model.get_parameters().items() if name not in optimizers
    )


def _optimizers(model: Any) -> Iterator[tuple[str, Any]]:
    from stable_baselines3.common.save_util import recursive_getattr
    from torch.optim import Optimizer

    for name in model._get_torch_save_params()[0]:
        found = recursive_getattr(model, name)
        if isinstance(found, Optimizer):
            yield name, found


def _variables(model: Any) -> list[str]:
    """Return the names of tensors outside of networks, such as SAC's entropy coefficient."""
    return model._get_torch_save_params()[1]


def _shapes_by_parameter(model: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter by the NAME/NUMBER of its optimizer state."""
    found: dict[str, tuple[int, ...]] = {}
    for name, optimizer in _optimizers(model):
        parameters = [
            parameter for group in optimizer.param_groups for parameter in group["params"]
        ]
        found |= {f"{name}/{i}": tuple(parameter.shape) for i, parameter in enumerate(parameters)}
    return found


def _moments(scales: Any) -> Iterator[tuple[str, Any]]:
    """Yield the running means of a VecNormalize, by name."""
    if scales is not None:
        yield from (
            (name, getattr(scales, name))
            for name in ("obs_rms", "ret_rms")
            if hasattr(scales, name)
        )


def _sums(envs: VecEnv) -> list[tuple[Any, str]]:
    """Return the wrappers with the names of their sums over an episode."""
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize, unwrap_vec_wrapper

    monitor, scales = (unwrap_vec_wrapper(envs, layer) for layer in (VecMonitor, VecNormalize))
    of_monitor = (
        [] if monitor is None else [(monitor, "episode_returns"), (monitor, "episode_lengths")]
    )
    return of_monitor + ([] if scales is None else [(scales, "returns")])


def _require_alike(arrays: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError unless arrays have the names, shapes and types of others."""
    for name in sorted({*arrays, *wanted}):
        kinds = [
            None if name not in some else (some[name].shape, some[name].dtype)
            for some in (arrays, wanted)
        ]
        if kinds[0] != kinds[1]:
            raise ValueError(f"{name} is {kinds[0]} in place of {kinds[1]}")
