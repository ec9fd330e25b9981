"""What the model gets wrong in the derivatives of a barrier, learned from short paths of the plant
under held inputs.

A network says something everywhere, but it has seen states of the explored region only. Outside it
extrapolates, and the errors at held-out states, all of which are from that region, mean nothing
there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.dynamics.lie import derivatives, lie_derivative_f, lie_derivative_g, relative_degree
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.number_text import finite_number
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.base import LearnedModel, Progress, Record
from safe_envs.wrappers.learning.checks import (
    Purpose,
    random_stream,
    require_degrees,
    require_problem,
)
from safe_envs.wrappers.learning.data.collection import Step, collect_paths, draw_states
from safe_envs.wrappers.learning.fit import LEAST_ROWS, hidden_widths, train
from safe_envs.wrappers.learning.models.network import Network, require_activation
from safe_envs.wrappers.learning.models.signature import Signature

_ROUNDING = 1e-12

_HELD_OUT = 0.15
"""Share of the states that `train` measures the network with."""

_SHORTEST, _LONGEST = 1e-4, 100.0
"""Label steps in control periods. Of shorter ones the rounding of h takes over, over longer ones
the derivatives change."""

_MOST_DISAGREEMENT = 1e-3
"""Of derivatives below the relative degree between inputs, relative to their size: they are labels
of the same numbers."""


@dataclass(eq=False)
class LearnedResidual:
    """Residuals of one barrier: h^(j) = L_f^j h + Delta_j, j <= r, and Sigma u more in the last, f
    and g those of the model.

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
            for name in _names(self.degree, [str(i + 1) for i in range(inputs)])
        )
        self._floats = compile_function(self.states, self.coordinates, "floats")
        self._arrays = compile_function(self.states, self.coordinates, "arrays")

    def floats(self, x: Sequence[float]) -> Sequence[float]:
        """The r + m residuals at one state."""
        return self.network.floats(self._floats(*x))

    def arrays(self, x: Components) -> Components:
        """The residuals at a batch of states, n components (B,) in and r + m components (B,) out."""
        return self.network.arrays(tuple(stacked(self._arrays(*x), len(x[0])).T))

    def eps(self, level: float) -> np.ndarray:
        """The errors (r + m,) that a fresh state exceeds with a probability of at most 1 - level,
        each residual by itself.

        The error of rank ceil(level (n + 1)) among the n at held-out states. It holds for states
        that are drawn as those were, on average over what is learned; outside the explored region
        it means nothing, for the network extrapolates there.

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
        """Make the model again.

        Raises:
            ConfigurationError: the problem is explored in other coordinates now, or the numbers do
                not fit.
        """
        coordinates = problem.exploration.coordinates
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
        """Raise LearnedFileError unless system, barriers and model are those that were learned."""
        signature.require(problem, "barriers", "model")

    def compare(
        self, problem: SafetyProblem, x: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """(truth, estimate) of each residual at states (B, n), by name, values (B,); the truth
        symbolic, of plant less model."""
        states, found = np.ascontiguousarray(x.T), {}
        for barrier, part in zip(problem.barriers, self.parts, strict=True):
            systems = (problem.plant, problem.model)
            plant, model = (
                _lie_derivatives(system, barrier.expression, part.degree)(x) for system in systems
            )
            names = _names(part.degree, [i.symbol.name for i in problem.inputs])
            # The first column is h itself.
            pairs = zip((plant - model).T[1:], part.arrays(tuple(states)), strict=True)
            found |= {
                f"{barrier.name} {name}": pair for name, pair in zip(names, pairs, strict=True)
            }
        return found


def learn_residual(
    problem: SafetyProblem,
    *,
    states: int = 3000,
    label_dt: float = 1e-3,
    hidden: Sequence[int] = (100, 30),
    epochs: int = 500,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> ResidualModel:
    """Learn the residuals of a problem's barriers where it is explored.

    From each state every input of the exploration is held for r + 2 steps, r the largest relative
    degree.

    Args:
        problem: whose plant is observed, and whose model is corrected.
        states: number of states to learn from.
        label_dt: length of a step in s.
        hidden: width of each hidden layer of the networks.
        epochs: of training, at most.
        seed: of all randomness.
        step: the plant, if it is not the problem's; a step of it has to last `label_dt` and to be
            free of noise.
        progress: told how far the work is.

    Raises:
        ConfigurationError: an argument is out of its range, the plant is noisy, or the inputs
            cannot tell the residuals apart.
        RelativeDegreeError: a barrier has no relative degree.

    Source: thesis Sec. 3.4, Alg. 1, with the differences that `residual_labels` names.
    """
    began = time.perf_counter()
    require_problem(problem)
    require_whole("states", states, LEAST_ROWS)
    widths = hidden_widths(hidden)
    _require_label_dt(label_dt, problem.dt)
    if step is None and problem.plant.noisy:
        raise ConfigurationError(
            f"the plant of {problem.name} is noisy, and the derivatives of a noisy path do not"
            " exist; learn with noise=0, or use ddscbf or bayesian-scbf, which are for noise"
        )
    x = draw_states(problem, states, random_stream(seed, Purpose.STATES))
    labels, transitions = residual_labels(problem, x, label_dt, seed, step)
    coordinates = problem.exploration.coordinates
    inputs = stacked(
        compile_function(problem.plant.states, coordinates, "arrays")(*np.ascontiguousarray(x.T)),
        states,
    )
    parts, errors = [], {}
    for i, (barrier, (targets, sizes)) in enumerate(zip(problem.barriers, labels, strict=True)):
        trained = train(
            inputs,
            targets,
            hidden=widths,
            epochs=epochs,
            seed=seed,
            sizes=sizes,
            progress=_share(progress, i, len(labels)),
        )
        degree = targets.shape[1] - problem.plant.m
        parts.append(
            LearnedResidual(
                problem.plant.states, coordinates, degree, trained.network, trained.heldout
            )
        )
        errors |= _summary(
            barrier.name, _names(degree, [u.symbol.name for u in problem.inputs]), parts[-1]
        )
    settings = {"states": states, "label_dt": label_dt, "hidden": list(widths), "epochs": epochs}
    record = Record(
        transitions, transitions * label_dt, time.perf_counter() - began, seed, errors, settings
    )
    # The step of somebody else may be that of any plant.
    signature = Signature.of(problem) if step is None else replace(Signature.of(problem), plant=())
    return ResidualModel(signature, record, tuple(parts))


def residual_labels(
    problem: SafetyProblem, x: np.ndarray, label_dt: float, seed: int = 0, step: Step | None = None
) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
    """Residuals at states by forward differences along paths under held inputs.

    Derivative j of h where a path begins is a combination of all S + 1 samples, with an error of
    order label_dt^(S + 1 - j). Below the relative degree r it is the same for every input, and the
    mean is taken. Of order r, the excess over the model is Delta_r + Sigma u, solved for by least
    squares over the inputs.

    Args:
        problem: whose plant, model, barriers and inputs of exploration are taken.
        x: states (N, n).
        label_dt: length of a step in s.
        seed: of the plant's randomness, if it has any.
        step: the plant, if it is not the problem's.

    Returns:
        For each barrier the labels (N, r + m) of Delta_1, ..., Delta_r, Sigma_1, ..., Sigma_m, and
        the sizes (r + m,) of the plant's derivatives, of which they are a part; and the number of
        transitions that were observed.

    Raises:
        ConfigurationError: the inputs cannot tell Delta_r and Sigma apart, or an input acts on h
            before derivative r.

    Source: thesis Eq. (3.17), (3.23), (3.24), for any number of inputs. Eq. (3.28) prints the
        central second difference, half of
    which lies under another input: it gives half of the input's gain for every step.
    """
    tried = np.array(problem.exploration.inputs, dtype=float)
    split = _split_by_input(problem, tried)
    degrees = [relative_degree(problem.model, b.expression) for b in problem.barriers]
    steps = max(degrees) + 2
    paths = collect_paths(
        problem,
        np.repeat(x, len(tried), axis=0),
        np.tile(tried, (len(x), 1)),
        steps,
        label_dt,
        step,
        seed,
    )
    samples = np.ascontiguousarray(paths.reshape(-1, paths.shape[2]).T)
    found = []
    for barrier, degree in zip(problem.barriers, degrees, strict=True):
        (h,) = compile_function(problem.plant.states, [barrier.expression], "arrays")(*samples)
        rates = _differences(h.reshape(len(x), len(tried), steps + 1), degree, label_dt)
        drift, last = rates[..., :-1], rates[..., -1]
        _require_agreement(drift, barrier.name)
        measured = np.hstack((drift.mean(axis=1), last @ split.T))
        nominal = _lie_derivatives(problem.model, barrier.expression, degree)(x)[:, 1:]
        found.append((measured - nominal, np.abs(measured).max(axis=0)))
    return found, len(x) * len(tried) * steps


def _require_label_dt(label_dt: float, dt: float) -> None:
    """Raise ConfigurationError unless a step of the labels suits control periods of dt s."""
    low, high = _SHORTEST * dt, _LONGEST * dt
    if not low <= finite_number("label_dt", label_dt) <= high:
        raise ConfigurationError(
            f"label_dt = {label_dt} s; give a step from {low:g} to {high:g} s, {_SHORTEST:g} to"
            f" {_LONGEST:g} control periods: over shorter ones the differences of h are rounding,"
            " over longer ones its derivatives change"
        )


def _split_by_input(problem: SafetyProblem, tried: np.ndarray) -> np.ndarray:
    """The matrix (1 + m, J) that takes values c + a u at J inputs to (c, a) by least squares;
    raises as `residual_labels`."""
    # Centred and scaled, for inputs may be large and far from 0.
    center = tried.mean(axis=0)
    scale = np.abs(tried - center).max(axis=0)
    design = np.hstack(
        (np.ones((len(tried), 1)), (tried - center) / np.where(scale > 0, scale, 1.0))
    )
    if np.linalg.matrix_rank(design) < design.shape[1]:
        raise ConfigurationError(
            f"the inputs {problem.exploration.inputs} of the exploration of {problem.name} cannot"
            f" tell {design.shape[1]} numbers apart; give {design.shape[1]} or more that do not lie"
            " in a plane"
        )
    solved = np.linalg.pinv(design)
    gains = solved[1:] / scale[:, None]
    return np.vstack((solved[0] - center @ gains, gains))


def _differences(h: np.ndarray, degree: int, dt: float) -> np.ndarray:
    """Derivatives 1..degree at the beginning of paths with samples (..., S + 1) dt apart, shape
    (..., degree)."""
    # Exact rationals, about 1 as sympy has it: weights that miss the sum 0 by a rounding would add
    # that times h/dt^j.
    table = sp.finite_diff_weights(degree, list(range(1, h.shape[-1] + 1)))
    weights = np.array([[float(w) for w in table[j][-1]] for j in range(1, degree + 1)])
    return (h - h[..., :1]) @ weights.T / dt ** np.arange(1, degree + 1)


def _require_agreement(rates: np.ndarray, name: str) -> None:
    """Raise ConfigurationError unless derivatives (N, J, r - 1) are the same for all J inputs."""
    spread = np.ptp(rates, axis=1).max(axis=0, initial=0.0)
    bad = spread > _MOST_DISAGREEMENT * np.maximum(
        np.abs(rates).max(axis=(0, 1), initial=0.0), 1e-8
    )
    if bad.any():
        raise ConfigurationError(
            f"derivative {int(bad.argmax()) + 1} of barrier {name} along the plant depends on the"
            " input, which in the model acts only on a later one; the residuals do not have the"
            " form that is learned. Check the input matrix of the model, or the noise of the plant"
        )


def _lie_derivatives(
    system: ControlAffineSDE, h: sp.Expr, degree: int
) -> Callable[[np.ndarray], np.ndarray]:
    """From states (N, n) to h, L_f h, ..., L_f^r h and the m entries of L_g L_f^(r-1) h, side by
    side (N, 1 + r + m)."""
    along = derivatives(system, h, degree, lie_derivative_f)
    expressions = [
        system.numeric(e) for e in (*along, *lie_derivative_g(system, along[degree - 1]))
    ]
    compiled = compile_function(system.states, expressions, "arrays")
    return lambda x: stacked(compiled(*np.ascontiguousarray(x.T)), len(x))


def _remedy(level: float, heldout: int) -> str:
    """How to get errors of a level that some held-out states are too few for."""
    highest = f"give a level up to {math.floor(1000 * heldout / (heldout + 1)) / 1000}"
    if level == 1:
        return f"{highest}: no number of states tells the largest error"
    more = math.ceil(level / (1 - level) - _ROUNDING * heldout) - heldout
    return (
        f"learn with about {math.ceil(more / _HELD_OUT)} more states, of which {more} are held out,"
        f" or {highest}"
    )


def _names(degree: int, inputs: Sequence[str]) -> list[str]:
    return [*(f"Delta_{j}" for j in range(1, degree + 1)), *(f"Sigma_{name}" for name in inputs)]


def _share(progress: Progress | None, part: int, parts: int) -> Progress | None:
    """Progress of one of some equal parts of the work."""
    return None if progress is None else lambda done: progress((part + done) / parts)


def _summary(name: str, outputs: Sequence[str], part: LearnedResidual) -> dict[str, float]:
    """Held-out errors by name: root mean square and 95 % quantile of each residual."""
    # The quantile describes these errors; that of fresh ones, `eps`, exists for 19 held-out states
    # or more only.
    rms, q95 = (
        np.sqrt((part.heldout**2).mean(axis=0)),
        np.quantile(part.heldout, 0.95, axis=0, method="higher"),
    )
    return {
        f"{name} {out} {kind}": float(e)
        for kind, errors in (("rms", rms), ("q95", q95))
        for out, e in zip(outputs, errors, strict=True)
    }
