"""State estimators of models with sensors."""

from safe_envs.wrappers.estimation.estimator import Estimator
from safe_envs.wrappers.estimation.initial_belief import InitialBelief, initial_belief
from safe_envs.wrappers.estimation.kalman import ExtendedKalmanFilter, KalmanFilter
from safe_envs.wrappers.estimation.registry import make_estimator
from safe_envs.wrappers.estimation.tracker import BeliefTracker
from safe_envs.wrappers.estimation.unscented import UnscentedKalmanFilter

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
