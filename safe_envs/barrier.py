"""A barrier: the function whose superlevel set is safe."""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp


@dataclass(frozen=True)
class Barrier:
    """h, with the safe set C = {x : h(x) >= 0}; a violation is h < 0.

    It is a function of the states alone, with numbers for its constants: plant and model may differ, what is safe
    is the same for both.

    Attributes:
        expression: h(x).
        name: how it is called in tables and plots.

    Source: thesis Eq. (3.3), (4.8).
    """

    expression: sp.Expr
    name: str = "h"

    def __post_init__(self) -> None:
        object.__setattr__(self, "expression", sp.sympify(self.expression))
