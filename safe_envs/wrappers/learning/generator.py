"""The generator of a barrier under unknown noise, learned from one-step transitions: DDSCBF of the
thesis, and a shorter way."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self, get_args

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, filled, stacked
from safe_envs.dynamics.lie import (
    derivatives,
    generator,
    gradient,
    lie_derivative_f,
    relative_degree,
)
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.base import LearnedModel, Progress, Record
from safe_envs.wrappers.learning.checks import require_degrees, require_kind, require_problem
from safe_envs.wrappers.learning.data.collection import Step, collect
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.diffusion import LearnedDiffusion
from safe_envs.wrappers.learning.estimators import (
    Estimator,
    drift_warnings,
    in_bulk,
    ito_part,
    mean_rates,
    rates,
    region_warnings,
    require_estimator,
    slack,
)
from safe_envs.wrappers.learning.fit import train
from safe_envs.wrappers.learning.models.network import Network
from safe_envs.wrappers.learning.models.signature import Signature
from safe_envs.wrappers.learning.models.values import LearnedFileError

Way = Literal["network", "direct"]
"""How a generator is learned: see `learn_generator`."""

_ACTIVATION = "tanh"
_TRAINING: dict[str, Any] = {
    "hidden": [100, 30],
    "activation": _ACTIVATION,
    "rate": 1e-3,
    "batch": 32,
    "epochs": 500,
}


@dataclass(frozen=True, eq=False)
class LearnedGenerator:
    """What noise adds to the derivatives of one barrier of relative degree r: A^j h = L_f^j h +
    M_j(x) (+ the input's part).

    Implements `safe_envs.wrappers.conditions.base.Terms`: the row of a condition takes M_r and, for
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
        """The coordinates, and their derivatives by every state, coordinate by coordinate; over
        floats, and over arrays."""
        read = (*self.coordinates, *(sp.diff(c, s) for c in self.coordinates for s in self.states))
        return compile_function(self.states, read, "floats"), compile_function(
            self.states, read, "arrays"
        )

    def floats(self, x: Sequence[float]) -> list[float]:
        """Values of the symbols at one state, given by components."""
        read, p = self._chart[0](*x), len(self.coordinates)
        value = self.networks[-1].floats(read[:p])
        return (
            value
            if self.degree == 1
            else value
            + self._by_states(self.networks[-2].values_and_slopes_floats(read[:p], 0)[1], read[p:])
        )

    def arrays(self, x: Components) -> Components:
        """Values of the symbols at a batch of states, components (B,) in and out."""
        value = self.networks[-1].arrays(self.coordinates_at(x))
        return value if self.degree == 1 else (*value, *self.slopes(self.degree - 1, x))

    def slopes(self, order: int, x: Components) -> Components:
        """dM_j/dx_1..dx_n for an order j from 1, components (B,) in and out."""
        read, p = self._chart[1](*x), len(self.coordinates)
        return tuple(
            self._by_states(
                self.networks[order - 1].values_and_slopes_arrays(self.coordinates_at(x), 0)[1],
                read[p:],
            )
        )

    def coordinates_at(self, x: Components) -> list[np.ndarray]:
        """The coordinates at a batch of states, components (B,) in and out."""
        return [filled(c, x[0].shape) for c in self._chart[1](*x)[: len(self.coordinates)]]

    def _by_states(self, slopes: Sequence[Any], chart: Components) -> list[Any]:
        """The chain rule: slopes by the coordinates, and those of the coordinates, to slopes by the
        states."""
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
        """The numbers, by name."""
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
        """What else `restored` needs, JSON-able."""
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
        """Make the model again for a problem whose signature fits.

        Raises:
            LearnedFileError: the networks are functions of other coordinates.
        """
        states, coordinates = problem.plant.states, problem.exploration.coordinates
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
            tuple(Network.from_arrays(arrays, prefix, _ACTIVATION) for prefix in prefixes)
            for prefixes in orders
        ]
        generators = tuple(LearnedGenerator(states, coordinates, found) for found in networks)
        return cls(Signature.of(problem), record, generators)

    @classmethod
    def check(cls, signature: Signature, problem: SafetyProblem) -> None:
        """Raise LearnedFileError where a model with a signature is of no use for a problem.

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
        """(truth, estimate) at states (B, n), by name: M_r of each barrier, or the covariance's
        entries from the diagonal on.

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
            pairs[_label(learned.degree, barrier)] = (
                read(*components)[0],
                learned.arrays(components)[0],
            )
        return {
            name: (filled(a, (len(x),)), filled(b, (len(x),))) for name, (a, b) in pairs.items()
        }


