"""The answer of `safe-envs check`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from rich.console import Console

from safe_envs.errors import shortened
from safe_envs.outward_text import number_at_least, number_at_most, percent_at_least
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.wrappers.certificates.certificate import AnyCertificate, HeldCertificate
from safe_envs.wrappers.certificates.check_result import CheckResult
from safe_envs.wrappers.certificates.statements import EnvDifference
from safe_envs.wrappers.verification.held_check import stated_bound

_BY = {
    "intervals": "branch and bound with first-order forms",
    "balls": "ball arithmetic of Arb",
    "judge": "the program that found its numbers, branch and bound with outward rounding",
}


@dataclass(frozen=True, eq=False)
class CheckAnswer:
    """What was found of the certificate of a file.

    Attributes:
        file: its name.
        certificate: what it states.
        found: results of the checks, by name.
        env: whether its system is that of the env that it names.
        starts: states to tell the bound of.
    """

    file: str
    certificate: AnyCertificate
    found: Mapping[str, CheckResult]
    env: EnvDifference
    starts: Sequence[Sequence[float]]

    @property
    def word(self) -> str:
        """What is said of the certificate: checked only where every check says so."""
        words = [result.word for result in self.found.values()]
        words += ["refuted"] if self.env.word == "differs" else []
        return next((word for word in ("refuted", "undecided") if word in words), "checked")

    def bounds(self) -> list[float | None]:
        """Return the bound at each start, rounded down; 0 outside of G, None unless checked."""
        if self.word != "checked":
            return [None] * len(self.starts)
        c, bounds = self.certificate, list[float | None]()
        plant = c.plant
        for start in self.starts:
            known = dict(zip(plant.states, map(sp.Float, start), strict=True))
            values: list[Any] = [h.xreplace(known) for h in plant.barriers]
            ranges = zip(start, plant.workspace, strict=True)
            within = all(float(low) < x < float(high) for x, (low, high) in ranges)
            inside = within and all(float(v) > 0 for v in values)
            x = np.array([start], dtype=float)
            at = (
                stated_bound(c).held_bounds_at(x, c.steps)
                if isinstance(c, HeldCertificate)
                else c.bounds_at(x)
            )
            bounds.append(max(0.0, float(at[0]) - 1e-9) if inside else 0.0)
        return bounds

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        c = self.certificate
        parts = {
            name: {
                "word": result.word,
                "boxes": result.boxes,
                "statements": [part.as_dict() for part in result.parts],
            }
            for name, result in self.found.items()
        }
        bounds = zip(self.starts, self.bounds(), strict=True)
        return {
            "file": self.file,
            "env_id": c.env_id,
            "options": c.options,
            "env": self.env._asdict(),
            "degree": c.psi.degree,
            "input": "held" if isinstance(c, HeldCertificate) else "continuous",
            "control": "policy" if c.plant.policy else "constraint",
            **{name: float(v) for name, v in _numbers(c).items()},
            "word": self.word,
            "checks": parts,
            "bounds": [{"state": list(start), "bound": bound} for start, bound in bounds],
        }


def _numbers(c: AnyCertificate) -> dict[str, Any]:
    if isinstance(c, HeldCertificate):
        own = {"m": c.shortfall, "sag": c.sag, "tail": c.tail, "c": c.supremum}
        return own | {"period": c.period, "steps": c.steps}
    return {"a": c.rate, "m": c.shortfall, "c": c.supremum, "horizon": c.horizon}


def _number_text(name: str, value: Any) -> str:
    """Return a number of a certificate, on the side on which the certificate states less."""
    if name in ("period", "steps"):
        return f"{float(value):.9g}"
    return (number_at_least if name == "horizon" else number_at_most)(value, 9)


def _formula(c: AnyCertificate) -> str:
    """Return the bound that a certificate states."""
    if isinstance(c, HeldCertificate):
        return (
            "P(safe and in the workspace at all control instants) >="
            " [psi(x) - steps (m + sag + tail)]/c"
        )
    spent = "m (1 - e^(-a T))/a" if c.rate else "m T"
    weight = "psi(x) e^(-a T)" if c.rate else "psi(x)"
    return f"P(safe for T, or until the workspace is left) >= [{weight} - {spent}]/c"


def print_check(console: Console, answer: CheckAnswer) -> None:
    """Print what a certificate states, and whether it is so.

    Args:
        console: to print on.
        answer: to print.
    """
    c = answer.certificate
    names = ", ".join(s.name for s in c.plant.states)
    whose = c.env_id or "a system without an id"
    control = "one policy" if c.plant.policy else "every input that meets its constraint"
    say(console, f"{shortened(answer.file)}: barrier certificate of {shortened(whose)}")
    say(console, f"psi has degree {c.psi.degree} in {names}; it is for {control}")
    told = ", ".join(f"{name} = {_number_text(name, v)}" for name, v in _numbers(c).items())
    say(console, f"It states, with {told}: {_formula(c)}")
    say(console, answer.env.text)
    for name, result in answer.found.items():
        say(console, f"\nBy {_BY[name]}:")
        rows = []
        for part in result.parts:
            at = "" if part.state is None else f"at ({', '.join(f'{x:.6g}' for x in part.state)})"
            note = "; ".join(text for text in (at, part.reason) if text)
            boxes = f"{part.boxes:,}" if part.boxes else ""
            seconds = f"{part.seconds:.2f}" if part.seconds else ""
            rows.append((part.name, part.word, boxes, seconds, note))
        console.print()
        print_rows(console, "plrrp", ("statement", "word", "boxes", "seconds", ""), rows)
        console.print()
    if answer.starts:
        rows = []
        for start, bound in zip(answer.starts, answer.bounds(), strict=True):
            place = ", ".join(f"{x:g}" for x in start)
            text = "not proved" if bound is None else f">= {percent_at_least(bound, 2)} %"
            rows.append((place, text))
        console.print()
        print_rows(console, "pr", (names, "bound"), rows)
        console.print()
    proof = "a proof of its bound" if answer.word == "checked" else "no proof of its bound"
    held = (
        f"for input that is held for {float(c.period):g} s"
        if isinstance(c, HeldCertificate)
        else ""
    )
    say(console, f"{answer.word}: the certificate is {proof}, {held or 'for continuous control'}")
