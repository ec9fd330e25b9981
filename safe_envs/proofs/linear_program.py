"""Linear programs whose solution is a barrier: its basis, the safe set, samples and inputs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError, NumericalError, SystemDefinitionError
from safe_envs.filters.certificates.certificate import Plant
from safe_envs.proofs.safe_set import Region, sample, towards_zero

_MOST_COEFFICIENT = 1000.0
_SECONDS, _TIME_OVER = 10.0, 1
"""Of a linear program, and what SciPy says where they did not suffice."""

_SLACK = 1e-9


@dataclass(frozen=True)
class Claims:
    """What psi, the sum of a basis with coefficients, has to meet.

    Attributes:
        generator: coefficients of A psi + a psi, which is to be >= -m, shape (B, K).
        at_most_one: values of the basis where psi <= 1, shape (C, K).
        not_positive: values of the basis where psi <= 0, shape (D, K).
    """

    generator: np.ndarray
    at_most_one: np.ndarray
    not_positive: np.ndarray


@dataclass(frozen=True)
class MeanBound:
    """psi(x_0) e^(-a T) - m (1 - e^(-a T))/a, for c = 1.

    Attributes:
        rate: a >= 0 in 1/s.
        horizon: T in s.
    """

    rate: float
    horizon: float

    @property
    def decay(self) -> float:
        """The factor e^(-a T) of psi."""
        return math.exp(-self.rate * self.horizon)

    @property
    def spent(self) -> float:
        """The factor (1 - e^(-a T))/a of m, in s."""
        a = self.rate
        return -math.expm1(-a * self.horizon) / a if a else self.horizon

    def mean(self, psi: np.ndarray, m: float, supremum: float) -> float:
        """Return the mean of the bound over starts.

        Args:
            psi: at the starts, shape (B,).
            m: shortfall.
            supremum: c.
        """
        values = (psi * self.decay - m * self.spent) / supremum
        return float(values.clip(0.0, 1.0).mean())


def solve(claims: Claims, bound: MeanBound, weights: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the coefficients and the shortfall m of the largest mean bound.

    Args:
        claims: that psi has to meet.
        bound: which is linear in psi and m.
        weights: mean of the basis over the starts that count, shape (K,), with their part of all
            starts as its first entry: the first member of the basis is 1.

    Returns:
        Coefficients, shape (K,), and m; nothing where no solution was found.
    """
    from scipy.optimize import linprog

    g, one, zero = claims.generator, claims.at_most_one, claims.not_positive
    matrix = np.zeros((len(g) + len(one) + len(zero), len(weights) + 1))
    matrix[:, :-1] = np.concatenate([-g, one, zero])
    matrix[: len(g), -1] = -1.0
    limits = np.zeros(len(matrix))
    limits[len(g) : len(g) + len(one)] = 1.0
    sizes = np.abs(matrix).max(axis=1)
    cost = np.append(-bound.decay * weights, bound.spent * weights[0])
    ranges = [(-_MOST_COEFFICIENT, _MOST_COEFFICIENT)] * len(weights) + [(0.0, None)]
    for method in ("highs-ds", "highs-ipm"):
        found = linprog(
            cost,
            matrix / sizes[:, None],
            limits / sizes - _SLACK,
            bounds=ranges,
            method=method,
            options={"time_limit": _SECONDS},
        )
        if found.x is not None and found.status != _TIME_OVER:
            return found.x[:-1], max(0.0, float(found.x[-1]))
    return None


class Jets(NamedTuple):
    """All members of a basis at states.

    Attributes:
        values: shape (B, K).
        gradients: with respect to the states, shape (B, n, K).
        hessians: shape (B, n, n, K).
    """

    values: np.ndarray
    gradients: np.ndarray
    hessians: np.ndarray


