"""Importance sampling of rare violations: noise that drifts towards smaller h, and weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.rare_events.particles import Particles, PathPlayer
from safe_envs.agents.rare_events.path_keys import PathKeys
from safe_envs.dynamics.philox import DRIFTING

_STRONGEST = 64.0
"""The strongest drift that is thought of, in standard deviations of the noise over an episode."""


def log_ratio(girsanov_integrals: np.ndarray, lengths: Any) -> np.ndarray:
    """Return the log density of episodes' noise as it is over that with a drift.

    By Girsanov it is c int e'dW + c^2/2 int e'e dt.

    Args:
        girsanov_integrals: of the episodes, as in `TiltedNoiseEnv`, shape (..., 2).
        lengths: c of each, or one for all.
    """
    return lengths * girsanov_integrals[..., 0] + 0.5 * lengths**2 * girsanov_integrals[..., 1]


def optimal_tilt(
    girsanov_integrals: np.ndarray, shares: np.ndarray, horizon: float
) -> tuple[float, float]:
    """Return the drift whose weights differ least, judged by episodes that violate.

    It does not matter how these were found.

    With the weight w of an episode the second moment under the drift is E[w; violation] without it.
    So episodes that the drift would hardly ever show, since they violate on another way, count with
    their large weights.

    Args:
        girsanov_integrals: of episodes that violate, as in `TiltedNoiseEnv`, shape (B, 2).
        shares: of the probability for which each stands, shape (B,).
        horizon: of an episode, in s.

    Returns:
        The length c in 1/sqrt(s), and the deviation of the estimate of one episode with it,
        relative to the probability.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import logsumexp

    probability = math.fsum(shares)

    def log_second_moment(length: float) -> float:
        found: Any = logsumexp(log_ratio(girsanov_integrals, length), b=shares / probability)
        return float(found) - math.log(probability)

    # A sum of exponentials of convex functions: there is one minimum.
    found: Any = minimize_scalar(
        log_second_moment, bounds=(0.0, _STRONGEST / math.sqrt(horizon)), method="bounded"
    )
    return float(found.x), math.sqrt(max(math.exp(min(found.fun, 700.0)) - 1.0, 0.0))


@dataclass(frozen=True)
class ImportanceSampling:
    """How to estimate the probability that h comes down to 0, from episodes that are pushed there.

    Attributes:
        player: simulates the episodes. Where it looks between control instants too, the bridges
            between given ends do not depend on a drift.
        seed: of all randomness.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """

    player: PathPlayer
    seed: int

    def estimate(self, length: float, episodes: int, repetitions: int) -> tuple[np.ndarray, int]:
        """Estimate the probability.

        Args:
            length: of the drift, in 1/sqrt(s).
            episodes: of a repetition.
            repetitions: R.

        Returns:
            Unbiased estimates, shape (R,), and the control periods that were simulated.
        """
        powers = np.zeros(episodes * repetitions)
        paths = Particles(self.player, PathKeys(self.seed, DRIFTING), powers, length)
        violating = np.flatnonzero(paths.lowest <= 0.0)
        weights = np.zeros(len(powers))
        # The density ratio of each up to its violation; 0 without one.
        weights[violating] = np.exp(log_ratio(paths.girsanov_integrals(violating), length))
        return weights.reshape(repetitions, episodes).mean(axis=1), paths.steps
