"""State estimators of a model and a sensor: what they share, and how they are named."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.arrays import numbers_in, real_array
from safe_envs.dynamics.codegen import Flavour, compile_function
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SystemDefinitionError, require_whole, shown
from safe_envs.problem.angle_jumps import angle_jumps, are_multiples, without_remainders, words_of
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.text import finite_number


@lru_cache(maxsize=64)
def pairs(n: int) -> tuple[tuple[int, int], ...]:
    """Return the places (i, j), i <= j, of the components of an n x n matrix, in order."""
    return tuple((i, j) for i in range(n) for j in range(i, n))


@lru_cache(maxsize=64)
def places(n: int) -> dict[tuple[int, int], int]:
    """Return the index of the component of each place (i, j), on both sides of the diagonal."""
    found = {pair: index for index, pair in enumerate(pairs(n))}
    return found | {(j, i): index for (i, j), index in found.items()}


def packed(matrix: Any) -> list[float]:
    """Return the components of a symmetric matrix (n, n)."""
    table = np.asarray(matrix, dtype=float)
    return [float(table[i, j]) for i, j in pairs(len(table))]


def unpacked(components: Sequence[Any], n: int) -> np.ndarray:
    """Return the matrix of components.

    Args:
        components: n (n + 1)/2 numbers, or arrays (B,).
        n: order of the matrix.

    Returns:
        Shape (n, n), or (B, n, n).
    """
    index = np.array([[places(n)[i, j] for j in range(n)] for i in range(n)])
    table = np.stack([np.asarray(c, dtype=float) for c in components])
    return np.moveaxis(table[index], (0, 1), (-2, -1))


def positive_part(components: Sequence[Any], n: int) -> list[Any]:
    """Return the smallest positive semidefinite matrix above a symmetric one, by components.

    Its eigenvalues are those of the other, or 0 in the place of negative ones.

    Args:
        components: floats or arrays (B,).
        n: order of the matrix.
    """
    if n == 1:
        return [np.maximum(components[0], 0.0)]
    values, vectors = np.linalg.eigh(unpacked(components, n))
    scaled = vectors * np.maximum(values, 0.0)[..., None, :]
    found = scaled @ np.swapaxes(vectors, -1, -2)
    return [found[..., i, j] for i, j in pairs(n)]


def cholesky(components: Sequence[Any], n: int) -> list[list[Any]]:
    """Return L with L L' = P, L_ij as entry j of list i, of a positive semidefinite P.

    Where a pivot is not positive, its column is 0: then L L' leaves out what rounding alone makes.

    Args:
        components: of P, floats or arrays (B,).
        n: order of the matrix.
    """
    at, zero = places(n), np.zeros(np.shape(components[0]))
    rows: list[list[Any]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        pivot = components[at[j, j]] - sum(rows[j][k] ** 2 for k in range(j))
        # What is left of a pivot after rounding counts as nothing.
        sound = pivot > 1e-14 * abs(components[at[j, j]])
        root = np.sqrt(np.where(sound, pivot, 1.0))
        rows[j][j] = np.where(sound, root, 0.0)
        for i in range(j + 1, n):
            rest = components[at[i, j]] - sum(rows[i][k] * rows[j][k] for k in range(j))
            rows[i][j] = np.where(sound, rest / root, 0.0)
    return rows


_PROPOSALS = 40_000
_LEAST = 100


@dataclass(frozen=True)
class InitialBelief:
    """Mean and covariance of the state at the first control instant, before its sample.

    Attributes:
        mean: n numbers.
        covariance: n (n + 1)/2 components, see `packed`.
    """

    mean: tuple[float, ...]
    covariance: tuple[float, ...]

    @classmethod
    def of(cls, mean: Any, covariance: Any) -> InitialBelief:
        """Return a belief that somebody states.

        Args:
            mean: shape (n,).
            covariance: shape (n, n), or (n,) for variances.

        Raises:
            ConfigurationError: The shapes do not fit, a number is not finite, or the covariance is
                not symmetric and positive semidefinite.
        """
        center, spread = real_array("mean", mean), real_array("covariance", covariance)
        table = np.diag(spread) if spread.ndim == 1 else spread
        if center.ndim != 1 or table.shape != 2 * center.shape:
            raise ConfigurationError(
                f"mean {center.shape} and covariance {spread.shape} do not fit; give (n,), and"
                " (n, n) or variances (n,)"
            )
        sound = np.isfinite(center).all() and np.isfinite(table).all()
        if not sound or not np.allclose(table, table.T) or np.linalg.eigvalsh(table)[0] < -1e-12:
            raise ConfigurationError(
                f"covariance = {shown(covariance)}; give a symmetric, positive semidefinite matrix"
            )
        return cls(tuple(center.tolist()), tuple(packed(table)))

    def require_states(self, n: int) -> None:
        """Raise ConfigurationError unless the belief is of so many states."""
        if len(self.mean) != n:
            raise ConfigurationError(
                f"the initial belief has {len(self.mean)} states; the model has {n}"
            )


def initial_belief(problem: SafetyProblem) -> InitialBelief:
    """Return the moments of the start distribution of a problem.

    They are exact for a fixed start, whose covariance is 0, and else those of 40,000 draws, always
    the same.

    Args:
        problem: whose start in use is taken.

    Raises:
        ConfigurationError: The condition of the distribution is hardly ever met.
    """
    start = problem.starts[problem.start]
    if not start.uniforms:
        fixed = [float(v) for v in start.proposals(1)[0]]
        return InitialBelief.of(fixed, np.zeros(len(fixed)))
    states = start.proposals(_PROPOSALS)
    if start.condition is not None:
        condition = problem.model.numeric(start.condition)
        allowed = compile_function(problem.model.states, (condition,), "arrays")(*states.T)[0]
        states = states[np.broadcast_to(allowed > 0, len(states))]
    if len(states) < _LEAST:
        raise ConfigurationError(
            f"the start {problem.start!r} of {problem.name} meets its condition too rarely for its"
            " moments; give an InitialBelief of your own"
        )
    return InitialBelief.of(states.mean(axis=0), _covariance(states))


def _covariance(states: np.ndarray) -> np.ndarray:
    """Return the covariance of draws, without correlations that are nothing but chance."""
    table: np.ndarray = np.atleast_2d(np.cov(states.T))
    scale = np.sqrt(np.diag(table))
    size = np.outer(scale, scale)
    chance = abs(table) < 4.0 * size / np.sqrt(len(states))
    np.fill_diagonal(chance, False)
    return np.where(chance, 0.0, table)


def require_state_alone(model: ControlAffineSDE, measurement: Measurement) -> None:
    """Raise SystemDefinitionError where a model or a sensor depends on signals or the time.

    Args:
        model: that predicts. Its signals may be in barriers, at which no estimator looks.
        measurement: what is measured.
    """
    for what, symbol in _uses(model, measurement, {*model.signals, TIME}):
        raise SystemDefinitionError(
            f"{what} depends on {'the time' if symbol == TIME else f'the signal {symbol}'}, of"
            " which an estimator knows no value: make it a state, with its rate in the drift (1"
            " for the time). Barriers may hold signals and the time, which the filter is given"
        )


def require_fixed(
    model: ControlAffineSDE, measurement: Measurement, given: Collection[sp.Symbol]
) -> None:
    """Raise ConfigurationError where a model or a sensor depends on what a filter is given.

    Args:
        model: that predicts, with values of its parameters.
        measurement: what is measured.
        given: symbols whose values the filter is given at each call; those of the same names count.
    """
    names = {s.name for s in given}
    known = {p for p in model.parameters if p.name in names}
    for what, symbol in _uses(model, measurement, known):
        raise ConfigurationError(
            f"{what} of the estimator depends on {symbol}, whose value the filter is given at each"
            f" call: the estimator predicts with {symbol} = {model.parameters[symbol]:g} always."
            " Leave it out of adjustable=... and signals, or make it a state"
        )


def _uses(
    model: ControlAffineSDE, measurement: Measurement, symbols: set[Any]
) -> Iterator[tuple[str, Any]]:
    """Return which parts depend on symbols, and on which of them."""
    parts: dict[str, Any] = {
        "the drift": model.drift,
        "the input matrix": model.input_matrix,
        "the diffusion": model.diffusion,
    }
    parts |= {f"the measurement {c.name}": c.expression for c in measurement.channels}
    for what, part in parts.items():
        for symbol in sorted(part.free_symbols & symbols, key=str):
            yield what, symbol


_STATES = 9
"""At which outputs are compared."""


def continuous_output(channel: Channel, model: ControlAffineSDE) -> sp.Expr:
    """Return what a channel measures, as an expression that is continuous modulo its period.

    Args:
        channel: of a sensor.
        model: with the values of the parameters.

    Raises:
        ConfigurationError: It jumps by no multiple of the period.
    """
    expression = model.numeric(channel.expression)
    jumps = angle_jumps(expression)
    if not (channel.period if jumps is None else are_multiples(jumps, channel.period)):
        raise ConfigurationError(
            f"the measurement {channel.name} jumps {words_of(jumps)} after a turn of its angles,"
            f" and its period is {channel.period:g}: an estimator would take the jump for an error"
            " of the state. Give a period of which the jump is a multiple, or leave it out"
        )
    return without_remainders(expression) if channel.period else expression


def periods_of_states(estimator: Any) -> tuple[float, ...]:
    """Return the number modulo which a sensor tells each state; 0 of those that it tells in full.

    A channel a x_i + b of period T tells x_i modulo T/|a|, if all other channels repeat after that.

    Args:
        estimator: an `Estimator`.
    """
    outputs = [continuous_output(c, estimator.model) for c in estimator.measurement.channels]
    found = []
    for i, state in enumerate(estimator.model.states):
        turns = set()
        for channel, output in zip(estimator.measurement.channels, outputs, strict=True):
            slope = sp.simplify(sp.diff(output, state)) if channel.period else sp.S.Zero
            if slope.is_number and slope != 0:
                turns.add(abs(channel.period / float(slope)))
        found.append(next((turn for turn in sorted(turns) if _repeats(estimator, i, turn)), 0.0))
    return tuple(found)


def _repeats(estimator: Any, i: int, turn: float) -> bool:
    """Return whether all that is measured is the same after a turn of a state, at some states."""
    x = list(np.random.default_rng(0).standard_normal((estimator.n, _STATES)))
    turned = [c + turn * (j == i) for j, c in enumerate(x)]
    with np.errstate(all="ignore"):
        before, after = (
            [np.broadcast_to(y, _STATES) for y in estimator.expected("arrays", states)]
            for states in (x, turned)
        )
        differences = estimator.innovations("arrays", after, before, [True] * len(before))
    scales = [abs(y[np.isfinite(y)]).max(initial=0.0) for y in before]
    # What is not finite, as the root of a negative number, tells nothing.
    return not any(
        (abs(d) > 1e-9 * scale).any() for d, scale in zip(differences, scales, strict=True)
    )


Components = Sequence[Any]
"""Floats of one state, or arrays (B,) of a batch."""


class Update(NamedTuple):
    """A belief after a sample.

    Attributes:
        mean: n components.
        covariance: n (n + 1)/2 components, see `safe_envs.filters.estimation.estimator`.
        innovation: k components: what was measured less what was expected; 0 of lost samples.
        nis: normalized innovation squared, nu' S^-1 nu of what was received: for a linear model
            and Gaussian noise chi-square distributed, with as many degrees of freedom.
    """

    mean: Components
    covariance: Components
    innovation: Components
    nis: Any


class Estimator(ABC):
    """Base of the estimators: a belief about the state, a mean and a covariance, in time.

    The model moves by the step of the simulator, and its sensor is without bias: a bias and a
    mismatch of the plant are unknown to the estimator.

    Attributes:
        name: by which texts know it.
        text: with its settings.
        n: number of states.
        variances: of the noise of each channel.
        added: standard deviation of the noise added to each state, per square root of a second.

    Args:
        model: that is believed.
        measurement: what is measured.
        dt: control period in s.
        substeps: integration steps in it.
        process_noise: standard deviation per square root of a second of noise that the estimator
            adds to the model's, for all states or one number for each: for what the model does not
            know. Without noise the covariance would go to 0, and no sample count any more.
        initial: belief before the first sample, if it is known.

    Raises:
        SystemDefinitionError: Something unknown is measured, or the model or the sensor depends on
            signals or the time.
        ConfigurationError: A number is out of range, or something is measured without noise or with
            jumps that its period does not take away.
    """

    name: ClassVar[str]

    def __init__(
        self,
        model: ControlAffineSDE,
        measurement: Measurement,
        dt: float,
        substeps: int = 1,
        process_noise: float | Sequence[float] = 0.0,
        initial: InitialBelief | None = None,
    ) -> None:
        require_whole("substeps", substeps, 1)
        self.dt, self.substeps = finite_number("dt", dt), int(substeps)
        if not self.dt > 0.0:
            raise ConfigurationError(f"dt = {self.dt} s; a control period is positive")
        require_state_alone(model, measurement)
        measurement.require_known(model)
        exact = [c.name for c in measurement.channels if not c.noise > _LEAST_NOISE]
        if exact:
            raise ConfigurationError(
                f"{', '.join(exact)}: measured without noise, for which the gain of an estimator is"
                " singular; give a small standard deviation, or the true state without a sensor"
            )
        self.model, self.measurement, self.n = model, measurement, model.n
        if initial is not None:
            initial.require_states(model.n)
        self.initial = initial
        self.added = _process_noise(process_noise, model)
        self._expected = [continuous_output(c, model) for c in measurement.channels]
        self.variances = tuple(c.noise**2 for c in measurement.channels)

    @property
    def text(self) -> str:
        """The name with the settings."""
        added = [float(a) for a in self.added]
        if not any(added):
            return self.name
        equal = added[:1] if len(set(added)) == 1 else added
        return f"{self.name}:process_noise={','.join(format(a, 'g') for a in equal)}"

    @abstractmethod
    def predict(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        """Return the belief one control period later.

        Args:
            flavour: "floats" for one state, "arrays" for a batch.
            mean: n components.
            covariance: n (n + 1)/2 components.
            u: m components of the input that is executed.

        Returns:
            The mean and the covariance.
        """

    @abstractmethod
    def update(
        self,
        flavour: Flavour,
        mean: Components,
        covariance: Components,
        y: Components,
        received: Components,
    ) -> Update:
        """Return the belief after a sample.

        Args:
            flavour: see `predict`.
            mean: n components.
            covariance: n (n + 1)/2 components.
            y: k components of what was measured; finite numbers where it was lost.
            received: whether each component was.
        """

    def gained(
        self, flavour: Flavour, mean: Components, covariance: Components, u: Components
    ) -> tuple[Components, Components]:
        """Return the covariance after the coming sample, and by how much that lowers it.

        The second is K S K', with the gain K and the covariance S of the innovation: the covariance
        of the jump of the mean.

        Args:
            flavour: see `predict`.
            mean: n components.
            covariance: n (n + 1)/2 components.
            u: m components of the input until then.
        """
        mean, before = self.predict(flavour, mean, covariance, u)
        y = self.expected(flavour, mean)
        after = self.update(flavour, mean, before, y, [True] * len(y)).covariance
        return after, [b - a for b, a in zip(before, after, strict=True)]

    def expected(self, flavour: Flavour, mean: Components) -> Components:
        """Return what a sensor without noise measures of a state.

        Args:
            flavour: see `predict`.
            mean: n components of the state.

        Returns:
            k components.
        """
        return self._functions[flavour](*mean)

    @cached_property
    def _functions(self) -> dict[Flavour, Any]:
        return {f: compile_function(self.model.states, self._expected, f) for f in _FLAVOURS}

    def innovations(
        self, flavour: Flavour, y: Components, expected: Components, received: Components
    ) -> list[Any]:
        """Return what was measured less what was expected.

        That of a periodic channel is within half a period of 0, and that of a lost sample is 0.

        Args:
            flavour: see `predict`.
            y: k components.
            expected: k components.
            received: whether each was measured.
        """
        found, up = [], math.ceil if flavour == "floats" else np.ceil
        for channel, value, mean, has in zip(
            self.measurement.channels, y, expected, received, strict=True
        ):
            difference = value - mean
            if channel.period:
                turns = up(difference / channel.period - 0.5)
                difference = difference - channel.period * turns
            found.append(difference * has)
        return found

    @cached_property
    def periods(self) -> tuple[float, ...]:
        """The number modulo which the sensor tells each state; 0 of those that it tells in full."""
        return periods_of_states(self)

    @cached_property
    def certain(self) -> tuple[int, ...]:
        """Places of the states that are known without any uncertainty, throughout.

        Initially they are, no noise drives them, and their rates depend on none but themselves.
        """
        if self.initial is None:
            return ()
        states, n = self.model.states, self.n
        start = unpacked(self.initial.covariance, n)
        known = {i for i in range(n) if not start[i, i] and not self.diffusion_square[i, i]}
        rates = sp.Matrix(self.model.numeric(self.model.drift)).row_join(
            sp.Matrix(self.model.numeric(self.model.input_matrix))
        )
        while True:
            others = {s for i, s in enumerate(states) if i not in known}
            lost = {i for i in known if rates[i, :].free_symbols & others}
            if not lost:
                return tuple(sorted(known))
            known -= lost

    @cached_property
    def jacobian(self) -> Any:
        """A = d(f + g u)/dx, a matrix of expressions of the states and inputs."""
        model = self.model
        rate = model.numeric(model.drift + model.input_matrix * sp.Matrix(model.inputs))
        return sp.Matrix(rate).jacobian(list(model.states))

    @cached_property
    def diffusion_square(self) -> Any:
        """Sigma sigma' with what is added to it, a matrix of expressions of the states."""
        sigma = sp.Matrix(self.model.numeric(self.model.diffusion))
        added = sp.diag(*[sp.Float(a, 17) ** 2 if a else 0 for a in self.added])
        return sigma * sigma.T + added

    @cached_property
    def output_jacobian(self) -> Any:
        """H = dc/dx, a matrix of expressions of the states."""
        return sp.Matrix(self._expected).jacobian(list(self.model.states))


