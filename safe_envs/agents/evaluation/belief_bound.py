"""Whether the bound of belief conditions is proved: P(unsafe) <= P(h_B < 0 somewhere) + delta.

The proof, in `safe_envs.wrappers.conditions.belief`, is of the Kalman filter of a linear model with
Gaussian noise, which is the plant, of unbiased linear measurements, a start that is known, and
barriers that are half-spaces.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import Condition
from safe_envs.wrappers.estimation import Estimator
from safe_envs.wrappers.estimation.kalman import ExtendedKalmanFilter, nonlinearity


def delta_of(conditions: Sequence[Condition]) -> float | None:
    """Return the probability that belief conditions allow; None where there are none."""
    given = [condition.belief for condition in conditions if condition.belief is not None]
    return max(given) if given and len(given) == len(conditions) else None


def why_not_proved(
    problem: SafetyProblem, estimator: Estimator, monitoring: str = "discrete"
) -> str | None:
    """Return why the bound is measured and not proved; None where it is proved.

    Args:
        problem: that is simulated.
        estimator: of its state.
        monitoring: where violations are looked for; the bound is of the control instants.
    """
    nonlinear = nonlinearity(estimator)
    states = problem.plant.states
    expressions = {b.name: problem.plant.numeric(b.expression) for b in problem.barriers}
    bent = [name for name, h in expressions.items() if not _is_affine(h, states)]
    channels = estimator.measurement.channels
    reasons = {
        f"the estimator is no Kalman filter: {nonlinear}": bool(nonlinear),
        f"{estimator.name} is none of a linear model": not isinstance(
            estimator, ExtendedKalmanFilter
        ),
        "the model is not the plant": any(
            _parts(system) != _parts(problem.plant) for system in (problem.model, estimator.model)
        ),
        "the estimator has noise that the plant has not": any(estimator.added),
        "the start is not known": bool(problem.starts[problem.start].uniforms),
        "the sensor is biased": any(c.bias for c in channels),
        "violations between the control instants count too": monitoring != "discrete",
        "the sensor is periodic": any(c.period for c in channels),
        f"{', '.join(bent)} is no half-space": bool(bent),
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def _is_affine(h: sp.Expr, states: Sequence[sp.Symbol]) -> bool:
    return all(sp.simplify(e) == 0 for e in sp.hessian(h, list(states)))


def _parts(system: ControlAffineSDE) -> tuple[object, ...]:
    return tuple(
        sp.ImmutableMatrix(system.numeric(part))
        for part in (system.drift, system.input_matrix, system.diffusion)
    )
