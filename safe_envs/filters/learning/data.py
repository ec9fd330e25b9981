"""One-step data of a system, which system they are of, and files of data and models."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from safe_envs import arrays as array_files
from safe_envs.arrays import ArrayFile, reading, require_size, write_arrays
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, InvalidInputError, require_whole, shortened, shown
from safe_envs.filters.learning.checks import require_kind, require_problem
from safe_envs.lazy_attributes import package_version
from safe_envs.problem.problem import SafetyProblem

LARGEST = 1e100
"""Largest number in a file: a product of a few of them is still a number."""


class LearnedFileError(ConfigurationError):
    """A file is no learned model or data set of this project, damaged, or of another problem."""


def require_text(given: Any) -> str:
    """Return a text of JSON; raise TypeError where it is none."""
    if not isinstance(given, str):
        raise TypeError(f"{shown(given)} is no text")
    return given


def require_finite(given: Any) -> float:
    """Return a number of JSON as a float; raise TypeError or ValueError where it is none."""
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError(f"{shown(given)} is no number")
    if not math.isfinite(given):
        raise ValueError(f"{given} is not finite")
    return float(given)


def array_of(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the array of a name, as floats.

    Args:
        arrays: by name.
        name: of the array.
        shape: that it has to have.

    Raises:
        KeyError: there is none.
        ValueError: its shape is another, or a number is not finite or too large.
    """
    array = arrays[name].astype(float, copy=False)
    if array.shape != shape or not (np.abs(array) <= LARGEST).all():
        raise ValueError(
            f"{name} has the shape {array.shape}, not {shape}, or a number that is not finite or"
            f" above {LARGEST:g}"
        )
    return array


def numbers(name: str, given: Any) -> np.ndarray:
    """Return numbers as an array of floats, with nothing left out.

    Args:
        name: of what was given, for the message.
        given: anything.

    Raises:
        InvalidInputError: it is none, entries of it are masked, or it is complex.
    """
    parts = given if isinstance(given, list | tuple) else (given,)
    if any(np.ma.is_masked(part) for part in parts):
        raise InvalidInputError(
            f"{name} has masked entries, whose values mean nothing; drop such rows, as by"
            " numpy.ma.compress_rows"
        )
    try:
        found = np.asarray(given)
        if not np.iscomplexobj(found):
            return found.astype(float, copy=False)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{name} is no array of numbers ({error}); give rows of equal length"
        ) from error
    raise InvalidInputError(
        f"{name} is complex; give real numbers, the parts of a complex state as two states"
    )


@dataclass(frozen=True)
class Signature:
    """The system of which something was learned.

    Attributes:
        system: name of the problem.
        states: their names, in order.
        state_units: their units.
        inputs: their names, in order.
        input_units: their units.
        dt: control period in s.
        barriers: expressions of the barriers.
        model: parameters that the designer believed.
        plant: parameters of the plant that was stepped; empty where they are not known, as for a
            log.
    """

    system: str
    states: tuple[str, ...]
    state_units: tuple[str, ...]
    inputs: tuple[str, ...]
    input_units: tuple[str, ...]
    dt: float
    barriers: tuple[str, ...] = ()
    model: tuple[tuple[str, float], ...] = ()
    plant: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, problem: SafetyProblem) -> Signature:
        """Return the signature of a problem."""
        return cls(
            problem.name,
            tuple(s.symbol.name for s in problem.states),
            tuple(s.unit for s in problem.states),
            tuple(i.symbol.name for i in problem.inputs),
            tuple(i.unit for i in problem.inputs),
            problem.dt,
            tuple(str(problem.model.numeric(b.expression)) for b in problem.barriers),
            _parameters(problem.model),
            _parameters(problem.plant),
        )

    def require(self, problem: SafetyProblem, *also: str) -> None:
        """Raise LearnedFileError unless this was learned of a problem's system.

        Args:
            problem: for which it is to be used.
            *also: further attributes that must be the same: "barriers", "model", "dt".
        """
        difference = self.difference(problem, *also)
        if difference:
            raise LearnedFileError(
                f"what was learned is of another problem: {difference}; learn again, by `safe-envs"
                " identify`"
            )

    def difference(self, problem: SafetyProblem, *also: str) -> str:
        """Say in what this is not of a problem's system; "" if it is.

        Args:
            problem: see `require`.
            *also: see `require`.
        """
        wanted = Signature.of(problem)
        for name in ("system", "states", "state_units", "inputs", "input_units", *also):
            mine, other = getattr(self, name), getattr(wanted, name)
            if mine != other:
                return f"its {name.replace('_', ' ')}: {mine}, that of {problem.name}: {other}"
        return ""

    def differences(self, problem: SafetyProblem) -> tuple[str, ...]:
        """Return the parameters of the plant that differ from a problem's: "v = 0.8 (here 1)".

        There are none where the plant is not known.
        """
        here = dict(_parameters(problem.plant))
        return tuple(
            f"{name} = {value:.12g} (here {here.get(name, math.nan):.12g})"
            for name, value in self.plant
            if here.get(name) != value
        )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Signature:
        """Read what `asdict` and JSON made of one.

        Raises:
            TypeError, ValueError: it is something else.
        """
        found = dict(data)
        if set(found) != {f.name for f in fields(cls)}:
            raise ValueError("the entries of a signature are others")
        found["system"], found["dt"] = require_text(found["system"]), require_finite(found["dt"])
        for name in ("states", "state_units", "inputs", "input_units", "barriers"):
            found[name] = tuple(map(require_text, found[name]))
        for name in ("model", "plant"):
            found[name] = tuple(
                (require_text(parameter), require_finite(value)) for parameter, value in found[name]
            )
        return cls(**found)


