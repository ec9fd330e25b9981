"""Coordinates in which a problem closes, so that fewer numbers than states decide what happens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import formula, require_real
from safe_envs.errors import SystemDefinitionError, shown
from safe_envs.problem.signals import Variable


@dataclass(frozen=True)
class Frame:
    """Coordinates q(x) of the states in which a problem closes, for a symmetry that it has.

    A vehicle in a disk, for one, has the same prospects wherever it is turned around the centre:
    its distance from there and its heading against the radius decide. What is computed on a grid of
    states needs fewer axes so.

    The law of q after one step of the simulation must depend on the state through q alone, and
    barriers and goal must be functions of q. Whoever uses a frame checks that, for it depends on
    the parameters; where it fails, the states themselves are used.

    Attributes:
        coordinates: symbol and range of each. The range holds every safe state. It is one period of
            a periodic one.
        values: q, expressions of the states.
        section: one state for each value of q: an expression of the coordinates for each state, in
            order. A state that stands for itself is a coordinate as well.
        periods: of each coordinate, 0 for those that are not periodic; all 0 by default.

    Raises:
        SystemDefinitionError: the parts do not fit together.
    """

    coordinates: tuple[Variable, ...]
    values: tuple[sp.Expr, ...]
    section: tuple[sp.Expr, ...]
    periods: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.coordinates or not all(isinstance(c, Variable) for c in self.coordinates):
            raise SystemDefinitionError(
                f"coordinates of a frame = {shown(self.coordinates)}; give a `Variable` for each"
            )
        given: dict[str, Any] = {
            "coordinates": tuple(self.coordinates),
            "values": tuple(formula("a value of a frame", e) for e in self.values),
            "section": tuple(formula("the section of a frame", e) for e in self.section),
            "periods": tuple(map(float, self.periods)) or (0.0,) * len(self.coordinates),
        }
        for name, entry in given.items():
            object.__setattr__(self, name, entry)
        require_real(self.symbols, (), ())
        if len({s.name for s in self.symbols}) < len(self.symbols):
            raise SystemDefinitionError("two coordinates of a frame have the same name")
        if not len(self.values) == len(self.periods) == len(self.coordinates):
            raise SystemDefinitionError(
                f"a frame of {len(self.coordinates)} coordinates has {len(self.values)} values and"
                f" {len(self.periods)} periods; give one for each"
            )
        for c, period in zip(self.coordinates, self.periods, strict=True):
            finite = math.isfinite(c.low) and math.isfinite(c.high) and c.low < c.high
            if not finite or (period and not math.isclose(c.high - c.low, period)):
                raise SystemDefinitionError(
                    f"coordinate {c.symbol} of a frame has the range [{c.low}, {c.high}] and the"
                    f" period {period:g}; give a finite range, which is one period of a periodic"
                    " coordinate"
                )

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """The symbols of the coordinates."""
        return tuple(c.symbol for c in self.coordinates)

    def require_known(self, system: ControlAffineSDE) -> None:
        """Check that a frame fits a system.

        Raises:
            SystemDefinitionError: another symbol is in it, a coordinate is named like a symbol of
                the system, or the section has another number of states.
        """
        taken = {s.name for s in (*system.states, *system.inputs, *system.parameters)}
        for c in self.symbols:
            if c.name in taken:
                raise SystemDefinitionError(
                    f"coordinate {c} of the frame is named like a symbol of the system; give it"
                    " another name"
                )
        if len(self.section) != system.n:
            raise SystemDefinitionError(
                f"the section of the frame has {len(self.section)} expressions; give one for each"
                f" of the {system.n} states"
            )
        for value in self.values:
            system.require_known("a value of the frame", value.free_symbols, system.states)
        themselves = self.unchanged(system.states)
        for state in self.section:
            known = (*self.symbols, *themselves)
            system.require_known("the section of the frame", state.free_symbols, known)

    def unchanged(self, states: tuple[sp.Symbol, ...]) -> tuple[sp.Symbol, ...]:
        """Return the states that stand for themselves in the section."""
        return tuple(s for s, e in zip(states, self.section, strict=True) if s == e)
