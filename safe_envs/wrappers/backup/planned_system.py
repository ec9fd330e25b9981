"""A system under backup laws as it is simulated: readings of a state, inputs, and steps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, filled
from safe_envs.dynamics.defined import NO_VALUE, defined_arrays
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.wrappers.backup.closed_part import closed_part

_FLAVOURS: tuple[Flavour, ...] = ("floats", "arrays")


@dataclass(frozen=True)
class PlannedLaw:
    """A backup law with its terminal set.

    Attributes:
        name: of the law.
        law: an expression for each input.
        terminal: >= 0 in the terminal set.
    """

    name: str
    law: tuple[sp.Expr, ...]
    terminal: sp.Expr


class PlannedSystem:
    """What the plans of backup laws consist of.

    A period is one of the env with every random number 0: classical Runge-Kutta for a system
    without noise, whose plans are thereby those of the env; and Euler for one with noise. Inputs
    are evaluated at control instants, clipped to the input bounds, and held.

    Args:
        system: that is known.
        barriers: h of each barrier.
        laws: at least one.
        bounds: lower and upper bounds of the inputs.
        dt: control period in s.
        substeps: integration steps in it.
        periods: after which a plan has to be in its terminal set.

    Attributes:
        laws: as given.
        periods: as given.
        bounds: as given.
        ends: lower and upper bound of each input.
        middle: of the bounds, which stands for an input without a value.
        count: number of barriers.
        system, places: the part of the system that is simulated, and the indices of its states.
        readings: of each law the barriers, the terminal expression and its inputs.
        compiled: the readings as functions of p components, by flavour.
        steps: the integrators by flavour.
        still, still_arrays: what they take for noise, zeros.
        substeps: as given.
        step_size: of the integration, in s.
    """

    def __init__(
        self,
        system: ControlAffineSDE,
        barriers: Iterable[sp.Expr],
        laws: Sequence[PlannedLaw],
        bounds: tuple[Sequence[float], Sequence[float]],
        dt: float,
        substeps: int,
        periods: int,
    ) -> None:
        self.laws, self.periods = tuple(laws), periods
        self.bounds, heights = bounds, tuple(barriers)
        self.ends = [(np.array(a), np.array(b)) for a, b in zip(*bounds, strict=True)]
        self.middle = [0.5 * a + 0.5 * b for a, b in zip(*bounds, strict=True)]
        self.count = len(heights)
        wanted = [*heights, *(e for law in laws for e in (law.terminal, *law.law))]
        self.system, self.places = closed_part(system, wanted)
        self.steps = {f: Integrator(self.system, dt, substeps, f) for f in _FLAVOURS}
        self.substeps, self.step_size = substeps, dt / substeps
        self.readings = [
            tuple(self.system.numeric(e) for e in (*heights, law.terminal, *law.law))
            for law in laws
        ]
        self.compiled = {f: [self._compile(each, f) for each in self.readings] for f in _FLAVOURS}
        self.still = [0.0] * self.steps["floats"].channels
        self.still_arrays = [np.array(0.0)] * len(self.still)

    def _compile(self, reading: Sequence[sp.Expr], flavour: Flavour) -> Any:
        return compile_function(self.system.states, reading, flavour)

    def part(self, x: Sequence[Any]) -> Components:
        """Return those components of a state, or of states, that plans need.

        All other methods take states as these p components.

        Args:
            x: n components.
        """
        return tuple([x[i] for i in self.places])

    def inputs_of_one(self, x: Sequence[float]) -> list[list[float]]:
        """Return what each law executes at a state.

        Args:
            x: p components.
        """
        found = []
        for reading in self.compiled["floats"]:
            try:
                found.append(self.clipped(reading(*x)))
            except NO_VALUE:
                found.append(list(self.middle))
        return found

    def clipped(self, values: Sequence[float]) -> list[float]:
        """Return the inputs among readings within their bounds; the middle where there is none.

        Args:
            values: the barriers, the terminal expression and the inputs of a law.
        """
        wanted = values[self.count + 1 :]
        limits = zip(wanted, *self.bounds, self.middle, strict=True)
        return [c if u != u else min(max(u, a), b) for u, a, b, c in limits]

    def inputs(self, x: Components) -> list[Components]:
        """Return what each law executes at states.

        Args:
            x: p components (B,).

        Returns:
            For each law m components (B,).
        """
        return [self.clipped_arrays(reading(*x), x) for reading in self.compiled["arrays"]]

    def clipped_arrays(self, values: Components, x: Components) -> Components:
        """Return the inputs among readings of a batch; see `clipped`.

        Args:
            values: the readings.
            x: p components (B,) of the states that they are of.
        """
        shape, wanted = x[0].shape, values[self.count + 1 :]
        found = []
        for u, (low, high), middle in zip(wanted, self.ends, self.middle, strict=True):
            clipped = np.minimum(np.maximum(filled(u, shape), low), high)
            missing = np.isnan(clipped)
            found.append(np.where(missing, middle, clipped) if missing.any() else clipped)
        return tuple(found)

    def barriers(self, x: Components) -> Components:
        """Return the barriers at states, k components, -inf where one has no value.

        Args:
            x: p components (B,).
        """
        with np.errstate(all="ignore"):
            return defined_arrays(self.compiled["arrays"][0](*x)[: self.count])

    def advanced(self, x: Components, u: Components) -> Components:
        """Return the states one period later.

        Args:
            x: p components (B,) of the states.
            u: m components (B,) of the inputs.
        """
        shape = x[0].shape
        step = self.steps["arrays"].step
        return tuple([filled(c, shape) for c in step(x, u, self.still_arrays)])
