"""Systems from outside this package behind `gym.make`."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from safe_envs.envs.spec import register_system
from safe_envs.envs.system_env import SystemEnv, SystemVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.object_import import resolved
from safe_envs.problem.factory import Factory, build_problem, load_system
from safe_envs.problem.problem import SafetyProblem

_ENTRY = "safe_envs.envs.custom:Custom"


def register(env_id: str, system: str | Factory) -> None:
    """Register an id for a system of your own.

    `gym.make`, `gym.make_vec` and all commands know it then.

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
    register_system(env_id, _ENTRY, f"{_ENTRY}Vector", system=place)


class Custom(SystemEnv):
    """A system from outside this package.

    Args:
        system: where it is defined: see `safe_envs.problem.factory.load_system`.
        **options: as for `SystemEnv`.

    Raises:
        ConfigurationError: The place or an argument is unknown or out of range.
    """

    def __init__(self, system: str = "", **options: Any) -> None:
        super().__init__(system=system, **options)

    @classmethod
    def make_problem(cls, *, system: str = "", **options: Any) -> SafetyProblem:
        """Return the problem at a place, with these options."""
        return build_problem(system, load_system(system), options)


class CustomVector(SystemVectorEnv):
    """`Custom` in a batch."""

    env_class = Custom
