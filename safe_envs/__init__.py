"""Gymnasium environments of safety-critical systems under uncertainty.

Importing this package registers their ids, as soon as Gymnasium is imported too. What is named here
is imported when it is first used: ids, errors and completion in a shell need no symbolic algebra.
"""

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
from safe_envs.gymnasium_ids import register_with_gymnasium
from safe_envs.lazy_attributes import lazy_attributes, package_version
from safe_envs.systems import ENV_IDS

if TYPE_CHECKING:
    from safe_envs.agents.evaluation.evaluate import evaluate
    from safe_envs.agents.questions import best, certify, check, sweep, verify
    from safe_envs.dynamics.sde import ControlAffineSDE
    from safe_envs.envs.env import SafeEnv
    from safe_envs.envs.registered import register
    from safe_envs.envs.vector_env import SafeVectorEnv
    from safe_envs.filters.decision_log import DecisionLog
    from safe_envs.filters.safety_filter import SafetyFilter
    from safe_envs.problem.builder import define_problem
    from safe_envs.problem.clf import CLF
    from safe_envs.problem.problem import Barrier, SafetyProblem
    from safe_envs.registry import make_problem
    from safe_envs.scripts.figures.log import plot_log
    from safe_envs.wrappers.safety_filter import SafetyFilterWrapper

    __version__: str

__all__ = [
    "CLF",
    "ENV_IDS",
    "Barrier",
    "ConfigurationError",
    "ControlAffineSDE",
    "DecisionLog",
    "InvalidInputError",
    "NumericalError",
    "RelativeDegreeError",
    "SafeEnv",
    "SafeEnvsError",
    "SafeVectorEnv",
    "SafetyFilter",
    "SafetyFilterWrapper",
    "SafetyProblem",
    "SystemDefinitionError",
    "SystemDefinitionWarning",
    "best",
    "certify",
    "check",
    "define_problem",
    "evaluate",
    "make_problem",
    "plot_log",
    "register",
    "sweep",
    "verify",
]

_MODULES = {
    "Barrier": "safe_envs.problem.problem",
    "CLF": "safe_envs.problem.clf",
    "ControlAffineSDE": "safe_envs.dynamics.sde",
    "DecisionLog": "safe_envs.filters.decision_log",
    "SafeEnv": "safe_envs.envs.env",
    "SafeVectorEnv": "safe_envs.envs.vector_env",
    "SafetyFilter": "safe_envs.filters.safety_filter",
    "SafetyFilterWrapper": "safe_envs.wrappers.safety_filter",
    "SafetyProblem": "safe_envs.problem.problem",
    **dict.fromkeys(("best", "certify", "check", "sweep", "verify"), "safe_envs.agents.questions"),
    "evaluate": "safe_envs.agents.evaluation.evaluate",
    "make_problem": "safe_envs.registry",
    "plot_log": "safe_envs.scripts.figures.log",
    "register": "safe_envs.envs.registered",
    "define_problem": "safe_envs.problem.builder",
}


_find, _names = lazy_attributes(__name__, _MODULES, globals())


def __getattr__(name: str) -> Any:
    return package_version() if name == "__version__" else _find(name)


def __dir__() -> list[str]:
    return sorted({*_names(), "__version__"})


register_with_gymnasium()
