"""A problem in as few coordinates as decide what happens, and a sub-step of the simulation in them.

Three things make states superfluous. A state that moves by itself, without input and noise, from a
known start is a function of time. A symmetry of the problem, declared as its frame, leaves fewer
coordinates; it is checked on the step. An angle that occurs only through its sine and cosine is
periodic, so that one turn of it is enough.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.automaton import Automaton
from safe_envs.wrappers.value.automaton_building import problem_automaton
from safe_envs.wrappers.value.chain import Chain, Coordinate, Derivation
from safe_envs.wrappers.value.known_states import known_states, known_values
from safe_envs.wrappers.value.one_step import Intervals, sub_step, with_intervals
from safe_envs.wrappers.value.product_states import keeps_safe

MOST_COORDINATES = 4
"""Axes of a grid that fits into memory."""

KNOWN_ROUNDING = 1e-6
"""By which known states may differ from what they are to be: that of single precision."""

_NONE: Mapping[str, tuple[float, float]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class ReducedProblem:
    """The Markov chain of a simulation, and its sets, in few coordinates.

    Attributes:
        problem: that it was derived from.
        coordinates: at most four.
        inputs: symbols.
        noise: symbols of the standard normals of one sub-step.
        intervals: (low, high) of the uncertain parameters, by the symbols that they have here.
        known: value of each known state (and of `TIME`, where the goal depends on it) at each
            instant of a sub-step, shape (steps substeps + 1,).
        step: each coordinate one sub-step later, of coordinates, inputs, noise, known symbols and
            uncertain parameters. A periodic coordinate may leave its range by it.
        barriers: of coordinates and known symbols.
        goal: likewise, reached where it is >= 0; None without one.
        outside: likewise, positive where the workspace is left.
        steps: control periods of an episode.
        substeps: of a control period.
        box: (low, high) of each input.
        specification: that an episode is to meet; "" for that of staying safe.
        automaton: of the specification; None without one.
        regions: that the specification names, of coordinates and known symbols, >= 0 inside.
        note: why a declared frame is not used, if so.
        assumed: what the known states are at each control instant, by their index in the plant's
            states, shape (steps + 1,), also those that never change; all that the chain depends on.
    """

    problem: SafetyProblem
    coordinates: tuple[Coordinate, ...]
    inputs: tuple[sp.Symbol, ...]
    noise: tuple[sp.Symbol, ...]
    intervals: Intervals
    known: Mapping[sp.Symbol, np.ndarray]
    step: tuple[sp.Expr, ...]
    barriers: tuple[sp.Expr, ...]
    goal: sp.Expr | None
    outside: sp.Expr
    steps: int
    substeps: int
    box: tuple[tuple[float, float], ...]
    specification: str = ""
    automaton: Automaton | None = None
    regions: Mapping[str, sp.Expr] = field(default_factory=dict)
    note: str = ""
    assumed: Mapping[int, np.ndarray] = field(default_factory=dict)

    def is_assumed(self, k: np.ndarray, x: Components) -> np.ndarray:
        """Return whether the known states of states are those of the chain.

        They are in all episodes from the problem's own start, and need not be in those that begin
        elsewhere, to which nothing here applies then.

        Args:
            k: control instants, int array (B,).
            x: arrays (B,) of the plant's states.

        Returns:
            Shape (B,).
        """
        found = np.ones(len(k), dtype=bool)
        for i, values in self.assumed.items():
            expected = values[k]
            found &= np.abs(x[i] - expected) <= KNOWN_ROUNDING * (1.0 + np.abs(expected))
        return found

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """The symbols of the coordinates."""
        return tuple(c.symbol for c in self.coordinates)

    def of_states(self, x: Components) -> Components:
        """Return the coordinates of states.

        Args:
            x: a float or an array for each state of the plant.

        Returns:
            A float or an array for each coordinate; periodic ones may be outside their range.
        """
        arrays, floats = self._of_states
        return (arrays if any(isinstance(v, np.ndarray) for v in x) else floats)(*x)

    @cached_property
    def _of_states(self) -> tuple[Callable[..., Components], Callable[..., Components]]:
        expressions = tuple(c.expression for c in self.coordinates)
        states = self.problem.plant.states
        return (
            compile_function(states, expressions, "arrays"),
            compile_function(states, expressions, "floats"),
        )

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256, in hexadecimal digits, of all that determines the chain and its sets."""
        known = {
            sp.srepr(s): hashlib.sha256(v.astype("<f8").tobytes()).hexdigest()
            for s, v in self.known.items()
        }
        named = [(name, sp.srepr(e)) for name, e in self.regions.items()]
        described = (
            *([self.specification, named] if self.specification else []),
            [(sp.srepr(c.symbol), c.low, c.high, c.period) for c in self.coordinates],
            [sp.srepr(c.expression) for c in self.coordinates],
            [sp.srepr(s) for s in (*self.problem.plant.states, *self.inputs, *self.noise)],
            sorted((sp.srepr(s), *ends) for s, ends in self.intervals.items()),
            sorted(known.items()),
            [[sp.srepr(e) for e in part] for part in (self.step, self.barriers)],
            [sp.srepr(e) for e in (sp.sympify(self.goal), self.outside)],
            (self.steps, self.substeps, self.box),
        )
        return hashlib.sha256(repr(described).encode()).hexdigest()


