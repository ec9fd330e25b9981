"""Of which system something was learned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.data.values import LearnedFileError, require_finite, require_text


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
