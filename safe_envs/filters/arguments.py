"""What users give, to make a filter and at each call of it.

The system, barriers, conditions and goal; input bounds, values of signals, and the time.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import numbers_in, real_array
from safe_envs.dynamics.codegen import finite
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import declared_sign
from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    SystemDefinitionError,
    nearest,
    shown,
    unexpected_argument,
)
from safe_envs.filters.conditions.base import AffineConstraint, Condition, Pairs
from safe_envs.filters.conditions.estimates import belief_places
from safe_envs.filters.conditions.text import Conditions, conditions_for, parse_for_system
from safe_envs.filters.decisions import Bounds
from safe_envs.filters.qp import FilterQP
from safe_envs.problem.builder import named_barriers
from safe_envs.problem.clf import CLF
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.text import finite_number

_FORMS = (
    "give a Condition, one for each barrier, or their text, such as 'szcbf', 'hocbf:alpha=2,8' or"
    " 'hocbf+scbf'"
)


def require_system(given: Any) -> ControlAffineSDE:
    """Return a system.

    Args:
        given: as users give it.

    Raises:
        SystemDefinitionError: It is none.
    """
    if isinstance(given, ControlAffineSDE):
        return given
    kind = given.__name__ if inspect.isclass(given) else type(given).__name__
    advice = (
        "take SafetyFilter.for_problem(problem, filters) for a problem"
        if isinstance(given, SafetyProblem)
        else "give a ControlAffineSDE, or take SafetyFilter.for_problem for the problem of an env"
    )
    raise SystemDefinitionError(f"system is {kind}; {advice}")


def require_problem(given: Any) -> SafetyProblem:
    """Return a problem.

    Args:
        given: as users give it.

    Raises:
        SystemDefinitionError: It is none.
    """
    if isinstance(given, SafetyProblem):
        return given
    raise SystemDefinitionError(
        f"problem is {type(given).__name__}; give a SafetyProblem, such as"
        " safe_envs.registry.make_problem('safe_envs/Pendulum-v0'), or take SafetyFilter(system,"
        " barriers, filters, input_bounds) for a system"
    )


def require_word(name: str, given: Any, allowed: Sequence[str]) -> None:
    """Raise ConfigurationError unless an argument is one of a few words.

    Args:
        name: of the argument.
        given: as users give it.
        allowed: words.
    """
    if not isinstance(given, str) or given not in allowed:
        raise ConfigurationError(f"{name} = {shown(given)}; {nearest(str(given), allowed)}")


def with_adjustable(system: ControlAffineSDE, adjustable: Any) -> ControlAffineSDE:
    """Return a system with some of its parameters as signals that do not change by themselves.

    Args:
        system: as users give it.
        adjustable: names or symbols of parameters, several or a single one.

    Raises:
        ConfigurationError: One is no parameter, or more than the sign of its symbol is declared.
    """
    several = isinstance(adjustable, list | tuple | set | frozenset)
    by_name = {p.name: p for p in system.parameters}
    chosen: dict[sp.Symbol, int] = {}
    for given in adjustable if several else [adjustable]:
        name = given.name if isinstance(given, sp.Symbol) else given
        symbol = by_name.get(name) if isinstance(name, str) else None
        if symbol is None:
            raise ConfigurationError(
                f"adjustable names {shown(given)}, which is no parameter of the system;"
                f" {nearest(str(name), by_name)}"
            )
        if declared_sign(symbol) is None:
            raise ConfigurationError(
                f"the parameter {name} cannot be adjustable: more is declared of its symbol than"
                f" a sign; make it by sympy.symbols({name!r}, real=True)"
            )
        chosen[symbol] = 0
    if not chosen:
        return system
    fixed = {p: value for p, value in system.parameters.items() if p not in chosen}
    return replace(system, parameters=fixed, signals={**system.signals, **chosen})


def read_pairs(system: ControlAffineSDE, barriers: Any, conditions: Any) -> Pairs:
    """Return each barrier with its condition.

    Args:
        system: whose symbols the barriers hold.
        barriers: a `Barrier` or an expression, several of them, or (barrier, condition) pairs.
        conditions: a condition for all barriers, one for each, or their text; None with pairs, and
            for "szcbf" with noise and "hocbf" without.

    Raises:
        SystemDefinitionError: There is no barrier, or one is none of the system.
        ConfigurationError: A condition is none, or their number is wrong.
        RelativeDegreeError: No input reaches a barrier whose condition needs default rates.
    """
    alone = _is_pair(barriers) or not isinstance(barriers, list | tuple)
    entries: list[Any] = [barriers] if alone else list(barriers)
    if any(map(_is_pair, entries)):
        if conditions is not None or not all(map(_is_pair, entries)):
            numeric = numbers_in(conditions).size and conditions is not None
            raise ConfigurationError(
                f"barriers holds (barrier, condition) pairs, and filters = {shown(conditions)};"
                f" {'bounds go by name, input_bounds=...; ' if numeric else ''}give pairs alone, or"
                " barriers alone and their conditions"
            )
        entries, conditions = [list(part) for part in zip(*entries, strict=True)]
    named = named_barriers(entries)
    for barrier in named:
        used: set[Any] = barrier.expression.free_symbols
        fixed = ", ".join(sorted(p.name for p in used & set(system.parameters)))
        if fixed:
            raise SystemDefinitionError(
                f"barrier {barrier.name} holds the parameter {fixed}, which a filter takes as a"
                f" number; write its value, or name it in adjustable=({fixed!r},)"
            )
        system.require_known(f"barrier {barrier.name}", used, system.measured)
    return tuple(zip(named, _read_conditions(system, named, conditions), strict=True))


def _is_pair(given: Any) -> bool:
    return (
        isinstance(given, list | tuple)
        and len(given) == 2
        and not isinstance(given[0], Condition | str)
        and isinstance(given[1], Condition | str)
    )


def _read_conditions(
    system: ControlAffineSDE, barriers: Sequence[Barrier], given: Any
) -> tuple[Condition, ...]:
    if given is None:
        given = "szcbf" if system.noisy else "hocbf"
    if isinstance(given, str):
        return parse_for_system(given, system, barriers)
    if isinstance(given, Condition):
        return (given,) * len(barriers)
    if not isinstance(given, list | tuple):
        raise _no_condition(given)
    for entry in given:
        if not isinstance(entry, Condition | str):
            raise _no_condition(given)
    if len(given) != len(barriers):
        raise ConfigurationError(
            f"{len(given)} conditions for {len(barriers)} barriers; give one for each, or one for"
            " all"
        )
    return tuple(
        parse_for_system(entry, system, [barrier])[0] if isinstance(entry, str) else entry
        for entry, barrier in zip(given, barriers, strict=True)
    )


def _no_condition(given: Any) -> ConfigurationError:
    if inspect.isclass(given) and issubclass(given, Condition):
        advice = f"make one of the class, {given.__name__}(...)"
    elif numbers_in(given).size:
        advice = f"input bounds are the next argument, input_bounds=...; {_FORMS}"
    else:
        advice = _FORMS
    return ConfigurationError(f"filters = {shown(given)}; {advice}")


def refuse_unknown(given: Iterable[str], known: Callable[..., Any]) -> None:
    """Raise UnknownArgumentError for arguments that something does not have.

    Args:
        given: their names.
        known: what has other arguments.
    """
    for name in given:
        allowed = list(inspect.signature(known).parameters)[1:-1]
        raise unexpected_argument("SafetyFilter", name, nearest(name, allowed))


def require_goal(clf: Any, weights: Any) -> None:
    """Raise ConfigurationError for a goal that is none, or has weights besides its own.

    Args:
        clf: as users give it; None for no goal.
        weights: as users give them.
    """
    if clf is None:
        return
    if not isinstance(clf, CLF):
        raise ConfigurationError(f"clf = {shown(clf)}; give a CLF(V), or None")
    if weights is not None:
        raise ConfigurationError(
            "weights and clf were given; the weights of a joint QP are those of the clf"
        )


def runtime_symbols(
    model: ControlAffineSDE, pairs: Pairs, constraints: Iterable[AffineConstraint], clf: CLF | None
) -> tuple[sp.Symbol, ...]:
    """Return what a decision needs besides the state: the signals, and the time if it occurs.

    Args:
        model: whose signals they are.
        pairs: barriers, which are evaluated, with their conditions.
        constraints: of the QP.
        clf: its goal, if there is one.
    """
    expressions = [barrier.expression for barrier, _ in pairs]
    for c in (each for given in constraints for each in (given, *given.alternatives)):
        expressions += [*c.coefficient, c.offset, *c.chain, *c.domain, *(c.uncertainty or ())]
        expressions += [e for e in (c.demand, c.change) if e is not None]
    if clf is not None:
        growth, along = clf.growth(model)
        expressions += [clf.V, growth, *along]
    timed = any(TIME in e.free_symbols for e in expressions)
    return (*model.signals, *([TIME] if timed else []))


WIDEST = 1e100
"""Largest bound of an input: its square, an effort, is still a number. It stands for infinite
ones."""


def read_bounds(
    inputs: Sequence[sp.Symbol], given: Any, endless: bool
) -> tuple[list[float], list[float]]:
    """Return the lower and the upper bounds of m inputs.

    Args:
        inputs: m symbols.
        given: (low, high) for all inputs, or one such pair for each.
        endless: whether ends may be infinite, for which `WIDEST` stands.

    Raises:
        ConfigurationError: They are neither, or no intervals.
    """
    pairs = np.empty(0) if given is None else numbers_in(given)
    if pairs.shape == (2,):
        pairs = np.broadcast_to(pairs, (len(inputs), 2))
    if pairs.shape != (len(inputs), 2):
        raise ConfigurationError(
            f"input_bounds = {shown(given)}; give (low, high) of the input in physical units, for"
            f" all inputs or for each of the {len(inputs)}"
            f"{'; an end may be infinite' if endless else ''}"
        )
    table: Any = pairs.tolist()
    for symbol, (low, high) in zip(inputs, table, strict=True):
        if not low < high:
            raise ConfigurationError(
                f"input_bounds of {symbol} are [{low}, {high}]; the lower one has to be below the"
                " upper"
            )
        require_ends(symbol, low, high, endless)
    low, high = np.clip(pairs, -WIDEST, WIDEST).T
    return low.tolist(), high.tolist()


def require_ends(symbol: sp.Symbol, low: float, high: float, endless: bool) -> None:
    """Raise ConfigurationError where an input's bound is infinite and may not be, or too wide.

    Args:
        symbol: of the input.
        low: its lower bound, a number.
        high: its upper bound, a number.
        endless: whether ends may be infinite.
    """
    if not endless and (math.isinf(low) or math.isinf(high)):
        raise ConfigurationError(
            f"input_bounds of {symbol} are [{low}, {high}]; a filter with a goal, a reciprocal"
            " condition, a certificate or an uncertain constraint needs finite ones, which it may"
            " reach"
        )
    if low == math.inf or high == -math.inf or any(WIDEST < abs(b) < math.inf for b in (low, high)):
        raise ConfigurationError(
            f"input_bounds of {symbol} are [{low}, {high}]; finite ones are within {WIDEST:g}, and"
            " -math.inf and math.inf stand for none"
        )


def positive_weights(name: str, given: Any, count: int) -> list[float]:
    """Return weights as floats.

    Args:
        name: of the argument, for errors.
        given: as users give them; None for ones.
        count: how many there are to be.

    Raises:
        ConfigurationError: Their number is wrong, or one is not positive and finite.
    """
    values = np.ones(count) if given is None else numbers_in(given)
    if values.shape != (count,) or not (np.isfinite(values) & (values > 0.0)).all():
        raise ConfigurationError(f"{name} = {shown(given)}; give {count} positive numbers")
    return values.tolist()


def control_period(constraints: Sequence[AffineConstraint], dt: Any) -> float:
    """Return the control period in s, 0 where none is given.

    Args:
        constraints: those of the filter, some of which may need it.
        dt: as users give it.

    Raises:
        ConfigurationError: It is not positive and finite, or missing.
    """
    if dt is None:
        if any(constraint.change is not None for constraint in constraints):
            raise ConfigurationError(
                "a sampling margin of first order needs the control period: SafetyFilter(...,"
                " dt=...)"
            )
        return 0.0
    period = finite_number("dt", dt)
    if period <= 0.0:
        raise ConfigurationError(f"dt = {dt} s; a control period is positive and finite")
    return period


def takes_endless(constraints: Iterable[AffineConstraint], clf: CLF | None) -> bool:
    """Return whether a QP has a bounded answer without input bounds.

    That is so where the answer is the input nearest to the proposed one. A goal, and reciprocal
    conditions outside their domain, go as far as the bounds let them; and a plane above an
    uncertainty needs their corners.

    Args:
        constraints: of the QP.
        clf: its goal, if there is one.
    """
    return clf is None and all(c.demand is None and c.uncertainty is None for c in constraints)


def known_for_problem(
    problem: SafetyProblem, conditions: Conditions, knowledge: str, objective: str
) -> tuple[ControlAffineSDE, tuple[Condition, ...], CLF | None]:
    """Return the system that a filter knows, its conditions, and its goal if it has one.

    Args:
        problem: that the filter is for.
        conditions: see `SafetyFilter.for_problem`, as for the others.
        knowledge: "model" or "plant".
        objective: "nearest" or "clf".

    Raises:
        SystemDefinitionError: See `SafetyFilter.for_problem`.
        ConfigurationError: See there.
    """
    require_problem(problem)
    require_word("knowledge", knowledge, ("model", "plant"))
    require_word("objective", objective, ("nearest", "clf"))
    if objective == "clf" and problem.clf is None:
        raise ConfigurationError(
            f"objective = 'clf', but {problem.name} has no control Lyapunov function; use 'nearest'"
        )
    each = conditions_for(problem, conditions)
    correcting = [condition.name for condition in each if condition.corrects_model]
    if knowledge == "plant" and 0 < len(correcting) < len(each):
        raise ConfigurationError(
            f"{correcting[0]} corrects the model, and the other barriers' conditions know the"
            " plant; use knowledge='model'"
        )
    known = problem.model if knowledge == "model" or correcting else problem.plant
    return known, each, problem.clf if objective == "clf" else None


_SIGNS: dict[str, Callable[[Any], Any]] = {
    "positive": lambda value: value > 0.0,
    "nonnegative": lambda value: value >= 0.0,
    "negative": lambda value: value < 0.0,
    "nonpositive": lambda value: value <= 0.0,
    "nonzero": lambda value: value != 0.0,
}


_DOUBLE = np.dtype(np.float64)


def doubles(what: str, given: Any) -> np.ndarray:
    """Return states or inputs as an array of doubles.

    Args:
        what: name of the argument, for errors.
        given: as users give it.

    Raises:
        InvalidInputError: It is no array of real numbers.
    """
    return (
        given
        if type(given) is np.ndarray and given.dtype is _DOUBLE
        else real_array(what, given).astype(np.float64)
    )


def require_finite(x: np.ndarray, u: np.ndarray) -> None:
    """Raise InvalidInputError where a state or an input has an entry that is not finite.

    Args:
        x: states, any shape.
        u: proposed inputs, any shape.
    """
    for what, values in (("state", x), ("nominal input", u)):
        if not (finite(values) or np.isfinite(values).all()):
            where = np.argwhere(~np.isfinite(values))[0].tolist()
            raise InvalidInputError(
                f"the {what} has the entry {values[tuple(where)]} at {where}; a filter needs finite"
                " numbers"
            )


class RuntimeArguments:
    """Reads input bounds and values for one state, as floats, and for a batch, as arrays.

    Args:
        qp: whose inputs and runtime symbols they are.
        defaults: values of the adjustable parameters where none are given.
        fixed: names of parameters that are not adjustable, for errors.
        endless: whether input bounds may be infinite.
    """

    def __init__(
        self,
        qp: FilterQP,
        defaults: Mapping[sp.Symbol, float],
        fixed: Sequence[str],
        endless: bool,
    ) -> None:
        self._inputs, self._symbols, self._n = qp.model.inputs, qp.runtime, qp.model.n
        self._fixed, self._endless = fixed, endless
        self._named = [s for s in qp.runtime if s != TIME]
        self._place: dict[Any, int] = {s.name: i for i, s in enumerate(self._named)}
        self._start: list[Any] = [defaults.get(s) for s in self._named]
        self._timed = TIME in qp.runtime
        signs = [declared_sign(s) for s in qp.runtime]
        self._signs = {i: word for i, word in enumerate(signs) if word in _SIGNS}

    def values(self, parameters: Any, t: Any, batch: tuple[int, ...] | None = None) -> list[Any]:
        """Return the values of the runtime symbols.

        Args:
            parameters: value of each signal and adjustable parameter, by name or symbol.
            t: time in s; not looked at where nothing depends on it.
            batch: leading axes of the states; None for one state.

        Returns:
            Floats for one state, arrays (B,) for a batch.

        Raises:
            ConfigurationError: A name is unknown, comes twice or is missing.
            InvalidInputError: A value is no finite number, or not of the declared sign.
        """
        found = self._start.copy()
        if parameters is not None:
            self._read(parameters, found, batch)
        if None in found if batch is None else any(value is None for value in found):
            raise self._missing(found)
        if self._timed:
            if t is None:
                raise ConfigurationError(
                    "the time is missing, on which a barrier or the system depends; give t=... in s"
                    " at each call"
                )
            found.append(_number("time t", t, batch))
        if batch is not None:
            size = math.prod(batch)
            found = [np.full(size, value) if np.ndim(value) == 0 else value for value in found]
        for i, word in self._signs.items():
            met = _SIGNS[word](found[i])
            if not (met if batch is None else met.all()):
                raise InvalidInputError(
                    f"{self._symbols[i]} = {shown(found[i])}; its symbol is declared {word}, and"
                    " sympy simplifies by that"
                )
        return found

    def _read(self, parameters: Any, found: list[Any], batch: tuple[int, ...] | None) -> None:
        if not isinstance(parameters, Mapping):
            raise ConfigurationError(
                f"parameters = {shown(parameters)}; give a dict of values by name, such as"
                " {'mass': 1.2}"
            )
        seen = 0
        for key, value in parameters.items():
            place = self._place.get(key.name if isinstance(key, sp.Symbol) else key)
            if place is None:
                raise self._unknown(key)
            if seen & (1 << place):
                raise ConfigurationError(f"parameters gives {self._named[place]} twice")
            seen |= 1 << place
            found[place] = _number(f"value of {self._named[place]}", value, batch)

    def _unknown(self, key: Any) -> ConfigurationError:
        name = key.name if isinstance(key, sp.Symbol) else key
        if name in self._fixed:
            advice = (
                f"it is a parameter of the system; make the filter with adjustable=({name!r},) to"
                " give its value at each call"
            )
        elif name in (TIME, TIME.name):
            advice = "the time is an argument of its own, t=..."
        else:
            advice = nearest(str(name), [s.name for s in self._named])
        return ConfigurationError(f"parameters gives {shown(name)}; {advice}")

    def _missing(self, found: Sequence[Any]) -> ConfigurationError:
        missing = [s for s, v in zip(self._named, found, strict=True) if v is None]
        if belief_places(missing, self._n):
            return ConfigurationError(
                "the conditions with belief have no belief: decide by filter_measurement(y, u) of a"
                " filter that is made with estimator=..., or leave belief out"
            )
        names = [s.name for s in missing]
        given = ", ".join(f"{name!r}: ..." for name in names)
        return ConfigurationError(
            f"the signals {', '.join(names)} have no value; give parameters={{{given}}} at each"
            " call"
        )

    def bounds(self, given: Any, batch: tuple[int, ...] = ()) -> Bounds:
        """Return the lower and the upper input bounds.

        Args:
            given: (low, high) for all inputs, one such pair for each, (m, 2), or for each input of
                each state, (..., m, 2). An input whose two bounds are equal is held there.
            batch: leading axes of the states, none for one state.

        Returns:
            m floats each, or m arrays (B,) where bounds differ between states.

        Raises:
            InvalidInputError: The shape does not fit, or a bound is NaN or not in order.
            ConfigurationError: A bound is infinite, and the filter needs finite ones.
        """
        m = len(self._inputs)
        if type(given) is tuple and len(given) == 2 and _is_interval(*given):
            return [float(given[0])] * m, [float(given[1])] * m
        pairs = real_array("pair of bounds", given).astype(np.float64, copy=False)
        if pairs.shape == (2,):
            pairs = np.broadcast_to(pairs, (m, 2))
        if pairs.shape[-2:] != (m, 2) or pairs.shape[:-2] not in ((), batch):
            per_state = f", or {(*batch, m, 2)} for each state" if batch else ""
            raise InvalidInputError(
                f"input_bounds has the shape {np.shape(given)}; give (low, high) for all inputs, or"
                f" such a pair for each, ({m}, 2){per_state}"
            )
        low, high = pairs[..., 0], pairs[..., 1]
        if not (low <= high).all() or not (abs(pairs) <= WIDEST).all():
            self._require_intervals(pairs)
            low, high = np.clip(low, -WIDEST, WIDEST), np.clip(high, -WIDEST, WIDEST)
        if pairs.ndim == 2:
            return low.tolist(), high.tolist()
        low, high = [np.ascontiguousarray(end.reshape(-1, m).T) for end in (low, high)]
        return list(low), list(high)

    def _require_intervals(self, pairs: np.ndarray) -> None:
        for symbol, ends in zip(self._inputs, np.moveaxis(pairs, -2, 0), strict=True):
            for low, high in ends.reshape(-1, 2).tolist():
                if not low <= high:
                    raise InvalidInputError(
                        f"input_bounds of {symbol} are [{low}, {high}]; give numbers, the lower one"
                        " first"
                    )
                require_ends(symbol, low, high, self._endless)


def _is_interval(low: Any, high: Any) -> bool:
    """Return whether two Python numbers are the ends of a finite interval, which is the rule."""
    numbers = type(low) in (float, int) and type(high) in (float, int)
    return numbers and -WIDEST <= low <= high <= WIDEST


def _number(what: str, given: Any, batch: tuple[int, ...] | None) -> Any:
    """Return a finite number as a float, or several of a batch as an array (B,)."""
    if isinstance(given, float) and math.isfinite(given):
        return float(given)
    found = real_array(what, given)
    if found.shape not in ((), batch):
        each = f", or an array {batch}, one for each state" if batch else ""
        raise InvalidInputError(f"the {what} has the shape {found.shape}; give a number{each}")
    if not np.isfinite(found).all():
        raise InvalidInputError(f"the {what} is {shown(given)}; give finite numbers")
    return float(found) if found.ndim == 0 else found.astype(np.float64).reshape(-1)