def reduced(
    problem: SafetyProblem,
    knowledge: str = "plant",
    intervals: Mapping[str, tuple[float, float]] = _NONE,
    specification: str = "",
) -> ReducedProblem:
    """Reduce a problem to the coordinates that decide what happens.

    Args:
        problem: with the start, noise and bounds in use.
        knowledge: whose step is taken, that of the "plant" or of the "model".
        intervals: (low, high) of parameters that are uncertain, by name. They stay symbols.
        specification: that an episode is to meet; "" for that of staying safe.

    Returns:
        The chain of a simulation in these coordinates.

    Raises:
        ConfigurationError: there are too many coordinates for a grid, or one that has neither
            bounds nor a period; or an argument is not allowed; or the text is no specification
            over the problem's sets.
    """
    require_direct(problem, "tables of values and promises")
    worlds = {"plant": problem.plant, "model": problem.model}
    if knowledge not in worlds:
        raise ConfigurationError(f"knowledge = {shown(knowledge)}; {nearest(knowledge, worlds)}")
    automaton = problem_automaton(problem, specification) if specification else None
    regions = () if automaton is None else tuple(a for a in automaton.atoms if a in problem.regions)
    system, uncertain = with_intervals(worlds[knowledge], intervals)
    foreknown = known_states(problem, system)
    free = [s for s in problem.plant.states if s not in foreknown]
    if problem.frame is None:
        _require_few(problem, free)
    noise, moved = sub_step(system, problem.dt / problem.substeps)
    derivation = Derivation(problem, system, uncertain, noise, moved, frozenset(foreknown), regions)
    chain, note = derivation.in_states(), ""
    if problem.frame is not None and automaton is not None and not keeps_safe(automaton):
        # Frames are checked at safe states only.
        note = f"the frame of {problem.name} is not used: the specification allows unsafe states"
    elif problem.frame is not None:
        framed, note = derivation.in_frame(problem.frame)
        chain = framed or chain
    _require_few(problem, [c.symbol for c in chain.coordinates], note)
    known, constant = known_values(problem, foreknown, derivation.following)
    assumed = _assumed(problem, chain, derivation.following, {**known, **constant})
    chain = chain.with_numbers(constant).with_periods()
    used = set().union(*(e.free_symbols for e in chain.expressions))
    return ReducedProblem(
        problem=problem,
        coordinates=chain.coordinates,
        inputs=system.inputs,
        noise=noise,
        intervals=uncertain,
        known={s: v for s, v in known.items() if s in used},
        step=chain.step,
        barriers=chain.barriers,
        goal=chain.goal,
        outside=chain.outside,
        steps=problem.steps,
        substeps=problem.substeps,
        box=problem.box,
        specification=specification,
        automaton=automaton,
        regions=chain.regions,
        note=note,
        assumed=assumed,
    )


def _assumed(
    problem: SafetyProblem,
    chain: Chain,
    following: Mapping[sp.Symbol, Any],
    values: Mapping[sp.Symbol, Any],
) -> Mapping[int, np.ndarray]:
    """Return the values of the known states on which a chain depends, also through others."""
    used: set[Any] = set()
    found: set[Any] = set().union(*(e.free_symbols for e in chain.expressions))
    while found - used:
        used |= found
        found = set().union(*(following[s].free_symbols for s in used if s in following))
        found &= values.keys()
    return {
        i: np.broadcast_to(
            np.asarray(values[s], dtype=float), problem.steps * problem.substeps + 1
        )[:: problem.substeps]
        for i, s in enumerate(problem.plant.states)
        if s in used and s in values
    }


def _require_few(problem: SafetyProblem, coordinates: Sequence[sp.Symbol], note: str = "") -> None:
    if len(coordinates) > MOST_COORDINATES:
        names = ", ".join(s.name for s in coordinates)
        raise ConfigurationError(
            f"{problem.name} has {len(coordinates)} coordinates ({names}); a grid takes at most"
            f" {MOST_COORDINATES}. Fewer are left if states that neither input nor noise reaches"
            " start at known values (give such a start), or in the coordinates of a symmetry"
            f" (declare a frame){f'; {note}' if note else ''}"
        )
