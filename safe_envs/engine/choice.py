"""The choice between NumPy and compiled programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from safe_envs.engine.program import is_available
from safe_envs.errors import ConfigurationError, NotCompilableError, nearest, shown

ENGINES = ("auto", "numpy", "compiled")
"""Engines by name; "auto" takes the compiled one for long work that it can do, if it is there."""

LONG = 5_000_000
"""Control periods from which "auto" takes the compiled engine: NumPy needs seconds for them, which
a compilation takes as well. The choice depends on nothing else that changes from run to run, so
that a command gives the same numbers each time."""

_PART = 1_000_000
_FEW_NUMBERS = 100
"""Control periods that take some tenths of a second, if a program has few numbers."""

_Found = TypeVar("_Found")


def require_engine(engine: str) -> None:
    """Raise ConfigurationError unless a word is one of `ENGINES`."""
    if engine not in ENGINES:
        raise ConfigurationError(f"engine = {shown(engine)}; {nearest(str(engine), ENGINES)}")


def compiled_or_none(engine: str, periods: float, make: Callable[[], _Found]) -> _Found | None:
    """Return what `make` makes for the compiled engine; None where NumPy is to do the work.

    Args:
        engine: one of `ENGINES`.
        periods: control periods to simulate, about.
        make: makes something of compiled programs, or raises `NotCompilableError`.

    Raises:
        ConfigurationError: The compiled engine was asked for, and Numba is missing.
        NotCompilableError: It was asked for, and cannot do the work.
    """
    if engine == "numpy" or (engine == "auto" and not (periods >= LONG and is_available())):
        return None
    try:
        return make()
    except NotCompilableError as error:
        if engine == "compiled":
            raise NotCompilableError(
                f"engine = 'compiled': {error}; use 'numpy', or 'auto'"
            ) from error
        return None


def engine_for(engine: str, periods: float) -> str:
    """Return "numpy" in place of "auto" for short work, and any other word as it is.

    Args:
        engine: one of `ENGINES`.
        periods: control periods to simulate, about.
    """
    return "numpy" if engine == "auto" and periods < LONG else engine


def periods_of_a_part(numbers: int) -> int:
    """Return control periods to simulate by one call, which nothing can interrupt.

    They take less than a second, about: a program reads most of its numbers, such as the weights of
    a network, in each period. It is no measured time, so that the parts are the same each time.

    Args:
        numbers: of the program.
    """
    return max(1, _PART * _FEW_NUMBERS // max(numbers, _FEW_NUMBERS))
