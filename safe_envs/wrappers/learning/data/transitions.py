"""One-step data of a system: states, inputs that are held, and the states that follow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from safe_envs.errors import ConfigurationError, InvalidInputError, require_whole, shortened, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.checks import require_kind, require_problem
from safe_envs.wrappers.learning.data.files import DATA, load, save
from safe_envs.wrappers.learning.data.signature import Signature
from safe_envs.wrappers.learning.data.values import LearnedFileError, numbers

_ARRAYS = ("x", "u", "successors", "dt")


@dataclass(frozen=True, eq=False)
class Transitions:
    """One-step data of a system.

    What NumPy reads as numbers may be given. Arrays of floats are not copied: they must not be
    changed afterwards.

    Attributes:
        signature: of which system.
        x: states from which the steps start, shape (P, n).
        u: physical inputs that are held, shape (P, m).
        successors: states that follow, in K repetitions of each step, shape (P, K, n).
        dt: how long each step lasts, in s, shape (P,); one number is broadcast.
        seed: of all randomness; None for data from elsewhere.

    Raises:
        InvalidInputError: there are no data, an array has the wrong shape or is not finite, a dt is
            not positive, or a row occurs twice.
        ConfigurationError: the seed is no whole number, or the signature is none.
    """

    signature: Signature
    x: np.ndarray
    u: np.ndarray
    successors: np.ndarray
    dt: np.ndarray
    seed: int | None = None

    def __post_init__(self) -> None:
        require_kind("signature", self.signature, Signature, "Signature.of(problem)")
        for name in _ARRAYS:
            object.__setattr__(self, name, numbers(name, getattr(self, name)))
        self._check_shapes()
        if not self.dt.ndim:
            object.__setattr__(self, "dt", np.full(self.points, self.dt))
        for name in _ARRAYS:
            _require_finite(name, getattr(self, name))
        shortest = int(self.dt.argmin())
        if not self.dt[shortest] > 0:
            raise InvalidInputError(
                f"dt[{shortest}] = {self.dt[shortest]} s; a step needs a positive duration"
            )
        if self.seed is not None:
            require_whole("seed", self.seed, 0)
        self._refuse_copies()

    def _check_shapes(self) -> None:
        n, m = len(self.signature.states), len(self.signature.inputs)
        points, repetitions = self.successors.shape[:2] if self.successors.ndim == 3 else (-1, -1)
        given = ", ".join(f"{name} {getattr(self, name).shape}" for name in _ARRAYS)
        wanted = (
            f"x (P, {n}), u (P, {m}), successors (P, K, {n}) and dt (P,) or one number, with P and"
            " K from 1"
        )
        shapes = ((points, n), (points, m), (points, repetitions, n))
        if (self.x.shape, self.u.shape, self.successors.shape) != shapes or self.dt.shape not in (
            (),
            (points,),
        ):
            raise InvalidInputError(
                f"the shapes do not fit each other or {self.signature.system}: {given}; give"
                f" {wanted}"
            )
        if not points or not repetitions:
            raise InvalidInputError(f"there are no data: {given}; give {wanted}")

    def _refuse_copies(self) -> None:
        # Rows can be very long; almost always the first successor tells them apart.
        labels = _labels(np.column_stack((self.dt, self.x, self.u, self.successors[:, 0])))
        suspects = np.flatnonzero(np.bincount(labels)[labels] > 1)
        if not suspects.size:
            return
        rows = [
            self.dt[suspects],
            self.x[suspects],
            self.u[suspects],
            self.successors[suspects].reshape(len(suspects), -1),
        ]
        labels = _labels(np.column_stack(rows))
        copied = np.bincount(labels)[labels] > 1
        if copied.any():
            first, second = suspects[labels == labels[copied.argmax()]][:2].tolist()
            raise InvalidInputError(
                f"rows {first} and {second} are the same: x = {self.x[first]}, u = {self.u[first]},"
                " dt, and all successors. A copy tells nothing new and makes estimates look surer"
                " than they are; drop the copies"
            )

    @classmethod
    def from_log(
        cls, source: SafetyProblem | Signature, x: Any, u: Any, successors: Any, dt: Any
    ) -> Self:
        """Make data of a log, each step once; their signature does not tell the plant.

        Args:
            source: the problem, or its signature, whose states and inputs they are of.
            x: states from which the steps start, shape (P, n); here and below what NumPy reads as
                numbers.
            u: physical inputs that were held, shape (P, m).
            successors: states that followed, shape (P, n).
            dt: how long the steps lasted, in s: one number, or shape (P,).

        Raises:
            InvalidInputError: as for `Transitions`.
            ConfigurationError: the source is neither a problem nor a signature.
        """
        if not isinstance(source, Signature):
            require_problem(source)
        signature = replace(
            source if isinstance(source, Signature) else Signature.of(source), plant=()
        )
        followed = numbers("successors", successors)
        if followed.ndim != 2:
            raise InvalidInputError(
                f"the successors of a log have the shape {followed.shape}; give (P,"
                f" {len(signature.states)})"
            )
        return cls(signature, x, u, followed[:, None], dt)

    @property
    def points(self) -> int:
        """P, the number of pairs of a state and an input."""
        return len(self.x)

    @property
    def repetitions(self) -> int:
        """K, how often each step was repeated."""
        return self.successors.shape[1]

    @property
    def count(self) -> int:
        """P K, the number of transitions."""
        return self.points * self.repetitions

    @property
    def observed(self) -> float:
        """Time that all transitions last together, in s."""
        return float(self.dt.sum()) * self.repetitions

    def require(self, problem: SafetyProblem) -> None:
        """Raise LearnedFileError unless the data are of a problem's system."""
        difference = self.signature.difference(problem)
        if difference:
            raise LearnedFileError(
                f"the data are of another problem: {difference}; give data of {problem.name}, or"
                " let them be collected"
            )

    def split(self, share: float, rng: np.random.Generator) -> tuple[Transitions, Transitions]:
        """Divide the data at random by start states; rows from the same state stay together.

        Args:
            share: part of the start states that is held out, between 0 and 1; at least one is, and
                at least one is not.
            rng: of the choice.

        Returns:
            What is left, and what is held out.

        Raises:
            ConfigurationError: the share is not between 0 and 1.
            InvalidInputError: all rows start from the same state.
        """
        held = self.held_out(share, rng)
        return self._part(~held), self._part(held)

    def held_out(self, share: float, rng: np.random.Generator) -> np.ndarray:
        """Return which rows `split` holds out, shape (P,).

        Args:
            share: see `split`.
            rng: see `split`.

        Raises:
            ConfigurationError: see `split`.
            InvalidInputError: see `split`.
        """
        if not 0 < share < 1:
            raise ConfigurationError(
                f"share = {shown(share)}; give the part of the data to be held out, between 0 and 1"
            )
        labels = _labels(self.x)
        states = int(labels.max()) + 1
        if states < 2:
            raise InvalidInputError(
                f"all {self.points} rows start from the state {self.x[0]}; to hold some out takes"
                " two states at least"
            )
        held = np.zeros(states, dtype=bool)
        held[rng.permutation(states)[: min(max(round(share * states), 1), states - 1)]] = True
        return held[labels]

    def _part(self, rows: np.ndarray) -> Transitions:
        return Transitions(
            self.signature,
            self.x[rows],
            self.u[rows],
            self.successors[rows],
            self.dt[rows],
            self.seed,
        )

    def save(self, path: Path) -> None:
        """Write the data to a file; see `safe_envs.wrappers.learning.data.files.save`.

        Raises:
            ConfigurationError: it cannot be written there.
        """
        save(
            path,
            DATA,
            self.signature,
            {"seed": self.seed},
            {name: getattr(self, name) for name in _ARRAYS},
        )

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read data from a file.

        Raises:
            LearnedFileError: it is missing, damaged, or holds something else.
        """
        content = load(path)
        if content.kind != DATA:
            raise LearnedFileError(
                f"{path} holds {shown(content.kind)}, not {shown(DATA)}; give a file that"
                " `Transitions.save` wrote"
            )
        try:
            return cls(
                content.signature,
                **{name: content.arrays[name] for name in _ARRAYS},
                seed=content.details["seed"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise LearnedFileError(
                f"the data in {path} are incomplete: {shortened(error)}. Collect them again"
            ) from error


def _require_finite(name: str, values: np.ndarray) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        place = np.unravel_index(int(bad.argmax()), values.shape)
        indices = ", ".join(str(int(i)) for i in place)
        raise InvalidInputError(
            f"{name}[{indices}] = {values[place]}, one of {bad.sum()} entries that are not finite;"
            " drop such rows"
        )


def _labels(rows: np.ndarray) -> np.ndarray:
    """Return a label for each row (P, c), the same for equal rows, from 0 without gaps, (P,)."""
    order = np.lexsort(rows.T)
    ordered = rows[order]
    labels = np.empty(len(rows), dtype=int)
    labels[order[0]] = 0
    labels[order[1:]] = (ordered[1:] != ordered[:-1]).any(axis=1).cumsum()
    return labels
