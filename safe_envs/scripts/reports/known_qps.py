"""Quadratic programs (QPs) with known answers, for each of the solvers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class KnownQP:
    """The input nearest to a proposed one, within bounds, that meets constraints a u + b >= 0.

    Attributes:
        name: of the kind of QP, which decides on the solver.
        a: k constraints of m coefficients.
        b: k offsets.
        proposed: m inputs.
        bound: of the size of each input.
        answer: m inputs.
        feasible: whether the constraints can be met.
    """

    name: str
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    proposed: tuple[float, ...]
    bound: float
    answer: tuple[float, ...]
    feasible: bool = True

    @property
    def in_closed_form(self) -> bool:
        """Whether no solver is needed."""
        return len(self.b) == 1 or len(self.proposed) < 3


KNOWN_QPS = (
    KnownQP("one constraint, in closed form", ((-1.0, -1.0),), (1.0,), (1.0, 1.0), 5.0, (0.5, 0.5)),
    KnownQP(
        "one constraint that cannot be met",
        ((1.0, 0.0),),
        (-7.0,),
        (0.0, 1.0),
        5.0,
        (5.0, 1.0),
        feasible=False,
    ),
    KnownQP("several constraints, one input", ((-1.0,), (1.0,)), (1.0, 3.0), (2.0,), 5.0, (1.0,)),
    KnownQP(
        "several constraints, two inputs",
        ((-1.0, 0.0), (0.0, -1.0)),
        (1.0, 0.5),
        (2.0, 2.0),
        5.0,
        (1.0, 0.5),
    ),
    KnownQP(
        "contradicting constraints, two inputs",
        ((1.0, 0.0), (-1.0, 0.0)),
        (-2.0, 1.0),
        (0.0, 0.3),
        5.0,
        (1.5, 0.3),
        feasible=False,
    ),
    KnownQP(
        "three inputs",
        ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
        (1.0, 0.5),
        (2.0, 2.0, 2.0),
        5.0,
        (1.0, 0.5, 2.0),
    ),
    KnownQP(
        "contradicting constraints, three inputs",
        ((1.0, 1.0, 1.0), (1.0, 0.0, 0.0)),
        (-10.0, 1.0),
        (0.0, 0.0, 0.0),
        3.0,
        (3.0, 3.0, 3.0),
        feasible=False,
    ),
)
