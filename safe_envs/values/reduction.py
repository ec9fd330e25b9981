"""A problem in as few coordinates as decide what happens, and a sub-step of the simulation in them.

Three things make states superfluous. A state that moves by itself, without input and noise, from a
known start is a function of time. A symmetry of the problem, declared as its frame, leaves fewer
coordinates; it is checked on the step. An angle that occurs only through its sine and cosine is
periodic, so that one turn of it is enough.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.integrators import euler_maruyama_step, rate
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import fitting
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.filters.specification import Automaton, problem_automaton
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.frame import Frame
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME, excess
from safe_envs.text import finite_number
from safe_envs.values.frame_check import World, check_frame
from safe_envs.values.product_states import keeps_safe

_MOST_TERMS = 120
_LARGEST = 600
"""Parts of an expression that is too large to be expanded to see whether it gets shorter."""

Intervals = Mapping[sp.Symbol, tuple[float, float]]


def with_intervals(
    system: ControlAffineSDE, intervals: Mapping[str, tuple[float, float]]
) -> tuple[ControlAffineSDE, Intervals]:
    """Return a system whose uncertain parameters are states that do not move.

    All that is derived from the system leaves their symbols as they are then.

    Args:
        system: the dynamics.
        intervals: (low, high) of parameters, by name.

    Returns:
        The system, with the parameters as further states, and the intervals by their symbols.

    Raises:
        ConfigurationError: a parameter does not exist, an interval is none, or the system has no
            finite value in it.
    """
    by_name = {p.name: p for p in system.parameters}
    found: dict[sp.Symbol, tuple[float, float]] = {}
    for name, given in intervals.items():
        if name not in by_name:
            raise ConfigurationError(
                f"an interval names the parameter {shown(name)}, which the system lacks;"
                f" {nearest(name, by_name)}"
            )
        found[sp.Symbol(name, real=True)] = _ends(system, by_name[name], given)
    if not found:
        return system, {}
    symbols = {by_name[p.name]: p for p in found}
    still = [0] * len(found)
    uncertain = ControlAffineSDE(
        states=(*system.states, *found),
        inputs=system.inputs,
        drift=[*system.drift.xreplace(symbols), *still],
        input_matrix=system.input_matrix.xreplace(symbols).col_join(sp.zeros(len(found), system.m)),
        diffusion=system.diffusion.xreplace(symbols).col_join(
            sp.zeros(len(found), system.diffusion.cols)
        ),
        parameters={p: v for p, v in system.parameters.items() if p not in symbols},
    )
    vanishing = {p: 0 for p, (low, high) in found.items() if low <= 0.0 <= high}
    if (
        uncertain.noisy
        and not replace(uncertain, diffusion=uncertain.diffusion.xreplace(vanishing)).noisy
    ):
        names = ", ".join(p.name for p in vanishing)
        raise ConfigurationError(
            f"the intervals of {names} hold 0, where the noise vanishes and the simulation takes"
            " steps of Runge and Kutta in place of Euler's; begin them above 0"
        )
    return uncertain, found


def _ends(system: ControlAffineSDE, parameter: sp.Symbol, given: Any) -> tuple[float, float]:
    name = parameter.name
    try:
        low, high = given
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"interval of {name} = {shown(given)}; give (low, high)"
        ) from error
    low, high = finite_number(f"low end of {name}", low), finite_number(f"high end of {name}", high)
    if low > high:
        raise ConfigurationError(f"interval of {name} = ({low:g}, {high:g}); its low end is higher")
    for value in (low, high, *[0.0] * (low < 0.0 < high)):
        fitting(parameter, value)
        rate(system.with_parameters(**{name: value}))  # Raises where there is a division by 0.
    return low, high


def sub_step(
    system: ControlAffineSDE, h: float
) -> tuple[tuple[sp.Symbol, ...], tuple[sp.Expr, ...]]:
    """Derive the state after one sub-step, as `Integrator` computes it.

    Args:
        system: the dynamics.
        h: length of the sub-step, in s.

    Returns:
        Symbols of the standard normals that it takes, one for each channel that is not zero, and
        the state after it as expressions of states, inputs and normals.
    """
    if system.noisy:
        draws, moved = euler_maruyama_step(system, h)
        return draws, tuple(map(tidied, moved))
    x, f = list(system.states), list(rate(system))
    half, whole, sixth = (sp.Float(value, 17) for value in (0.5 * h, h, h / 6.0))

    def rate_at(length: sp.Float, slope: Iterable[Any]) -> list[Any]:
        at = {s: s + length * k for s, k in zip(x, slope, strict=True)}
        return [e.xreplace(at) for e in f]

    k1 = f
    k2 = rate_at(half, k1)
    k3 = rate_at(half, k2)
    k4 = rate_at(whole, k3)
    return (), tuple(
        tidied(s + sixth * (b1 + 2 * (b2 + b3) + b4))
        for s, b1, b2, b3, b4 in zip(x, k1, k2, k3, k4, strict=True)
    )


def tidied(expression: Any) -> Any:
    """Return an expression with fewer occurrences of its symbols, if that is easily done.

    The fewer times a symbol occurs, the narrower is what interval arithmetic makes of it. Large
    expressions stay as they are.
    """
    parts = list(itertools.islice(sp.preorder_traversal(expression), _LARGEST))
    if len(parts) == _LARGEST or any(map(_has_many_terms, parts)):
        return expression
    expanded = sp.expand(expression, trig=False, power_base=False, power_exp=False, log=False)
    best: Any = min(expression, expanded, _with_mean_angles(expanded), key=occurrences)
    for symbol in sorted(best.free_symbols, key=sp.default_sort_key):
        best = min(best, _collected(best, symbol), key=occurrences)
    return best


def _has_many_terms(part: Any) -> bool:
    """Return whether a power of a sum, multiplied out, has more terms than a large expression."""
    if not (isinstance(part, sp.Pow) and part.base.is_Add and part.exp.is_Integer):
        return False
    n = int(part.exp)
    return n > 1 and math.comb(len(part.base.args) + n - 1, n) > _MOST_TERMS


def occurrences(expression: Any) -> int:
    """Return how many times symbols occur in an expression."""
    if not expression.args:
        return int(expression.is_Symbol)
    if isinstance(expression, sp.Pow) and expression.exp.is_number:
        return occurrences(expression.base)
    return sum(occurrences(part) for part in expression.args)


def _collected(expression: Any, symbol: sp.Symbol) -> Any:
    """Take a symbol out of the terms of a sum that are linear in it."""
    terms: Sequence[Any] = sp.Add.make_args(expression)
    linear: dict[Any, Any] = {t: t.coeff(symbol, 1) for t in terms}
    factors = [c for t, c in linear.items() if c != 0 and not c.has(symbol) and t == c * symbol]
    if len(factors) < 2:
        return expression
    rest = [t for t, c in linear.items() if not (c != 0 and not c.has(symbol) and t == c * symbol)]
    return sp.Add(*rest, sp.Mul(symbol, sp.Add(*factors)))


def _with_mean_angles(expression: Any) -> Any:
    """Write the sum of two cosines as twice the cosine of the mean times that of half the gap."""
    # The rates that a step of Runge and Kutta takes of a heading are at its start, middle and end:
    # so the heading occurs once.
    turns: dict[Any, list[Any]] = {}
    rest: list[Any] = []
    for term in sp.Add.make_args(expression):
        found = [f for f in sp.Mul.make_args(term) if isinstance(f, sp.sin | sp.cos)]
        if len(found) == 1:
            number, factor = (term / found[0]).as_independent(*term.free_symbols)
            turns.setdefault((found[0].func, number, factor), []).append(found[0].args[0])
        else:
            rest.append(term)
    sums: dict[Any, list[Any]] = {}
    for (function, number, factor), angles in turns.items():
        while len(angles) > 1:
            a, b = angles.pop(), angles.pop()
            mean, half = sp.expand((a + b) / 2), sp.expand((a - b) / 2)
            sums.setdefault((function(mean), factor), []).append(2 * number * sp.cos(half))
        for angle in angles:
            sums.setdefault((function(angle), factor), []).append(number)
    return sp.Add(*rest, *(turn * factor * sp.Add(*s) for (turn, factor), s in sums.items()))


@dataclass(frozen=True)
class Coordinate:
    """An axis of the grid.

    Attributes:
        symbol: of the coordinate in the expressions of a `ReducedProblem`.
        low: end of its range.
        high: other end.
        period: after which everything repeats, 0 if nothing does.
        expression: the coordinate, of the states.
    """

    symbol: sp.Symbol
    low: float
    high: float
    period: float
    expression: sp.Expr


@dataclass(frozen=True)
class Chain:
    """A problem in coordinates; all expressions are of these and of states that are known.

    Attributes:
        coordinates: the axes.
        step: each coordinate one sub-step later.
        barriers: what is safe.
        goal: reached where it is >= 0; None without one.
        outside: positive where the workspace is left.
        regions: that matter, by name, >= 0 inside.
    """

    coordinates: tuple[Coordinate, ...]
    step: tuple[sp.Expr, ...]
    barriers: tuple[sp.Expr, ...]
    goal: sp.Expr | None
    outside: sp.Expr
    regions: Mapping[str, sp.Expr]

    @property
    def expressions(self) -> tuple[sp.Expr, ...]:
        """All of them, those of the step first."""
        goal = () if self.goal is None else (self.goal,)
        return (*self.step, *self.barriers, *goal, self.outside, *self.regions.values())

    def with_numbers(self, numbers: Mapping[sp.Symbol, sp.Expr]) -> Chain:
        """Return the chain with numbers in place of states that never change."""

        def put(e: Any) -> Any:
            return sp.sympify(e).xreplace(dict(numbers))

        return Chain(
            self.coordinates,
            tuple(map(put, self.step)),
            tuple(map(put, self.barriers)),
            None if self.goal is None else put(self.goal),
            put(self.outside),
            {name: put(e) for name, e in self.regions.items()},
        )

    def with_periods(self) -> Chain:
        """Return the chain with the period 2 pi for coordinates without bounds that have it.

        Raises:
            ConfigurationError: A coordinate has neither bounds nor that period.
        """
        return replace(
            self, coordinates=tuple(map(self._with_period, range(len(self.coordinates))))
        )

    def _with_period(self, i: int) -> Coordinate:
        c = self.coordinates[i]
        if math.isfinite(c.low) and math.isfinite(c.high):
            return c
        shift = {c.symbol: c.symbol + 2 * sp.pi}
        if not all(
            is_zero(e.xreplace(shift) - e - (2 * sp.pi if j == i else 0))
            for j, e in enumerate(self.expressions)
        ):
            raise ConfigurationError(
                f"{c.symbol} lacks finite bounds and does not repeat after 2 pi, so that no grid"
                " can cover it; give the state a workspace"
            )
        return replace(c, low=-math.pi, high=math.pi, period=2 * math.pi)


@dataclass(frozen=True)
class Derivation:
    """What the coordinates of a problem are derived from.

    Attributes:
        problem: the problem.
        system: plant or model, with its uncertain parameters as further states.
        uncertain: their intervals.
        noise: symbols of the normals of a sub-step.
        moved: the states after a sub-step.
        known: the states that are known in advance, which are no coordinates.
        regions: names of those that matter.
    """

    problem: SafetyProblem
    system: ControlAffineSDE
    uncertain: Intervals
    noise: tuple[sp.Symbol, ...]
    moved: tuple[sp.Expr, ...]
    known: frozenset[sp.Symbol]
    regions: tuple[str, ...] = ()

    @property
    def following(self) -> dict[sp.Symbol, sp.Expr]:
        """Each state after a sub-step, by its symbol."""
        return dict(zip(self.system.states, self.moved, strict=True))

    def coordinates(self, states: Iterable[sp.Symbol]) -> tuple[Coordinate, ...]:
        """Return those of some states that are not known in advance, as coordinates."""
        return tuple(
            Coordinate(v.symbol, v.low, v.high, 0.0, v.symbol)
            for v in self.problem.states
            if v.symbol in states and v.symbol not in self.known
        )

    def in_states(self) -> Chain:
        """Return the problem in its states."""
        problem, following = self.problem, self.following
        free = self.coordinates(problem.plant.states)
        return Chain(
            free,
            tuple(following[c.symbol] for c in free),
            tuple(b.expression for b in problem.barriers),
            problem.goal,
            problem.outside,
            self._regions,
        )

    def in_frame(self, frame: Frame) -> tuple[Chain | None, str]:
        """Return the problem in a frame, or None and the reason why that cannot be used."""
        problem = self.problem
        verdict = check_frame(frame, problem, self._world())
        if verdict.reason:
            return None, f"the frame of {problem.name} is not used: {verdict.reason}"
        states = problem.plant.states
        section: Any = dict(zip(states, frame.section, strict=True))
        following: Any = {s: e.xreplace(section) for s, e in self.following.items()}
        rest = self.coordinates(frame.unchanged(states))
        own = tuple(
            Coordinate(c.symbol, c.low, c.high, period, value)
            for c, period, value in zip(frame.coordinates, frame.periods, frame.values, strict=True)
        )
        stepped: Any = [c.expression.xreplace(following) for c in own]
        outside: Any = excess(verdict.bounds)
        return Chain(
            (*own, *rest),
            (*stepped, *(following[c.symbol] for c in rest)),
            tuple(tidied(b.expression.xreplace(section)) for b in problem.barriers),
            None if problem.goal is None else tidied(problem.goal.xreplace(section)),
            outside.xreplace(section),
            {name: tidied(e.xreplace(section)) for name, e in self._regions.items()},
        ), ""

    @property
    def _regions(self) -> dict[str, sp.Expr]:
        return {name: self.problem.regions[name] for name in self.regions}

    def _world(self) -> World:
        problem = self.problem
        return World(
            symbols=self.system.states,
            inputs=self.system.inputs,
            noise=self.noise,
            moved=self.moved,
            barriers=tuple(b.expression for b in problem.barriers),
            goal=problem.goal,
            regions=tuple(self._regions.values()),
            ranges=(*((v.low, v.high) for v in problem.states), *self.uncertain.values()),
        )


def known_states(problem: SafetyProblem, system: ControlAffineSDE) -> tuple[sp.Symbol, ...]:
    """Return the states that are known in advance.

    Neither inputs nor noise reach them, their drift depends on known states alone, and the start in
    use has one value for each.

    Args:
        problem: with the start in use.
        system: plant or model, whose further states, next to the problem's, are unknown.
    """
    rates = dict(zip(system.states, rate(system), strict=True))
    noise = system.numeric(system.diffusion)
    start = dict(zip(problem.plant.states, problem.starts[problem.start].state, strict=True))
    known = [
        s
        for i, s in enumerate(system.states)
        if s in start and not sp.sympify(start[s]).free_symbols and noise[i, :].is_zero_matrix
    ]
    while True:
        # Inputs and uncertain parameters are no states that could be known.
        fewer = [s for s in known if rates[s].free_symbols <= set(known)]
        if len(fewer) == len(known):
            return tuple(known)
        known = fewer


def known_values(
    problem: SafetyProblem, known: Sequence[sp.Symbol], following: Mapping[sp.Symbol, Any]
) -> tuple[Mapping[sp.Symbol, np.ndarray], Mapping[sp.Symbol, sp.Expr]]:
    """Return what known states are, as functions of time or as numbers.

    Args:
        problem: with the start in use.
        known: the states.
        following: each state after a sub-step.

    Returns:
        Values at each instant of a sub-step, shape (steps substeps + 1,), of the states that move
        and of `TIME`; and the value of each state that does not.

    Raises:
        ConfigurationError: A state has no finite value at some time.
    """
    start: Any = dict(zip(problem.plant.states, problem.starts[problem.start].state, strict=True))
    constant = {s: sp.Float(float(start[s]), 17) for s in known if following[s] == s}
    moving = tuple(s for s in known if s not in constant)
    count = problem.steps * problem.substeps
    times = np.arange(count + 1) / problem.substeps * problem.dt
    if not moving:
        return {TIME: times}, constant
    advance = compile_function(moving, [following[s].xreplace(constant) for s in moving], "floats")
    path = np.empty((count + 1, len(moving)))
    path[0] = [float(start[s]) for s in moving]
    for k in range(count):
        try:
            path[k + 1] = advance(*path[k].tolist())
        except (ArithmeticError, ValueError):
            path[k + 1] = np.nan
        if not np.isfinite(path[k + 1]).all():
            raise ConfigurationError(
                f"{', '.join(map(str, moving))} of {problem.name} have no finite value"
                f" {times[k + 1]:g} s after the start; shorten the horizon"
            )
    return {**dict(zip(moving, path.T.copy(), strict=True)), TIME: times}, constant


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
        box=problem.input_bounds,
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


_PARTS = {1: 8, 2: 4}
_FEW_PARTS = 2
"""Parts of the interval of each uncertain parameter, by the number of parameters."""


@dataclass(frozen=True)
class StepParts:
    """A step in parts: x' = rest + effect u + blur w.

    Attributes:
        rest: of each coordinate, with the boxed noise.
        effect: of each coordinate and input.
        blur: standard deviation along each coordinate of noise that is integrated exactly.
        boxed: normals that are divided into boxes.
        is_affine: whether `rest` does not hold the inputs.
    """

    rest: tuple[sp.Expr, ...]
    effect: tuple[tuple[sp.Expr, ...], ...]
    blur: tuple[float, ...]
    boxed: tuple[sp.Symbol, ...]
    is_affine: bool

    @property
    def expressions(self) -> list[sp.Expr]:
        """All expressions of the step."""
        return [*self.rest, *(entry for effects in self.effect for entry in effects)]


def step_parts(reduced: ReducedProblem) -> StepParts:
    """Return the step of a problem in parts."""
    rest = [sp.sympify(e) for e in reduced.step]
    blur, boxed = [0.0] * len(rest), []
    for w in reduced.noise:
        sizes = [sp.diff(e, w) for e in rest]
        touched = [i for i, size in enumerate(sizes) if size != 0]
        if len(touched) == 1 and sizes[touched[0]].is_number and not blur[touched[0]]:
            i = touched[0]
            blur[i] = abs(float(sizes[i]))
            rest[i] = rest[i].subs(w, 0)
        elif touched:
            boxed.append(w)
    inputs = reduced.inputs
    varying = {*inputs, *boxed}
    effect = [[sp.diff(e, u) for u in inputs] for e in rest]
    is_affine = not any(entry.free_symbols & varying for row in effect for entry in row)
    if is_affine:
        rest = [e.subs(dict.fromkeys(inputs, 0)) for e in rest]
    else:
        effect = [[sp.Integer(0)] * len(inputs) for _ in rest]
    return StepParts(tuple(rest), tuple(map(tuple, effect)), tuple(blur), tuple(boxed), is_affine)


def scenarios(
    intervals: Mapping[sp.Symbol, tuple[float, float]],
) -> list[tuple[tuple[float, float], ...]]:
    """Return boxes that cover uncertain parameters.

    Args:
        intervals: (low, high) of each parameter.
    """
    parts = _PARTS.get(len(intervals), _FEW_PARTS)
    cut = []
    for low, high in intervals.values():
        number = parts if high > low else 1
        ends = [low + (high - low) * i / number for i in range(number)] + [high]
        cut.append(list(itertools.pairwise(ends)))
    return list(itertools.product(*cut))
