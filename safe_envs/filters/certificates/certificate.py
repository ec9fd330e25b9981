"""What certificates state: a barrier psi, and the numbers of its bound."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial


@dataclass(frozen=True)
class Plant:
    """The system of a certificate, in exact numbers.

    Attributes:
        states: symbols.
        workspace: lower and upper end of each state; to leave it ends an episode. For a state that
            is an angle of period 2 pi in all expressions it may be one period.
        inputs: symbols.
        bounds: lower and upper bound of each input.
        drift: f, n expressions of the states.
        input_matrix: g, n lists of m expressions.
        diffusion: sigma, n lists of d expressions.
        barriers: h_1, ..., h_k; the safe set C is where all of them are positive.
        policy: u(x), m expressions, where the certificate is of one policy; empty where it is of
            every input that meets its constraint.
    """

    states: tuple[sp.Symbol, ...]
    workspace: tuple[tuple[sp.Expr, sp.Expr], ...]
    inputs: tuple[sp.Symbol, ...]
    bounds: tuple[tuple[sp.Expr, sp.Expr], ...]
    drift: tuple[sp.Expr, ...]
    input_matrix: tuple[tuple[sp.Expr, ...], ...]
    diffusion: tuple[tuple[sp.Expr, ...], ...]
    barriers: tuple[sp.Expr, ...]
    policy: tuple[sp.Expr, ...] = ()

    @property
    def angles(self) -> tuple[bool, ...]:
        """Which states are angles, of which the workspace is one period."""
        return tuple(sp.expand(high - low) == 2 * sp.pi for low, high in self.workspace)


@dataclass(frozen=True)
class BarrierCertificate:
    """In continuous control, P(safe up to T) >= [psi(x_0) e^(-a T) - m (1 - e^(-a T))/a]/c.

    It is a proof where a sound check of its statements passes: on G, where psi and all h_i are
    positive and the workspace is not left, psi <= c and A psi >= -a psi - m along some input within
    the bounds (along the policy if there is one); psi <= 0 where an h_i is 0; and psi <= 0 at the
    ends of the period of an angle, unless psi does not depend on it.

    Attributes:
        env_id: of the registered env, with its options; empty for other systems.
        options: of the env, as for `gym.make`, JSON values.
        plant: the system.
        psi: the barrier, a polynomial of its states.
        rate: a >= 0 in 1/s.
        shortfall: m >= 0 in 1/s, for psi has no unit.
        supremum: c > 0.
        horizon: T in s.
    """

    env_id: str
    options: dict[str, object]
    plant: Plant
    psi: Polynomial
    rate: Fraction
    shortfall: Fraction
    supremum: Fraction
    horizon: Fraction

    def bounds_at(self, starts: np.ndarray, horizon: float | None = None) -> np.ndarray:
        """Return the bound at starts in C; where psi <= 0 it is 0.

        Args:
            starts: states, shape (B, n).
            horizon: T in s; by default that of the certificate.

        Returns:
            Values in [0, 1], shape (B,).
        """
        a, m, c = map(float, (self.rate, self.shortfall, self.supremum))
        time = float(self.horizon) if horizon is None else horizon
        spent = -math.expm1(-a * time) / a if a else time
        values = self.values(starts) * math.exp(-a * time) - m * spent
        return np.clip(values / c, 0.0, 1.0)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return psi, with angles taken back to the period of the workspace.

        Args:
            x: states, shape (B, n).

        Returns:
            Shape (B,).
        """
        low = np.array([float(ends[0]) for ends in self.plant.workspace])
        turned = low + np.mod(x - low, 2.0 * math.pi)
        return self.psi.values(np.where(self.plant.angles, turned, x))


Word = Literal["checked", "refuted", "undecided"]


class StatementCheck(NamedTuple):
    """What was found of one statement of a certificate.

    Attributes:
        name: of the statement.
        word: checked, refuted or undecided.
        boxes: that were looked at.
        seconds: that it took.
        state: at which a refuted statement is wrong, or the middle of a box that is undecided.
        reason: what is known of it.
    """

    name: str
    word: Word
    boxes: int = 0
    seconds: float = 0.0
    state: np.ndarray | None = None
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        state = None if self.state is None else [float(x) for x in self.state]
        return {**self._asdict(), "state": state}


class CheckResult(NamedTuple):
    """What was found of a certificate.

    Attributes:
        word: checked, refuted or undecided.
        statement: name of the first statement that is refuted or else undecided; empty if checked.
        state: of that statement.
        boxes: that were looked at.
        parts: what was found of each statement.
    """

    word: Word
    statement: str
    state: np.ndarray | None
    boxes: int
    parts: tuple[StatementCheck, ...]


def combined(parts: list[StatementCheck]) -> CheckResult:
    """Return what the statements say together: checked only if all of them are."""
    words: tuple[Word, ...] = ("refuted", "undecided")
    worst = next((part for word in words for part in parts if part.word == word), None)
    boxes = sum(part.boxes for part in parts)
    if worst is None:
        return CheckResult("checked", "", None, boxes, tuple(parts))
    return CheckResult(worst.word, worst.name, worst.state, boxes, tuple(parts))
