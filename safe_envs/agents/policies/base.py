"""The interface of a policy, and its bases."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.errors import ConfigurationError, InvalidInputError, NotCompilableError

BLOCK = 128
"""Observations in a block; see `BlockPolicy`."""

CHOOSE = "def choose(observation, step, k0, k1, data, work):\n"
"""How the function of a compiled program begins; see `Policy.source`."""

Spaces = tuple[gym.Space[Any], gym.Space[Any]]
"""The spaces of observations and of actions."""


class Policy(ABC):
    """Base of this project's policies, with the `predict` of Stable-Baselines3.

    Attributes:
        deterministic: whether equal observations get equal actions.
    """

    deterministic: bool = True

    def prepare(self, progress: Callable[[float], None] | None = None) -> None:  # noqa: B027
        """Do what takes long, before the first episode; most policies have no such work.

        Args:
            progress: called with the part of the work that is done, from 0 to 1.
        """

    def begin(self, episodes: range, seed: int) -> None:  # noqa: B027  (most policies ignore it)
        """Receive the episodes of the rows of the coming batches, before each batch of episodes.

        The actions in an episode may depend on the episode and the seed, never on the other rows:
        the result of an evaluation must not depend on the size of its batches.

        Args:
            episodes: one for each row, surplus rows of the last batch included.
            seed: of the evaluation.
        """

    def resume(self, rows: range, seeds: Sequence[int], periods: Sequence[int]) -> None:
        """Receive episodes that go on in their midst, before each batch of them.

        The actions may depend on an episode's seed and control period, and on its row.

        Args:
            rows: one for each episode.
            seeds: of the episodes.
            periods: control period of each that comes next.
        """
        self.begin(rows, seeds[0])

    @abstractmethod
    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions.

        Args:
            observation: one observation (k,) or a batch (B, k).
            state: hidden state of a recurrent policy, passed through.
            episode_start: whether each episode starts here; for recurrent policies.
            deterministic: ask for the mean action of a random policy that has one.

        Returns:
            Actions in [-1, 1], shape (m,) or (B, m), and the hidden state.
        """

    def source(self, data: Data) -> Source:
        """Return the policy as a function of compiled programs.

        It is called `choose`, takes what `act` of `safe_envs.compiled.slots` takes, and returns the
        actions that `predict` returns, a tuple; an action without a finite value is NaN.

        Args:
            data: receives its numbers.

        Raises:
            NotCompilableError: There is no such function.
        """
        raise not_compilable(self)


class StatelessPolicy(Policy):
    """Base of the policies whose actions depend on the observations alone.

    Args:
        width: number k of the entries of an observation.
    """

    def __init__(self, width: int) -> None:
        self._width = width

    @abstractmethod
    def actions(self, given: np.ndarray) -> np.ndarray:
        """Return the actions at one observation (k,) or a batch (B, k), in double precision."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Check the observations and choose actions; see `Policy.predict`.

        Raises:
            InvalidInputError: The observation has another shape than (k,) or (B, k).
        """
        return self.actions(checked_observation(observation, self._width)), state


class BlockPolicy(StatelessPolicy):
    """Base of the policies that are networks.

    A matrix product rounds a row differently in batches of different sizes. So every network call
    gets a block of the same number of rows, with an episode always in the same row of its block.
    """

    _offset = 0

    @abstractmethod
    def act(self, block: np.ndarray) -> np.ndarray:
        """Return the actions (BLOCK, m) at observations (BLOCK, k) in float32."""

    def begin(self, episodes: range, seed: int) -> None:
        """Remember in which row of its block the first episode belongs; see `Policy.begin`."""
        self._offset = episodes.start % BLOCK

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Ask the network for its deterministic actions; see `StatelessPolicy.actions`."""
        rows = np.atleast_2d(given)
        end = self._offset + len(rows)
        padded = np.zeros((-(-end // BLOCK) * BLOCK, self._width), dtype=np.float32)
        padded[self._offset : end] = rows
        found = [self.act(padded[k : k + BLOCK]) for k in range(0, len(padded), BLOCK)]
        return np.concatenate(found)[self._offset : end].reshape(*given.shape[:-1], -1)


def not_compilable(policy: Any) -> NotCompilableError:
    """Return the error that says that a policy is no function of compiled programs."""
    return NotCompilableError(
        f"the policy {type(policy).__name__} has no compiled form, and only the NumPy engine can"
        " call it"
    )


def checked_observation(observation: Any, width: int) -> np.ndarray:
    """Return observations in double precision.

    Args:
        observation: one observation (width,) or a batch (B, width).
        width: number of entries of an observation.

    Raises:
        InvalidInputError: The observation has another shape.
    """
    given = np.asarray(observation, dtype=np.float64)
    if given.ndim not in (1, 2) or given.shape[-1] != width:
        raise InvalidInputError(
            f"the observation has shape {given.shape}; the policy takes ({width},) or (B, {width})"
        )
    return given


def require_spaces(what: str, trained: Spaces, wanted: Spaces) -> None:
    """Raise ConfigurationError unless a policy takes an env's observations and gives its actions.

    Args:
        what: the policy is, to begin the message with.
        trained: spaces of the policy.
        wanted: spaces of the env that it is to act in.
    """
    for kind, its, of_env in zip(("observation", "action"), trained, wanted, strict=True):
        if its != of_env:
            raise ConfigurationError(
                f"{what} was trained for another {kind} space, {_difference(its, of_env)}. Where it"
                " was trained behind wrappers that change spaces, give the model itself, with an"
                " env that has these wrappers: PPO.load(file, env=env)"
            )


def _difference(trained: gym.Space[Any], wanted: gym.Space[Any]) -> str:
    if (
        not (isinstance(trained, gym.spaces.Box) and isinstance(wanted, gym.spaces.Box))
        or trained.shape != wanted.shape
    ):
        return f"{trained}; the env's is {wanted}"
    theirs, ours = [
        f"between {space.low.tolist()} and {space.high.tolist()}" for space in (trained, wanted)
    ]
    return f"{theirs}; the env's is {ours}"
