"""Distributions of the initial state, and draws from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import numbers_in
from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.dynamics.noise import START, Key, StreamReader
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.draws import MOST_TRIES
from safe_envs.errors import ConfigurationError, SystemDefinitionError
from safe_envs.problem.option_errors import wrong_start
from safe_envs.problem.signals import Variable
from safe_envs.text import finite_number

_TRIES_AT_ONCE = 4


@dataclass(frozen=True)
class Start:
    """Distribution of the initial state.

    A map of independent uniforms on [0, 1), restricted to `condition` > 0.
    """

    state: tuple[sp.Expr, ...]
    uniforms: tuple[sp.Symbol, ...] = ()
    condition: sp.Expr | None = None

    @classmethod
    def at(cls, values: Sequence[float]) -> Start:
        """Return the distribution of a fixed initial state."""
        return cls(tuple(sp.Float(v, 17) for v in values))

    @classmethod
    def given(cls, states: Sequence[Variable], start: Any) -> Start:
        """Return the distribution of an initial state that somebody asks for.

        Args:
            states: with their ranges.
            start: a number for each.

        Raises:
            ConfigurationError: It has another number of them, or one is not in its range.
        """
        found = numbers_in(start)
        if found.shape != (len(states),):
            raise wrong_start(found.size, [s.symbol.name for s in states])
        values = [
            finite_number(f"start of {s.symbol}", v)
            for s, v in zip(states, found.tolist(), strict=True)
        ]
        for s, v in zip(states, values, strict=True):
            if not s.low <= v <= s.high:
                raise ConfigurationError(
                    f"start of {s.symbol} = {v} is outside the workspace [{s.low}, {s.high}]"
                )
        return cls.at(values)

    def proposals(self, count: int) -> np.ndarray:
        """Return some states, always the same, whether or not they meet the condition.

        Args:
            count: how many.

        Returns:
            Shape (count, n).
        """
        uniforms = np.random.default_rng(0).random((len(self.uniforms), count))
        return stacked(compile_function(self.uniforms, self.state, "arrays")(*uniforms), count)


class StartSampler:
    """Draws from a `Start` by rejection.

    Args:
        start: the distribution.
        model: by whose parameters its condition is evaluated.
        title: name of the distribution, for errors.
    """

    def __init__(self, start: Start, model: ControlAffineSDE, title: str) -> None:
        self._title = title
        self._uniforms = len(start.uniforms)
        # Few envs start together, and each from numbers of its own: plain floats are fastest.
        self._state = compile_function(start.uniforms, start.state, "floats")
        self._tries, self._accept = 1, None
        if start.condition is not None:
            condition = model.numeric(start.condition)
            self._tries = _TRIES_AT_ONCE
            self._accept = BarrierFunction(model.states, (condition,), "floats")

    def draw(self, reader: StreamReader, key: Key, episode: int) -> Components:
        """Draw the initial state of an episode.

        Args:
            reader: reads the uniforms of the stream `START`, for each try as many as the
                distribution has.
            key: of the episode's seed.
            episode: its number.

        Returns:
            A plain float for each state.

        Raises:
            ConfigurationError: The condition is hardly ever met.
        """
        if self._uniforms:
            reader.seek(key, episode, START)
        for _ in range(MOST_TRIES // self._tries):
            for uniforms in reader.uniforms((self._tries, self._uniforms)).tolist():
                x = self._state(*uniforms)
                if self._accept is None or self._accept(*x)[0] > 0:
                    return x
        raise ConfigurationError(
            f"no start of {self._title} met the condition of the distribution in {MOST_TRIES}"
            " tries; give a fixed start or another distribution"
        )

    def draw_batch(
        self, reader: StreamReader, keys: Sequence[Key], episodes: Sequence[int]
    ) -> np.ndarray:
        """Draw the initial states of episodes.

        Args:
            reader: see `draw`.
            keys: of each episode's seed.
            episodes: their numbers.

        Returns:
            Shape (n, len(keys)).
        """
        if keys and not self._uniforms:
            # Nothing is drawn for a fixed start.
            fixed = np.array([self.draw(reader, keys[0], episodes[0])], dtype=float).T
            return np.repeat(fixed, len(keys), axis=1)
        drawn = [self.draw(reader, k, e) for k, e in zip(keys, episodes, strict=True)]
        return np.array(drawn, dtype=float).T.copy()


@dataclass(frozen=True)
class SamplingDomain:
    """Where and how a system is excited to learn from it.

    `SafetyProblem.sampling_domain` completes what is empty.

    Attributes:
        region: (low, high) of each state. States are drawn uniformly from it, where every barrier
            is positive.
        inputs: input vectors that are tried, in physical units; clipped to the input bounds.
        coordinates: expressions of the states that a learned function depends on: cosines and sines
            of angles, relative positions.
    """

    region: tuple[tuple[float, float], ...] = ()
    inputs: tuple[tuple[float, ...], ...] = ()
    coordinates: tuple[sp.Expr, ...] = ()

    def completed(
        self, states: Sequence[Variable], input_bounds: Sequence[tuple[float, float]]
    ) -> SamplingDomain:
        """Fill what is empty.

        States get their ranges, an angle a whole turn; inputs go halfway to their bounds.

        Args:
            states: with their ranges, possibly infinite.
            input_bounds: (low, high) of each input.

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
        if any(len(u) != len(input_bounds) or not all(map(math.isfinite, u)) for u in self.inputs):
            raise SystemDefinitionError(
                f"an input of a sampling domain needs {len(input_bounds)} finite numbers; given"
                f" {self.inputs}"
            )
        clipped = tuple(
            tuple(min(max(v, low), high) for v, (low, high) in zip(u, input_bounds, strict=True))
            for u in self.inputs
        )
        # Inputs that narrow bounds make one and the same would tell nothing of the input's effect.
        inputs = (
            clipped
            if clipped and len(set(clipped)) == len(set(self.inputs))
            else _halfway(input_bounds)
        )
        coordinates = self.coordinates or tuple(
            e
            for s, angle in zip(states, angles, strict=True)
            for e in ((sp.cos(s.symbol), sp.sin(s.symbol)) if angle else (s.symbol,))
        )
        return SamplingDomain(region, inputs, coordinates)


def _halfway(input_bounds: Sequence[tuple[float, float]]) -> tuple[tuple[float, ...], ...]:
    """Return, for each input, the points halfway from its centre to its bounds, others centred."""
    center = [0.5 * (low + high) for low, high in input_bounds]
    reach = [0.25 * (high - low) for low, high in input_bounds]
    return tuple(
        tuple(c + sign * reach[j] * (i == j) for i, c in enumerate(center))
        for j in range(len(input_bounds))
        for sign in (-1.0, 1.0)
    )
