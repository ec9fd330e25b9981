"""The interface of a policy, and its bases."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.engine.formulas import Source
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, InvalidInputError, NotCompilableError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME

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

        It is called `choose`, takes what `act` of `safe_envs.engine.slots` takes, and returns the
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


class ObservedState:
    """Solves the features of a problem for its states.

    A state is a feature itself; an angle whose cosine and sine are features, if a whole turn
    changes nothing; or the only unknown of a feature that is linear in it, such as the relative
    position of an obstacle once the own position is known.

    Args:
        problem: whose features they are.
        needed: states that must be read; the others are 0 where the observation does not hold
            them.

    Raises:
        ConfigurationError: The observation does not hold one of the states that are needed.
    """

    def __init__(self, problem: SafetyProblem, needed: Collection[sp.Basic]) -> None:
        columns = tuple(sp.Dummy(feature.name, real=True) for feature in problem.features)
        given: list[tuple[Any, Any]] = [
            (problem.plant.numeric(feature.expression), column)
            for feature, column in zip(problem.features, columns, strict=True)
            if not feature.expression.has(TIME)
        ]
        found = _solved(problem, given)
        missing = [str(s) for s in problem.plant.states if s in needed and s not in found]
        if missing:
            raise ConfigurationError(
                f"the observation of {problem.name} does not determine {', '.join(missing)}, which"
                " the policy best needs; add features: each of these states, or the cosine and the"
                " sine of an angle"
            )
        values = [found.get(s, sp.Integer(0)) for s in problem.plant.states]
        self._function = compile_function(columns, values, "arrays")

    def __call__(self, observations: np.ndarray) -> Components:
        """Return the components of the states, n arrays (B,), of observations (B, k)."""
        values = self._function(*np.ascontiguousarray(observations.T))
        return tuple(np.broadcast_to(value, len(observations)) for value in values)


def _solved(problem: SafetyProblem, given: list[tuple[Any, Any]]) -> dict[Any, Any]:
    """Return the states that features determine, as expressions of the features' values."""
    found: dict[Any, Any] = {s: value for s, value in given if s.is_Symbol}
    of = dict(given)
    for s in problem.plant.states:
        if s not in found and {sp.cos(s), sp.sin(s)} <= of.keys() and _turns(problem, s):
            found[s] = sp.atan2(of[sp.sin(s)], of[sp.cos(s)])
    known = -1
    while known < len(found):
        known = len(found)
        for expression, value in given:
            unknown = expression.free_symbols & set(problem.plant.states) - found.keys()
            if len(unknown) != 1:
                continue
            (s,) = unknown
            slope = sp.expand(expression).coeff(s)
            rest = sp.expand(expression - slope * s)
            if slope.is_number and not rest.has(s):
                found[s] = (value - rest.xreplace(found)) / slope
    return found


def _turns(problem: SafetyProblem, angle: sp.Symbol) -> bool:
    """Return whether a whole turn of an angle changes neither the motion nor what is safe."""
    plant = problem.plant
    parts = [
        *plant.drift,
        *plant.input_matrix,
        *plant.diffusion,
        *(barrier.expression for barrier in problem.barriers),
        problem.outside,
        sp.Integer(0) if problem.goal is None else problem.goal,
    ]
    return all(sp.expand(e - e.subs(angle, angle + 2 * sp.pi)) == 0 for e in parts)


def rows_of(observation: Any, space: gym.Space[Any]) -> tuple[Any, int, bool]:
    """Return observations with the batch in front.

    Args:
        observation: one, or a batch of them.
        space: of one.

    Returns:
        The batch, each array of the type of its space; its size; and whether a batch was given.

    Raises:
        InvalidInputError: The observation is of another space.
    """
    try:
        typed = _typed(observation, space)
        sizes = {_batch(array, of_space) for array, of_space in _arrays(typed, space)}
        (size,) = sizes
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"the observation is {shapes_of(observation)}; the policy takes one of {space}, or a"
            " batch of them"
        ) from error
    return (
        (each(lambda array: array[None], typed), 1, False) if size is None else (typed, size, True)
    )


def each(function: Callable[[np.ndarray], Any], observation: Any) -> Any:
    """Return a function of each array of an observation, in the structure of the observation.

    Args:
        function: of an array.
        observation: an array, or a mapping or a tuple of them.
    """
    if isinstance(observation, Mapping):
        return {key: each(function, part) for key, part in observation.items()}
    if isinstance(observation, tuple):
        return tuple(each(function, part) for part in observation)
    return function(observation)


def arrays_of(observation: Any) -> list[np.ndarray]:
    """Return the arrays of an observation."""
    found: list[np.ndarray] = []
    each(lambda array: found.append(np.asarray(array)), observation)
    return found


def shapes_of(observation: Any) -> str:
    """Return the shape of an observation as text, or the shapes of its parts."""
    if isinstance(observation, Mapping):
        parts = [f"{key!r}: {shapes_of(part)}" for key, part in observation.items()]
        return f"{{{', '.join(parts)}}}"
    try:
        return f"of shape {np.shape(observation)}"
    except ValueError:  # parts of different lengths
        return f"a {type(observation).__name__}"


def _typed(observation: Any, space: gym.Space[Any]) -> Any:
    """Return an observation whose arrays are of the types of the space."""
    if isinstance(space, gym.spaces.Dict):
        return {key: _typed(observation[key], part) for key, part in space.spaces.items()}
    if isinstance(space, gym.spaces.Tuple):
        return tuple(_typed(*pair) for pair in zip(observation, space.spaces, strict=True))
    return np.asarray(observation, dtype=space.dtype)


def _arrays(typed: Any, space: gym.Space[Any]) -> Iterator[tuple[np.ndarray, gym.Space[Any]]]:
    """Yield each array of an observation and its space."""
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        parts: Any = space.spaces
        for key in parts if isinstance(space, gym.spaces.Dict) else range(len(parts)):
            yield from _arrays(typed[key], parts[key])
    else:
        yield typed, space


def _batch(array: np.ndarray, space: gym.Space[Any]) -> int | None:
    """Return the number of elements of a space in an array, None for the element itself."""
    if array.shape == space.shape:
        return None
    if space.shape is None or array.shape[1:] != space.shape:
        raise ValueError("the shape is another one")
    return len(array)