@dataclass(frozen=True)
class ChebyshevBasis:
    """Products T_i(z_1) T_j(z_2) ... up to a total degree, in z = (x - center)/scale.

    Attributes:
        states: symbols x_1, ..., x_n.
        center: of the states for which z is in [-1, 1].
        scale: half of the width of their range, each > 0.
        degree: largest total degree, at least 0.
        even: only members of even total degree, which are the same at z and -z.
    """

    states: tuple[sp.Symbol, ...]
    center: tuple[Fraction, ...]
    scale: tuple[Fraction, ...]
    degree: int
    even: bool = False

    @cached_property
    def exponents(self) -> np.ndarray:
        """The degrees i, j, ... of the members, shape (K, n); the first one is constant."""
        ranges = [range(self.degree + 1)] * len(self.states)
        step = 2 if self.even else 1
        totals = range(0, self.degree + 1, step)
        found = [key for key in itertools.product(*ranges) if sum(key) in totals]
        return np.array(sorted(found, key=lambda key: (sum(key), key)))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return all members at states (B, n), shape (B, K)."""
        found = np.ones((len(x), len(self.exponents)))
        for i in range(len(self.states)):
            found *= self._along(x, i)[0][:, self.exponents[:, i]]
        return found

    def jets(self, x: np.ndarray) -> Jets:
        """Return all members with their derivatives at states.

        Args:
            x: states, shape (B, n).
        """
        n = len(self.states)
        each = [[part[:, self.exponents[:, i]] for part in self._along(x, i)] for i in range(n)]

        def product(orders: list[int]) -> np.ndarray:
            found = each[0][orders[0]]
            for own, order in zip(each[1:], orders[1:], strict=True):
                found = found * own[order]
            return found

        unit = np.eye(n, dtype=int)
        gradients = np.stack([product(e.tolist()) for e in unit], axis=1)
        hessians = np.empty((len(x), n, n, len(self.exponents)))
        for i in range(n):
            for j in range(i + 1):
                hessians[:, i, j] = hessians[:, j, i] = product((unit[i] + unit[j]).tolist())
        return Jets(product([0] * n), gradients, hessians)

    def embedded(self, lower: ChebyshevBasis, coefficients: np.ndarray) -> np.ndarray:
        """Return the coefficients of a polynomial of another basis, shape (K,).

        Args:
            lower: the other basis, all members of which this one has.
            coefficients: of its members.
        """
        places = {tuple(key): i for i, key in enumerate(self.exponents.tolist())}
        found = np.zeros(len(places))
        found[[places[tuple(key)] for key in lower.exponents.tolist()]] = coefficients
        return found

    def polynomial(self, coefficients: np.ndarray, decimals: int) -> Polynomial:
        """Return the polynomial of rounded coefficients, exactly.

        Args:
            coefficients: of the members, shape (K,).
            decimals: to which they are rounded.
        """
        monomials = _monomials(self.degree)
        found: dict[tuple[int, ...], Fraction] = {}
        for key, c in zip(self.exponents.tolist(), coefficients.tolist(), strict=True):
            exact = Fraction(round(c * 10**decimals), 10**decimals)
            if not exact:
                continue
            for powers in itertools.product(*(range(k % 2, k + 1, 2) for k in key)):
                factor = 1
                for k, power in zip(key, powers, strict=True):
                    factor *= monomials[k][power]
                found[powers] = found.get(powers, Fraction(0)) + exact * factor
        return Polynomial(
            self.states, self.center, self.scale, {k: v for k, v in found.items() if v}
        )

    def _along(self, x: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return T_0, ..., T_N of one variable with two derivatives, shape (B, N + 1) each."""
        scale = float(self.scale[i])
        z = (x[:, i] - float(self.center[i])) / scale
        found = np.zeros((3, len(x), self.degree + 1))
        found[0, :, 0] = 1.0
        if self.degree:
            found[0, :, 1], found[1, :, 1] = z, 1.0
        for k in range(2, self.degree + 1):
            t, d, dd = found[:, :, k - 1]
            found[0, :, k] = 2.0 * z * t - found[0, :, k - 2]
            found[1, :, k] = 2.0 * (t + z * d) - found[1, :, k - 2]
            found[2, :, k] = 2.0 * (2.0 * d + z * dd) - found[2, :, k - 2]
        return found[0], found[1] / scale, found[2] / scale**2


def _monomials(degree: int) -> list[list[int]]:
    """Return the coefficients of T_0, ..., T_N by powers."""
    found = [[1], [0, 1]]
    for _ in range(2, degree + 1):
        raised = [0, *(2 * c for c in found[-1])]
        found.append([c - d for c, d in itertools.zip_longest(raised, found[-2], fillvalue=0)])
    return found


