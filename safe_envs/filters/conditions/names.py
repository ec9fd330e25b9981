"""Names of filters, known before the classes behind them are imported."""

from __future__ import annotations

from safe_envs import plugins
from safe_envs.errors import ConfigurationError, RelativeDegreeError, nearest, shown

COMMON = ("sampling_margin", "belief", "measurement_error")
"""Names of the parameters of every condition."""

PARAMETERS = {
    "cbf": ("alpha", *COMMON),
    "ecbf": ("k", "poles", *COMMON),
    "hocbf": ("alpha", *COMMON),
    "rcbf": ("gamma", "form", *COMMON),
    "srcbf": ("gamma", "form", *COMMON),
    "szcbf": ("alpha", *COMMON),
    "scbf": COMMON,
}
"""Names of the parameters of the conditions that need nothing but a model of the system."""

OF_MODEL = tuple(PARAMETERS)
"""Names of these conditions."""

OF_DATA = ("learned-hocbf", "ddscbf", "bayesian-scbf")
"""Names of the conditions that need a learned model."""

ONLY_DEGREE_1 = "A cbf is for relative degree 1; use hocbf or ecbf"
"""Advice where a barrier has another one."""

CERTIFIED = "certified"
"""Name of the condition of a barrier certificate."""

_BUILT_IN = (*OF_MODEL, *OF_DATA, CERTIFIED)

PROMISE = "promise"
"""Name of the filter of `safe_envs.values`, which is no condition."""

BACKUP = "backup"
"""Name of the filter of `safe_envs.proofs.backup_filter`, which is no condition either."""

BY_THEMSELVES = {PROMISE: f"{PROMISE}:p=0.99", BACKUP: BACKUP}
"""Filters that act by themselves, by name, each with an example of its text."""

RESERVED = ("none", *BY_THEMSELVES)
"""Names that no condition can have: "none" stands for the unfiltered env."""


AT_STATE = "@state"
"""What the name of a filter ends with that is evaluated at the true state of a measured env."""


def is_built_in(name: str) -> bool:
    """Return whether a name is that of a condition of this project."""
    return name in _BUILT_IN


def condition_names() -> tuple[str, ...]:
    """Return the names of all conditions: the built-in ones, then those of installed packages.

    A package can take neither a built-in name nor one of `RESERVED`.
    """
    declared = plugins.plugin_names(plugins.CONDITIONS)
    return (*_BUILT_IN, *(name for name in declared if name not in (*_BUILT_IN, *RESERVED)))


def unknown_filter(name: str, *more: str) -> ConfigurationError:
    """Return the error of a filter that nobody knows.

    Args:
        name: what was given.
        more: names that are allowed besides those of conditions.
    """
    allowed = (*more, *condition_names(), *BY_THEMSELVES)
    heads = [part.strip().split(":")[0] for part in name.split(",")]
    if len(heads) > 1 and all(head in ("none", *allowed) for head in heads):
        return ConfigurationError(
            f"filter {shown(name)} names {len(heads)} filters; repeat the option for each, as in"
            f" {' '.join(f'--filter {head}' for head in heads)} (in Python: a list)"
        )
    return ConfigurationError(
        f"unknown filter {shown(name)};"
        f" {nearest(name, allowed, 'or a condition of your own as FILE.py:NAME')}"
    )


def unfiltered_in_sum(text: str) -> ConfigurationError:
    """Return the error of a filter for several barriers that names the unfiltered env for one."""
    return ConfigurationError(
        f"filter {shown(text)}: 'none' is the unfiltered env, no condition; give it alone or leave"
        " it out"
    )


def wrong_rates(barrier: str, degree: int, given: int) -> RelativeDegreeError:
    """Return the error of a condition whose rates do not suit the degree of a barrier.

    Args:
        barrier: its name.
        degree: its relative degree.
        given: number of rates.
    """
    return RelativeDegreeError(
        f"barrier {barrier} has relative degree {degree} and needs as many rates; {given} given"
    )
