"""Gymnasium environments of safety-critical systems under uncertainty.

Importing this package registers their ids. What is named here is imported when it is first used:
ids, errors and completion in a shell need no symbolic algebra.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    NumericalError,
    RelativeDegreeError,
    SafeEnvsError,
    SystemDefinitionError,
    SystemDefinitionWarning,
)
from safe_envs.systems import ENV_IDS, register_all

if TYPE_CHECKING:
    from safe_envs.dynamics.sde import ControlAffineSDE
    from safe_envs.envs.custom import register
    from safe_envs.envs.env import SafeEnv
    from safe_envs.envs.vector_env import SafeVectorEnv
    from safe_envs.problem.barrier import Barrier
    from safe_envs.problem.builder import state_problem
    from safe_envs.problem.clf import CLF
    from safe_envs.problem.problem import SafetyProblem
    from safe_envs.wrappers.safety_filter import SafetyFilter

__all__ = [
    "CLF",
    "ENV_IDS",
    "Barrier",
    "ConfigurationError",
    "ControlAffineSDE",
    "InvalidInputError",
    "NumericalError",
    "RelativeDegreeError",
    "SafeEnv",
    "SafeEnvsError",
    "SafeVectorEnv",
    "SafetyFilter",
    "SafetyProblem",
    "SystemDefinitionError",
    "SystemDefinitionWarning",
    "register",
    "state_problem",
]

__version__ = version("safe-envs")

_MODULES = {
    "Barrier": "problem.barrier",
    "CLF": "problem.clf",
    "ControlAffineSDE": "dynamics.sde",
    "SafeEnv": "envs.env",
    "SafeVectorEnv": "envs.vector_env",
    "SafetyFilter": "wrappers.safety_filter",
    "SafetyProblem": "problem.problem",
    "register": "envs.custom",
    "state_problem": "problem.builder",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_all()
