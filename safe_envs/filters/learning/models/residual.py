"""Learned residuals of the derivatives of barriers: what the model gets wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, stacked, tabulated
from safe_envs.dynamics.lie import derivatives, lie_derivative_f, lie_derivative_g
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.learning.checks import require_degrees
from safe_envs.filters.learning.data import Signature
from safe_envs.filters.learning.models.base import LearnedModel, Record
from safe_envs.filters.learning.models.network import Network, network_source, require_activation
from safe_envs.problem.problem import SafetyProblem

_ROUNDING = 1e-12


_HELD_OUT = 0.15
"""Share of the states that `train` measures the network with."""


@dataclass(eq=False)
class LearnedResidual:
    """Residuals of one barrier: h^(j) = L_f^j h + Delta_j, j <= r, with Sigma u added in the last.

    f and g are those of the model.

    Attributes:
        states: n symbols.
        coordinates: p expressions of the states, the inputs of the network.
        degree: r, the relative degree of the model.
        network: from the coordinates to Delta_1, ..., Delta_r in units of h per s^j, and Sigma_1,
            ..., Sigma_m in units of h per s^r and unit of the input.
        heldout: absolute errors (N_h, r + m) of the network at states of the explored region that
            it was not trained on.
        symbols: r + m symbols that stand for its outputs in a row.

    Source: thesis Eq. (3.18).
    """

    states: tuple[sp.Symbol, ...]
    coordinates: tuple[sp.Expr, ...]
    degree: int
    network: Network
    heldout: np.ndarray
    symbols: tuple[sp.Symbol, ...] = field(init=False)

    def __post_init__(self) -> None:
        fits = (len(self.coordinates), self.heldout.shape[1:]) == (
            len(self.network.input_mean),
            self.network.output_mean.shape,
        )
        if not fits:
            raise ConfigurationError(
                f"{len(self.coordinates)} coordinates and errors {self.heldout.shape} do not fit"
                " the network"
            )
        inputs = self.heldout.shape[1] - self.degree
        self.symbols = tuple(
            sp.Dummy(name, real=True)
            for name in residual_names(self.degree, [str(i + 1) for i in range(inputs)])
        )
        self._floats = compile_function(self.states, self.coordinates, "floats")
        self._arrays = compile_function(self.states, self.coordinates, "arrays")

    def floats(self, x: Sequence[float]) -> Sequence[float]:
        """Return the r + m residuals at one state."""
        return self.network.floats(self._floats(*x))

    def arrays(self, x: Components) -> Components:
        """Return the residuals at states: n components (B,) in, r + m components (B,) out."""
        return self.network.arrays(tuple(stacked(self._arrays(*x), len(x[0])).T))

    def source(self, name: str, data: Data) -> Source:
        """See `safe_envs.filters.conditions.base.Terms.source`."""
        chart, network = f"{name}_coordinates", f"{name}_network"
        return (
            formulas(chart, {"x": self.states}, self.coordinates, data)
            + network_source(self.network, network, data)
            + Source(
                f"def {name}(x, data, work):\n    return {network}({chart}(x, data), data, work)\n"
            )
        )

    def eps(self, level: float) -> np.ndarray:
        """Return errors (r + m,) that a fresh state exceeds with probability at most 1 - level.

        They are those of rank ceil(level (n + 1)) among the n at held-out states, for each residual
        by itself. That holds for states that are drawn as those were, on average over what is
        learned; outside the explored region it means nothing, for the network extrapolates there.

        Raises:
            ConfigurationError: the level is not in [0, 1], or higher than this many held-out states
                can tell.

        Source: split conformal prediction, Vovk, Gammerman and Shafer, Algorithmic Learning in a
            Random World, 2005.
        """
        if not 0 <= level <= 1:
            raise ConfigurationError(f"level = {shown(level)}; give a share from 0 to 1")
        n = len(self.heldout)
        # A level such as .95 is no binary number: 20 times it has to count as 19.
        rank = max(1, math.ceil(level * (n + 1) - _ROUNDING * n))
        if rank > n:
            raise ConfigurationError(
                f"level = {shown(level)} is more than {n} held-out states can tell;"
                f" {_remedy(level, n)}"
            )
        return np.sort(self.heldout, axis=0)[rank - 1]


@dataclass(eq=False)
class ResidualModel(LearnedModel):
    """The residuals of all barriers of a problem.

    Attributes:
        parts: one for each barrier.
    """

    signature: Signature
    record: Record
    parts: tuple[LearnedResidual, ...]
    method = "learned-hocbf"

    def arrays(self) -> dict[str, np.ndarray]:
        """Networks and held-out errors, by name."""
        found: dict[str, np.ndarray] = {}
        for i, part in enumerate(self.parts):
            found |= {**part.network.to_arrays(f"part_{i}"), f"part_{i}_heldout": part.heldout}
        return found

    def details(self) -> dict[str, Any]:
        """Relative degrees and activations of the parts, and their common coordinates."""
        return {
            "degrees": [part.degree for part in self.parts],
            "activations": [part.network.activation for part in self.parts],
            "coordinates": [str(c) for c in self.parts[0].coordinates],
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
            ConfigurationError: the problem is explored in other coordinates now, or the numbers do
                not fit.
        """
        coordinates = problem.sampling_domain.coordinates
        if [str(c) for c in coordinates] != details["coordinates"]:
            raise ConfigurationError(
                f"it has the coordinates {shown(details['coordinates'])}, those of {problem.name}"
                f" are {coordinates}"
            )
        require_degrees(problem, details["degrees"])
        parts = []
        for i, (degree, activation) in enumerate(
            zip(details["degrees"], details["activations"], strict=True)
        ):
            require_activation(activation)
            network, heldout = (
                Network.from_arrays(arrays, f"part_{i}", activation),
                arrays[f"part_{i}_heldout"].astype(float),
            )
            if (
                heldout.shape != (len(heldout), degree + problem.plant.m)
                or not heldout.size
                or not (heldout >= 0).all()
            ):
                raise ValueError(f"errors of the shape {heldout.shape}, or below 0")
            parts.append(
                LearnedResidual(problem.plant.states, coordinates, degree, network, heldout)
            )
        return cls(Signature.of(problem), record, tuple(parts))

    @classmethod
    def check(cls, signature: Signature, problem: SafetyProblem) -> None:
        """Raise LearnedFileError unless system, barriers and model are the same."""
        signature.require(problem, "barriers", "model")

    def compare(
        self, problem: SafetyProblem, x: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return truth (plant less model) and estimate of each; see `LearnedModel.compare`."""
        states, found = np.ascontiguousarray(x.T), {}
        for barrier, part in zip(problem.barriers, self.parts, strict=True):
            systems = (problem.plant, problem.model)
            plant, model = (
                lie_derivatives(system, barrier.expression, part.degree)(x) for system in systems
            )
            names = residual_names(part.degree, [i.symbol.name for i in problem.inputs])
            # The first column is h itself.
            pairs = zip((plant - model).T[1:], part.arrays(tuple(states)), strict=True)
            found |= {
                f"{barrier.name} {name}": pair for name, pair in zip(names, pairs, strict=True)
            }
        return found


def lie_derivatives(
    system: ControlAffineSDE, h: sp.Expr, degree: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of states (N, n) that gives Lie derivatives, side by side (N, 1 + r + m).

    They are h, L_f h, ..., L_f^r h and the m entries of L_g L_f^(r-1) h.

    Args:
        system: with f and g.
        h: expression of the states.
        degree: r.
    """
    along = derivatives(system, h, degree, lie_derivative_f)
    expressions = [
        system.numeric(e) for e in (*along, *lie_derivative_g(system, along[degree - 1]))
    ]
    return tabulated(system.states, expressions)


def _remedy(level: float, heldout: int) -> str:
    """Say how to get errors of a level for which there are too few held-out states."""
    highest = f"give a level up to {math.floor(1000 * heldout / (heldout + 1)) / 1000}"
    if level == 1:
        return f"{highest}: no number of states tells the largest error"
    more = math.ceil(level / (1 - level) - _ROUNDING * heldout) - heldout
    return (
        f"learn with about {math.ceil(more / _HELD_OUT)} more states, of which {more} are held out,"
        f" or {highest}"
    )


def residual_names(degree: int, inputs: Sequence[str]) -> list[str]:
    """Return the names of Delta_1, ..., Delta_r, Sigma_1, ..., Sigma_m.

    Args:
        degree: r.
        inputs: names of the m inputs.
    """
    return [*(f"Delta_{j}" for j in range(1, degree + 1)), *(f"Sigma_{name}" for name in inputs)]
