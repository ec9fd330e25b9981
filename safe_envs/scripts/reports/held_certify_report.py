"""The answer of `safe-envs certify --held`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.agents.evaluation.setting_text import describe_system
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.outward_text import number_at_most
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.certify_report import proved_cell, proved_mean, say_written
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.wrappers.synthesis.held_synthesis import HeldAttempt, HeldCertification


@dataclass(frozen=True, eq=False)
class HeldCertifyAnswer:
    """What was found for an env with held input.

    Attributes:
        title: of the env.
        config: what was asked for, as JSON.
        problem: of the env.
        found: the certificate, and what was tried.
        out: file of the certificate, if one was asked for.
    """

    title: str
    config: dict[str, Any]
    problem: SafetyProblem
    found: HeldCertification
    out: Path | None

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        found, certificate = self.found, self.found.certificate
        numbers = {}
        if certificate is not None:
            names = ("supremum", "shortfall", "sag", "tail", "period", "steps")
            numbers = {name: float(getattr(certificate, name)) for name in names}
            numbers["degree"] = certificate.psi.degree
        return {
            "config": self.config,
            "versions": package_versions(),
            "proved": found.mean if certificate else None,
            "proved_margin": found.margin if certificate else None,
            "starts": found.starts,
            **numbers,
            "degrees": [_attempt(a) for a in found.attempts],
            "seconds": found.seconds,
            "file": None if self.out is None or certificate is None else str(self.out),
        }

    def print_on(self, console: Console) -> None:
        """Print the degrees, the certificate, and what was not found.

        Args:
            console: to print on.
        """
        told = (
            " | barrier certificate of held input for every policy under psi's constraint"
            f" | start {self.problem.start}\n{describe_system(self.problem)}"
        )
        say(console, Text.assemble((self.title, "bold"), told))
        titles = ("degree", "coeffi\u00adcients", "linear program", "sampled", "proved", "boxes")
        rows = []
        for a in self.found.attempts:
            b = a.bound
            cells = (
                str(a.degree),
                str(a.members),
                percent(None if a.program is None else max(0.0, a.program)),
                percent(None if a.program is None else a.sampled),
                proved_cell(None if b is None else a.proved, b.reason if b else ""),
                f"{b.boxes:,}" if b else "-",
                f"{a.seconds:.1f}",
            )
            rows.append(cells)
        console.print()
        print_rows(console, "r", (*titles, "seconds"), rows)
        console.print()
        for line in self._lines():
            say(console, line)
        if self.found.certificate is not None:
            say_written(console, self.out)

    def _lines(self) -> list[str]:
        found, c = self.found, self.found.certificate
        notes = [
            f"Note: degree {a.degree} is undecided: {a.bound.reason}."
            for a in found.attempts
            if a.bound is not None and a.bound.reason
        ]
        none = [str(a.degree) for a in found.attempts if a.sampled <= 0.0]
        if none:
            notes.append(
                f"Note: no barrier of degree {', '.join(none)} has a bound above 0 at the sampled"
                " states. That says nothing of other degrees, or of other functions."
            )
        if c is None:
            return ["No bound above 0 is proved.", *notes]
        lost = (c.shortfall + c.sag + c.tail) * c.steps
        parts = (c.shortfall, c.sag, c.tail, c.supremum)
        m1, m2, e, top = (number_at_most(v, 3) for v in parts)
        lines = [
            f"Proved: P(safe and in the workspace for {c.steps} steps of {float(c.period):g} s)"
            f" {proved_mean(found.mean, found.margin, found.starts)}",
            f"psi of degree {c.psi.degree}, c = {top}; in a step it falls by at most m1 + m2 + e ="
            f" {m1} + {m2} + {e}, which costs {number_at_most(100 * lost, 2)} % of c = 1",
            f"found and proved in {found.seconds:.3g} s",
        ]
        return [*lines, *notes]


def _attempt(a: HeldAttempt) -> dict[str, Any]:
    b = a.bound
    return {
        "degree": a.degree,
        "coefficients": a.members,
        "program": a.program,
        "sampled": None if a.program is None else a.sampled,
        "proved": None if b is None or b.reason else a.proved,
        "reason": (b.reason or None) if b else None,
        "boxes": b.boxes if b else None,
        "seconds": a.seconds,
    }