def _parameters(system: ControlAffineSDE) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((p.name, value) for p, value in system.parameters.items()))


DATA = "transitions"
"""Kind of a file that holds data; others hold models or policies."""

_FORMAT = 2
_PACKAGES = ("safe-envs", "numpy", "sympy", "torch")


@dataclass(frozen=True)
class Content:
    """The content of a file.

    Attributes:
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: by name.
        sha256: checksum of it all.
    """

    kind: str
    signature: Signature
    details: dict[str, Any]
    arrays: dict[str, np.ndarray]
    sha256: str


def checksum(
    kind: str, signature: Signature, details: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> str:
    """Return the SHA-256 of everything that is saved, as hexadecimal digits.

    Args:
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name.
    """
    return array_files.checksum([kind, asdict(signature), details], arrays)


def save(
    path: Path,
    kind: str,
    signature: Signature,
    details: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write a file, whole or not at all.

    Args:
        path: where.
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name; none may be called "header".

    Raises:
        ConfigurationError: it cannot be written there, or would be too large to be read.
    """
    # Before the checksum, which takes as long as all that is written.
    require_size(path, arrays)
    header = {
        "format": _FORMAT,
        "kind": kind,
        "signature": asdict(signature),
        "details": dict(details),
        "versions": {package: package_version(package) for package in _PACKAGES},
        "sha256": checksum(kind, signature, details, arrays),
    }
    write_arrays(path, header, arrays)


def load(path: Path, writer: str = "safe-envs identify") -> Content:
    """Read a file.

    Args:
        path: of the file.
        writer: command that writes such files, for the messages.

    Raises:
        LearnedFileError: it is missing, a folder, no such file, truncated or altered.
    """
    name = shortened(path)
    with reading(path, writer, LearnedFileError) as file:
        content = _content(name, file, writer)
    if content.sha256 != checksum(content.kind, content.signature, content.details, content.arrays):
        raise LearnedFileError(
            f"{name} was altered: its content does not match its checksum. Run `{writer}` again"
        )
    return content


def _content(name: str, file: ArrayFile, writer: str) -> Content:
    """Read a file; of what is no file of this project, nothing but the header."""
    header = file.header
    if header["format"] != _FORMAT:
        raise LearnedFileError(
            f"{name} has the format {shown(header['format'])}; this version reads {_FORMAT}. Run"
            f" `{writer}` again"
        )
    kind, signature, details = (
        require_text(header["kind"]),
        Signature.from_json(header["signature"]),
        dict(header["details"]),
    )
    return Content(kind, signature, details, file.arrays(), require_text(header["sha256"]))


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
        """Write the data to a file; see `safe_envs.filters.learning.data.save`.

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
