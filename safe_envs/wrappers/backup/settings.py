"""The text of the backup filter: `backup`, or `backup:horizon=2:margin=0.1`."""

from __future__ import annotations

from dataclasses import dataclass

from safe_envs.errors import ConfigurationError
from safe_envs.number_text import finite_number
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.filter_settings import FilterSettings, settings_in
from safe_envs.wrappers.conditions.names import BACKUP

_KEYS = ("horizon", "margin")
_EXAMPLE = f"{BACKUP}:horizon=2"

LONGEST = 10_000
"""Control periods of a plan at most."""


@dataclass(frozen=True)
class BackupSettings(FilterSettings):
    """What a backup filter is asked for.

    Attributes:
        horizon: how long a law may take to reach its terminal set, in s; None for what the problem
            states.
        margin: which no barrier may fall below on a plan, in its unit.

    Raises:
        ConfigurationError: A value is out of range.
    """

    name = BACKUP
    only_of_steps = "its plans are of the env's own steps"

    horizon: float | None = None
    margin: float = 0.0

    def __post_init__(self) -> None:
        if self.horizon is not None:
            horizon = finite_number("horizon of the backup filter", self.horizon)
            if not horizon > 0.0:
                raise ConfigurationError(
                    f"horizon = {horizon:g} s of the backup filter; give a positive time, like"
                    f" {_EXAMPLE}"
                )
            object.__setattr__(self, "horizon", horizon)
        margin = finite_number("margin of the backup filter", self.margin)
        if margin < 0.0:
            raise ConfigurationError(
                f"margin = {margin:g} of the backup filter; give a number >= 0 in the unit of the"
                f" barriers, like {BACKUP}:margin=0.1"
            )
        object.__setattr__(self, "margin", margin)

    @classmethod
    def of_text(cls, text: str) -> BackupSettings:
        """Read the text of a backup filter.

        Args:
            text: `backup`, and if need be `:horizon=2` in s and `:margin=0.1`.

        Raises:
            ConfigurationError: It has another form, or a value is out of range.
        """
        given = settings_in(text, BACKUP, _KEYS, _EXAMPLE)
        return cls(**{key: finite_number(f"{key} of {BACKUP}", v) for key, v in given.items()})

    @property
    def text(self) -> str:
        """The text from which `of_text` makes the same settings."""
        horizon = "" if self.horizon is None else f":horizon={self.horizon!r}"
        margin = f":margin={self.margin!r}" if self.margin else ""
        return f"{BACKUP}{horizon}{margin}"

    def require_fit(self, problem: SafetyProblem, objective: str = "nearest") -> None:
        """Raise ConfigurationError where a problem has no backup, or the settings do not fit it.

        Args:
            problem: that is to be kept safe.
            objective: of the filter.
        """
        if problem.backup is None:
            raise ConfigurationError(_none_stated(problem))
        if self.horizon is not None and self.horizon > LONGEST * problem.dt:
            raise ConfigurationError(
                f"horizon = {self.horizon:g} s of the backup filter; plans of {problem.name} have"
                f" {LONGEST} control periods of {problem.dt:g} s at most"
            )
        self.require_nearest(objective)


def _none_stated(problem: SafetyProblem) -> str:
    if problem.rates:
        return (
            f"{problem.name} with rate_limit has no backup: its laws give the inputs, of which the"
            " rates are now decided. Leave rate_limit out, or state a backup for the rates with"
            " dataclasses.replace(problem, backup=Backup(...))"
        )
    return (
        f"{problem.name} states no backup: a law that brings the system to a set which it never"
        " leaves. Give one, state_problem(..., backup=Backup((BackupLaw(name, law, terminal),),"
        " horizon)), dataclasses.replace(problem, backup=...), or FilterSpec(..., backup=...) for a"
        " third-party env, from safe_envs.problem.backup; or take another filter, such as"
        f" {problem.filter}"
    )
