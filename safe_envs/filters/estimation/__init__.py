"""State estimators of models with sensors.

What is named here is imported when it is first used: a command checks names before.
"""

from typing import TYPE_CHECKING

from safe_envs.lazy_attributes import lazy_attributes

if TYPE_CHECKING:
    from safe_envs.filters.estimation.estimator import Estimator, InitialBelief, initial_belief
    from safe_envs.filters.estimation.kalman import ExtendedKalmanFilter, KalmanFilter
    from safe_envs.filters.estimation.registry import make_estimator
    from safe_envs.filters.estimation.tracker import BeliefTracker
    from safe_envs.filters.estimation.unscented import UnscentedKalmanFilter

__all__ = [
    "BeliefTracker",
    "Estimator",
    "ExtendedKalmanFilter",
    "InitialBelief",
    "KalmanFilter",
    "UnscentedKalmanFilter",
    "initial_belief",
    "make_estimator",
]

_HERE = "safe_envs.filters.estimation"
_MODULES = {
    "BeliefTracker": f"{_HERE}.tracker",
    "Estimator": f"{_HERE}.estimator",
    "ExtendedKalmanFilter": f"{_HERE}.kalman",
    "InitialBelief": f"{_HERE}.estimator",
    "KalmanFilter": f"{_HERE}.kalman",
    "UnscentedKalmanFilter": f"{_HERE}.unscented",
    "initial_belief": f"{_HERE}.estimator",
    "make_estimator": f"{_HERE}.registry",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())
