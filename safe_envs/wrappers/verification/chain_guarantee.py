"""The guarantee of the chains of barriers: which theorems apply, and what they are worth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from safe_envs.wrappers.verification import bounds
from safe_envs.wrappers.verification.assumptions import (
    JOINT,
    above_shortfall,
    above_suprema,
    failures,
    infeasible,
    mismatch,
    missed_somewhere,
    nearly_rough,
    no_bound,
    outside,
    unbounded,
)
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.judge import JudgeResult
from safe_envs.wrappers.verification.proof import ChainProof
from safe_envs.wrappers.verification.results import (
    Bound,
    Candidate,
    Extremum,
    Stages,
    Status,
    candidates_for,
    holds_up_to_a_time,
    stages_of,
)
from safe_envs.wrappers.verification.safe_set import draw_starts, sample
from safe_envs.wrappers.verification.safe_set_analysis import SafeSetAnalysis
from safe_envs.wrappers.verification.search import largest

NOTHING = "it is 0 at these starts up to this horizon"
"""What there is to say of a bound that is 0."""

_SAMPLES = 2048
_STARTS = 1024
_EMPTY = "the sets C_j have no state in common"


class ChainGuarantee:
    """The bounds that the chains b_0, ..., b_(r-1) of the barriers give.

    A search looks for counterexamples to their hypotheses and for the suprema and the shortfall in
    them. The judge then proves the hypotheses and the numbers, or leaves some of them undecided:
    bounds that need these are estimates.

    Args:
        formulas: the chains and conditions, compiled.
        analysis: of the safe set, if there is one; made when it is needed otherwise.
        seconds: of processor time, for the search for the shortfall and for the judge each. Then
            the judge is not asked either for what would be 0 at the starts. None for no limit.
    """

    def __init__(
        self,
        formulas: Formulas,
        analysis: SafeSetAnalysis | None = None,
        seconds: float | None = None,
    ) -> None:
        self.formulas, self._given, self._seconds = formulas, analysis, seconds

    @cached_property
    def analysis(self) -> SafeSetAnalysis:
        """What was found in the safe set."""
        seconds = math.inf if self._seconds is None else self._seconds
        return self._given or SafeSetAnalysis(self.formulas, seconds=seconds)

    @cached_property
    def proof(self) -> ChainProof:
        """What the judge proves of the hypotheses and numbers."""
        # What several conditions lack together is proved, or not, without knowing it.
        shortfall, hints = 0.0, np.empty((0, self.formulas.problem.plant.n))
        if self.formulas.joint:
            shortfall, state = self.analysis.max_shortfall
            hints = state[None]
        suprema = self.analysis.suprema.tolist()
        return ChainProof(self.formulas, suprema, shortfall, hints, self._seconds)

    @property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """The hypotheses with the judge's word; none where no theorem applies."""
        return self.proof.statements if self._is_judged else []

    @cached_property
    def _is_judged(self) -> bool:
        """Whether a theorem applies, so that the judge is asked for its hypotheses and numbers."""
        return not no_bound(self.formulas) and self.analysis.invariant_set is not None

    @cached_property
    def shortfall(self) -> Extremum:
        """The largest shortfall on the invariant set; on C where that is empty."""
        found = self.analysis.max_shortfall[0]
        return Extremum(found, self.proof.shortfall.value) if self._is_judged else Extremum(found)

    @cached_property
    def suprema(self) -> tuple[Extremum, ...]:
        """The suprema c_j on the invariant set; where none matters, none is proved."""
        found = self.analysis.suprema.tolist()
        if self.formulas.certain or not self._is_judged:
            return tuple(map(Extremum, found))
        return tuple(map(Extremum, found, [number.value for number in self.proof.suprema]))

    @property
    def note(self) -> str | None:
        """Why there is no bound, the first of several reasons; None if there is one."""
        return self._reason or None

    @cached_property
    def _reason(self) -> str:
        # What needs no search comes first.
        reason = no_bound(self.formulas) or mismatch(self.formulas)
        if not reason and self.analysis.invariant_set is None:
            reason = _EMPTY
        if not reason:
            reason = next(filter(None, self._against), "")
        if (
            not reason
            and self.formulas.certain
            and not holds_up_to_a_time(self.formulas, self.stages)
        ):
            reason = self.remark
        return reason

    @property
    def _against(self) -> Iterator[str]:
        """Reasons why there is no bound, the cheapest first; a proof only where it decides."""
        yield from failures(self.analysis)
        if self._seconds is not None and self._surely_nothing:
            # What several conditions lack together takes long to search for.
            yield (self.remark if self.formulas.joint else "") or NOTHING
        yield self._unbounded
        yield from self._unverified

    @property
    def _surely_nothing(self) -> bool:
        """Whether the bound is 0 at the starts whatever the judge proves.

        The numbers that the search found are too small, if anything, and make it too large.
        """
        suprema = self.analysis.suprema
        if self.formulas.certain or not np.isfinite(suprema).all():
            return False
        b = self.formulas.chain(draw_starts(self.formulas.problem, _STARTS))
        stages = stages_of(self.formulas, suprema.tolist(), 0.0)
        horizon = self.formulas.problem.duration
        found = candidates_for(self.formulas, b, stages, horizon, Extremum(0.0))
        return not found[-1].values.any()

    @property
    def _unbounded(self) -> str:
        """Which supremum is infinite, where one matters, in words; may be empty."""
        proved = self.formulas.certain or all(math.isfinite(c.value) for c in self.suprema)
        return "" if proved else unbounded(self.analysis)

    @property
    def _unverified(self) -> list[str]:
        """The assumptions that neither the search nor the judge establishes, in words."""
        found = [] if self.proof.bounded.word == "proved" else [self.analysis.limits]
        found += [] if self.proof.regular else [nearly_rough(self.analysis)]
        if not self.formulas.joint and math.isinf(self.proof.shortfall.value):
            found.append(JOINT)
        return [reason for reason in found if reason]

    @property
    def remark(self) -> str:
        """Why the bound is weak: where no action meets the condition; may be empty."""
        return missed_somewhere(self.shortfall, self.proof.negligible)

    @property
    def word(self) -> Status:
        """Whether the bound that `at` returns is proved or estimated."""
        allowed = any(self.stages.shortfalls)
        return "proved" if self.proof.word_of(allowed)[0] == "proved" else "estimated"

    @cached_property
    def stages(self) -> Stages:
        """The stages of all barriers."""
        suprema = None if self.formulas.certain else [c.value for c in self.suprema]
        return stages_of(self.formulas, suprema, self.shortfall.value)

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Return the largest bound on P(safe up to the horizon) whose hypotheses hold.

        Args:
            starts: states, shape (B, n).
            horizon: T in s.

        Returns:
            Values in [0, 1], shape (B,); 0 where there is no bound.
        """
        b = self.formulas.chain(np.asarray(starts, dtype=np.float64))
        if self.note:
            return np.zeros(len(b))
        return candidates_for(self.formulas, b, self.stages, horizon, self.shortfall)[-1].values

    def contradiction(
        self, reached: np.ndarray, violated: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """Say what states contradict in the numbers of the bound; "" if nothing.

        Args:
            reached: states that were reached, starts among them, shape (B, n).
            violated: states where the filter violated its conditions, shape (E, n).
            actions: what it executed there, shape (E, m).
            slack: by how much it reports to have violated them, shape (E,); the actions themselves
                tell how much of it is a sampling margin.

        Returns:
            A text.
        """
        if self.note:
            return ""
        return above_suprema(self.formulas, self.suprema, reached) or above_shortfall(
            self.formulas, self.shortfall, violated, actions
        )

    def applicable_bounds(self, starts: np.ndarray, horizon: float) -> list[Bound]:
        """Return the results that suit the conditions, at a start or on average over several.

        P(safe) from a random start is the mean of P(safe) over it, so that the mean of a bound is a
        bound.

        Args:
            starts: states, shape (B, n).
            horizon: T in s.
        """
        formulas = self.formulas
        nothing = no_bound(formulas)
        if not nothing and self.analysis.invariant_set is not None:
            nothing = self._unbounded
        if nothing or self.analysis.invariant_set is None:
            return [Bound("all of them", None, "no bound", nothing or _EMPTY)]
        b = formulas.chain(starts)
        inside = (b > 0.0).all(axis=1)
        if not inside.any():
            return [Bound("all of them", None, "hypothesis fails", outside(formulas, b))]
        share = f"{100 * (1 - inside.mean()):.1f} %"
        partly = [f"0 at the {share} of the starts that are outside some C_j"] * (not inside.all())
        candidates = candidates_for(formulas, b, self.stages, horizon, self.shortfall)
        found = [self._judged(candidate, partly) for candidate in candidates]
        high = above_suprema(formulas, self.suprema, starts)
        return [bound.without(high) for bound in found]

    def _judged(self, candidate: Candidate, partly: list[str]) -> Bound:
        """Return the mean of a result over the starts, with what is against it."""
        infeasible = "" if candidate.allows_shortfall else self._infeasible
        broken = [*failures(self.analysis), *filter(None, [infeasible])]
        unproved = [*self._unverified, *filter(None, [candidate.gap])]
        status, open_ = self._status(candidate, bool(broken), bool(unproved))
        values = candidate.values
        reason = "; ".join([*broken, *unproved, *filter(None, [open_]), *partly])
        error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else 0.0
        return Bound(candidate.name, float(values.mean()), status, reason, candidate.forever, error)

    def _status(self, candidate: Candidate, broken: bool, unproved: bool) -> tuple[Status, str]:
        """Return what a result is worth, and what the judge leaves undecided of it."""
        if broken or unproved:
            return "hypothesis fails" if broken else "not established", ""
        word, reason = self.proof.word_of(candidate.allows_shortfall)
        if word == "refuted":
            return "hypothesis fails", reason
        return ("proved", "") if word == "proved" else ("estimated", f"undecided: {reason}")

    @cached_property
    def _infeasible(self) -> str:
        """Where the conditions cannot be met, in words; may be empty."""
        return infeasible(self.analysis, self.shortfall)

    def best_start(self, seed: int = 0) -> np.ndarray | None:
        """Return the state (n,) where the printed bound is largest; None without such a bound.

        Args:
            seed: of the search.
        """
        formulas, analysis = self.formulas, self.analysis
        if (
            analysis.invariant_set is None
            or formulas.certain
            or no_bound(formulas)
            or self._unbounded
        ):
            return None
        level, region, rng = formulas.invariant_level, analysis.region, np.random.default_rng(seed)
        points = sample("the intersection of the C_j", level, region, _SAMPLES, rng).points

        def printed(x: np.ndarray) -> np.ndarray:
            return bounds.theorem_4_2_10_printed(formulas.chain(x), self.stages.suprema)

        return largest(printed, points, region, rng)[1]
