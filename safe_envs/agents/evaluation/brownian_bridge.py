"""The smallest h between control instants: what a look at the instants alone does not see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.dynamics.lie import quadratic_variation_rate, vanishes
from safe_envs.dynamics.noise import BRIDGE, EpisodeUniforms, standard_exponentials
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.problem.problem import SafetyProblem

MONITORING = ("discrete", "continuous")
"""Where h is checked: at control instants, or between them too."""


def require_monitoring(monitoring: str) -> None:
    """Check a word for where h is checked.

    Raises:
        ConfigurationError: it is none of `MONITORING`.
    """
    if monitoring not in MONITORING:
        raise ConfigurationError(
            f"monitoring = {shown(monitoring)}; {nearest(str(monitoring), MONITORING)}"
        )


class BrownianBridge:
    """Draws the smallest h of a control period, given h at both of its ends.

    Between the ends h is taken for a Brownian bridge with the variance rate s^2 = |sigma' grad h|^2
    of the period's beginning. That is exact for a Brownian motion with any constant drift, and
    right to first order in the period where s varies. The minimum m of such a bridge from h_0 to
    h_1 over dt has P(m <= y) = exp(-2 (h_0 - y)(h_1 - y)/(s^2 dt)) for y below both, so that with a
    standard exponential E

        m = (h_0 + h_1 - sqrt((h_1 - h_0)^2 + 2 s^2 dt E))/2.

    Several barriers get bridges of their own, drawn independently of each other. Where s = 0,
    because there is no noise or because it reaches h through a derivative only, the smaller end is
    all there is.

    Args:
        problem: whose plant, barriers and control period are taken.

    Attributes:
        reached: for each barrier, whether the noise reaches it directly, so that there is anything
            to draw.

    Source: P. Glasserman, Monte Carlo Methods in Financial Engineering, Springer 2003, Sec. 6.4.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        plant = problem.plant
        self.reached = reached_by_noise(problem)
        self._rates = compile_function(plant.states, bridge_rates(problem), "arrays")
        self._h = BarrierFunction(
            plant.states,
            [plant.numeric(barrier.expression) for barrier in problem.barriers],
            "arrays",
        )

    @property
    def draws(self) -> int:
        """Standard exponentials that a period takes for each episode."""
        return len(self.reached)

    def barriers(self, x: Components) -> np.ndarray:
        """Return the barriers at states, given component by component, shape (B, k)."""
        return stacked(self._h(*x), len(x[0]))

    def sample_minimum(
        self, x: Components, before: np.ndarray, after: np.ndarray, draws: np.ndarray
    ) -> np.ndarray:
        """Draw the smallest value of each barrier during a control period, its ends included.

        Args:
            x: components of the states at the beginning of the period, each of shape (B,).
            before: barriers there, shape (B, k).
            after: barriers at the end of the period, shape (B, k).
            draws: standard exponentials, shape (B, k).

        Returns:
            Shape (B, k).
        """
        ends = np.minimum(before, after)
        if any(self.reached):
            # With an end without a value, which is -inf, there is nothing to draw.
            with np.errstate(invalid="ignore"):
                reach = np.sqrt((after - before) ** 2 + stacked(self._rates(*x), len(ends)) * draws)
                # Rounding must not lift the minimum above an end.
                ends = np.fmin(ends, 0.5 * (before + after - reach))
        return ends


def reached_by_noise(problem: SafetyProblem) -> tuple[bool, ...]:
    """Return for each barrier whether the noise reaches it directly."""
    plant = problem.plant
    return tuple(
        not vanishes(plant, quadratic_variation_rate(plant, barrier.expression))
        for barrier in problem.barriers
    )


def bridge_rates(problem: SafetyProblem) -> list[Any]:
    """Return 2 s^2 dt of each barrier as a formula of the state."""
    plant = problem.plant
    rates = [quadratic_variation_rate(plant, barrier.expression) for barrier in problem.barriers]
    return [2.0 * problem.dt * plant.numeric(rate) for rate in rates]


def smallest(barriers: np.ndarray) -> np.ndarray:
    """Return the smallest of the barriers of each episode: shape (B,) for (B, k)."""
    return barriers[:, 0] if barriers.shape[1] == 1 else barriers.min(axis=1)


def bridge_notes(problem: SafetyProblem) -> list[str]:
    """Return notes on how to read numbers of continuous monitoring."""
    reached = reached_by_noise(problem)
    smooth = [
        barrier.name
        for barrier, reaches in zip(problem.barriers, reached, strict=True)
        if not reaches
    ]
    notes = []
    if smooth:
        notes.append(
            f"continuous monitoring changes nothing for {', '.join(smooth)}, which no noise reaches"
            " directly: there only a smaller dt does anything."
        )
    if sum(reached) > 1:
        notes.append(
            "between control instants each barrier is taken by itself, independently of the others."
        )
    return notes


class Exponentials:
    """Standard exponentials of episodes side by side, a stream for each.

    The draws of an episode do not depend on its neighbours.

    Args:
        seeds: of the episodes, one for each row.
        width: how many a row gets at a time.
        periods: control period of each row that comes next; None for the first of all.
    """

    def __init__(
        self, seeds: Sequence[int], width: int, periods: Sequence[int] | None = None
    ) -> None:
        self._uniforms = EpisodeUniforms(seeds, BRIDGE, width, periods)

    def next(self) -> np.ndarray:
        """Return the draws of the next control period, shape (rows, width)."""
        return standard_exponentials(self._uniforms.next())
