"""Learned generators of barriers under unknown noise."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, filled
from safe_envs.dynamics.lie import derivatives, generator, lie_derivative_f
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.learning.checks import require_degrees
from safe_envs.filters.learning.data import LearnedFileError, Signature, array_of
from safe_envs.filters.learning.models.base import LearnedModel, Record
from safe_envs.filters.learning.models.features import Features
from safe_envs.filters.learning.models.network import Network, network_source, slopes_source
from safe_envs.problem.problem import Barrier, SafetyProblem

_SINGULAR = 1e-12
"""Least eigenvalue of a constant covariance, as part of the largest one: what is below cannot be
told from rounding."""


@dataclass(frozen=True, eq=False)
class Entry:
    """An entry of the covariance, and of its mirror image, that is not zero everywhere.

    Attributes:
        row: its index i.
        column: its index j >= i.
        features: on which it was regressed.
        weights: of the features, shape (M,), in units of x_i x_j per s.
    """

    row: int
    column: int
    features: Features
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class LearnedDiffusion:
    """C(x) = sigma sigma', each entry a polynomial of degree 0 to 2 in the scaled states.

    A regression knows no signs: where an entry of the diagonal is near 0 it may come out slightly
    negative. Generators only contain C itself, so that nothing is made of that; but see `system`.

    Attributes:
        states: n symbols.
        entries: those that are not zero.
    """

    states: tuple[sp.Symbol, ...]
    entries: tuple[Entry, ...]

    @cached_property
    def covariance(self) -> sp.ImmutableMatrix:
        """C, n x n expressions of the states."""
        matrix = sp.zeros(len(self.states))
        for entry in self.entries:
            matrix[entry.row, entry.column] = matrix[entry.column, entry.row] = (
                entry.features.combined(entry.weights.tolist())
            )
        return sp.ImmutableMatrix(matrix)

    def system(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """Return the model with a diffusion L for which L L' = C.

        L is a Cholesky factor in symbols, whose roots cancel in L L': `ito_correction`, and with it
        every generator, sees the polynomials themselves. To evaluate L is another matter: where the
        regressed C is not positive definite, its roots have no real value. A constant C is
        projected to a positive semidefinite one first.

        Args:
            model: with the same states; its own diffusion is ignored.
        """
        matrix = self.covariance
        factor = _cholesky(matrix if matrix.free_symbols else _projected(matrix))
        live = [j for j in range(factor.cols) if factor[j, j] != 0]
        return replace(model, diffusion=factor[:, live] if live else sp.zeros(model.n, 1))

    def details(self) -> list[dict[str, Any]]:
        """Return all but the weights, for JSON."""
        return [{"row": e.row, "column": e.column, **e.features.details()} for e in self.entries]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the weights by name."""
        return {_name(e.row, e.column): e.weights for e in self.entries}

    @classmethod
    def restored(
        cls,
        states: tuple[sp.Symbol, ...],
        details: Sequence[Mapping[str, Any]],
        arrays: Mapping[str, np.ndarray],
    ) -> LearnedDiffusion:
        """Make it again of what `details` and `to_arrays` gave.

        Args:
            states: n symbols.
            details: see `details`.
            arrays: see `to_arrays`.

        Raises:
            KeyError: a part is missing.
            ValueError: the parts do not fit.
        """
        entries, places = [], {(i, j) for j in range(len(states)) for i in range(j + 1)}
        for d in details:
            # Each place once.
            places.remove((d["row"], d["column"]))
            features = Features.restored(states, d)
            weights = array_of(arrays, _name(d["row"], d["column"]), (features.count,))
            entries.append(Entry(int(d["row"]), int(d["column"]), features, weights))
        return cls(states, tuple(entries))


def _projected(matrix: sp.ImmutableMatrix) -> sp.ImmutableMatrix:
    """Return the nearest positive semidefinite matrix of numbers, with positive pivots or 0."""
    numbers = np.array(matrix, dtype=float)
    live = np.flatnonzero(numbers.diagonal())
    values, vectors = np.linalg.eigh(numbers[np.ix_(live, live)])
    if not len(live) or values[0] >= _SINGULAR * values[-1]:
        return matrix
    numbers[np.ix_(live, live)] = vectors * np.maximum(values, _SINGULAR * values[-1]) @ vectors.T
    return sp.ImmutableMatrix(numbers.tolist())


def _cholesky(matrix: Any) -> sp.ImmutableMatrix:
    """Lower triangular L with L L' = C, in symbols; a state without noise has an empty column."""
    n = matrix.rows
    factor: Any = sp.zeros(n)
    for j in range(n):
        pivot = matrix[j, j] - sum(factor[j, k] ** 2 for k in range(j))
        if pivot == 0:
            continue
        factor[j, j] = sp.sqrt(pivot)
        for i in range(j + 1, n):
            factor[i, j] = (
                matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))
            ) / factor[j, j]
    return sp.ImmutableMatrix(factor)


def _name(row: int, column: int) -> str:
    return f"covariance_{row}_{column}"


ACTIVATION = "tanh"


