"""The barrier of a belief, and the dynamics of an estimate, on which conditions derive their chain.

Of an estimate x^ with the error's covariance P, the belief barrier is

    h_B = h(x^) - z sqrt(q),    q = grad h' (P + dt/4 sigma sigma') grad h + 1/2 tr(H P H P).

The first term is the variance of h to first order. The second makes the rate of the root finite at
a start that is known, where P = 0; the third, with the Hessian H of h, where grad h = 0, and with
it q is the variance of a quadratic h. Both only enlarge the margin.

**What is proved.** Let the model be linear with Gaussian noise, its estimate that of the Kalman
filter, and h = c' x + d. Given the measurements y_0..y_k, and with inputs that are functions of
these (and of independent random numbers), the state X_k is Gaussian with mean x^_k and covariance
P_k: P(h(X_k) < 0 | y) = Phi(-h(x^_k)/sqrt(c' P_k c)), which is at most Phi(-z) where h_B >= 0. An
exit is at some instant k with h(X_k) < 0, and there h_B < 0, or not. By the union bound over the
instants 0..K,

    P(exit) <= P(h_B < 0 at some instant) + (K + 1) Phi(-z),

and z = -Phi^-1(delta/(K + 1)) makes the last term delta; for several barriers the union is over
them too. Elsewhere, and for an extended Kalman filter, this is a design that is measured.

**The dynamics of the estimate.** From instant to instant x^ moves by the model's step, and jumps by
K nu, with the innovation's covariance S: dx^ = (f + g u) dt + G dW with G G' = K S K'/dt. P
grows by the positive part of (P_(k+1) - P_k)/dt: where it shrinks, h_B rises by itself, and a
condition that only forbids h_B to fall would let h fall instead. Both are known before the sample
for a linear model, and found at the estimate for an extended filter; they are signals of the
system, given at each decision. A condition derives its chain for this system. For a half-space and
Euler's steps the stochastic CBF
then keeps E[h_B at k + 1 | y_0..y_k] >= h_B at k: the mean of x^ moves by dt (f + g u), and the
root is concave and monotone in P, so that its tangent along what P grows is above it.

Source: Clark, Control barrier functions for stochastic systems, Automatica 2021, for barriers of
    the estimate.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import lru_cache
from typing import Any

import sympy as sp

from safe_envs.dynamics.lie import gradient
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.barrier import Barrier

_TINY = sp.Float(1e-18)
"""Added to q: without any uncertainty its root has a rate of 0, and not of 0/0."""

Symbols = tuple[sp.Symbol, ...]


@lru_cache(maxsize=64)
def belief_symbols(n: int) -> tuple[Symbols, Symbols, Symbols]:
    """Return the symbols of P, of its rate, and of G, in the order of `BeliefTracker.believed`.

    P and its growth are upper triangles of symmetric matrices, (1, 1), (1, 2), .., (1, n), (2, 2),
    and so on; G is a lower triangle, (1, 1), (2, 1), (2, 2), (3, 1) and so on.

    Args:
        n: number of states.
    """
    upper = [(i, j) for i in range(n) for j in range(i, n)]
    lower = [(i, j) for i in range(n) for j in range(i + 1)]
    groups = (("P", upper), ("P_rate", upper), ("G", lower))
    found = [
        tuple(sp.Symbol(f"belief_{name}_{i + 1}_{j + 1}", real=True) for i, j in places)
        for name, places in groups
    ]
    return found[0], found[1], found[2]


def belief_system(model: ControlAffineSDE, certain: Collection[int] = ()) -> ControlAffineSDE:
    """Return the dynamics of the estimate of a model's state; see above.

    Args:
        model: that the estimator knows.
        certain: places of states without any uncertainty.
    """
    n = model.n
    spread, rates, jump = belief_symbols(n)
    entries = iter(jump)
    diffusion = [[next(entries) if j <= i else 0 for j in range(n)] for i in range(n)]
    for i in certain:
        diffusion[i] = [0] * n
        for row in diffusion:
            row[i] = 0
    moving: dict[Any, Any] = dict(zip(spread, rates, strict=True))
    still = dict.fromkeys((*rates, *jump), 0)
    return replace(
        model,
        # With numbers in place of parameters, long derivatives need not be searched for them.
        drift=model.numeric(model.drift),
        input_matrix=model.numeric(model.input_matrix),
        diffusion=diffusion,
        parameters={},
        signals={**{s: model.numeric(r) for s, r in model.signals.items()}, **moving, **still},
    )


def belief_barrier(
    model: ControlAffineSDE, barrier: Barrier, z: float, dt: float, certain: Collection[int] = ()
) -> Barrier:
    """Return h_B; see above.

    Args:
        model: that the estimator knows.
        barrier: h.
        z: standard deviations of the margin.
        dt: control period in s.
        certain: places of states without any uncertainty.
    """
    n, states = model.n, model.states
    spread = _symmetric(belief_symbols(n)[0], n)
    for i in certain:
        spread[i, :], spread[:, i] = sp.zeros(1, n), sp.zeros(n, 1)
    slopes = sp.Matrix([sp.sympify(e) for e in gradient(model, barrier.expression)])
    noise = sp.Matrix(model.numeric(model.diffusion))
    first = spread + sp.Float(dt, 17) / 4 * noise * noise.T
    curvature = sp.hessian(barrier.expression, states)
    bent = curvature * spread
    q = (slopes.T * first * slopes)[0, 0] + (bent * bent).trace() / 2 + _TINY
    return Barrier(barrier.expression - sp.Float(z, 17) * sp.sqrt(q), barrier.name)


def standard_deviations(delta: float, instants: int) -> float:
    """Return z = -Phi^-1(delta/instants).

    Args:
        delta: probability for all instants together.
        instants: K + 1 control instants, times the barriers.

    Raises:
        ConfigurationError: delta/instants is 1/2 or more, and no margin.
    """
    from scipy import stats

    if not 0.0 < delta / instants < 0.5:
        raise ConfigurationError(
            f"belief = {delta} for {instants} instants; give a probability above 0 and below"
            f" {min(1.0, 0.5 * instants):g}"
        )
    return float(stats.norm.isf(delta / instants))


def _symmetric(components: Symbols, n: int) -> sp.Matrix:
    table, entries = sp.zeros(n, n), iter(components)
    for i in range(n):
        for j in range(i, n):
            table[i, j] = table[j, i] = next(entries)
    return table
