"""Names of estimators and of their settings, which a command checks before it imports them."""

from __future__ import annotations

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.text import numbers

_SETTINGS = {
    "kf": ("process_noise",),
    "ekf": ("process_noise",),
    "ukf": ("process_noise", "alpha", "beta", "kappa"),
}


def settings_of(text: str) -> tuple[str, dict[str, str]]:
    """Return the name of an estimator and its settings, as texts.

    Args:
        text: such as "ekf" or "ukf:alpha=.5".

    Raises:
        ConfigurationError: The name or a setting is unknown, or a value is no number.
    """
    name, *entries = text.split(":")
    if name not in _SETTINGS:
        raise ConfigurationError(f"unknown estimator {shown(text)}; {nearest(name, _SETTINGS)}")
    found: dict[str, str] = {}
    for entry in entries:
        key, _, value = entry.partition("=")
        if key not in _SETTINGS[name] or key in found:
            raise ConfigurationError(
                f"estimator {shown(text)}: unknown or repeated setting {shown(key)};"
                f" {nearest(key, _SETTINGS[name])}"
            )
        numbers(key, value)
        found[key] = value
    if any(len(numbers(key, found[key])) > 1 for key in found if key != "process_noise"):
        raise ConfigurationError(f"estimator {shown(text)}: give one number for each setting")
    return name, found