@dataclass(frozen=True, eq=False)
class LearnedGenerator:
    """The terms M_j that noise adds to the derivatives of a barrier: A^j h = L_f^j h + M_j + ....

    These are `safe_envs.filters.conditions.base.Terms`: a constraint takes M_r and, for
    r >= 2, the slopes of M_(r-1), for

        A^r h(x, u) = L_f^r h + M_r + (L_g L_f^(r-1) h + grad M_(r-1) . g) u.

    Attributes:
        states: n symbols.
        coordinates: expressions of the states that the networks take.
        networks: M_1..M_r, each in the units of h per s^j.
        symbols: of M_r, then of dM_(r-1)/dx_1..dx_n where r >= 2.

    Source: thesis Sec. 5.3, for r = 1.
    """

    states: tuple[sp.Symbol, ...]
    coordinates: tuple[sp.Expr, ...]
    networks: tuple[Network, ...]
    symbols: tuple[sp.Symbol, ...] = field(init=False)

    def __post_init__(self) -> None:
        names = ["M", *(f"M_{s}" for s in self.states)] if len(self.networks) > 1 else ["M"]
        object.__setattr__(self, "symbols", tuple(sp.Dummy(name, real=True) for name in names))
        for network in self.networks:
            if (len(network.input_mean), len(network.output_mean)) != (len(self.coordinates), 1):
                raise ValueError(
                    f"a network of {len(network.input_mean)} inputs and {len(network.output_mean)}"
                    " outputs does not fit"
                )

    @property
    def degree(self) -> int:
        """The relative degree r."""
        return len(self.networks)

    @cached_property
    def _chart(self) -> tuple[Callable[..., Components], Callable[..., Components]]:
        """The coordinates, then their derivatives by every state; over floats, and over arrays."""
        read = (*self.coordinates, *(sp.diff(c, s) for c in self.coordinates for s in self.states))
        return compile_function(self.states, read, "floats"), compile_function(
            self.states, read, "arrays"
        )

    def floats(self, x: Sequence[float]) -> list[float]:
        """Return the values of the symbols at one state, given by components."""
        read, p = self._chart[0](*x), len(self.coordinates)
        value = self.networks[-1].floats(read[:p])
        return (
            value
            if self.degree == 1
            else value
            + self._by_states(self.networks[-2].values_and_slopes_floats(read[:p], 0)[1], read[p:])
        )

    def arrays(self, x: Components) -> Components:
        """Return the values of the symbols at a batch of states, components (B,) in and out."""
        value = self.networks[-1].arrays(self.coordinates_at(x))
        return value if self.degree == 1 else (*value, *self.slopes(self.degree - 1, x))

    def source(self, name: str, data: Data) -> Source:
        """See `safe_envs.filters.conditions.base.Terms.source`."""
        read, value, slopes, chain = (
            f"{name}_{part}" for part in ("coordinates", "value", "slopes", "by_states")
        )
        values = f"{value}(read, data, work)"
        found = formulas(read, {"x": self.states}, self.coordinates, data)
        found += network_source(self.networks[-1], value, data)
        if self.degree > 1:
            symbols = sp.symbols(f"_slope:{len(self.coordinates)}", real=True)
            pairs = list(zip(symbols, self.coordinates, strict=True))
            by_states = [sp.Add(*(k * sp.diff(c, s) for k, c in pairs)) for s in self.states]
            found += slopes_source(self.networks[-2], slopes, data, 0)
            found += formulas(chain, {"x": self.states, "slopes": symbols}, by_states, data)
            values += f" + {chain}(x, {slopes}(read, data, work), data)"
        text = f"def {name}(x, data, work):\n    read = {read}(x, data)\n    return {values}\n"
        return found + Source(text)

    def slopes(self, order: int, x: Components) -> Components:
        """Return dM_j/dx_1..dx_n.

        Args:
            order: j, from 1.
            x: states, n components (B,).

        Returns:
            n components (B,).
        """
        read, p = self._chart[1](*x), len(self.coordinates)
        return tuple(
            self._by_states(
                self.networks[order - 1].values_and_slopes_arrays(self.coordinates_at(x), 0)[1],
                read[p:],
            )
        )

    def coordinates_at(self, x: Components) -> list[np.ndarray]:
        """Return the coordinates at a batch of states, components (B,) in and out."""
        return [filled(c, x[0].shape) for c in self._chart[1](*x)[: len(self.coordinates)]]

    def _by_states(self, slopes: Sequence[Any], chart: Components) -> list[Any]:
        """Return slopes by the states, by the chain rule, of those by the coordinates."""
        n = len(self.states)
        return [sum(slope * chart[k * n + i] for k, slope in enumerate(slopes)) for i in range(n)]


