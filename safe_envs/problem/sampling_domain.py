"""Where and how a system is excited when something of it is to be learned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

from safe_envs.errors import SystemDefinitionError
from safe_envs.problem.signals import Variable


@dataclass(frozen=True)
class SamplingDomain:
    """Where and how a system is excited to learn from it.

    `SafetyProblem.sampling_domain` completes what is empty.

    Attributes:
        region: (low, high) of each state. States are drawn uniformly from it, where every barrier
            is positive.
        inputs: input vectors that are tried, in physical units; clipped to the box.
        coordinates: expressions of the states that a learned function depends on: cosines and sines
            of angles, relative positions.
    """

    region: tuple[tuple[float, float], ...] = ()
    inputs: tuple[tuple[float, ...], ...] = ()
    coordinates: tuple[sp.Expr, ...] = ()

    def completed(
        self, states: Sequence[Variable], box: Sequence[tuple[float, float]]
    ) -> SamplingDomain:
        """Fill what is empty.

        States get their ranges, an angle a whole turn; inputs go halfway to their bounds.

        Args:
            states: with their ranges, possibly infinite.
            box: (low, high) of each input.

        Returns:
            The domain without empty parts.

        Raises:
            SystemDefinitionError: a part has the wrong length, or a range is infinite or empty.
        """
        angles = [s.unit == "rad" and math.isinf(s.low) and math.isinf(s.high) for s in states]
        region = self.region or tuple(
            (-math.pi, math.pi) if angle else (s.low, s.high)
            for s, angle in zip(states, angles, strict=True)
        )
        if len(region) != len(states):
            raise SystemDefinitionError(
                f"the region of a sampling domain has {len(region)} ranges for {len(states)} states"
            )
        for state, (low, high) in zip(states, region, strict=True):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise SystemDefinitionError(
                    f"cannot explore {state.symbol} in [{low}, {high}]; give"
                    " SamplingDomain(region=...) finite ranges, or the problem a workspace"
                )
        if any(len(u) != len(box) or not all(map(math.isfinite, u)) for u in self.inputs):
            raise SystemDefinitionError(
                f"an input of a sampling domain needs {len(box)} finite numbers; given"
                f" {self.inputs}"
            )
        clipped = tuple(
            tuple(min(max(v, low), high) for v, (low, high) in zip(u, box, strict=True))
            for u in self.inputs
        )
        # Inputs that a narrow box makes one and the same would tell nothing of the input's effect.
        inputs = (
            clipped if clipped and len(set(clipped)) == len(set(self.inputs)) else _halfway(box)
        )
        coordinates = self.coordinates or tuple(
            e
            for s, angle in zip(states, angles, strict=True)
            for e in ((sp.cos(s.symbol), sp.sin(s.symbol)) if angle else (s.symbol,))
        )
        return SamplingDomain(region, inputs, coordinates)


def _halfway(box: Sequence[tuple[float, float]]) -> tuple[tuple[float, ...], ...]:
    """Return, for each input, the points halfway from its centre to its bounds, others centred."""
    center = [0.5 * (low + high) for low, high in box]
    reach = [0.25 * (high - low) for low, high in box]
    return tuple(
        tuple(c + sign * reach[j] * (i == j) for i, c in enumerate(center))
        for j in range(len(box))
        for sign in (-1.0, 1.0)
    )
