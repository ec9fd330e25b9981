"""Policies that need no training: nominal controller, no action, random actions."""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.agents.policies.base import Policy, checked_observation
from safe_envs.dynamics.codegen import compile_function
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.errors import NumericalError
from safe_envs.problem.problem import SafetyProblem

_CHUNK = 128


class NominalController(Policy):
    """The problem's nominal controller.

    It sees the observation and the model's parameters, never the plant.

    Args:
        problem: whose `nominal` laws, input bounds and features are taken.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._name = problem.name
        self._width = len(problem.features)
        self._box = problem.box
        self._center, self._half = center_and_half_width(problem)
        symbols = tuple(f.symbol for f in problem.features)
        laws = tuple(problem.model.numeric(law) for law in problem.nominal)
        self._floats = compile_function(symbols, laws, "floats")
        self._arrays = compile_function(symbols, laws, "arrays")

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Evaluate the laws; actions are in double precision.

        Raises:
            InvalidInputError: the observation has another shape than (k,) or (B, k).
            NumericalError: a law has no finite value at an observation.
        """
        given = checked_observation(observation, self._width)
        if given.ndim == 1:
            try:
                inputs = self._floats(*given.tolist())
            except (OverflowError, ZeroDivisionError, ValueError) as error:
                raise self._undefined(given) from error
        else:
            with np.errstate(all="ignore"):
                inputs = self._arrays(*np.ascontiguousarray(given.T))
        actions = np.empty((*given.shape[:-1], len(self._box)))
        for j, (u, (low, high), c, w) in enumerate(
            zip(inputs, self._box, self._center, self._half, strict=True)
        ):
            actions[..., j] = (np.minimum(np.maximum(u, low), high) - c) / w
        if not np.isfinite(actions).all():
            rows = given.reshape(-1, self._width)
            raise self._undefined(rows[~np.isfinite(actions.reshape(len(rows), -1)).all(axis=1)][0])
        return actions, state

    def _undefined(self, observation: np.ndarray) -> NumericalError:
        return NumericalError(
            f"the nominal controller of {self._name!r} has no finite value at the observation"
            f" {observation.tolist()}"
        )


class ZeroController(Policy):
    """The physical input 0, or the point within the input bounds nearest to it.

    Args:
        problem: whose input bounds are taken.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._width = len(problem.features)
        center, half = center_and_half_width(problem)
        inputs = [min(max(0.0, low), high) for low, high in problem.box]
        self._action = np.array([(u - c) / w for u, c, w in zip(inputs, center, half, strict=True)])

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Return the one action, for every observation; see `Policy.predict`."""
        given = checked_observation(observation, self._width)
        return np.tile(self._action, (*given.shape[:-1], 1)), state


class RandomPolicy(Policy):
    """Independent actions, uniform in [-1, 1].

    In an evaluation every episode has a stream of its own, so that its actions do not depend on the
    batch that it is simulated in; elsewhere one generator serves all calls.

    Args:
        problem: whose number of inputs is taken.
        seed: of the generator that serves outside evaluations.
    """

    deterministic = False

    def __init__(self, problem: SafetyProblem, seed: int = 0) -> None:
        self._width = len(problem.features)
        self._m = len(problem.inputs)
        self._generator = np.random.default_rng(seed)
        self._streams: list[np.random.Generator] = []

    def begin(self, episodes: range, seed: int) -> None:
        """Give each episode its stream; see `Policy.begin`."""
        # The env of episode i is seeded by the child (i,) of the seed; this is the child of that
        # child.
        self._streams = [
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(i, 0))) for i in episodes
        ]
        self._drawn = np.empty((len(episodes), _CHUNK, self._m))
        self._position = _CHUNK

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Draw actions; see `Policy.predict`. They stay random with `deterministic`."""
        batch = checked_observation(observation, self._width).shape[:-1]
        if batch != (len(self._streams),):
            return self._generator.uniform(-1.0, 1.0, (*batch, self._m)), state
        if self._position == _CHUNK:
            for stream, drawn in zip(self._streams, self._drawn, strict=True):
                stream.random(out=drawn)
            self._position = 0
        self._position += 1
        return 2.0 * self._drawn[:, self._position - 1] - 1.0, state