_BANK = 2**14
_WIDENED = 1.02
_HALVINGS = 45
_DECIMALS = 3


@dataclass(frozen=True)
class Domain:
    """The safe set C within a workspace, from which states are drawn.

    Attributes:
        plant: the system.
        low: lower ends of the workspace, shape (n,).
        high: upper ends, shape (n,).
        closed: states at whose ends no episode ends, so that psi has to be <= 0 there: those of
            which the workspace holds one period, shape (n,).
        seed: of the draws that find C.

    Raises:
        ConfigurationError: No state of C was found, or the workspace is unbounded.
    """

    plant: Plant
    low: np.ndarray
    high: np.ndarray
    closed: np.ndarray
    seed: int = 0

    @classmethod
    def of(cls, plant: Plant, closed: Sequence[bool], seed: int = 0) -> Domain:
        """Return the domain of a plant.

        Args:
            plant: the system.
            closed: see the class.
            seed: see the class.

        Raises:
            ConfigurationError: See the class.
        """
        ends = np.array([[float(e) for e in pair] for pair in plant.workspace])
        unbounded = [
            str(s) for s, own in zip(plant.states, ends, strict=True) if not np.isfinite(own).all()
        ]
        if unbounded:
            raise ConfigurationError(
                f"the workspace is unbounded in {', '.join(unbounded)}, where no polynomial is"
                " bounded; give the states a finite range"
            )
        return cls(plant, ends[:, 0], ends[:, 1], np.array(closed, dtype=bool), seed)

    @property
    def region(self) -> Region:
        """The workspace."""
        none = np.zeros(len(self.low), dtype=bool)
        return Region(self.low, self.high, none, none)

    @cached_property
    def bank(self) -> np.ndarray:
        """States that fill C, shape (B, n)."""
        rng = np.random.default_rng(self.seed)
        found = sample("the safe set", self.level, self.region, _BANK, rng).points
        return found[self.inside(found)]

    @cached_property
    def frame(self) -> tuple[tuple[Fraction, ...], tuple[Fraction, ...]]:
        """Center and half widths of a box around C, in short decimals, n of each."""
        low, high = self.bank.min(axis=0), self.bank.max(axis=0)
        if self.even:
            high = np.maximum(high, -low)
            low = -high
        center, half = (low + high) / 2.0, _WIDENED * (high - low) / 2.0
        low, high = np.maximum(self.low, center - half), np.minimum(self.high, center + half)
        return (
            tuple(_decimal(c, round) for c in (low + high) / 2.0),
            tuple(_decimal(r, np.ceil) for r in (high - low) / 2.0),
        )

    @cached_property
    def even(self) -> bool:
        """Whether all is the same at x and -x, so that psi may be: with the inputs u or -u."""
        p = self.plant
        mirrored = {s: -s for s in p.states}
        ends = [(*p.workspace,), (*p.bounds,)]
        if any(low + high != 0 for low, high in ends[0]) or p.policy or self.closed.any():
            return False

        def parity(entries: Any) -> int:
            """Return 1 for even entries, -1 for odd ones, 0 for others."""
            for sign in (1, -1):
                if all(sp.expand(e.subs(mirrored) - sign * e) == 0 for e in entries):
                    return sign
            return 0

        symmetric = all(low + high == 0 for low, high in ends[1])
        sigma = sp.Matrix(p.diffusion)
        effects = [parity(column) for column in zip(*p.input_matrix, strict=True)]
        return (
            all(parity([h]) == 1 for h in p.barriers)
            and all(e.subs(mirrored) + e == 0 for e in map(sp.expand, p.drift))
            and parity(sigma * sigma.T) == 1
            and all(e == -1 or (e == 1 and symmetric) for e in effects)
        )

    @cached_property
    def _barriers(self) -> Any:
        return compile_function(self.plant.states, self.plant.barriers, "arrays")

    def level(self, x: np.ndarray) -> np.ndarray:
        """Return the smallest h of states (B, n), shape (B,)."""
        with np.errstate(all="ignore"):
            return at_states(self._barriers, x).min(axis=1)

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Return which states (B, n) are in C and in the workspace, shape (B,)."""
        within = ((x >= self.low) & (x <= self.high)).all(axis=1)
        return within & (self.level(x) >= 0.0)

    def wrapped(self, x: np.ndarray) -> np.ndarray:
        """Return states (B, n) whose angles are in the one period that the workspace holds."""
        period = self.high - self.low
        return np.where(self.closed, self.low + (x - self.low) % period, x)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw states of C, more of them near its edge.

        Args:
            count: of draws, some of which may be outside.
            rng: of the draws.

        Returns:
            Shape (B, n), B <= count.
        """
        x, end, _ = self._rays(count, rng)
        share = 1.0 - rng.random(len(x)) ** 2
        found = x + share[:, None] * (end - x)
        return found[self.inside(found)]

    def draw_edge(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw states of C where an h is 0, or at an end where no episode ends.

        Args:
            count: of draws, some of which may leave the workspace instead.
            rng: of the draws.

        Returns:
            Shape (B, n).
        """
        _, end, leaves = self._rays(count, rng)
        found = [end[leaves]]
        for i in np.flatnonzero(self.closed).tolist():
            for value in (self.low[i], self.high[i]):
                moved = self.bank[rng.integers(len(self.bank), size=count // 2)].copy()
                moved[:, i] = value
                found.append(moved[self.inside(moved)])
        return np.concatenate(found)

    def cells(self, x: np.ndarray, count: int) -> np.ndarray:
        """Return the number of the cell in which each state is.

        Args:
            x: states, shape (B, n).
            count: of cells, about.

        Returns:
            Shape (B,).
        """
        n = x.shape[1]
        center, scale = (np.array([float(v) for v in part]) for part in self.frame)
        along = math.ceil(count ** (1.0 / n))
        place = (((x - center) / scale + 1.0) / 2.0 * along).astype(int).clip(0, along - 1)
        return np.asarray(np.ravel_multi_index(tuple(place.T), (along,) * n))

    def _rays(
        self, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return starts of rays in C, where they leave it, and which do so within the workspace."""
        x = self.bank[rng.integers(len(self.bank), size=count)]
        direction = rng.standard_normal(x.shape) * np.array([float(s) for s in self.frame[1]])
        # A quarter of the rays lies in the ends of the workspace, where a polynomial may be large.
        i, upper = rng.integers(x.shape[1], size=count), rng.random(count) < 0.5
        moved, each = x.copy(), np.arange(count)
        moved[each, i] = np.where(upper, self.high[i], self.low[i])
        ends = (rng.random(count) < 0.25) & self.inside(moved) & (x.shape[1] > 1)
        x = np.where(ends[:, None], moved, x)
        direction[each[ends], i[ends]] = 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ahead = np.where(direction > 0.0, self.high - x, self.low - x) / direction
        longest = np.nanmin(np.where(direction == 0.0, np.inf, ahead), axis=1)
        leaves = self.level(x + longest[:, None] * direction) < 0.0
        low, high = np.where(leaves, 0.0, longest), longest.copy()
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            within = self.level(x + middle[:, None] * direction) >= 0.0
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        return x, x + low[:, None] * direction, leaves


def at_states(function: Any, x: np.ndarray) -> np.ndarray:
    """Return what a compiled function gives at states.

    Args:
        function: of the components of a state.
        x: states, shape (B, n).

    Returns:
        Shape (B, number of expressions).
    """
    parts = function(*np.ascontiguousarray(x.T))
    return np.stack([np.broadcast_to(np.asarray(p, dtype=float), len(x)) for p in parts], axis=1)


def _decimal(value: float, rounding: Any) -> Fraction:
    """Return a number near a value, with few decimals for its size."""
    power = _DECIMALS - int(np.floor(np.log10(abs(value)))) if value else 0
    unit = Fraction(10) ** -power
    return Fraction(int(rounding(value / float(unit)))) * unit


@dataclass(frozen=True)
class Samples:
    """States with the values of a basis and of its generator.

    Attributes:
        states: shape (B, n).
        values: of the members of the basis, shape (B, K).
        drift: L_f phi + 1/2 tr(sigma' D2phi sigma) of each member phi; along the policy where
            there is one, shape (B, K).
        inputs: L_g phi; of no input where there is a policy, shape (B, m, K).
    """

    states: np.ndarray
    values: np.ndarray
    drift: np.ndarray
    inputs: np.ndarray

    def joined(self, other: Samples) -> Samples:
        """Return the states of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Samples(*(np.concatenate(pair) for pair in pairs))

    def only(self, chosen: np.ndarray) -> Samples:
        """Return the states that a mask or indices choose."""
        return Samples(*(part[chosen] for part in vars(self).values()))

    def along(self, inputs: np.ndarray) -> np.ndarray:
        """Return the generator of each member along inputs (B, m), shape (B, K)."""
        return self.drift + np.einsum("bm,bmk->bk", inputs, self.inputs)


@dataclass(frozen=True)
class Generator:
    """Lie derivatives and Ito corrections at states.

    Attributes:
        plant: the system.
    """

    plant: Plant

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lower and upper bounds of the inputs, shape (m, 2); of none where there is a policy."""
        if self.plant.policy:
            return np.zeros((0, 2))
        return np.array([[float(e) for e in pair] for pair in self.plant.bounds]).reshape(-1, 2)

    @cached_property
    def _parts(self) -> tuple[Any, Any, Any]:
        p = self.plant
        drift, effect = sp.Matrix(p.drift), sp.Matrix(p.input_matrix)
        if p.policy:
            drift, effect = drift + effect * sp.Matrix(p.policy), sp.zeros(len(p.states), 0)
        sigma = sp.Matrix(p.diffusion) if p.diffusion[0] else sp.zeros(len(p.states), 1)
        return (
            compile_function(p.states, drift.flat(), "arrays"),
            compile_function(p.states, effect.flat(), "arrays") if len(effect) else None,
            compile_function(p.states, (sigma * sigma.T).flat(), "arrays"),
        )

    def fields(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return drift (B, n), input matrix (B, n, m) and sigma sigma' (B, n, n) at states (B, n).

        Raises:
            NumericalError: One of them has no finite value at a state.
        """
        n = x.shape[1]
        drift, effect, covariance = self._parts
        with np.errstate(all="ignore"):
            found = (
                at_states(drift, x),
                at_states(effect, x).reshape(len(x), n, len(self.bounds))
                if effect is not None
                else np.zeros((len(x), n, 0)),
                at_states(covariance, x).reshape(len(x), n, n),
            )
        for part in found:
            bad = ~np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
            if bad.any():
                raise NumericalError(
                    "the system has no finite drift, input matrix or diffusion at the state"
                    f" {x[bad][0].tolist()} of the safe set"
                )
        return found

    def samples(self, basis: ChebyshevBasis, x: np.ndarray) -> Samples:
        """Return a basis and its generator at states.

        Args:
            basis: whose members are taken.
            x: states, shape (B, n).
        """
        drift, effect, covariance = self.fields(x)
        jets = basis.jets(x)
        rates = np.einsum("bn,bnk->bk", drift, jets.gradients)
        rates += 0.5 * np.einsum("bij,bijk->bk", covariance, jets.hessians)
        return Samples(x, jets.values, rates, np.einsum("bnm,bnk->bmk", effect, jets.gradients))

    def largest_rate(self, samples: Samples, coefficients: np.ndarray) -> np.ndarray:
        """Return the largest A psi along inputs within the bounds, shape (B,).

        Args:
            samples: states, B of them.
            coefficients: of psi.
        """
        effect = samples.inputs @ coefficients
        low, high = self.bounds.T
        return samples.drift @ coefficients + np.maximum(low * effect, high * effect).sum(axis=1)

    def best_inputs(self, samples: Samples, coefficients: np.ndarray, band: float) -> np.ndarray:
        """Return inputs within the bounds that raise psi most, or nearly.

        They are continuous: inputs that jump where L_g psi changes its sign let a linear program
        move that change between the sampled states, where its inequality fails then.

        Args:
            samples: states, B of them.
            coefficients: of psi.
            band: effect of an input on the rate of psi, in 1/s, below which it is in proportion to
                the effect: a quarter of it is lost at most.

        Returns:
            Shape (B, m).
        """
        low, high = self.bounds.T
        half = (high - low) / 2.0
        effect = samples.inputs @ coefficients
        return (low + high) / 2.0 + half * np.clip(effect * half / band, -1.0, 1.0)


Witness = Callable[[np.ndarray], np.ndarray]
"""From states (B, n) to inputs (B, m)."""


def witnesses_of(
    generator: Generator, domain: Domain, nominal: tuple[sp.Expr, ...]
) -> dict[str, Witness]:
    """Return inputs to begin with, by name: the better of them is found by trying.

    Args:
        generator: of the plant.
        domain: the safe set.
        nominal: laws of the nominal controller, of the states; () where it is none.

    Returns:
        The input that raises the smallest h fastest, where that has relative degree 1; a linear
        feedback that holds the plant at the state with the largest h; the nominal controller; the
        middle of the bounds. Just one for a plant without a free input.
    """
    middle = generator.bounds.mean(axis=1)
    found: dict[str, Witness] = {}
    if len(middle):
        found["ascent of h"] = _ascent(generator, domain)
        regulator = _regulator(generator, domain)
        if regulator is not None:
            found["linear regulator"] = regulator
        if nominal:
            found["nominal controller"] = _law(generator, domain.plant, nominal)
    return found | {"constant input": lambda x: np.broadcast_to(middle, (len(x), len(middle)))}


def _law(generator: Generator, plant: Plant, laws: tuple[sp.Expr, ...]) -> Witness:
    compiled = compile_function(plant.states, laws, "arrays")
    low, high = generator.bounds.T

    def inputs(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            values = at_states(compiled, x)
        return np.where(np.isfinite(values), values, (low + high) / 2.0).clip(low, high)

    return inputs


def _ascent(generator: Generator, domain: Domain) -> Witness:
    plant = domain.plant
    levels = compile_function(plant.states, plant.barriers, "arrays")
    slopes = compile_function(
        plant.states, [sp.diff(h, s) for h in plant.barriers for s in plant.states], "arrays"
    )
    low, high = generator.bounds.T

    def inputs(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            gradients = at_states(slopes, x).reshape(len(x), len(plant.barriers), -1)
            nearest = at_states(levels, x).argmin(axis=1)
        gradient = np.nan_to_num(gradients[np.arange(len(x)), nearest])
        effect = np.einsum("bn,bnm->bm", gradient, generator.fields(x)[1])
        return np.where(effect > 0.0, high, np.where(effect < 0.0, low, (low + high) / 2.0))

    return inputs


def _regulator(generator: Generator, domain: Domain) -> Witness | None:
    """Return u_0 - K (x - x_0), clipped, or nothing where the plant cannot be stabilised so."""
    from scipy.linalg import LinAlgError, solve_continuous_are

    plant = domain.plant
    best = domain.bank[domain.level(domain.bank).argmax()]
    scale = np.array([float(s) for s in domain.frame[1]])
    half = np.diff(generator.bounds, axis=1)[:, 0] / 2.0
    drift, effect, _ = generator.fields(best[None])
    b = effect[0] * half / scale[:, None]
    try:
        jacobian = sp.Matrix(plant.drift).jacobian(list(plant.states))
        slopes = at_states(compile_function(plant.states, jacobian.flat(), "arrays"), best[None])
        a = slopes.reshape(len(scale), -1) * scale / scale[:, None]
        cost = solve_continuous_are(a, b, np.eye(len(scale)), np.eye(len(half)))
    except (LinAlgError, ValueError, SystemDefinitionError):
        return None
    gain = half[:, None] * (b.T @ cost) / scale
    low, high = generator.bounds.T
    holding = np.linalg.lstsq(effect[0], -drift[0], rcond=None)[0].clip(low, high)
    return lambda x: (holding - (x - best) @ gain.T).clip(low, high)


@dataclass(frozen=True)
class BarrierCandidate:
    """A barrier psi whose numbers hold at many states, which proves nothing.

    Attributes:
        basis: of psi.
        coefficients: of its members, shape (K,).
        bound: with the rate and the horizon.
        shortfall: m, as sampled.
        supremum: c, as sampled.
        mean: of the bound over the starts.
        program: mean of the bound by the linear program, which knows fewer states.
        rounds: linear programs that were solved.
    """

    basis: ChebyshevBasis
    coefficients: np.ndarray
    bound: MeanBound
    shortfall: float
    supremum: float
    mean: float
    program: float
    rounds: int

    def embedded(self, basis: ChebyshevBasis) -> BarrierCandidate:
        """Return the same barrier in a basis that has all members of its own."""
        coefficients = basis.embedded(self.basis, self.coefficients)
        return replace(self, basis=basis, coefficients=coefficients)

    def psi(self, x: np.ndarray) -> np.ndarray:
        """Return psi of states (B, n), shape (B,)."""
        return self.basis.values(x) @ self.coefficients


_LEVELS = (-1.0, 0.0, 1.0)
"""Effects of an input for its band, at which states are taken along the sign change of L_g psi."""


class AskedClaims(NamedTuple):
    """What a linear program asks at states.

    Attributes:
        inputs: along which the generator inequality is asked, shape (B, m).
        generator: whether it is asked; where it is not, psi <= 0 is, shape (B,).
    """

    inputs: np.ndarray
    generator: np.ndarray

    def only(self, chosen: np.ndarray) -> AskedClaims:
        """Return what is asked at the states that a mask or indices choose."""
        return AskedClaims(self.inputs[chosen], self.generator[chosen])

    def joined(self, other: AskedClaims) -> AskedClaims:
        """Return what is asked at the states of both."""
        return AskedClaims(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


@dataclass(frozen=True, eq=False)
class Reference:
    """What fixes the inputs of a linear program: a law, or a barrier that they raise.

    The inequality with the best input for each psi is not convex in psi. With the best input for
    the last psi it is, and the last psi still meets it.

    Attributes:
        generator: of the plant.
        domain: the safe set.
        given: the law, or the barrier.
        band: see `Generator.best_inputs`, in 1/s.
    """

    generator: Generator
    domain: Domain
    given: Witness | BarrierCandidate
    band: float

    def asked(self, basis: ChebyshevBasis, samples: Samples) -> AskedClaims:
        """Return what is asked at states.

        Args:
            basis: of the samples.
            samples: states.
        """
        old = self.given
        if not isinstance(old, BarrierCandidate):
            return AskedClaims(old(samples.states), np.ones(len(samples.states), dtype=bool))
        if basis != old.basis:
            samples = self.generator.samples(old.basis, samples.states)
        psi = samples.values @ old.coefficients
        rate = self.generator.largest_rate(samples, old.coefficients)
        met = rate + old.bound.rate * psi + old.shortfall >= 0.0
        inputs = self.generator.best_inputs(samples, old.coefficients, self.band)
        return AskedClaims(inputs, (psi > 0.0) | met)

    def sign_changes(self, states: np.ndarray) -> np.ndarray:
        """Return states of G near those where an input changes its sign; none for a law.

        The given inputs vary most there, so that more states are needed.

        Args:
            states: of C, to begin at, shape (B, n).
        """
        old, found = self.given, [states[:0]]
        if not isinstance(old, BarrierCandidate):
            return found[0]
        c, half = old.coefficients, np.diff(self.generator.bounds, axis=1)[:, 0] / 2.0
        near = self.generator.samples(old.basis, states)
        near = near.only(near.values @ c > 0.0)
        cells = self.domain.cells(near.states, 10 * len(c))
        for j, h in enumerate(half):
            effect = np.abs(near.inputs[:, j] @ c)
            counts = np.zeros(len(effect), dtype=bool)
            counts[np.argsort(effect)[: 100 + 10 * len(c)]] = True
            begin = near.states[worst(-effect, cells, counts, 100 + 3 * len(c))]
            for level in _LEVELS if len(begin) else ():

                def distance(x: np.ndarray, j: int = j, e: float = level / h) -> np.ndarray:
                    own = self.generator.samples(old.basis, x).inputs[:, [j]]
                    return own @ c - e * self.band

                moved = towards_zero(distance, begin, self.domain.region)
                found.append(moved[self.domain.inside(moved)])
        return np.concatenate(found)


def worst(cost: np.ndarray, cell: np.ndarray, counts: np.ndarray, most: int) -> np.ndarray:
    """Return indices of the largest costs, one of each cell, of those that count.

    Args:
        cost: shape (B,).
        cell: number of the cell of each, shape (B,).
        counts: shape (B,).
        most: number of indices.
    """
    order = np.flatnonzero(counts)
    order = order[np.argsort(-cost[order], kind="stable")]
    _, first = np.unique(cell[order], return_index=True)
    return order[np.sort(first)][:most]
