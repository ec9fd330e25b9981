"""Errors of this project: each says what was given, what is allowed and what to do."""

from __future__ import annotations

import copy
import difflib
import numbers
from collections.abc import Iterable
from typing import Any, Self


class SafeEnvsError(Exception):
    """Base of every error that this project raises on purpose."""


class SystemDefinitionError(SafeEnvsError, ValueError):
    """A system, barrier or problem contradicts itself."""


class SystemDefinitionWarning(UserWarning):
    """A system, barrier or problem may not be what its author means."""


class RelativeDegreeError(SystemDefinitionError):
    """The input does not appear in the derivatives of a barrier where a condition needs it."""


class ConfigurationError(SafeEnvsError, ValueError):
    """An argument names something unknown or has a value outside its range."""


class UnknownArgumentError(ConfigurationError, TypeError):
    """A keyword argument is unknown.

    It is a TypeError in Python's words too: libraries that try arguments on any env, as TorchRL
    does with `frameskip`, leave out those that are refused so.
    """


class NotCompilableError(ConfigurationError):
    """Something is asked of the compiled engine that only the NumPy engine can do."""


class InvalidInputError(SafeEnvsError, ValueError):
    """A state or an action has the wrong shape or is not finite."""


class NumericalError(SafeEnvsError, ArithmeticError):
    """A formula has no finite value at a state."""


class WorkersLostError(SafeEnvsError, RuntimeError):
    """Processes end before they have computed what they were given."""


def shown(given: Any) -> str:
    """Return a value as a message shows it: texts in quotes, long ones without their middle."""
    try:
        return shortened(repr(given))
    except ValueError:  # Python writes no whole number of more than 4300 digits.
        return f"a {type(given).__name__} with too many digits"


def shortened(given: Any, most: int = 120) -> str:
    """Return a value as text, without its middle if it is longer than about `most` characters.

    Args:
        given: a text, a path or an error.
        most: characters.
    """
    text = str(given)
    if len(text) <= most:
        return text
    half = most // 2
    return f"{text[:half]}...({len(text) - 2 * half} more characters)...{text[-half:]}"


def unknown(what: str, name: Any, allowed: Iterable[str]) -> ConfigurationError:
    """Return the error of a name that nobody knows.

    Args:
        what: is named.
        name: what was given.
        allowed: names.
    """
    return ConfigurationError(f"unknown {what} {shown(name)}; {nearest(str(name), allowed)}")


def unexpected_argument(owner: str, name: str, advice: str) -> UnknownArgumentError:
    """Return the error of a keyword argument that nobody knows.

    Args:
        owner: what does not have it.
        name: of the argument.
        advice: what helps, such as the nearest names.
    """
    complaint = f"{owner} got an unexpected keyword argument {shown(name)}"
    return UnknownArgumentError(f"{complaint}; {advice}")


def install_extra(extra: str) -> str:
    """Return how to install the packages of an extra; this package is on no index.

    Args:
        extra: of pyproject.toml.
    """
    return f'pip install --editable ".[{extra}]" in a checkout'


RENAMED = {
    "alphas": "alpha",
    "bounds": "input_bounds",
    "box": "input_bounds",
    "condition": "filter",
    "conditions": "filters",
    "p": "alpha",
    "state_problem": "define_problem",
}
"""Names of today for earlier ones of arguments, settings and functions, for advice in errors."""

HELD_CERTIFICATES = (
    "certificates of held input are gone; tables bound the env's own steps: `safe-envs evaluate"
    " ENV_ID --closed-loop`, or the filter promise:p=0.95"
)
"""What to use in place of a certificate of held input."""

GONE = {
    "--held": HELD_CERTIFICATES,
    "--arb": "it is gone; `safe-envs check FILE` proves every statement in its own arithmetic",
}
"""What serves in place of options that are gone, for advice in errors."""

_FEW = 6
"""So many allowed names are listed in full, of more of them the nearest three."""


def _as_argument(option: str) -> str:
    return option.removeprefix("--").replace("-", "_")


def nearest(name: str, allowed: Iterable[str], more: str = "") -> str:
    """Return a phrase that helps to find the allowed name that was meant.

    Args:
        name: what was given.
        allowed: names.
        more: what else may help, such as "or a number".

    Returns:
        The nearest name, and the others: all where they are few, else the next two.
    """
    if name in GONE:
        return GONE[name]
    names = list(allowed)
    now = RENAMED.get(name.removeprefix("--"))
    if new := next((each for each in names if _as_argument(each) == now), None):
        return f"it is {new} now"
    # Whoever writes a name in capitals means the name.
    lower = {each.lower(): each for each in reversed(names)}
    found = difflib.get_close_matches(shortened(name).lower(), lower, n=3, cutoff=0.4)
    close = [lower[each] for each in found]
    if len(names) > _FEW:
        if close:
            others = [f"or {', '.join(close[1:])}"] if close[1:] else []
        else:
            others = [f"allowed: {', '.join(names[:3])} and {len(names) - 3} more"]
    else:
        others = [f"allowed: {', '.join(names) if names else 'none'}"]
    rest = "; ".join([*others, more] if more else others)
    if not close:
        return rest
    return f"did you mean {close[0]!r}?{f' ({rest})' if rest else ''}"


def require_whole(name: str, value: Any, least: int) -> None:
    """Raise ConfigurationError unless a value is a whole number from `least`.

    NumPy's integers are whole numbers, truth values are not.

    Args:
        name: of the argument, for the error.
        value: what was given.
        least: smallest allowed number.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or int(value) < least:
        raise ConfigurationError(f"{name} = {shown(value)}; give a whole number from {least}")


def flag(name: str, value: Any) -> bool:
    """Return a value that is True or False.

    Args:
        name: of the argument, for the error.
        value: what was given.

    Raises:
        ConfigurationError: it is anything else, such as the text "false", which counts as true.
    """
    if not isinstance(value, bool):
        raise ConfigurationError(f"{name} = {shown(value)}; give True or False")
    return value


class IndependentCopies:
    """Base of what holds a state that changes: `copy.copy` of it is `copy.deepcopy`.

    A shallow copy in mid-episode would have the clock, the counters and the noise of its original.
    """

    def __copy__(self) -> Self:
        return copy.deepcopy(self)
