"""Gymnasium environments of safety-critical systems under uncertainty; importing this package registers their ids."""

from importlib.metadata import version

from safe_envs.barrier import Barrier
from safe_envs.clf import CLF
from safe_envs.custom import register, register_custom
from safe_envs.env import SafeEnv
from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    NumericalError,
    RelativeDegreeError,
    SafeEnvsError,
    SystemDefinitionError,
    SystemDefinitionWarning,
)
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from safe_envs.statement import state_problem
from safe_envs.systems import ENV_IDS, register_all
from safe_envs.vector import SafeVectorEnv

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
    "SafetyProblem",
    "SystemDefinitionError",
    "SystemDefinitionWarning",
    "register",
    "state_problem",
]

__version__ = version("safe-envs")

register_all()
register_custom()