def learn_generator(
    problem: SafetyProblem,
    *,
    points: int = 200,
    repetitions: int = 50_000,
    estimator: Estimator = "martingale",
    way: Way | None = None,
    data: Transitions | None = None,
    seed: int = 0,
    step: Step | None = None,
    progress: Progress | None = None,
) -> GeneratorModel:
    """Learn what the noise adds to the generators of a problem's barriers, where the model's f and
    g are right.

    The way "network" is the thesis': M_1 is fitted to estimates of 1/2 tr(sigma sigma' h_xx). For r
    >= 2 it goes on with A b_(j-1) of b_(j-1) = L_f^(j-1) h + M_(j-1), so that a network is
    differentiated twice by finite noise: M_j is fitted to L_f M_(j-1) + the estimate for b_(j-1).
    The way "direct" learns the covariance of the noise and differentiates symbols.

    Args:
        problem: whose plant is sampled; of its model, the noise is ignored.
        points: N, number of states, drawn from where the problem is explored.
        repetitions: n, transitions from each, under the input nearest to 0.
        estimator: see `safe_envs.wrappers.learning.estimators.ito_part`; for the way "network".
        way: None for "network" where all barriers have relative degree 1, and "direct" elsewhere
            and for data without repetitions.
        data: to learn from instead, under any inputs; `points`, `repetitions` and `step` are
            ignored then.
        seed: of all randomness.
        step: how the system is stepped; None for the plant's.
        progress: is told which part is done.

    Raises:
        ConfigurationError: an argument is not allowed, or the data are of another system.
        InvalidInputError: there are too few points for a network.
        RelativeDegreeError: a barrier has none.

    Source: thesis Algorithm 2, Sec. 5.3. Its estimator is "printed", 200 points, 50000 transitions
        from each.
    """
    require_problem(problem)
    require_estimator(estimator)
    if way not in (None, *get_args(Way)):
        raise ConfigurationError(f"way = {shown(way)}; allowed: {', '.join(get_args(Way))}")
    begin, told = time.perf_counter(), progress or (lambda _: None)
    degrees = [relative_degree(problem.model, b.expression) for b in problem.barriers]
    if data is None:
        at_rest = [min(max(0.0, low), high) for low, high in problem.box]
        data = collect(
            problem,
            points,
            repetitions,
            [at_rest],
            seed=seed,
            step=step,
            progress=lambda part: told(0.5 * part),
        )
    require_kind("data", data, Transitions, "collect, Transitions.from_log or Transitions.load")
    data.require(problem)
    way = way or ("network" if max(degrees) == 1 and data.repetitions > 1 else "direct")
    settings: dict[str, Any] = {"way": way, "points": data.points, "repetitions": data.repetitions}
    rate = rates(problem.model, data)
    mean = mean_rates(problem.model, data, rate)
    warnings = (
        *drift_warnings(data, rate, mean, [s.name for s in problem.model.states]),
        *region_warnings(problem, data),
    )
    errors, generators, diffusion = {}, [], None
    if way == "direct":
        diffusion, errors = LearnedDiffusion.learn(problem, data, mean, slack(data, rate, mean))
        warnings += () if diffusion.entries else ("the data show no noise, and none was learned",)
    else:
        settings |= {"estimator": estimator, "training_seed": seed, **_TRAINING}
        done, every = 0, sum(degrees)
        # The printed estimator has the bias that it was printed with.
        taken = rate if estimator == "printed" else mean
        for barrier, degree in zip(problem.barriers, degrees, strict=True):
            found = LearnedGenerator(problem.plant.states, problem.exploration.coordinates, ())
            for _ in range(degree):
                how = {
                    "seed": seed,
                    "progress": lambda part, k=done: told(0.5 + 0.5 * (k + part) / every),
                }
                found, new = _next_order(problem, barrier, found, data, taken, estimator, **how)
                errors |= new
                done += 1
            generators.append(found)
    told(1.0)
    record = Record(
        data.count,
        data.observed,
        time.perf_counter() - begin,
        data.seed,
        errors,
        settings,
        warnings,
    )
    signature = replace(
        Signature.of(problem), plant=data.signature.plant, **({"barriers": ()} if diffusion else {})
    )
    return GeneratorModel(signature, record, tuple(generators), diffusion)


def _next_order(
    problem: SafetyProblem,
    barrier: Barrier,
    known: LearnedGenerator,
    data: Transitions,
    rate: np.ndarray,
    estimator: Estimator,
    **how: Any,
) -> tuple[LearnedGenerator, dict[str, float]]:
    """Add M_j to M_1..M_(j-1); and its median error at held-out points, labels included, and the
    labels' standard error."""
    model, below, n = problem.model, known.degree, problem.plant.n
    base = model.numeric(derivatives(model, barrier.expression, below, lie_derivative_f)[-1])
    read_base = compile_function(model.states, (base,), "arrays")
    read = compile_function(
        model.states, (*gradient(model, base), *model.numeric(model.drift)), "arrays"
    )

    def value(x: Components) -> Any:
        return read_base(*x)[0] + (
            in_bulk(known.networks[-1], known.coordinates_at(x)) if below else 0.0
        )

    def slopes(x: Components) -> Components:
        own = read(*x)[:n]
        return (
            tuple(a + b for a, b in zip(own, known.slopes(below, x), strict=True)) if below else own
        )

    x = tuple(np.ascontiguousarray(data.x.T))
    estimate = ito_part(data, rate, value, slopes, estimator)
    labels = estimate.values
    if below:
        labels += sum(
            slope * f for slope, f in zip(known.slopes(below, x), read(*x)[n:], strict=True)
        )
    trained = train(
        stacked(known.coordinates_at(x), data.points), labels[:, None], **how, **_TRAINING
    )
    label = _label(below + 1, barrier)
    errors = {label: float(np.median(trained.heldout))}
    if estimate.deviations is not None:
        errors[f"{label}, standard error of labels"] = float(
            np.sqrt(np.mean(estimate.deviations**2))
        )
    return replace(known, networks=(*known.networks, trained.network)), errors


def _noise_part(problem: SafetyProblem, barrier: Barrier, degree: int) -> Any:
    """A^r h - L_f^r h of the plant, in symbols."""
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


def _label(order: int, barrier: Barrier) -> str:
    return f"M_{order}({barrier.name})"
