"""The options of a problem: the one schema behind `gym.make`, the command line and sweeps.

A new option is a field of `ProblemOptions`, and what it changes in `SafetyProblem.configured`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shown, unexpected_argument
from safe_envs.problem.option_errors import refused_noise
from safe_envs.text import finite_number, named_values, numbers

SENSOR_OPTIONS = ("measurement", "sensor_noise")
"""Names of the options that put a sensor between the state and the observation."""

Reader = Callable[[str, Any], Any]
"""From the name of an option and its text (texts, where it is repeatable) to its value."""


def _read_noise(option: str, text: str) -> float | list[float]:
    levels = numbers(option, text)
    return levels[0] if len(levels) == 1 else levels


def _read_start(option: str, text: str) -> str | list[float]:
    try:
        return numbers(option, text)
    except ConfigurationError:
        if "," in text:
            raise
        return text


def _read_box(option: str, texts: Sequence[str]) -> list[float] | list[list[float]]:
    pairs = [numbers(option, text) for text in texts]
    for text, pair in zip(texts, pairs, strict=True):
        if len(pair) != 2:
            raise ConfigurationError(f"{option} {shown(text)} has {len(pair)} numbers; give LO,HI")
    return pairs[0] if len(pairs) == 1 else pairs


def _read_measurement(option: str, texts: Sequence[str]) -> list[str]:
    from safe_envs.problem.measurement import read_items

    return read_items(option, texts)


def _option(
    text: str,
    reader: Reader | None = None,
    metavar: str | None = None,
    repeatable: bool = False,
    least: int | None = None,
) -> Any:
    """Return a field with what a command line needs: the reader is None where a number is read."""
    # The least number is that of an option that takes whole ones.
    of_texts = {"reader": reader, "metavar": metavar, "repeatable": repeatable, "least": least}
    return field(default=None, metadata={"help": text, **of_texts})


def _parameters(text: str, words: bool = False) -> Any:
    return _option(f"{text} Repeatable.", partial(named_values, words=words), "K=V", True)


@dataclass(frozen=True, kw_only=True)
class ProblemOptions:
    """What may be changed in a problem; None keeps the problem's own value.

    Attributes:
        noise: diffusion of plant and model alike, one number for all channels or one for each; 0
            turns it off.
        plant: parameters of the simulated system, by name.
        model: parameters that the designer believes, by name.
        barrier: arguments of the function that builds the problem (of its barrier, mostly), by
            name.
        dt: control period in s.
        substeps: integration steps in a control period.
        horizon: length of an episode in s.
        input_bounds: physical bounds (low, high) of every input, or one such pair for each.
        start: name of an initial distribution, or a fixed initial state.
        delay: whole control periods after which the plant executes an input that is sent.
        model_delay: the delay that filters believe, by default that of the plant; 0 for filters
            that are unaware of it.
        slew_limit: bounds (low, high) of the rate at which the plant's actuators follow the input
            that is sent, in its unit per s, for all inputs or one such pair for each. Filters are
            unaware of them.
        rate_limit: the same as part of the system, whose inputs become states, and their rates
            the inputs: see `safe_envs.problem.actuators`.
        measurement: what is measured of the state, and becomes the observation: "default" for the
            problem's own sensor, other texts of `safe_envs.problem.measurement`, a list of
            them, standard deviations by name or expression, or a `Measurement`. None for the
            features without any error.
        sensor_noise: factor of the standard deviations of all that is measured.

    Raises:
        ConfigurationError: A value is of the wrong kind.
    """

    noise: float | Sequence[float] | None = _option(
        "Diffusion, one number for all channels or one for each (.1,.2); 0 turns it off.",
        _read_noise,
        "X",
    )
    plant: Mapping[str, float] | None = _parameters("Parameter of the simulated system.")
    model: Mapping[str, float] | None = _parameters("Parameter that the designer believes.")
    barrier: Mapping[str, Any] | None = _parameters("Argument of the barrier.", words=True)
    dt: float | None = _option("Control period in s.")
    substeps: int | None = _option("Integration steps in a control period.", least=1)
    horizon: float | None = _option("Length of an episode in s.")
    input_bounds: Sequence[Any] | None = _option(
        "Physical bounds of all inputs, or once for each.", _read_box, "LO,HI", True
    )
    start: str | Sequence[float] | None = _option(
        "Initial state, or the name of a distribution.", _read_start, "A,B,.."
    )
    delay: int | None = _option("Delay of the plant's inputs, in control periods.", least=0)
    model_delay: int | None = _option(
        "Delay that filters believe; that of the plant by default.", least=0
    )
    slew_limit: Sequence[Any] | None = _option(
        "Bounds of the actuators' rates, which filters do not know.", _read_box, "LO,HI", True
    )
    rate_limit: Sequence[Any] | None = _option(
        "Bounds of the inputs' rates, which become the inputs.", _read_box, "LO,HI", True
    )
    measurement: str | Sequence[str] | Mapping[str, Any] | None = _option(
        "What is measured in place of the state: default, or NAME or expression, noise and more.",
        _read_measurement,
        "EXPR:noise=S",
        True,
    )
    sensor_noise: float | None = _option("Factor of the standard deviations of the sensor.")

    def __post_init__(self) -> None:
        for name in PARAMETER_GROUPS:
            values = getattr(self, name)
            if values is not None and not (
                isinstance(values, Mapping) and all(isinstance(key, str) for key in values)
            ):
                raise ConfigurationError(
                    f"{name} = {values!r}; give a dictionary of names and values"
                )
        for name in ("dt", "horizon", "sensor_noise"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, finite_number(name, getattr(self, name)))
        if self.sensor_noise is not None and self.sensor_noise < 0.0:
            raise ConfigurationError(f"sensor_noise = {self.sensor_noise:g}; give a factor from 0")

    @classmethod
    def of(
        cls, title: str, arguments: Mapping[str, Any], of_barrier: Collection[str]
    ) -> ProblemOptions:
        """Sort the arguments of `gym.make`.

        Args:
            title: name of the env, for errors.
            arguments: options, and arguments of the barrier by themselves.
            of_barrier: names of the arguments that the barrier has.

        Returns:
            The options, with all arguments of the barrier under `barrier`.

        Raises:
            UnknownArgumentError: There is no such argument.
            ConfigurationError: An argument is of the wrong kind, or the barrier does not have it.
        """
        apart = {name: value for name, value in arguments.items() if name in of_barrier}
        options = {name: value for name, value in arguments.items() if name not in of_barrier}
        for name in options:
            if name not in OPTION_NAMES:
                allowed = (*OPTION_NAMES, *of_barrier)
                raise unexpected_argument(title, name, nearest(name, allowed))
        found = cls(**options)
        barrier = {**(found.barrier or {}), **apart}
        for name in barrier:
            if name not in of_barrier:
                raise ConfigurationError(
                    f"{title} has no barrier argument {shown(name)}; {nearest(name, of_barrier)}"
                )
        return replace(found, barrier=barrier)

    @property
    def changes(self) -> dict[str, Any]:
        """The options that are given, by name, without those of the barrier."""
        return {
            name: value
            for name in OPTION_NAMES
            if name != "barrier" and (value := getattr(self, name)) is not None
        }


OPTION_NAMES = tuple(option.name for option in fields(ProblemOptions))
"""Every option, in the order of the command line."""

WHOLE_OPTIONS: dict[str, int] = {
    option.name: option.metadata["least"]
    for option in fields(ProblemOptions)
    if option.metadata["least"] is not None
}
"""The least value of each option that takes whole numbers."""

PARAMETER_GROUPS = ("plant", "model", "barrier")
"""The options that are values by name."""


def noise_levels(problem: Any, noise: float | Sequence[float] | None) -> dict[str, float]:
    """Return the values of a problem's diffusion parameters, by name.

    Args:
        problem: a `SafetyProblem`.
        noise: one number for all of them, or one for each; None to change none.

    Raises:
        ConfigurationError: The problem has none, or a number is missing or negative.
    """
    if noise is None:
        return {}
    # Not imported before it is needed: a command reads the options first.
    import numpy as np

    from safe_envs.arrays import numbers_in

    names = problem.noise
    if not names:
        advice = (
            ": its diffusion holds numbers only; write it as a parameter, so that it can be changed"
            if problem.plant.noisy
            else ""
        )
        raise ConfigurationError(f"{problem.name} has no noise channels{advice}")
    given = numbers_in(noise)
    if (
        given.shape not in ((1,), (len(names),))
        or not np.isfinite(given).all()
        or (given < 0).any()
    ):
        raise refused_noise(noise, names)
    return dict(zip(names, np.broadcast_to(given, len(names)).tolist(), strict=True))
