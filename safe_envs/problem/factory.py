"""From a function that builds a problem, or the place of one, to the problem with its options."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache, wraps
from typing import Any

from safe_envs.errors import ConfigurationError
from safe_envs.plugins import SYSTEMS, called, load_object, load_plugin, plugin_names
from safe_envs.problem.options import ProblemOptions
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.validation import require_sound

Factory = Callable[..., SafetyProblem]


def build_problem(title: str, factory: Factory, arguments: Mapping[str, Any]) -> SafetyProblem:
    """Build a problem with the arguments of `gym.make`.

    Args:
        title: name of the env, for errors.
        factory: function that builds the problem from the arguments of its barrier.
        arguments: fields of `ProblemOptions`, and arguments of the barrier by themselves.

    Raises:
        ConfigurationError: An argument is unknown or out of range.
    """
    options = ProblemOptions.of(title, arguments, inspect.signature(factory).parameters)
    return factory(**(options.barrier or {})).configured(**options.changes)


def remembering(factory: Factory) -> Factory:
    """Return a function that answers with the very object of the last time.

    A problem's symbols take most of the time that an env takes to make.
    """
    remembered = lru_cache(maxsize=32, typed=True)(factory)

    @wraps(factory)
    def answer(**arguments: Any) -> SafetyProblem:
        plain = all(isinstance(value, int | float | str) for value in arguments.values())
        return (remembered if plain else factory)(**arguments)

    return answer


def load_system(place: Any) -> Factory:
    """Import a system from outside this package, which runs the code there.

    Args:
        place: FILE.py:NAME, MODULE:NAME or the name of an entry point in the group
            `safe_envs.systems`: of a `SafetyProblem`, or of a function that returns one.

    Returns:
        The function, whose keyword arguments are those of `--barrier`; one without any for a
        problem.

    Raises:
        ConfigurationError: There is no such place, or the code there ends with an error.
    """
    if not isinstance(place, str) or not place:
        raise ConfigurationError(
            f"system = {place!r}; give the place where it is defined as a text, FILE.py:NAME or"
            " MODULE:NAME, like make_problem('Custom-v0', system='cart_pole.py:problem')"
        )
    named = ":" not in place and plugin_names(SYSTEMS)
    found = load_plugin(SYSTEMS, place) if named else load_object(place)
    if isinstance(found, SafetyProblem):
        require_sound(found)
        return lambda: found
    if not inspect.isfunction(found):
        raise ConfigurationError(
            f"{place} is {type(found).__name__}; give a SafetyProblem, or a function that"
            " returns one"
        )
    return _sound_factory(found, place)


@lru_cache(maxsize=64)
def _sound_factory(function: Callable[..., Any], place: str) -> Factory:
    @wraps(function)
    def factory(**arguments: Any) -> SafetyProblem:
        problem = called(function, place, arguments)
        if not isinstance(problem, SafetyProblem):
            raise ConfigurationError(
                f"{place} returned {type(problem).__name__}; it is to return a SafetyProblem"
            )
        require_sound(problem)
        return problem

    return remembering(factory)
