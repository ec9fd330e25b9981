"""What the judge proves of the hypotheses of the bounds, and of the numbers in them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
import sympy as sp

from safe_envs.outward_text import number_at_most
from safe_envs.wrappers.conditions.constraint import AffineConstraint
from safe_envs.wrappers.verification.assumptions import JOINT
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.input_terms import (
    exact_number,
    largest_input_term,
    not_polynomial,
)
from safe_envs.wrappers.verification.judge import JudgeResult, Word, judge, supremum
from safe_envs.wrappers.verification.statements import Statement

BUDGET = Budget(boxes=300_000, seconds=60.0)
"""Of each statement of a bound: a second or two where there are few states and barriers, and
counted in boxes, so that its numbers do not depend on the machine."""

Verdict = TypeVar("Verdict")

_RELATIVE = 1e-3
_SMALL = 1e-7
_QUICK = 0.3
_SHOWN = 6
_WIDTHS = (1e1, 1e2, 1e4, 1e6)


class JudgedNumber(NamedTuple):
    """A number of a bound: a supremum, or a shortfall.

    Attributes:
        name: of the number.
        value: proved upper bound; infinite where there is none.
        verdict: that the number is at most this.
    """

    name: str
    value: float
    verdict: JudgeResult


class ChainProof:
    """What the judge proves of chains b_0, ..., b_(r-1) and their conditions.

    The region G of all statements is where all b_j are positive, in the workspace.

    Args:
        formulas: the chains and conditions.
        suprema: of the b_j, as a search found them.
        shortfall: the largest one, as a search found it.
        hints: states where the conditions may fail, shape (B, n).
        seconds: for all statements together; None for as long as each takes.
        budget: of each statement.
    """

    def __init__(
        self,
        formulas: Formulas,
        suprema: Sequence[float],
        shortfall: float,
        hints: np.ndarray,
        seconds: float | None = None,
        budget: Budget = BUDGET,
    ) -> None:
        self._formulas, self._found, self._lack = formulas, suprema, shortfall
        self._hints, self._budget, self._seconds = hints, budget, seconds
        exact, system = formulas.system.exact, formulas.system
        self._chain = tuple(exact(e) for e in formulas.chain_expressions)
        self._region = Statement(
            "G", system.states, self._workspace(), sp.Integer(1), positive=self._chain
        )

    def _workspace(self) -> tuple[tuple[Any, Any], ...]:
        """Return the exact ends of the workspace, of a whole period for an angle."""
        periodic = self._formulas.region.periodic.tolist()
        return tuple(
            (-sp.pi, sp.pi) if angle else (exact_number(v.low), exact_number(v.high))
            for v, angle in zip(self._formulas.problem.states, periodic, strict=True)
        )

    def _within(self, decide: Callable[[Budget], Verdict], part: float = 1.0) -> Verdict:
        """Let the judge decide something with a part of its boxes, in the time that is left."""
        budget, begun = self._budget, time.process_time()
        seconds = budget.seconds if self._seconds is None else min(self._seconds, budget.seconds)
        found = decide(Budget(round(part * budget.boxes), max(seconds, 0.0)))
        if self._seconds is not None:
            self._seconds -= time.process_time() - begun
        return found

    @cached_property
    def bounded(self) -> JudgeResult:
        """Whether G is bounded."""
        ends = [np.array(end, dtype=float) for end in zip(*self._region.box, strict=True)]
        open_ = [i for i in range(len(ends[0])) if np.isinf([ends[0][i], ends[1][i]]).any()]
        verdict = JudgeResult("proved", 0)
        for i in open_:
            for width in _WIDTHS:
                verdict = self._empty_beyond(i, width)
                if verdict.word == "proved":
                    break
            else:
                return verdict
        return verdict

    def _empty_beyond(self, i: int, width: float) -> JudgeResult:
        """Judge whether G has no state where x_i is beyond a number."""
        verdict = JudgeResult("proved", 0)
        for side in (-1, 1):
            beyond = (width, sp.oo) if side > 0 else (-sp.oo, -width)
            low, high = self._region.box[i]
            if (side > 0 and high != sp.oo) or (side < 0 and low != -sp.oo):
                continue
            box = (*self._region.box[:i], beyond, *self._region.box[i + 1 :])
            name = f"C is bounded in {self._region.states[i]}"
            empty = replace(self._region, name=name, box=box, claim=sp.Integer(-1))
            verdict = self._within(lambda budget, s=empty: judge(s, budget), _QUICK)
            if verdict.word != "proved":
                reason = f"{name} is not established"
                return JudgeResult("undecided", verdict.boxes, box=verdict.box, reason=reason)
        return verdict

    @cached_property
    def smooth(self) -> JudgeResult:
        """Whether all b_j are twice continuously differentiable on G."""
        statement = replace(self._region, name="the barrier on G", smooth=self._chain)
        return self._within(lambda budget: judge(statement, budget))

    @cached_property
    def continuous(self) -> JudgeResult:
        """Whether f, g and sigma are continuous on G."""
        system = self._formulas.system
        entries = [
            e for part in (system.drift, system.input_matrix, system.diffusion) for e in part
        ]
        asked = not_polynomial([system.exact(e) for e in entries], system.states)
        statement = replace(self._region, name="the system on G", continuous=asked)
        return self._within(lambda budget: judge(statement, budget))

    @property
    def regular(self) -> bool:
        """Whether the chains and the system are proved to be as smooth on G as bounds require."""
        return self.smooth.word == self.continuous.word == "proved"

    @cached_property
    def suprema(self) -> tuple[JudgedNumber, ...]:
        """Proved upper bounds of the b_j on G."""
        names = self._formulas.names
        return tuple(
            self._number(f"sup {name}", b, found, supremum_hints=True)
            for name, b, found in zip(names, self._chain, self._found, strict=True)
        )

    def _number(
        self, name: str, expression: Any, found: float, supremum_hints: bool = False
    ) -> JudgedNumber:
        """Prove an upper bound of an expression on G that is near what a search found."""
        wanted = max(_RELATIVE * abs(found) if math.isfinite(found) else 0.0, self.negligible)
        statement, hints = replace(self._region, name=name), None if supremum_hints else self._hints
        result = self._within(lambda budget: supremum(statement, expression, wanted, budget, hints))
        upper = max(result.upper, 0.0) if not math.isnan(result.upper) else math.inf
        if math.isfinite(upper):
            return JudgedNumber(name, upper, JudgeResult("proved", result.boxes))
        reason = result.reason or f"{name} is infinite"
        return JudgedNumber(name, math.inf, JudgeResult("undecided", result.boxes, reason=reason))

    @property
    def negligible(self) -> float:
        """A rate that over the horizon costs a bound nothing that matters."""
        size = min((c for c in self._found if math.isfinite(c) and c > 0.0), default=1.0)
        return _SMALL * size / self._formulas.problem.duration

    @cached_property
    def feasible(self) -> JudgeResult:
        """Whether some input within the bounds meets all conditions everywhere on G."""
        rows = self._rows
        if isinstance(rows, str):
            return JudgeResult("undecided", 0, reason=rows)
        name = "the condition can be met everywhere on G"
        if self._formulas.independent:
            best = sp.Min(*[self._best(row) for row in rows], evaluate=False)
            # Where the claim is 0 somewhere no budget suffices, but a small shortfall is proved.
            one = replace(self._region, name=name, claim=best)
            return self._within(lambda budget: judge(one, budget, self._hints), _QUICK)
        inputs = self._formulas.system.inputs
        claims = [
            sum(a * u for a, u in zip(self._coefficients(row), inputs, strict=True))
            + self._offset(row)
            for row in rows
        ]
        statement = replace(
            self._region,
            name="all conditions can be met at once on G",
            claim=sp.Min(*claims, evaluate=False),
            witnesses=inputs,
            witness=self._common_input,
        )
        verdict = self._within(lambda budget: judge(statement, budget))
        if verdict.word != "refuted":
            return verdict
        # The input that fails is one of many.
        reason = f"no input was found that meets all conditions: {verdict.reason}"
        return JudgeResult("undecided", verdict.boxes, box=verdict.box, reason=reason)

    @cached_property
    def shortfall(self) -> JudgedNumber:
        """Proved upper bound of what the best input misses a condition by on G."""
        name = "the shortfall"
        if self.feasible.word == "proved":
            return JudgedNumber(name, 0.0, self.feasible)
        rows = self._rows
        if isinstance(rows, str):
            return JudgedNumber(name, math.inf, JudgeResult("undecided", 0, reason=rows))
        if not self._formulas.independent:
            return JudgedNumber(name, math.inf, JudgeResult("undecided", 0, reason=JOINT))
        worst = sp.Max(*[-self._best(row) for row in rows], evaluate=False)
        return self._number(name, worst, self._lack)

    @property
    def _rows(self) -> tuple[AffineConstraint, ...] | str:
        """The constraints, or why the judge has no form of them."""
        rows = self._formulas.safety_filter.constraints
        if any(row.change is not None for row in rows):
            return (
                "a condition has a margin of first order for sampling, which has no interval form"
            )
        if any(row.uncertainty is not None or row.terms is not None for row in rows):
            return "a condition is learned or uncertain, which has no interval form"
        return tuple(rows)

    def _coefficients(self, row: AffineConstraint) -> list[Any]:
        return [self._formulas.system.exact(a) for a in row.coefficient]

    def _offset(self, row: AffineConstraint) -> Any:
        return self._formulas.system.exact(row.offset - (row.demand or 0))

    def _best(self, row: AffineConstraint) -> Any:
        """Return a u + b for the best input within the bounds."""
        bounds = [tuple(map(exact_number, ends)) for ends in self._formulas.problem.box]
        return self._offset(row) + largest_input_term(self._coefficients(row), bounds)

    def _common_input(self, x: np.ndarray) -> np.ndarray:
        """Return the inputs that the filter chooses at states, shape (B, m)."""
        rest = np.clip(0.0, *np.array(self._formulas.problem.box).T)
        with np.errstate(all="ignore"):
            found = self._formulas.safety_filter.filter(
                x, np.broadcast_to(rest, (len(x), len(rest)))
            )
        return np.nan_to_num(found.action)

    @property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """All that a bound asks for, with the judge's word."""
        certain = self._formulas.certain
        found = [
            ("G is bounded", self.bounded),
            ("f, g and sigma are continuous on G", self.continuous),
            ("the barrier is twice differentiable on G", self.smooth),
        ]
        if not certain:
            found += [
                (f"{n.name} <= {number_at_most(n.value, _SHOWN)}", n.verdict) for n in self.suprema
            ]
        found.append(("the condition can be met everywhere on G", self.feasible))
        if self.feasible.word != "proved":
            number = self.shortfall
            amount = f" by at most {number_at_most(number.value, _SHOWN)}" * math.isfinite(
                number.value
            )
            found.append((f"the best input violates it{amount}", number.verdict))
        return found

    def word_of(self, allows_shortfall: bool) -> tuple[Word, str]:
        """Return whether a bound is proved, and why not.

        Args:
            allows_shortfall: whether it holds with a shortfall.
        """
        needed = [self.bounded, self.continuous, self.smooth]
        if not self._formulas.certain:
            needed += [number.verdict for number in self.suprema]
        needed.append(self.shortfall.verdict if allows_shortfall else self.feasible)
        for word in ("refuted", "undecided"):
            for verdict in needed:
                if verdict.word == word:
                    return word, verdict.reason
        return "proved", ""
