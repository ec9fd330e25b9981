"""The text of the promise filter: `promise:p=0.99:robust=v:0.8..2.4:leaving=safe:table=FILE`.

`spec=always safe & eventually goal` says what is kept in place of safety. No sign of a
specification divides the text of a filter, so that it is written as it is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.number_text import finite_number, real
from safe_envs.problem.named_sets import set_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.filter_settings import FilterSettings, settings_in
from safe_envs.wrappers.conditions.names import PROMISE
from safe_envs.wrappers.value.automaton_building import automaton_of
from safe_envs.wrappers.value.settings import LEAVING
from safe_envs.wrappers.value.specification import Specification

_KEYS = ("p", "robust", "leaving", "spec", "table")
_EXAMPLE = f"{PROMISE}:p=0.99"
_SPEC_EXAMPLE = "like always safe & eventually goal"

_INTERVAL = re.compile(r"\s*(\w+)\s*:(.+?)\.\.(.+)")

Interval = tuple[str, float, float]
"""Name, lower and upper end of a parameter."""


@dataclass(frozen=True)
class PromiseSettings(FilterSettings):
    """What a promise filter is asked for.

    Attributes:
        probability: p, between 0 and 1.
        robust: parameters of which only an interval is known, each once.
        leaving: how an episode counts that leaves the workspace in the safe set: as a
            "violation", or as "safe".
        table: file of the table; None for the one of the user's cache, which is computed where it
            is missing.
        specification: that an episode is to meet, over the sets that the problem names; "" for that
            of staying safe.

    Raises:
        ConfigurationError: A value is out of range.
    """

    name = PROMISE
    only_of_steps = "its table is of the env's own steps"
    not_compiled = "looks up a table, which the engine 'numpy' alone can"
    of_paths = "what was kept on the whole path"

    probability: float
    robust: tuple[Interval, ...] = ()
    leaving: str = LEAVING[0]
    table: str | None = None
    specification: str = ""

    def __post_init__(self) -> None:
        p = finite_number("p of the promise filter", self.probability)
        if not 0.0 < p < 1.0:
            raise ConfigurationError(
                f"p = {p:g} of the promise filter; give a probability of being safe between 0 and"
                f" 1, both excluded, like {_EXAMPLE}"
            )
        object.__setattr__(self, "probability", p)
        if self.leaving not in LEAVING:
            raise ConfigurationError(
                f"leaving = {shown(self.leaving)} of the promise filter;"
                f" {nearest(str(self.leaving), LEAVING)}"
            )
        if not isinstance(self.specification, str):
            raise ConfigurationError(
                f"specification = {shown(self.specification)} of the promise filter; give text,"
                f" {_SPEC_EXAMPLE}"
            )
        object.__setattr__(self, "specification", " ".join(self.specification.split()))
        names = [name for name, _, _ in self.robust]
        for name, low, high in self.robust:
            if names.count(name) > 1:
                raise ConfigurationError(f"robust of the promise filter names {name} twice")
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise ConfigurationError(
                    f"robust = {name}:{low:g}..{high:g} of the promise filter; give two finite"
                    " numbers, the lower one first"
                )

    @classmethod
    def of_text(cls, text: str) -> PromiseSettings:
        """Read the text of a promise filter.

        Args:
            text: `promise:p=0.99`, and if need be `:robust=v:0.8..2.4` (several parameters with ";"
                between), `:leaving=safe`, `:spec=always safe & eventually goal` and
                `:table=FILE`.

        Raises:
            ConfigurationError: It has another form, or a value is out of range.
        """
        given = settings_in(text, PROMISE, _KEYS, _EXAMPLE)
        if "p" not in given:
            raise ConfigurationError(
                f"filter {shown(text)} names no probability; give one, like {_EXAMPLE}"
            )
        table = given.get("table")
        if table is not None and not table:
            raise ConfigurationError(f"filter {shown(text)}: table names no file")
        if "spec" in given and not given["spec"].strip():
            raise ConfigurationError(
                f"filter {shown(text)}: spec has no specification; give one, {_SPEC_EXAMPLE}, or"
                " leave it out for safety"
            )
        return cls(
            finite_number("p of the promise filter", given["p"]),
            _intervals(text, given["robust"]) if "robust" in given else (),
            given.get("leaving", LEAVING[0]),
            table,
            given.get("spec", ""),
        )

    @property
    def text(self) -> str:
        """The text from which `of_text` makes the same settings."""
        parts = [f"{PROMISE}:p={self.probability!r}"]
        if self.robust:
            parts.append("robust=" + ";".join(f"{n}:{a!r}..{b!r}" for n, a, b in self.robust))
        if self.leaving != LEAVING[0]:
            parts.append(f"leaving={self.leaving}")
        if self.specification:
            parts.append(f"spec={self.specification}")
        if self.table is not None:
            parts.append(f"table={self.table}")
        return ":".join(parts)

    @property
    def intervals(self) -> Mapping[str, tuple[float, float]]:
        """The intervals by the names of their parameters."""
        return {name: (low, high) for name, low, high in self.robust}

    def require_fit(self, problem: SafetyProblem, objective: str = "nearest") -> None:
        """Raise ConfigurationError where the settings do not fit a problem.

        Args:
            problem: whose parameters are meant.
            objective: of the filter.
        """
        known = problem.model.parameter_values
        for name, _, _ in self.robust:
            if name not in known:
                raise ConfigurationError(
                    f"robust of the promise filter: {problem.name} has no parameter {shown(name)};"
                    f" {nearest(name, known)}"
                )
        if self.specification:
            specification = Specification(self.specification, set_names(problem))
            specification.require_horizon(problem.steps)
            automaton_of(specification)
        self.require_nearest(objective)


def _intervals(text: str, given: str) -> tuple[Interval, ...]:
    """Read "v:0.8..2.4;m:1..2"."""
    found = []
    for part in given.split(";"):
        match = _INTERVAL.fullmatch(part)
        try:
            name, low, high = match.groups() if match else ("", "", "")
            found.append((name, real(low), real(high)))
        except ValueError as error:
            raise ConfigurationError(
                f"filter {shown(text)}: robust = {shown(part)}; give a parameter and two numbers,"
                ' like v:0.8..2.4, with ";" between several of them'
            ) from error
    return tuple(found)
