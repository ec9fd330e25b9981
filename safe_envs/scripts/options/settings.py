"""`--set NAME=VALUE`: settings of the methods of `safe-envs identify`, and hyperparameters."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.scripts.options.env_options import EnvOptions
from safe_envs.text import named_values, real

_NOT_SETTINGS = ("problem", "data", "seed", "step", "progress")
_OF_COLLECTING = ("starts", "steps", "points", "repetitions")
"""Settings that say which data are collected."""

SETTINGS = {
    "learned-hocbf": "states=3000, label_dt=0.001, hidden=100,30, epochs=500",
    "ddscbf": (
        "points=200, repetitions=50000, estimator=martingale (or centred, printed), way=network or"
        " direct (by default what suits)"
    ),
    "bayesian": (
        "starts=1000, steps=1, repetitions=100, degree=1 to 3 or more (by default by the number of"
        " rows), prior=10.0, diffusion_degree=0, alpha=1.0, beta=1.0, errors_in_variables=True (of"
        " a sensor)"
    ),
}
"""What `--set` takes for each method, for the help: importing the functions would take too long."""

SETTINGS_HELP = "\n\n".join(
    [
        "Setting of the method, repeatable; with the defaults:",
        *(f"{name}: {text}." for name, text in SETTINGS.items()),
    ]
)


def read_settings(method: str, learner: Callable[..., Any], texts: Sequence[str]) -> dict[str, Any]:
    """Read NAME=VALUE entries as keyword arguments of the function that learns by a method.

    Args:
        method: its name.
        learner: the function.
        texts: the entries.

    Returns:
        The values by name.

    Raises:
        ConfigurationError: the function has no such argument, or the value is not of its kind.
    """
    allowed = settings_of(learner)
    hints = typing.get_type_hints(learner)
    found = named_values("--set", texts, words=True)
    for name, value in found.items():
        if name not in allowed:
            given = shortened(f"{name}={value}")
            raise ConfigurationError(
                f"--set {given}: {method} has no setting {shown(name)}; {nearest(name, allowed)}"
            )
        found[name] = _of_kind(name, value, hints[name])
    return found


def settings_of(learner: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the settings of the function that learns by a method, by name."""
    return {
        name: found
        for name, found in inspect.signature(learner).parameters.items()
        if name not in _NOT_SETTINGS
    }


def refuse_collecting(settings: Mapping[str, Any], env: EnvOptions) -> None:
    """Check that nothing given only says how data are collected.

    Args:
        settings: of the method, by name.
        env: the options of the env.

    Raises:
        ConfigurationError: a setting or an option does.
    """
    idle = [f"--set {name}" for name in _OF_COLLECTING if name in settings]
    idle += [
        f"--{name.replace('_', '-')}"
        for name in ("dt", "substeps", "input_bounds")
        if name in env.changes
    ]
    if idle:
        raise ConfigurationError(
            f"{', '.join(idle)}: not allowed with --data, since nothing is collected then; leave"
            " it out"
        )


def _of_kind(name: str, value: float | str, hint: Any) -> Any:
    """Return a value as an argument of a type takes it: a word, whole numbers, or a number."""
    parts = (hint, *typing.get_args(hint))
    origins = {typing.get_origin(part) for part in parts}
    if typing.Literal in origins:
        return str(value)
    if Sequence in origins:
        try:
            return [_whole(real(entry)) for entry in str(value).split(",")]
        except ValueError as error:
            given = shortened(f"{name}={value}")
            raise ConfigurationError(
                f"--set {given}: give whole numbers with commas between, such as {name}=100,30"
            ) from error
    if hint is bool:
        words = {"true": True, "false": False}
        if str(value).lower() not in words:
            raise ConfigurationError(
                f"--set {shortened(name)}={shortened(value)}: give true or false"
            )
        return words[str(value).lower()]
    if isinstance(value, str):
        raise ConfigurationError(
            f"--set {shortened(name)}={shortened(value)}: {shown(value)} is not a number"
        )
    # A whole number may be written as 1e3; what is not whole, the method refuses.
    return int(value) if int in parts and float(value).is_integer() else value


def _whole(value: float) -> int:
    if not value.is_integer():
        raise ValueError(f"{value} is not whole")
    return int(value)


def read_hyperparameters(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of NAME=VALUE entries, which are YAML, by name.

    Raises:
        ConfigurationError: an entry has another form, or its value is no YAML.
    """
    import yaml

    from safe_envs.agents.sweeps.spec import value_of

    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigurationError(
                f"--set {shortened(text)}: give NAME=VALUE, such as learning_rate=0.001"
            )
        if not value.isascii():
            raise ConfigurationError(
                f"--set {shortened(text)} has characters beyond ASCII; write numbers with the"
                " digits 0 to 9"
            )
        try:
            found[name] = _number(value_of(value, "--set"))
        except yaml.YAMLError as error:
            problem = shortened(getattr(error, "problem", error))
            raise ConfigurationError(
                f"--set {shortened(text)} is no YAML that a setting may have: {problem}"
            ) from error
    return found


def _number(value: Any) -> Any:
    """Return a value, as a number also where YAML reads it as a text, such as 3e-4."""
    try:
        return real(value) if isinstance(value, str) else value
    except ValueError:
        return value
