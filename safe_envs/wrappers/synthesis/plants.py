"""Plants of problems, in exact numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import sympy as sp

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.certificates.certificate import Plant


def nominal_laws(problem: SafetyProblem) -> tuple[sp.Expr, ...]:
    """Return the nominal controller's laws of the states, clipped to the bounds of the inputs.

    Args:
        problem: whose nominal controller it is.

    Returns:
        An expression for each input; () where they depend on the time.
    """
    features = {f.symbol: f.expression for f in problem.features}
    found = []
    for law, (low, high) in zip(problem.nominal, problem.box, strict=True):
        of_states = problem.model.exact(law.subs(features, simultaneous=True))
        if TIME in of_states.free_symbols:
            return ()
        found.append(sp.Min(sp.Max(of_states, _exact(low)), _exact(high)))
    return tuple(found)
