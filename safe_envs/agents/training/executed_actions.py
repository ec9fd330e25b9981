"""Executed actions in units of the action space, from what a filter reports in physical units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.agents.training.lazy_info import of_each
from safe_envs.errors import ConfigurationError

_ROUNDING = 1e-6
"""How far beyond [-1, 1] rounding may move an action on the input bounds."""

_ALIKE = 1e-5
"""How far apart the same proposal may be in [-1, 1], once it was rounded to single precision."""


def executed_actions(
    proposed: np.ndarray, infos: Sequence[Any], bounds: np.ndarray | None
) -> np.ndarray:
    """Return executed actions in [-1, 1], or proposals without a filter, shape (n_envs, m).

    Args:
        proposed: in [-1, 1], shape (n_envs, m).
        infos: of the step, one for each env.
        bounds: inputs at the ends of the action space, shape (m, 2), where the infos do not say
            them, or not those of the learner; None if unknown.

    Raises:
        ConfigurationError: an executed action is out of the input bounds, or these are unknown.
    """
    names = "safe_action", "nominal_action", "input_bounds"
    reported = [of_each(infos, name) for name in names]
    rows: Any = slice(None)
    if isinstance(reported[0], list):
        rows = [i for i, u in enumerate(reported[0]) if u is not None]
        if not rows:
            return proposed
    actions = proposed.astype(np.float64)
    safe, nominal, told = (_rows_of(values, rows) for values in reported)
    actions[rows] = _between(safe, _fitting(actions[rows], nominal, told, bounds))
    return actions


def _fitting(
    proposed: np.ndarray,
    nominal: np.ndarray | None,
    told: np.ndarray | None,
    bounds: np.ndarray | None,
) -> np.ndarray:
    """Return the inputs at the ends of the learner's action space.

    Args:
        proposed: in [-1, 1], shape (rows, m).
        nominal: the same as inputs, as the filter got them, shape (rows, m); None if unknown.
        told: inputs at the ends of the filter's action space, (rows, m, 2); None if unknown.
        bounds: see `executed_actions`.
    """
    known = [each for each in (told, bounds) if each is not None]
    if told is not None and nominal is not None:
        known = [each for each in known if _stand_for(proposed, nominal, each)]
    if not known:
        raise ConfigurationError(
            "the env is filtered, and a wrapper around the filter changes the actions, or the"
            " map of the actions is no straight line, so that the executed ones are unknown in"
            " units of the action space; put the filter around that wrapper, or give"
            " replay_buffer_kwargs={'box': [(low, high), ...]}: the inputs at its ends. A loop of"
            " your own adds actions in [-1, 1], and not in the units of another action space"
        )
    return known[0]


def _rows_of(values: Any, rows: Any) -> Any:
    """Return the entries of some infos as an array; None where one of them has none."""
    if isinstance(values, np.ndarray):
        return values[rows]
    picked = [values[i] for i in (range(len(values)) if isinstance(rows, slice) else rows)]
    return None if any(each is None for each in picked) else np.array(picked)


def _between(inputs: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return inputs (rows, m) in [-1, 1], where bounds (m, 2) or (rows, m, 2) are the ends."""
    center, half = _middle(bounds)
    actions = (inputs - center) / half
    clipped = np.clip(actions, -1.0, 1.0)
    if not (np.abs(actions - clipped) <= _ROUNDING).all():
        low, high = np.sort(bounds.reshape(-1, *bounds.shape[-2:])[0], axis=-1).T
        raise ConfigurationError(
            f"the executed actions {inputs.tolist()} are not between {low.tolist()} and"
            f" {high.tolist()}; give the input bounds of the env's problem, as"
            " replay_options(env) does"
        )
    return clipped


def _stand_for(proposed: np.ndarray, nominal: np.ndarray, bounds: np.ndarray) -> bool:
    """Return whether proposals in [-1, 1] between bounds are the inputs that a filter got."""
    center, half = _middle(bounds)
    alike = np.abs(center + half * np.clip(proposed, -1.0, 1.0) - nominal) <= _ALIKE * np.abs(half)
    # A vector env that only starts an episode ignores the proposal, and reports an input at rest.
    return bool((alike | (nominal == np.clip(0.0, bounds.min(-1), bounds.max(-1)))).all())


def _middle(bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Physical input = middle + half the width * action."""
    return bounds.mean(axis=-1), 0.5 * (bounds[..., 1] - bounds[..., 0])


def bounds_of(box: Sequence[Sequence[float]], inputs: int) -> np.ndarray:
    """Return (low, high) of each input, shape (m, 2).

    Args:
        box: as pairs.
        inputs: m.

    Raises:
        ConfigurationError: it is something else.
    """
    try:
        pairs = np.array(box, dtype=np.float64)
    except (TypeError, ValueError):
        pairs = np.empty(0)
    if (
        pairs.shape != (inputs, 2)
        or not np.all(np.isfinite(pairs))
        or np.any(pairs[:, 0] >= pairs[:, 1])
    ):
        raise ConfigurationError(
            f"box = {box!r}; give a finite (low, high) with low < high for each of the {inputs}"
            " inputs"
        )
    return pairs
