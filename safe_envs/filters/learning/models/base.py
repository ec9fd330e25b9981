"""What learned models have in common: their records, and how they are saved."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from safe_envs.errors import require_whole, shortened
from safe_envs.filters.learning.data import (
    Content,
    LearnedFileError,
    Signature,
    checksum,
    require_finite,
    require_text,
    save,
)
from safe_envs.problem.problem import SafetyProblem


@dataclass(frozen=True)
class Record:
    """How something was learned.

    Attributes:
        transitions: number of one-step transitions that were used.
        observed: time that they last together, in s.
        seconds: that learning took, with the collection of the data.
        seed: of all randomness; None for data from elsewhere.
        errors: held-out errors by name, in the units of what was learned; JSON-able numbers.
        settings: JSON-able.
        warnings: what a user has to know, such as directions that were not excited.
    """

    transitions: int
    observed: float
    seconds: float
    seed: int | None = None
    errors: dict[str, float] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Record:
        """Read what `asdict` and JSON made of one.

        Raises:
            TypeError, ValueError: it is something else.
        """
        found = dict(data)
        for name in ("transitions", "seed"):
            if found[name] is not None or name != "seed":
                require_whole(name, found[name], 0)
        for name in ("observed", "seconds"):
            found[name] = require_finite(found[name])
        found["errors"] = {name: require_finite(error) for name, error in found["errors"].items()}
        found["settings"], found["warnings"] = (
            dict(found["settings"]),
            tuple(map(require_text, found["warnings"])),
        )
        return cls(**found)


class LearnedModel(ABC):
    """What was learned of a problem.

    Attributes:
        method: by which the command line knows it.
        signature: of which system.
        record: how it was learned.
        path: file that it came from, if any.
    """

    method: ClassVar[str]
    signature: Signature
    record: Record
    path: Path | None = None

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return the numbers, by name."""

    @abstractmethod
    def details(self) -> dict[str, Any]:
        """Return what else `restored` needs, JSON-able."""

    @classmethod
    @abstractmethod
    def restored(
        cls,
        problem: SafetyProblem,
        record: Record,
        details: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray],
    ) -> Self:
        """Make the model again for a problem whose signature fits.

        Args:
            problem: for which it is to be used.
            record: how it was learned.
            details: see `details`.
            arrays: see `arrays`.
        """

    @classmethod
    @abstractmethod
    def check(cls, signature: Signature, problem: SafetyProblem) -> None:
        """Raise LearnedFileError where a model with a signature is of no use for a problem.

        Args:
            signature: of the model.
            problem: for which it is to be used.
        """

    @abstractmethod
    def compare(
        self, problem: SafetyProblem, x: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return truth and estimate of each learned function; the plant is the truth.

        Args:
            problem: whose plant is taken.
            x: states, shape (B, n).

        Returns:
            (truth, estimate) by name, values of shape (B,).
        """

    def _saved(self) -> dict[str, Any]:
        record = asdict(self.record)
        return {**self.details(), "record": {**record, "warnings": list(record["warnings"])}}

    @cached_property
    def sha256(self) -> str:
        """Checksum of the model with its record, but for the time that learning took."""
        saved = self._saved()
        del saved["record"]["seconds"]
        return checksum(self.method, self.signature, saved, self.arrays())

    def save(self, path: Path) -> None:
        """Write the model as data; see `safe_envs.filters.learning.data.save`."""
        save(path, self.method, self.signature, self._saved(), self.arrays())

    @classmethod
    def from_content(cls, content: Content, problem: SafetyProblem) -> Self:
        """Make the model of a file again.

        Args:
            content: of the file.
            problem: for which it is to be used.

        Raises:
            LearnedFileError: it is of another system, or incomplete.
        """
        cls.check(content.signature, problem)
        try:
            details = dict(content.details)
            record = Record.from_json(details.pop("record"))
            model = cls.restored(problem, record, details, content.arrays)
        except LearnedFileError:
            raise
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise LearnedFileError(
                f"the file of {content.kind} is incomplete or altered: {shortened(error)}. Learn"
                " again"
            ) from error
        # What may differ from the problem, such as its noise, stays that of the data. The models
        # are frozen.
        object.__setattr__(model, "signature", content.signature)
        return model
