"""The answer of `safe-envs verify`, and the same as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.bound_check import MeasuredSafety
from safe_envs.agents.evaluation.safety_chain import SafetyChain
from safe_envs.wrappers import spec_of
from safe_envs.wrappers.verification.certificate_guarantee import CertificateGuarantee
from safe_envs.wrappers.verification.feasibility import SetFeasibility, Verification
from safe_envs.wrappers.verification.judge import JudgeResult
from safe_envs.wrappers.verification.results import Bound


@dataclass(frozen=True, eq=False)
class VerifyAnswer:
    """What was found about a filter.

    Attributes:
        title: of the env.
        config: what was asked for, as JSON.
        policy: name of the simulated policy.
        verification: where the conditions can be met.
        starts: for which the bounds are, shape (B, n).
        bounds: on the probability of no violation.
        measurements: of that probability; none without a simulation.
        chain: the bound for held input, the measured rate, and what any policy can attain.
    """

    title: str
    config: dict[str, Any]
    policy: str
    verification: Verification
    starts: np.ndarray
    bounds: Sequence[Bound]
    measurements: Sequence[MeasuredSafety]
    chain: SafetyChain

    @property
    def statements(self) -> list[tuple[str, JudgeResult]]:
        """All that a bound asks for, with the judge's word; none without an invariant set."""
        if self.verification.invariant_set is None:
            return []
        found = self.verification.guarantee.statements
        # Where no number is proved, none is finite.
        return [(text.replace("<= infinite", "is finite"), verdict) for text, verdict in found]

    @property
    def judged_region(self) -> str:
        """What the G of the statements is, in words."""
        of_certificate = isinstance(self.verification.guarantee, CertificateGuarantee)
        positive = "psi and all h are" if of_certificate else "all b_j are"
        return f"G is where {positive} positive, in the workspace"

    @property
    def filter_text(self) -> str:
        """The conditions of the filter."""
        return spec_of(self.verification.formulas.conditions)

    def document(self) -> dict[str, Any]:
        """Return all as strict JSON: what is infinite or not defined is null."""
        found = self.verification
        return _plain(
            {
                "config": {
                    **self.config,
                    "filter": self.filter_text,
                    "knowledge": found.formulas.knowledge,
                    "horizon": found.problem.duration,
                },
                "states": [s.symbol.name for s in found.problem.states],
                "drawn": found.analysis.safe.drawn,
                "notes": found.region.notes,
                "beyond_workspace": found.beyond,
                "undefined": found.undefined,
                "safe_set": _set(found, found.safe_set),
                "invariant_set": found.invariant_set and _set(found, found.invariant_set),
                "barriers": [_barrier(found, i) for i in range(len(found.barriers))],
                "statements": [
                    {"statement": text, **verdict._asdict()} for text, verdict in self.statements
                ],
                "bounds": [vars(b) for b in self.bounds],
                "measurements": [_measured(m) for m in self.measurements],
                "chain": self.chain.as_dict(),
            }
        )


def _set(found: Verification, part: SetFeasibility) -> dict[str, Any]:
    """Return the feasibility in a set; the number of a search has a name of its own."""
    shortfall = found.shortfall(part)
    return {**vars(part), "shortfall": shortfall.proved, "shortfall_found": shortfall.found}


def _barrier(found: Verification, i: int) -> dict[str, Any]:
    """Return what is known of a barrier; the numbers of a search have names of their own."""
    barrier, supremum, suprema = found.barriers[i], found.supremum(i), found.suprema(i)
    document = dict(vars(barrier))
    return {
        "name": document.pop("name"),
        "control_authority_found": document.pop("control_authority"),
        **document,
        "supremum": supremum.proved,
        "supremum_found": supremum.found,
        "suprema": [each.proved for each in suprema],
        "suprema_found": [each.found for each in suprema],
        "vanishes": barrier.vanishes,
        "unbounded": math.isinf(barrier.supremum),
    }


def _measured(found: MeasuredSafety) -> dict[str, Any]:
    horizons = [{**vars(h), "bounds": [vars(b) for b in h.bounds]} for h in found.horizons]
    shown = {key: getattr(found, key) for key in ("start", "state", "episodes", "repeats")}
    return {**shown, "horizons": horizons}


def _plain(value: Any) -> Any:
    match value:
        case dict():
            return {key: _plain(entry) for key, entry in value.items()}
        case list() | tuple():
            return [_plain(entry) for entry in value]
        case np.ndarray() | np.generic():
            return _plain(value.tolist())
        case float():
            return value if math.isfinite(value) else None
    return value
