"""Lower bounds on the probability of staying safe, as functions of numbers, with their hypotheses.

All of them are of continuous time, with the condition met at every instant: an input that is held
for a control period meets it at its beginning only. They follow from one inequality. Let G be the
set where b_0, ..., b_(r-1) are positive, cut to the inside of the workspace where leaving that ends
an episode. Let b be twice continuously differentiable in G, continuous on its closure and at most
c. Let X be stopped when it leaves G, at the time tau, and let A b >= -a b - m up to then, with a, m
>= 0. Then

    e^(a t) b(X_t) + m (e^(a t) - 1)/a     (m t in place of the last term where a = 0)

is a submartingale up to tau, so that b(x_0) is at most its expectation at min(tau, T), which is at
most e^(a T) c P(b is not 0 at min(tau, T)) + m (e^(a T) - 1)/a. That gives `stage_bound`. All
others follow from it. An episode that has left the workspace before is at an end, and safe until
then: so c and m are taken over G alone. For that a >= 0 is needed, since tau may come before T.

These are theorems about the numbers they are given. A bound with c and m from a search is an
estimate: a larger c or m that the search did not find would make it smaller.

Every function broadcasts over arrays of starts, and returns values in [0, 1]. A value of 0
guarantees nothing, and so does an infinite c.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

_FOREVER = math.inf


def stage_bound(
    b: ArrayLike, c: ArrayLike, horizon: float = _FOREVER, rate: float = 0.0, shortfall: float = 0.0
) -> np.ndarray:
    """Return [b e^(-a T) - m (1 - e^(-a T))/a]/c: a bound on P(X does not leave by b = 0 up to T).

    Hypotheses: A b >= -a b - m wherever X is before it leaves the set; b is positive at the start;
        b <= c there.

    Args:
        b: value at the start.
        c: supremum of b over the set.
        horizon: T in s; infinite for ever.
        rate: a >= 0 in 1/s.
        shortfall: m >= 0 in the units of b per s.

    Source: Doob's optional stopping; for m = 0 thesis Prop. 4.2.5 and 4.2.8.
    """
    b, c = np.asarray(b, dtype=np.float64), np.asarray(c, dtype=np.float64)
    # (1 - e^(-a T))/a without the loss of digits at small a T; T itself in the limit.
    spent = -math.expm1(-rate * horizon) / rate if rate else horizon
    lost = shortfall * spent if shortfall else 0.0
    left = b * (math.exp(-rate * horizon) if rate else 1.0) - lost
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.where((b > 0.0) & (c > 0.0) & np.isfinite(c), left / c, 0.0)
    return np.clip(bound, 0.0, 1.0)


def proposition_4_2_8(h: ArrayLike, c: float) -> np.ndarray:
    """Return h/c, a bound for ever.

    Hypotheses: relative degree 1; A h >= 0 on all of C, so that the condition can be met everywhere
        on it; c = sup h over C is finite, which the thesis does not ask for.

    Args:
        h: value of the barrier at the start.
        c: supremum of h over C.

    Source: thesis Prop. 4.2.8.
    """
    return stage_bound(h, c)


def proposition_4_2_5(h: ArrayLike, c: float, k: float, horizon: float) -> np.ndarray:
    """Return (h/c) e^(-k T).

    Hypotheses: relative degree 1; A h >= -k h on all of C; c = sup h over C is finite.

    Args:
        h: value of the barrier at the start.
        c: supremum of h over C.
        k: rate in 1/s.
        horizon: T in s.

    Source: thesis Prop. 4.2.5, corrected: Eq. (4.16) and (4.17) have e^(-c T), see
        `proposition_4_2_5_printed`.
    """
    return stage_bound(h, c, horizon, rate=k)


def proposition_4_2_5_printed(h: ArrayLike, c: float, horizon: float) -> np.ndarray:
    """Return the printed (h/c) e^(-c T), which is false for k > c.

    Its exponent has the units of h times s. For Brownian motion of variance s^2 t on (0, pi) and
    h = sin(x), A h = -k h with k = s^2/2 and c = 1: the probability of staying is about
    (4/pi) h e^(-k T), which falls below h e^(-T) if k > 1.

    Args:
        h: value of the barrier at the start.
        c: supremum of h over C.
        horizon: T in s.

    Source: thesis Eq. (4.16).
    """
    return stage_bound(h, c, horizon, rate=c)


def shortfall_repaired(h: ArrayLike, c: float, shortfall: float, horizon: float) -> np.ndarray:
    """Return (h - m T)/c: Prop. 4.2.8 where A h >= 0 cannot be met everywhere.

    Hypotheses: relative degree 1; A h >= -m on all of C; c = sup h over C is finite.

    Args:
        h: value of the barrier at the start.
        c: supremum of h over C.
        shortfall: m, by which the condition is violated at worst, in the units of h per s.
        horizon: T in s.

    Source: submartingale h + m t, see the head of this module.
    """
    return stage_bound(h, c, horizon, shortfall=shortfall)


def union_bound(
    b: ArrayLike,
    c: ArrayLike,
    horizon: float = _FOREVER,
    rates: Sequence[float] | None = None,
    shortfalls: Sequence[float] | None = None,
) -> np.ndarray:
    """Return max(0, sum of the stages' bounds - (r - 1)): the valid form of Thm. 4.2.10.

    X leaves the set through some b_j: each of these events has at most the probability that its
    `stage_bound` leaves, and together at most their sum. No independence is needed.

    Hypotheses: A b_j >= -a_j b_j - m_j for each j while all of b_0..b_(r-1) are positive. For j < r
        - 1 that holds by the definition b_(j+1) = A b_j + a_j b_j, with m_j = 0; for the last one
        it is the condition. All b_j are positive at the start, and each c_j = sup b_j over the
        intersection of the {b_j >= 0} is finite. Stages of several barriers may be put together if
        one action meets all conditions up to the m_j.

    Args:
        b: b_0..b_(r-1) at the starts, shape (..., r).
        c: c_0..c_(r-1), shape (r,).
        horizon: T in s; infinite for ever.
        rates: a_1..a_r in 1/s; zeros by default.
        shortfalls: m_j of each stage; zeros by default.

    Returns:
        Bounds, shape (...).

    Source: union bound over the exits of the b_j, in place of the product of thesis Thm. 4.2.10.
    """
    stages = _stages(b, c, horizon, rates, shortfalls)
    return np.clip(sum(stages) - (len(stages) - 1), 0.0, 1.0)


def theorem_4_2_10_printed(
    b: ArrayLike, c: ArrayLike, horizon: float = _FOREVER, rates: Sequence[float] | None = None
) -> np.ndarray:
    """Return the printed product of b_j/c_j, or its zeroing form; it has no valid proof for r >= 2.

    Its proof takes P(b_j stays positive | b_(j+1) stays positive) for at least b_j/c_j, Eq. (4.23).
    That conditions on the future: the paths on which b_(j+1) stays positive are not those of the
    unconditioned process, for which b_j is a submartingale. Simulated systems fall below the
    product. For r = 1 it is Prop. 4.2.8 or 4.2.5.

    Args:
        b: b_0..b_(r-1) at the starts, shape (..., r).
        c: c_0..c_(r-1), suprema over the intersection of the {b_j >= 0}, shape (r,). The thesis
            takes them over each C_j alone, where they may be infinite.
        horizon: T in s; infinite for ever.
        rates: a_1..a_r in 1/s; zeros by default.

    Returns:
        Products, shape (...).

    Source: thesis Thm. 4.2.10, with j = 0..r-1.
    """
    return np.prod(_stages(b, c, horizon, rates, None), axis=0)


def _stages(
    b: ArrayLike,
    c: ArrayLike,
    horizon: float,
    rates: Sequence[float] | None,
    shortfalls: Sequence[float] | None,
) -> list[np.ndarray]:
    values, suprema = np.asarray(b, dtype=np.float64), np.asarray(c, dtype=np.float64)
    count = values.shape[-1]
    settings = zip(rates or (0.0,) * count, shortfalls or (0.0,) * count, strict=True)
    return [
        stage_bound(values[..., j], suprema[j], horizon, a, m) for j, (a, m) in enumerate(settings)
    ]
