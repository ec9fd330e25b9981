"""The answer of `safe-envs certify`."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.agents.evaluation.setting_text import describe_system
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.outward_text import (
    number_at_least,
    number_at_most,
    percent_at_least,
    percent_at_most,
)
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.wrappers.certificates.certificate import BarrierCertificate
from safe_envs.wrappers.synthesis.certify import Certification


@dataclass(frozen=True, eq=False)
class CertifyAnswer:
    """What was found for an env.

    Attributes:
        title: of the env.
        config: what was asked for, as JSON.
        problem: of the env.
        found: the certificate, and what was tried.
        upper: of the best attainable safety of the env's step; None where it was not asked for.
        out: file of the certificate, if one was asked for.
    """

    title: str
    config: dict[str, Any]
    problem: SafetyProblem
    found: Certification
    upper: float | None
    out: Path | None

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        found = self.found
        judged = {j.degree: j for j in found.judgements}
        degrees = []
        for a in found.attempts:
            c, j = a.candidate, judged.get(a.degree)
            degrees.append(
                {
                    "degree": a.degree,
                    "coefficients": a.members,
                    "program": c and c.program,
                    "sampled": c and c.mean,
                    "proved": j and (None if j.numbers.reason else j.mean),
                    "reason": j and (j.numbers.reason or None),
                    "boxes": j and j.numbers.boxes,
                    "first_input": a.inputs,
                    "seconds": a.seconds + (j.seconds if j else 0.0),
                }
            )
        return {
            "config": self.config,
            "versions": package_versions(),
            "proved": found.mean if found.certificate else None,
            "proved_margin": found.margin if found.certificate else None,
            "starts": found.starts,
            "attainable_upper": self.upper,
            **_numbers(found.certificate),
            "degrees": degrees,
            "seconds": found.seconds,
            "file": None if self.out is None or found.certificate is None else str(self.out),
        }


def print_certification(console: Console, answer: CertifyAnswer) -> None:
    """Print the degrees, the certificate, and what was not found.

    Args:
        console: to print on.
        answer: to print.
    """
    found, problem = answer.found, answer.problem
    whose = "the nominal controller" if answer.config["policy"] else "every policy under psi's"
    whose += "" if answer.config["policy"] else " constraint"
    told = f" | barrier certificate for {whose} | start {problem.start}\n{describe_system(problem)}"
    say(console, Text.assemble((answer.title, "bold"), told))
    judged = {j.degree: j for j in found.judgements}
    titles = ("degree", "coeffi\u00adcients", "linear program", "sampled", "proved", "a", "boxes")
    rows = []
    for a in found.attempts:
        c, j = a.candidate, judged.get(a.degree)
        cells = (
            str(a.degree),
            str(a.members),
            percent(c.program if c else None),
            percent(c.mean if c else None),
            proved_cell(j and j.mean, j.numbers.reason if j else ""),
            f"{c.bound.rate:g}" if c else "-",
            f"{j.numbers.boxes:,}" if j else "-",
            f"{a.seconds + (j.seconds if j else 0.0):.1f}",
        )
        rows.append(cells)
    console.print()
    print_rows(console, "r", (*titles, "seconds"), rows)
    console.print()
    for line in (*_result_lines(answer), *_missing_lines(found)):
        say(console, line)
    if found.certificate is not None:
        say_written(console, answer.out)


def _result_lines(answer: CertifyAnswer) -> list[str]:
    found, certificate = answer.found, answer.found.certificate
    if certificate is None:
        return ["No bound above 0 is proved."]
    numbers = (certificate.rate, certificate.shortfall, certificate.supremum)
    a, m, c = (number_at_most(v, 6) for v in numbers)
    lines = [
        f"Proved: P(safe for {number_at_least(certificate.horizon, 6)} s, or until the workspace is"
        f" left) {proved_mean(found.mean, found.margin, found.starts)}",
        f"psi of degree {certificate.psi.degree}, a = {a} 1/s, m = {m} 1/s, c = {c};"
        f" found and proved in {found.seconds:.3g} s",
    ]
    best = next(x for x in found.attempts if x.degree == _degree(found))
    gap = (best.candidate.program if best.candidate else 0.0) - found.mean
    if gap > 0.0:
        lines.append(
            f"The linear program of this degree has {100 * gap:.2g} % more, at sampled states:"
            " better bounds need higher degrees, or other inputs in the program"
        )
    if answer.upper is not None:
        lines.append(
            f"No policy is safer than {percent_at_most(answer.upper)} % with the env's own held"
            " input (computed; another claim than this one, of continuous control)"
        )
    lines.append(
        "Note: the bound is of continuous control; the env holds its input for"
        f" {answer.problem.dt:g} s."
    )
    return lines


def proved_cell(mean: float | None, reason: str) -> str:
    """Return the bound of a degree as the cell of a table.

    Args:
        mean: of the bound; None where the judge was not asked.
        reason: why it is undecided; "" where it is proved.
    """
    if mean is None:
        return "-"
    return "undecided" if reason else f"{percent_at_least(mean)} %"


def proved_mean(mean: float, margin: float, starts: int) -> str:
    """Return ">=" and a proved bound, as one number, and what it is of.

    Args:
        mean: of the bound over the starts.
        margin: by which the mean over all starts may be lower, at 99.99 % confidence.
        starts: how many there are; 1 where none is drawn.
    """
    if starts == 1:
        return f">= {percent_at_least(mean)} %, from the start"
    least = max(Decimal(repr(mean)) - Decimal(repr(margin)), Decimal(0))
    return (
        f">= {percent_at_least(least)} %, mean over the starts: that over {starts:,} drawn ones,"
        f" less {percent_at_most(margin)} %, at 99.99 % confidence"
    )


def say_written(console: Console, out: Path | None) -> None:
    """Print where a certificate is, and the command that checks it.

    Args:
        console: to print on.
        out: its file, if one was asked for.
    """
    if out is not None:
        say(console, f"Written to {out}; check it with: safe-envs check {out}", wrap=False)


def _missing_lines(found: Certification) -> list[str]:
    """Return what was not found, in words."""
    lines = []
    none = [str(a.degree) for a in found.attempts if a.candidate is None]
    carried = [a.degree for a in found.attempts if a.carried]
    own = [j for j in found.judgements if j.degree not in carried]
    if none:
        lines.append(
            f"Note: no barrier of degree {', '.join(none)} has a bound above 0 at the sampled"
            " states. That says nothing of other degrees, or of other functions than polynomials."
        )
    lines += [
        f"Note: nothing of degree {degree} is better than psi of the lower degree, which it has."
        for degree in carried
    ]
    lines += [
        f"Note: degree {j.degree} is undecided: {j.numbers.reason}."
        for j in own
        if j.numbers.reason
    ]
    lines += [
        f"Note: the numbers of degree {j.degree} may be far from the least ones: {j.numbers.note}."
        for j in own
        if j.numbers.note and not j.numbers.reason
    ]
    return lines


def _degree(found: Certification) -> int:
    return max(found.judgements, key=lambda j: j.mean).degree


def _numbers(certificate: BarrierCertificate | None) -> dict[str, Any]:
    if certificate is None:
        return {}
    names = ("rate", "shortfall", "supremum", "horizon")
    return {name: float(getattr(certificate, name)) for name in names} | {
        "degree": certificate.psi.degree
    }
