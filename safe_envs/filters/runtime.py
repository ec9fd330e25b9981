"""What a user gives at each call of a filter: input bounds, values of signals, the time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import real_array
from safe_envs.dynamics.codegen import finite
from safe_envs.dynamics.symbols import declared_sign
from safe_envs.errors import ConfigurationError, InvalidInputError, nearest, shown
from safe_envs.filters.arguments import WIDEST, require_ends
from safe_envs.filters.conditions.estimates import belief_places
from safe_envs.filters.qp import FilterQP
from safe_envs.filters.solver import Bounds
from safe_envs.problem.signals import TIME

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
                f"bounds has the shape {np.shape(given)}; give (low, high) for all inputs, or such"
                f" a pair for each, ({m}, 2){per_state}"
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
                        f"bounds of {symbol} are [{low}, {high}]; give numbers, the lower one first"
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
