"""Sec. 4.3.1, adaptive cruise control: the settings of Figure 4.1 and Table 4.1."""

from __future__ import annotations

from types import SimpleNamespace

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.systems.acc import WEIGHT
from thesis.artefact import settings

CAR = settings(4, "cruise")
ASSUMED, FITTED = settings(4, "cruise_assumed"), settings(4, "cruise_fitted")
PRINTED_QP = SimpleNamespace(
    **{**vars(ASSUMED), "slack_weight": 2.0 / (WEIGHT / 9.81) ** 2, "rate": 0.0}
)
"""Equal weights on u^2 and d^2, of which only the ratio counts, and A V <= d."""
BY_PRINTED_QP = "the printed QP, 1/2 (u^2 + d^2) and AV <= d"


def problem_of(cruise: SimpleNamespace, limit: float, step: float = CAR.step) -> SafetyProblem:
    """Return the problem of the car with a limit of its force in N and a control period in s."""
    return make_problem(
        CAR.env,
        barrier={name: getattr(cruise, name) for name in ("tau", "rate", "slack_weight")},
        input_bounds=[-limit, limit],
        noise=CAR.noise,
        start=CAR.start,
        dt=step,
        horizon=CAR.horizon,
    )


def filters_of(cruise: SimpleNamespace) -> dict[str, str]:
    """Return the texts of the two conditions."""
    return {"SRCBF": f"srcbf:gamma={cruise.gamma}", "SCBF": "scbf"}
