"""Certificates of held input: from bounds that are proved, and back to be judged again."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.certificates.certificate import HeldCertificate, Plant
from safe_envs.wrappers.certificates.check_result import (
    CheckResult,
    StatementCheck,
    Word,
    combined,
)
from safe_envs.wrappers.verification.branch_and_bound import Budget
from safe_envs.wrappers.verification.held_bound import HeldBound
from safe_envs.wrappers.verification.judge import JudgeResult

_BUDGET = Budget(seconds=60.0)

_WORDS: dict[str, Word] = {"proved": "checked", "refuted": "refuted", "undecided": "undecided"}


def held_certificate(
    bound: HeldBound, steps: int, env_id: str = "", options: dict[str, object] | None = None
) -> HeldCertificate:
    """Return the certificate of a bound.

    Args:
        bound: that is proved.
        steps: K, control periods of an episode.
        env_id: of the env; empty for other systems.
        options: of the env.

    Raises:
        ConfigurationError: There is no bound.
    """
    if bound.reason:
        raise ConfigurationError(f"there is no bound to certify: {bound.reason}")
    return HeldCertificate(
        env_id,
        options or {},
        bound.plant,
        bound.psi,
        bound.period,
        steps,
        bound.supremum,
        bound.shortfall,
        bound.sag,
        bound.tail,
    )


def stated_bound(certificate: HeldCertificate) -> HeldBound:
    """Return the bound that a certificate states; nothing of it is proved here.

    Args:
        certificate: of held input.
    """
    return HeldBound(
        _clipped(certificate.plant),
        certificate.psi,
        certificate.period,
        certificate.supremum,
        certificate.shortfall,
        certificate.sag,
        certificate.tail,
    )


def check_held(certificate: HeldCertificate, seconds: float) -> CheckResult:
    """Judge the statements of a certificate of held input.

    Args:
        certificate: to check, which may be a stranger's.
        seconds: limit of time of each statement.

    Returns:
        A word for each statement; the bound is proved where all are checked.
    """
    verdicts = stated_bound(certificate).judged(Budget(seconds=seconds))
    return combined([_check_of(name, verdict) for name, verdict in verdicts])


def why_not_proved(certificate: HeldCertificate) -> str:
    """Return why the bound of a certificate is not proved, in words; "" where it is.

    Each certificate is judged once.

    Args:
        certificate: of held input.
    """
    parts = [getattr(certificate, each.name) for each in fields(certificate)[2:]]
    # A dictionary has no hash.
    key = repr([*parts, sorted(certificate.psi.coefficients.items())])
    if key not in _KNOWN:
        verdicts = stated_bound(certificate).judged(_BUDGET)
        reasons = (f"{name}: {v.reason}" for name, v in verdicts if v.word != "proved")
        _KNOWN[key] = next(reasons, "")
    return _KNOWN[key]


_KNOWN: dict[str, str] = {}


def _check_of(name: str, verdict: JudgeResult) -> StatementCheck:
    state = verdict.state
    if state is None and verdict.box is not None:
        state = verdict.box.mean(axis=0)
    return StatementCheck(
        name, _WORDS[verdict.word], verdict.boxes, state=state, reason=verdict.reason
    )


def _clipped(plant: Plant) -> Plant:
    """Return a plant whose policy is within the bounds, as the env clips it."""
    policy: Any = tuple(
        sp.Max(low, sp.Min(high, u))
        for u, (low, high) in zip(plant.policy, plant.bounds, strict=False)
    )
    return replace(plant, policy=policy)
