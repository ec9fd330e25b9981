"""Thesis Sec. 4.3.1, adaptive cruise control: the settings, printed and assumed."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from scipy.special import ndtr

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.scripts.reproduce.framework.artefact import Workload
from safe_envs.scripts.reproduce.framework.thesis_data import chapter
from safe_envs.systems.acc import WEIGHT

CHAPTER = chapter(4)
_SETTINGS = CHAPTER.settings["cruise"]
ACC = "safe_envs/ACC-v0"
START, NOISE, EPISODES = (_SETTINGS[name] for name in ("start", "noise", "episodes"))
STEP, HORIZON, UNBOUNDED = (_SETTINGS[name] for name in ("step", "horizon", "unbounded"))


@dataclass(frozen=True)
class CruiseSettings:
    """What the thesis leaves open, and the QP of the goal.

    Attributes:
        tau: headway in s.
        slack_weight: of the goal's d^2, where u^2 has 2/M^2.
        rate: of the goal, in 1/s.
        gamma: of the SRCBF.
        limit: of the force where it is bounded, in N.
    """

    tau: float = _SETTINGS["tau"]
    slack_weight: float = _SETTINGS["slack_weight"]
    rate: float = _SETTINGS["rate"]
    gamma: float = _SETTINGS["gamma"]
    limit: float = 0.3 * WEIGHT

    def problem(self, limit: float, step: float = STEP) -> SafetyProblem:
        """Return the problem of the car.

        Args:
            limit: of its force, in N.
            step: control period, in s.
        """
        shape = {"tau": self.tau, "rate": self.rate, "slack_weight": self.slack_weight}
        box = [-limit, limit]
        options = {"barrier": shape, "box": box, "noise": NOISE, "start": START, "dt": step}
        return make_problem(ACC, **options, horizon=HORIZON)

    @property
    def filters(self) -> dict[str, str]:
        """Return the texts of the two conditions."""
        return {"SRCBF": f"srcbf:gamma={self.gamma}", "SCBF": "scbf"}

    @property
    def most_unsafe(self) -> float:
        """Return the largest probability of a violation under any controller with A h >= 0.

        Then h >= h_0 - tau sigma_1 W_t.
        """
        distance, deviation = START[2] - self.tau * START[0], self.tau * NOISE * math.sqrt(HORIZON)
        return float(2.0 * ndtr(-distance / deviation))

    @property
    def stricter_below(self) -> float:
        """Return the h in m below which the SRCBF asks for more than the SCBF.

        A B <= gamma/B is A h >= (tau sigma_1)^2/h - gamma h^3.
        """
        return math.sqrt(self.tau * NOISE) / self.gamma**0.25


ASSUMED = CruiseSettings()
PRINTED_QP = CruiseSettings(slack_weight=2.0 / (WEIGHT / 9.81) ** 2, rate=0.0)
"""Equal weights on u^2 and d^2, of which only the ratio counts, and A V <= d."""
FITTED = CruiseSettings(**CHAPTER.settings["cruise_fitted"])
QUANTITIES = len(fields(CruiseSettings))
"""The four numbers of the table were fitted by so many."""
FITTED_GOAL = (
    f"tau = {FITTED.tau} s, weight {FITTED.slack_weight} on d^2, AV + {FITTED.rate:g} V <= d, gamma"
    f" = {FITTED.gamma:g}"
)
BY_PRINTED_QP = "the printed QP, 1/2 (u^2 + d^2) and AV <= d"


def setting_values(sample: Workload, step: float) -> dict[str, float]:
    """Return what the lines of a setting name.

    Args:
        sample: how much is simulated.
        step: control period, in s.
    """
    return {"count": sample.size(EPISODES), "control_period": step}