_LEAST_NOISE = 1e-150
"""Standard deviation whose square is still a number above 0."""

_FLAVOURS: tuple[Flavour, ...] = ("floats", "arrays")


def nonzero(matrix: Any, upper: bool = False) -> tuple[tuple[int, int], ...]:
    """Return the places of the entries of a matrix that are not 0.

    Args:
        matrix: of expressions.
        upper: only those (i, j) with i <= j.
    """
    rows, columns = matrix.shape
    return tuple(
        (i, j)
        for i in range(rows)
        for j in range(columns)
        if matrix[i, j] != 0 and not (upper and i > j)
    )


def packed_entries(matrix: Any) -> tuple[tuple[tuple[int, int], ...], list[Any]]:
    """Return the places and the expressions of the upper triangle that are not 0."""
    found = nonzero(matrix, upper=True)
    return found, [matrix[i, j] for i, j in found]


def _process_noise(given: Any, model: ControlAffineSDE) -> tuple[float, ...]:
    values = numbers_in(given)
    if values.shape not in ((), (1,), (model.n,)) or not (
        np.isfinite(values).all() and (values >= 0.0).all()
    ):
        raise ConfigurationError(
            f"process_noise = {shown(given)}; give a number >= 0, or one for each of the {model.n}"
            " states"
        )
    return tuple(np.broadcast_to(values, model.n).tolist())


