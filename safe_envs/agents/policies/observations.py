"""Observations of any space, one or a batch of them: arrays, or mappings and tuples of arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.errors import InvalidInputError


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
