"""What users give to make a filter: system, barriers, conditions and goal."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import sympy as sp

from safe_envs.dynamics.declarations import declared_sign
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import (
    ConfigurationError,
    SystemDefinitionError,
    nearest,
    shown,
    unexpected_argument,
)
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.builder import named_barriers
from safe_envs.problem.clf import CLF
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.validators import numbers_in
from safe_envs.wrappers.conditions import AffineConstraint, Condition
from safe_envs.wrappers.conditions.parts import Pairs
from safe_envs.wrappers.conditions.spec_text import parse_for_system

_FORMS = (
    "give a Condition, one for each barrier, or their text, such as 'szcbf', 'hocbf:p=2,8' or"
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
        "take SafetyFilter.for_problem(problem, conditions) for a problem"
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
        " barriers, conditions, bounds) for a system"
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
                f"barriers holds (barrier, condition) pairs, and conditions = {shown(conditions)};"
                f" {'input bounds go by name, bounds=...; ' if numeric else ''}give pairs alone, or"
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
        advice = f"input bounds are the next argument, bounds=...; {_FORMS}"
    else:
        advice = _FORMS
    return ConfigurationError(f"conditions = {shown(given)}; {advice}")


def refuse_unknown(given: Iterable[str], known: Callable[..., Any]) -> None:
    """Raise UnknownArgumentError for arguments that something does not have.

    Args:
        given: their names.
        known: what has other arguments.
    """
    for name in given:
        allowed = list(inspect.signature(known).parameters)[1:-1]
        advice = "input bounds are bounds=..." if name == "box" else nearest(name, allowed)
        raise unexpected_argument("SafetyFilter", name, advice)


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
