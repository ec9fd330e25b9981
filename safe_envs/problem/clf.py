"""A control Lyapunov function as a soft goal, and its min-norm law in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sympy as sp

from safe_envs.dynamics.lie import generator, lie_derivative_g
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import formula
from safe_envs.errors import ConfigurationError
from safe_envs.text import finite_number


@dataclass(frozen=True)
class CLF:
    """V is to decay at a rate, as far as that is worth its cost.

        min  w_u |u|^2 + w_d d^2   s.t.   AV + rate V <= d

    The slack d keeps the QP feasible: without it AV <= 0 cannot hold at the goal under noise.

    Attributes:
        V: Lyapunov function of the states; in a control loop of the user's also of the system's
            signals and of the time.
        rate: wanted rate of decay, in 1/s.
        input_weight: w_u > 0, an expression of the parameters.
        slack_weight: w_d > 0, likewise.

    Raises:
        ConfigurationError: the rate is negative or not finite.
        SystemDefinitionError: V or a weight is no expression.

    Source: the CLF part of the quadratic programs in thesis Sec. 4.3.1 and 5.4.2. Sec. 4.3.1 asks
        for AV <= d, without the
    rate, with the trace of sigma' sigma V_xx and weights of 1/2 each, at which u stays near 0.
    """

    V: Any
    rate: float = 1.0
    input_weight: Any = 1.0
    slack_weight: Any = 1.0

    def __post_init__(self) -> None:
        if finite_number("rate", self.rate) < 0:
            raise ConfigurationError(f"rate = {self.rate}; give a rate of decay >= 0 in 1/s")
        for name in ("V", "input_weight", "slack_weight"):
            object.__setattr__(self, name, formula(f"{name} of a clf", getattr(self, name)))

    def require_known(self, system: ControlAffineSDE, known: Sequence[sp.Symbol]) -> None:
        """Check of what V and the weights are functions.

        Args:
            system: whose parameters the weights may hold.
            known: symbols that V may hold.

        Raises:
            SystemDefinitionError: another symbol is in them.
        """
        system.require_known("V of the clf", self.V.free_symbols, known)
        for weight in (self.input_weight, self.slack_weight):
            system.require_known(
                "a weight of the clf", weight.free_symbols, tuple(system.parameters)
            )

    def growth(self, system: ControlAffineSDE) -> tuple[sp.Expr, tuple[sp.Expr, ...]]:
        """Return a and b, one for each input, of AV + rate V = a + b u."""
        b: Any = lie_derivative_g(system, self.V)
        return generator(system, self.V) + sp.sympify(self.rate) * self.V, tuple(b)

    def min_norm(self, system: ControlAffineSDE) -> tuple[sp.Expr, ...]:
        """Return the input of minimum cost without input bounds, one expression for each input.

        The only constraint is inactive where a <= 0. Elsewhere the multiplier follows from a + b u
        = d, so that u = -b' max(a, 0) / (b b' + w_u / w_d): there is no division by zero.
        """
        a, b = self.growth(system)
        scale = sp.Max(a, 0) / (
            sum(entry**2 for entry in b) + sp.sympify(self.input_weight) / self.slack_weight
        )
        return tuple(-scale * entry for entry in b)
