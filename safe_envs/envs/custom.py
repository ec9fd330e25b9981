"""Systems of your own behind `gym.make`: from the place of their statement, FILE.py:NAME or
MODULE:NAME, to an env."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import gymnasium as gym

from safe_envs.envs.env import SafeEnv, make_problem
from safe_envs.envs.vector_env import AutoresetMode, SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.object_import import called, load_object, resolved
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.validation import require_sound
from safe_envs.systems import CUSTOM_ID

Factory = Callable[..., SafetyProblem]

_ENTRY = "safe_envs.envs.custom:Custom"


def load_system(place: Any) -> Factory:
    """Import the statement of a system.

    Args:
        place: FILE.py:NAME or MODULE:NAME of a `SafetyProblem`, or of a function that returns one.
            Importing runs the code there.

    Returns:
        The function, whose keyword arguments are those of `--barrier`; one without any for a
        problem.

    Raises:
        ConfigurationError: there is no such place, or the code there ends with an error.
    """
    if not isinstance(place, str) or not place:
        raise ConfigurationError(
            f"system = {place!r}; give the place of its statement as a text, FILE.py:NAME or"
            f" MODULE:NAME, like gym.make({CUSTOM_ID!r}, system='cart_pole.py:problem')"
        )
    found = load_object(place)
    if isinstance(found, SafetyProblem):
        require_sound(found)
        return lambda: found
    if not inspect.isfunction(found):
        raise ConfigurationError(
            f"{place} is {type(found).__name__}; give a SafetyProblem, or a function that"
            " returns one"
        )

    def factory(**arguments: Any) -> SafetyProblem:
        given = tuple(sorted(arguments.items()))
        remembered = all(isinstance(value, int | float | str) for value in arguments.values())
        return (_stated if remembered else _stated.__wrapped__)(found, place, given)

    factory.__signature__ = inspect.signature(found)  # pyright: ignore[reportFunctionMemberAccess]
    return factory


@lru_cache(maxsize=64)
def _stated(
    function: Callable[..., Any], place: str, arguments: tuple[tuple[str, Any], ...]
) -> SafetyProblem:
    """Remembered: an env is often made more than once, and stating its problem takes longer than
    all else."""
    problem = called(function, place, dict(arguments))
    if not isinstance(problem, SafetyProblem):
        raise ConfigurationError(
            f"{place} returned {type(problem).__name__}; it is to return a SafetyProblem"
        )
    require_sound(problem)
    return problem


def register(env_id: str, system: str | Factory) -> None:
    """Register an id with Gymnasium for a system of your own: `gym.make`, `gym.make_vec` and all
    commands know it then.

    Args:
        env_id: like "my_lab/CartPole-v0"; one that was registered here before is replaced.
        system: where it is stated, see `load_system`; or the function itself, if it is at the top
            of a module. An env's spec holds the place as text, so that it can be made again
            elsewhere.

    Raises:
        ConfigurationError: there is no such place, what is there is neither a problem nor a
            function, or the id is another env's.
    """
    if isinstance(system, SafetyProblem):
        raise ConfigurationError(
            "register takes FILE.py:NAME or a function that returns a problem; a problem itself"
            " goes into SafeEnv(problem)"
        )
    if not isinstance(system, str):
        name = getattr(system, "__qualname__", "")
        if not name.isidentifier():
            raise ConfigurationError(
                f"{system!r} is no function at the top of a module, so that others could find it;"
                " define it there"
            )
        system = f"{system.__module__}:{name}"
    place = resolved(system)
    load_system(place)
    taken = gym.registry.get(env_id)
    if taken is not None and taken.entry_point != _ENTRY:
        raise ConfigurationError(
            f"the id {env_id} is taken by {taken.entry_point}; choose another, like"
            f" my_lab/{env_id.split('/')[-1]}"
        )
    gym.registry.pop(env_id, None)
    gym.register(
        env_id, entry_point=_ENTRY, vector_entry_point=f"{_ENTRY}Vector", kwargs={"system": place}
    )


class Custom(SafeEnv):
    """A system of your own.

    Args:
        system: where it is stated: see `load_system`.
        barrier: arguments of the function that states it, by name; each may also be given by
            itself.
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: see `SafeEnv`.
        **options: `noise`, `plant`, `model`, `dt`, `substeps`, `horizon`, `box` and `start` as for
          `SystemEnv`.

    Raises:
        ConfigurationError: the place or an argument is unknown or out of range.
    """

    def __init__(
        self,
        system: str = "",
        *,
        barrier: Mapping[str, Any] | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(
            make_problem(system, load_system(system), barrier, options),
            max_episode_steps,
            render_mode,
        )


class CustomVector(SafeVectorEnv):
    """The same, batched; further arguments as for `SafeVectorEnv`."""

    def __init__(
        self,
        system: str = "",
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        barrier: Mapping[str, Any] | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        problem = make_problem(system, load_system(system), barrier, options)
        super().__init__(problem, num_envs, autoreset_mode, max_episode_steps, render_mode)
