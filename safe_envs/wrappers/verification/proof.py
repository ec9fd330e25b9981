"""What the judge proves of the hypotheses of the bounds, and of the numbers in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.wrappers.conditions.constraint import AffineConstraint
from safe_envs.wrappers.verification.assumptions import JOINT
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.certificate_statements import rounded_up
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.input_terms import (
    exact_number,
    largest_input_term,
    not_polynomial,
)
from safe_envs.wrappers.verification.judge import JudgeResult, Word, judge, supremum
from safe_envs.wrappers.verification.statements import Statement

BUDGET = Budget(boxes=300_000, seconds=60.0)
"""Of each statement of a bound: a second or two, so that an evaluation does not wait for it, and
counted in boxes, so that its numbers do not depend on the machine."""

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
        budget: of each statement.
    """

    def __init__(
        self,
        formulas: Formulas,
        suprema: Sequence[float],
        shortfall: float,
        hints: np.ndarray,
        budget: Budget = BUDGET,
    ) -> None:
        self._formulas, self._found, self._lack = formulas, suprema, shortfall
        self._hints, self._budget = hints, budget
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

    @property
    def _quick(self) -> Budget:
        """Of what either takes few boxes or fails."""
        return replace(self._budget, boxes=round(_QUICK * self._budget.boxes))

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
            verdict = judge(
                replace(self._region, name=name, box=box, claim=sp.Integer(-1)), self._quick
            )
            if verdict.word != "proved":
                reason = f"{name} is not established"
                return JudgeResult("undecided", verdict.boxes, box=verdict.box, reason=reason)
        return verdict

    @cached_property
    def smooth(self) -> JudgeResult:
        """Whether all b_j are twice continuously differentiable on G."""
        return judge(
            replace(self._region, name="the barrier on G", smooth=self._chain), self._budget
        )

    @cached_property
    def continuous(self) -> JudgeResult:
        """Whether f, g and sigma are continuous on G."""
        system = self._formulas.system
        entries = [
            e for part in (system.drift, system.input_matrix, system.diffusion) for e in part
        ]
        asked = not_polynomial([system.exact(e) for e in entries], system.states)
        return judge(replace(self._region, name="the system on G", continuous=asked), self._budget)

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
        result = supremum(
            replace(self._region, name=name),
            expression,
            wanted,
            self._budget,
            None if supremum_hints else self._hints,
        )
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
            best = sp.Min(*[self._best(row) for row in rows])
            # Where the claim is 0 somewhere no budget suffices, but a small shortfall is proved.
            return judge(replace(self._region, name=name, claim=best), self._quick, self._hints)
        inputs = self._formulas.system.inputs
        claims = [
            sum(a * u for a, u in zip(self._coefficients(row), inputs, strict=True))
            + self._offset(row)
            for row in rows
        ]
        statement = replace(
            self._region,
            name="all conditions can be met at once on G",
            claim=sp.Min(*claims),
            witnesses=inputs,
            witness=self._common_input,
        )
        verdict = judge(statement, self._budget)
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
        worst = sp.Max(*[-self._best(row) for row in rows])
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
            found += [(f"{n.name} <= {_shown(n.value)}", n.verdict) for n in self.suprema]
        found.append(("the condition can be met everywhere on G", self.feasible))
        if self.feasible.word != "proved":
            number = self.shortfall
            amount = f" by at most {_shown(number.value)}" * math.isfinite(number.value)
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


def _shown(value: float) -> str:
    """Return a proved upper bound in few digits, not below it."""
    return f"{float(rounded_up(value, _SHOWN)) if math.isfinite(value) else value:.{_SHOWN}g}"