_TRIES = 5
_TOLERANCE = 1e-7
"""Part of the largest singular value below which one counts as 0."""


def require_observable(
    estimator: Estimator, problem: SafetyProblem, initial: InitialBelief
) -> None:
    """Check that a sensor determines all of the state that is uncertain.

    Along trajectories from some starts, under random inputs, what is measured is linearised, H F_k
    .. F_1. A direction of the state that none of them sees, from any start, is
    allowed only if nothing makes it uncertain: neither the initial belief nor the noise.

    Args:
        estimator: with the model and what is measured.
        problem: whose starts and input bounds are taken.
        initial: belief before the first sample.

    Raises:
        SystemDefinitionError: Some direction is uncertain and not seen.
    """
    n, scale = estimator.n, _scales(problem)
    rows, spread = _along(estimator, problem, initial)
    table = rows * scale
    _, values, vectors = np.linalg.svd(table, full_matrices=True)
    size = np.zeros(n)
    size[: len(values)] = values
    unseen = vectors[size <= _TOLERANCE * max(size.max(), 1e-300)]
    if not len(unseen):
        return
    # In units of the scales: how uncertain is what nothing sees?
    scaled = spread / np.outer(scale, scale)
    uncertain = unseen @ scaled @ unseen.T
    if np.trace(uncertain) <= _TOLERANCE**2:
        return
    sizes, directions = np.linalg.eigh(uncertain)
    found = directions[:, sizes > _TOLERANCE * sizes[-1]].T @ unseen
    parts = np.sqrt((found**2).sum(axis=0))
    names = [s.name for s, part in zip(problem.plant.states, parts, strict=True) if part > 0.1]
    raise SystemDefinitionError(
        f"the measurement ({', '.join(c.name for c in estimator.measurement.channels)}) does not"
        f" determine {', '.join(names)} of {problem.name}; measure more, such as"
        f" '{names[0]}:noise=S', or take measurement='default'"
    )