@dataclass(frozen=True, eq=False)
class GeneratorModel(LearnedModel):
    """Generators of barriers under noise that nobody knew, where f and g are known.

    Attributes:
        signature: of which system; without barriers where the diffusion was learned, which suits
            any.
        record: how it was learned.
        generators: of each barrier, the thesis' way; empty where the diffusion was learned.
        diffusion: the covariance of the noise, from which the generator of any barrier follows by
            differentiation.
    """

    method = "ddscbf"

    signature: Signature
    record: Record
    generators: tuple[LearnedGenerator, ...] = ()
    diffusion: LearnedDiffusion | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the numbers, by name."""
        if self.diffusion is not None:
            return self.diffusion.to_arrays()
        networks = [
            (f"barrier_{i}_order_{j}", m)
            for i, g in enumerate(self.generators)
            for j, m in enumerate(g.networks, start=1)
        ]
        return {
            name: array
            for prefix, network in networks
            for name, array in network.to_arrays(prefix).items()
        }

    def details(self) -> dict[str, Any]:
        """Return what else `restored` needs, JSON-able."""
        if self.diffusion is not None:
            return {"way": "direct", "entries": self.diffusion.details()}
        coordinates = [str(c) for c in self.generators[0].coordinates]
        return {
            "way": "network",
            "coordinates": coordinates,
            "degrees": [g.degree for g in self.generators],
        }

    @classmethod
    def restored(
        cls,
        problem: SafetyProblem,
        record: Record,
        details: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray],
    ) -> Self:
        """Make the model again; see `LearnedModel.restored`.

        Raises:
            LearnedFileError: the networks are functions of other coordinates.
        """
        states, coordinates = problem.plant.states, problem.sampling_domain.coordinates
        if details["way"] == "direct":
            return cls(
                Signature.of(problem),
                record,
                diffusion=LearnedDiffusion.restored(states, details["entries"], arrays),
            )
        if details["coordinates"] != [str(c) for c in coordinates]:
            raise LearnedFileError(
                f"what was learned takes the coordinates {shown(details['coordinates'])}, not"
                f" {coordinates}; learn again"
            )
        require_degrees(problem, details["degrees"])
        orders = [
            [f"barrier_{i}_order_{j}" for j in range(1, degree + 1)]
            for i, degree in enumerate(details["degrees"])
        ]
        networks = [
            tuple(Network.from_arrays(arrays, prefix, ACTIVATION) for prefix in prefixes)
            for prefixes in orders
        ]
        generators = tuple(LearnedGenerator(states, coordinates, found) for found in networks)
        return cls(Signature.of(problem), record, generators)

    @classmethod
    def check(cls, signature: Signature, problem: SafetyProblem) -> None:
        """Raise LearnedFileError where it is of no use for a problem; see `LearnedModel.check`.

        f and g of the model must be the same, and the barriers where their own generators were
        learned. What the model says about the noise does not matter: nothing of that was used.
        """
        model = problem.model
        used = {s.name for s in model.drift.free_symbols | model.input_matrix.free_symbols}
        believed = {p.name: value for p, value in model.parameters.items() if p.name not in used}
        known = replace(
            signature,
            model=tuple((name, believed.get(name, value)) for name, value in signature.model),
        )
        known.require(problem, "model", *(("barriers",) if signature.barriers else ()))

    def compare(
        self, problem: SafetyProblem, x: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return truth and estimate of M_r or of the covariance; see `LearnedModel.compare`.

        Raises:
            ConfigurationError: plant and model differ in f or g, and r >= 2: then M_r is no
                property of the plant alone.
        """
        plant, components = problem.plant, tuple(np.ascontiguousarray(x.T))
        pairs: dict[str, tuple[Any, Any]] = {}
        if self.diffusion is not None:
            truth, estimate = (
                plant.numeric(plant.diffusion * plant.diffusion.T),
                self.diffusion.covariance,
            )
            for i, j in itertools.combinations_with_replacement(range(plant.n), 2):
                read = compile_function(plant.states, (truth[i, j], estimate[i, j]), "arrays")
                pairs[f"C({plant.states[i]}, {plant.states[j]})"] = read(*components)
        for barrier, learned in zip(problem.barriers, self.generators, strict=False):
            read = compile_function(
                plant.states, (_noise_part(problem, barrier, learned.degree),), "arrays"
            )
            pairs[order_label(learned.degree, barrier)] = (
                read(*components)[0],
                learned.arrays(components)[0],
            )
        return {
            name: (filled(a, (len(x),)), filled(b, (len(x),))) for name, (a, b) in pairs.items()
        }


def _noise_part(problem: SafetyProblem, barrier: Barrier, degree: int) -> Any:
    """Return A^r h - L_f^r h of the plant, in symbols."""
    plant, model = problem.plant, problem.model
    fields = [
        [system.numeric(part) for part in (system.drift, system.input_matrix)]
        for system in (plant, model)
    ]
    if degree > 1 and fields[0] != fields[1]:
        raise ConfigurationError(
            f"plant and model of {problem.name} differ in f or g: there is no true M_{degree} to"
            " compare with"
        )
    with_noise, without = (
        derivatives(plant, barrier.expression, degree, d)[-1] for d in (generator, lie_derivative_f)
    )
    return plant.numeric(with_noise - without)


def order_label(order: int, barrier: Barrier) -> str:
    """Return the name of M_j of a barrier.

    Args:
        order: j.
        barrier: whose name is taken.
    """
    return f"M_{order}({barrier.name})"
