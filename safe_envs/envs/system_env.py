"""Bases of the registered envs: a system's problem behind the arguments of `gym.make`."""

from __future__ import annotations

from typing import Any, ClassVar

from gymnasium.vector import AutoresetMode

from safe_envs.envs.env import SafeEnv
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.problem.factory import build_problem, remembering
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