def _along(
    estimator: Estimator, problem: SafetyProblem, initial: InitialBelief
) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions that trajectories see, and the largest covariance without samples."""
    n, model = estimator.n, estimator.model
    rng = np.random.default_rng(0)
    measured = compile_function(model.states, list(estimator.output_jacobian), "floats")
    slopes = compile_function((*model.states, *model.inputs), list(estimator.jacobian), "floats")
    rows, spread = [], unpacked(initial.covariance, n).copy()
    for start in problem.starts[problem.start].proposals(_TRIES):
        x, p, transition = start.tolist(), list(initial.covariance), np.eye(n)
        for _ in range(2 * n):
            u = [float(rng.uniform(low, high)) for low, high in problem.input_bounds]
            rows.append(np.reshape(measured(*x), (-1, n)).astype(float) @ transition)
            step = np.eye(n) + estimator.dt * np.reshape(slopes(*x, *u), (n, n)).astype(float)
            transition = step @ transition
            x, p = (list(part) for part in estimator.predict("floats", x, p, u))
            if not np.isfinite([*x, *p]).all():
                break
            moved = unpacked(p, n)
            spread = np.where(abs(moved) > abs(spread), moved, spread)
    return np.concatenate(rows), np.diag(np.diag(spread))


def _scales(problem: SafetyProblem) -> np.ndarray:
    """Return the size of each state's range; 1 where it is not bounded."""
    width = np.array([v.high - v.low for v in problem.states])
    return np.where(np.isfinite(width), width, 1.0)
