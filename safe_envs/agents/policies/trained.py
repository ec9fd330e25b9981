"""Policies that were trained elsewhere: a model of Stable-Baselines3, and what lay around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import Policy
from safe_envs.agents.policies.observations import each, rows_of
from safe_envs.errors import InvalidInputError

_BLOCK = 512
"""Observations in a block: a call takes long, and longer with more rows."""

Map = Callable[[Any], Any]
"""From a batch of observations, or of actions, to another one."""


class TrainedPolicy(Policy):
    """A model with Stable-Baselines3's `predict`, asked for its deterministic action.

    It is called with blocks of the same number of rows, see `BlockPolicy`. A recurrent model keeps
    its memory in the hidden state that `predict` returns.

    Args:
        model: whose `predict` is called.
        space: of one observation of the env that it acts in.
        observe: what lay between that env and the model, from the env on.
        act: what the model's actions went through, from the model on.
    """

    _offset = 0

    def __init__(
        self,
        model: Any,
        space: gym.Space[Any],
        observe: Sequence[Map] = (),
        act: Sequence[Map] = (),
    ) -> None:
        self.name = type(model).__name__
        self._model, self._space = model, space
        self._observe, self._act = tuple(observe), tuple(act)

    def begin(self, episodes: range, seed: int) -> None:
        """Remember in which row of its block the first episode belongs; see `Policy.begin`."""
        self._offset = episodes.start % _BLOCK

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions; see `Policy.predict`.

        Raises:
            InvalidInputError: The observation is of another space than that of the env.
        """
        rows, size, is_batch = rows_of(observation, self._space)
        for change in self._observe:
            rows = change(rows)
        end = self._offset + size
        blocks = -(-end // _BLOCK)
        # Any observation would do in the other rows; zeros may be none.
        places = np.clip(np.arange(blocks * _BLOCK) - self._offset, 0, size - 1)
        starts = np.zeros(size, dtype=bool) if episode_start is None else np.asarray(episode_start)
        memories = state if isinstance(state, _Memories) else [None] * blocks
        if len(memories) != blocks:
            raise InvalidInputError(
                f"the hidden state is of {len(memories)} blocks of observations, and the"
                f" observations are {blocks}; give None at the beginning of each batch"
            )
        found, kept = [], _Memories()
        for k, memory in enumerate(memories):
            part = places[k * _BLOCK : (k + 1) * _BLOCK]
            block = each(lambda array, part=part: array[part], rows)
            actions, memory = self._model.predict(block, memory, starts[part], deterministic=True)
            found.append(actions)
            kept.append(memory)
        actions: Any = np.concatenate(found)[self._offset : end]
        for change in self._act:
            actions = change(actions)
        memory = state if all(memory is None for memory in kept) else kept
        return (actions if is_batch else actions[0]), memory


class _Memories(list[Any]):
    """The hidden state of each block."""
