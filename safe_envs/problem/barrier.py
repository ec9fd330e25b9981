"""A barrier: the function whose superlevel set is safe."""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp

from safe_envs.dynamics.declarations import formula


@dataclass(frozen=True)
class Barrier:
    """h, with the safe set C = {x : h(x) >= 0}; a violation is h < 0.

    It is a function of the states, with numbers for its constants: plant and model may differ, what
    is safe is the same for both. A filter in a control loop of the user's takes functions of the
    system's signals and of `safe_envs.problem.signals.TIME` too; in an env, what moves is a state.

    Attributes:
        expression: h(x), or h(x, s, t) with signals s.
        name: how it is called in tables and plots.

    Raises:
        SystemDefinitionError: h is no expression.

    Source: thesis Eq. (3.3), (4.8).
    """

    expression: sp.Expr
    name: str = "h"

    def __post_init__(self) -> None:
        object.__setattr__(self, "expression", formula("a barrier", self.expression))
