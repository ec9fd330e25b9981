"""Actions and inputs of policies, as kernels."""

from __future__ import annotations

from safe_envs.dynamics.noise import POLICY
from safe_envs.engine.draws import uniform_at


def action_of_input(u: float, low: float, high: float, center: float, half: float) -> float:
    """Return the action in [-1, 1] for an input, which is clipped to its bounds; NaN for NaN.

    Args:
        u: physical input.
        low: lower bound.
        high: upper bound.
        center: middle of the bounds.
        half: half of their distance.
    """
    clipped = low if u < low else high if u > high else u
    return (clipped - center) / half


def random_action(place: int, k0: int, k1: int) -> float:
    """Return the action that a word of the policy's stream of an episode stands for.

    Args:
        place: of the word, from 0.
        k0: first word of the key of the episode.
        k1: second word.
    """
    return 2.0 * uniform_at(place, 0, POLICY, k0, k1) - 1.0


def clip_to_bound(value: float, bound: float) -> float:
    """Return a number, or the end of [-bound, bound] that it lies beyond; NaN for NaN.

    Args:
        value: the number.
        bound: not negative.
    """
    return -bound if value < -bound else bound if value > bound else value


def action_in_another_box(
    action: float, center: float, half: float, new_center: float, new_half: float
) -> float:
    """Return the action that stands for the same or the nearest input in other input bounds.

    Args:
        action: in the old bounds.
        center: of the old bounds.
        half: width of the old bounds, halved.
        new_center: of the new bounds.
        new_half: width of the new bounds, halved.
    """
    return clip_to_bound((center + half * action - new_center) / new_half, 1.0)
