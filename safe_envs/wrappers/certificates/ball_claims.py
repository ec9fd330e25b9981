"""What has to hold for a certificate to be a proof, as statements for the check by balls.

Let G be the states in the workspace with psi > 0 and all h_i > 0. Until a path leaves the workspace
it leaves G only where psi <= 0: psi is continuous, and <= 0 where an h_i is 0. On the way e^(a t)
psi + m (e^(a t) - 1)/a is a local submartingale by A psi >= -a psi - m; stopped when the path
leaves G, or after T, its mean is at least psi(x_0). At the end it is at most c e^(a T) + m (e^(a T)
- 1)/a for paths that are still in G, and at most m (e^(a T) - 1)/a for all others, for there psi <=
0. So P(in G until T, or until the workspace is left) >= [psi(x_0) e^(-a T) - m (1 - e^(-a T))/a]/c.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.wrappers.certificates.certificate import BarrierCertificate
from safe_envs.wrappers.certificates.check_result import StatementCheck

_LARGEST_DEGREE = 4


class BallClaim(NamedTuple):
    """That the claim + sum of w u >= 0, for some u of each (w, low, high) in inputs, in a region.

    Attributes:
        name: of the statement.
        claim: expression of the states and of the symbols of psi and its derivatives.
        region: the expressions that are positive there.
        zero: another one that is 0 there, if any.
        inputs: the coefficients of the inputs, with their bounds.
        defined: what has to have a value there, in place of the claim.
        faces: in place of the workspace those of its faces where a state, by index, has a value.
    """

    name: str
    claim: Any
    region: tuple[Any, ...]
    zero: Any = None
    inputs: tuple[Any, ...] = ()
    defined: tuple[Any, ...] = ()
    faces: tuple[tuple[int, Any], ...] = ()


def statements_of(certificate: BarrierCertificate, psi: dict[Any, sp.Symbol]) -> list[BallClaim]:
    """Return all statements but the first one.

    Args:
        certificate: that makes them.
        psi: symbols of psi, by (), and of its derivatives, by the sorted indices of states.
    """
    plant, p, h = certificate.plant, psi[()], certificate.plant.barriers
    a, m, c = map(sp.Rational, (certificate.rate, certificate.shortfall, certificate.supremum))
    claim = a * p + m + sum(f * psi[i,] for i, f in enumerate(plant.drift))
    for i, k in combinations_with_replacement(range(len(plant.states)), 2):
        both = zip(plant.diffusion[i], plant.diffusion[k], strict=True)
        claim += sum(x * y for x, y in both) * psi[i, k] / (2 if i == k else 1)
    columns = zip(*plant.input_matrix, strict=True)
    effects = [sum(g * psi[i,] for i, g in enumerate(column)) for column in columns]
    inputs = tuple((w, *ends) for w, ends in zip(effects, plant.bounds, strict=True))
    if plant.policy:
        for u, (w, low, high) in zip(plant.policy, inputs, strict=True):
            claim += w * sp.Max(low, sp.Min(high, u))
        inputs = ()
    used = (*plant.drift, *h, *plant.policy, *sum((*plant.input_matrix, *plant.diffusion), ()))
    found = [
        BallClaim(
            "f, g, sigma, h and the policy are defined", sp.Integer(1), (p, *h), defined=used
        ),
        BallClaim("psi <= c", c - p, (p, *h)),
        BallClaim("A psi >= -a psi - m", claim, (p, *h), inputs=inputs),
    ]
    for i, e in enumerate(h):
        if not _is_same(e, certificate.psi):
            rest = (p, *h[:i], *h[i + 1 :])
            found.append(BallClaim(f"psi <= 0 where h_{i + 1} = 0", -p, rest, zero=e))
    for i, (x, (low, high)) in enumerate(zip(plant.states, plant.workspace, strict=True)):
        if plant.angles[i] and any(key[i] for key in certificate.psi.coefficients):
            name, faces = f"psi <= 0 at the ends of the turn of {x}", ((i, low), (i, high))
            found.append(BallClaim(name, -p, (p, *h), faces=faces))
    return found


def _is_same(e: sp.Expr, psi: Polynomial) -> bool:
    # Only sums of monomials are compared, for others may be huge.
    small = psi.degree <= _LARGEST_DEGREE and not e.atoms(sp.Add) - {e}
    return small and sp.expand(psi.expression - e) == 0


def first_statement(certificate: BarrierCertificate) -> StatementCheck:
    """Check what takes no search."""
    signs = certificate.rate >= 0 and certificate.shortfall >= 0 and certificate.supremum > 0
    ends = (*certificate.plant.workspace, *certificate.plant.bounds)
    sound = all(e.is_finite and f.is_finite and e < f for e, f in ends)
    word = "checked" if signs and certificate.horizon > 0 and sound else "refuted"
    return StatementCheck("finite box; a, m >= 0; c, T > 0", word)
