"""What a table of values is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, require_whole, shown
from safe_envs.number_text import finite_number

KNOWLEDGE = ("model", "plant")
LEAVING = ("violation", "safe")


@dataclass(frozen=True)
class ValueSettings:
    """What a table of values is asked for, next to a problem.

    Attributes:
        knowledge: whose step is taken, that of the "model" or of the "plant".
        leaving: how an episode counts that leaves the workspace in the safe set: as a "violation",
            or as "safe", which is how `evaluate` counts it.
        intervals: of parameters that are uncertain; values hold for the worst ones, which may
            change at every step.
        specification: that an episode is to meet, over the sets that the problem names, such as
            "always safe & eventually goal"; "" for that of staying safe.
        cells: number along each coordinate; None for numbers that suit the problem.
        inputs: number of inputs that are scanned along each input; None for one that suits.
        memory: in bytes, which the tables must not exceed.

    Raises:
        ConfigurationError: A value is not allowed.
    """

    knowledge: str = "model"
    leaving: str = "violation"
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    specification: str = ""
    cells: tuple[int, ...] | None = None
    inputs: int | None = None
    memory: float = 4e9

    def __post_init__(self) -> None:
        for name, allowed in (("knowledge", KNOWLEDGE), ("leaving", LEAVING)):
            given = getattr(self, name)
            if given not in allowed:
                raise ConfigurationError(f"{name} = {shown(given)}; {nearest(str(given), allowed)}")
        if not isinstance(self.specification, str):
            raise ConfigurationError(
                f"specification = {shown(self.specification)}; give text, such as"
                ' "always safe & eventually goal"'
            )
        if self.cells is not None:
            if isinstance(self.cells, str) or not isinstance(self.cells, Iterable):
                raise ConfigurationError(
                    f"cells = {shown(self.cells)}; give a whole number for each coordinate, such as"
                    " (400, 100)"
                )
            object.__setattr__(self, "cells", tuple(self.cells))
            for count in self.cells:
                require_whole("cells", count, 2)
        if self.inputs is not None:
            require_whole("inputs", self.inputs, 2)
        if not finite_number("memory", self.memory) > 0:
            raise ConfigurationError(f"memory = {shown(self.memory)}; give a number of bytes")
        intervals = {str(name): _interval(name, given) for name, given in self.intervals.items()}
        object.__setattr__(self, "intervals", intervals)

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as JSON-able data."""
        return {
            "specification": self.specification,
            "knowledge": self.knowledge,
            "leaving": self.leaving,
            "intervals": {name: list(pair) for name, pair in self.intervals.items()},
            "cells": None if self.cells is None else list(self.cells),
            "inputs": self.inputs,
            "memory": self.memory,
        }


def _interval(name: str, given: Any) -> tuple[float, float]:
    try:
        low, high = given
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"interval of {name} = {shown(given)}; give two numbers, the lower one first"
        ) from error
    ends = tuple(finite_number(f"interval of {name}", end) for end in (low, high))
    return ends[0], ends[1]
