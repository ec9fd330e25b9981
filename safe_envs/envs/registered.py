"""Bases of the registered envs: a system's problem behind the arguments of `gym.make`."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from safe_envs.envs.env import SafeEnv
from safe_envs.envs.spec import register_system
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.plugins import resolved
from safe_envs.problem.factory import Factory, build_problem, load_system, remembering
from safe_envs.problem.problem import SafetyProblem

_OF_BATCHES = {
    "autoreset_mode": "for vectorization_mode = 'sync' or 'async' of gym.make_vec give"
    " vector_kwargs={'autoreset_mode': 'SameStep'}",
    "engine": "leave it out, or leave out the vectorization_mode of gym.make_vec",
}
"""Arguments of `SystemVectorEnv` that one env does not have, and what to give in their place."""


class SystemEnv(SafeEnv):
    """Base of the registered envs: a system's problem behind the arguments of `gym.make`.

    Args:
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: "rgb_array", "human" or None; see `SafeEnv`.
        terminate_on_violation: see `SafeEnv`.
        **options: fields of `safe_envs.problem.options.ProblemOptions`; arguments of the barrier
            may also be given by themselves.

    Raises:
        ConfigurationError: An argument names something unknown or is out of range.
    """

    problem_factory: ClassVar[Any]
    """Builds the problem from the arguments of the barrier; called once for equal arguments."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "problem_factory" in vars(cls):
            cls.problem_factory = staticmethod(remembering(cls.problem_factory))

    def __init__(
        self,
        *,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        terminate_on_violation: bool = False,
        **options: Any,
    ) -> None:
        for name in _OF_BATCHES.keys() & options.keys():
            raise ConfigurationError(
                f"{name} is an argument of batches of envs that are stepped together, and this is"
                f" one env; {_OF_BATCHES[name]}"
            )
        problem = type(self).make_problem(**options)
        super().__init__(problem, max_episode_steps, render_mode, terminate_on_violation)

    @classmethod
    def make_problem(cls, **options: Any) -> SafetyProblem:
        """Return the problem that the env has with these options, without making the env."""
        return build_problem(cls.__name__, cls.problem_factory, options)


class SystemVectorEnv(SafeVectorEnv):
    """Base of the registered vector envs.

    Args:
        num_envs: see `SafeVectorEnv`.
        autoreset_mode: see `SafeVectorEnv`.
        max_episode_steps: see `SafeVectorEnv`.
        render_mode: see `SafeVectorEnv`.
        engine: see `SafeVectorEnv`.
        terminate_on_violation: see `SafeEnv`.
        **options: as for `SystemEnv`.
    """

    env_class: ClassVar[type[SystemEnv]]

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        engine: str = "numpy",
        terminate_on_violation: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(
            self.env_class.make_problem(**options),
            num_envs,
            autoreset_mode,
            max_episode_steps,
            render_mode,
            engine,
            terminate_on_violation,
        )


_ENTRY = "safe_envs.envs.registered:Custom"


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
