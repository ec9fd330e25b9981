"""The answer of `safe-envs certify`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp
from rich.console import Console
from rich.text import Text

from safe_envs.agents.evaluation.statistics import percent
from safe_envs.agents.evaluation.table import describe_system
from safe_envs.agents.jobs.store import package_versions
from safe_envs.errors import shortened
from safe_envs.filters.certificates.certificate import BarrierCertificate, CheckResult
from safe_envs.filters.certificates.matching import EnvDifference
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.certify import Certification
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.text import number_at_least, number_at_most, percent_at_least, percent_at_most


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


@dataclass(frozen=True, eq=False)
class CheckAnswer:
    """What was found of the certificate of a file.

    Attributes:
        file: its name.
        certificate: what it states.
        found: by the checker.
        env: whether its system is that of the env that it names.
        starts: states to tell the bound of.
    """

    file: str
    certificate: BarrierCertificate
    found: CheckResult
    env: EnvDifference
    starts: Sequence[Sequence[float]]

    @property
    def word(self) -> str:
        """What is said of the certificate: refuted too where its env has another system."""
        return "refuted" if self.env.word == "differs" else self.found.word

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
            bound = float(c.bounds_at(np.array([start], dtype=float))[0])
            bounds.append(max(0.0, bound - 1e-9) if inside else 0.0)
        return bounds

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        c = self.certificate
        bounds = zip(self.starts, self.bounds(), strict=True)
        return {
            "file": self.file,
            "env_id": c.env_id,
            "options": c.options,
            "env": self.env._asdict(),
            "degree": c.psi.degree,
            "control": "policy" if c.plant.policy else "constraint",
            **{name: float(v) for name, v in _stated_numbers(c).items()},
            "word": self.word,
            "boxes": self.found.boxes,
            "statements": [part.as_dict() for part in self.found.parts],
            "bounds": [{"state": list(start), "bound": bound} for start, bound in bounds],
        }


def _stated_numbers(c: BarrierCertificate) -> dict[str, Any]:
    return {"a": c.rate, "m": c.shortfall, "c": c.supremum, "horizon": c.horizon}


def _number_text(name: str, value: Any) -> str:
    """Return a number of a certificate, on the side on which the certificate states less."""
    return (number_at_least if name == "horizon" else number_at_most)(value, 9)


def _formula(c: BarrierCertificate) -> str:
    """Return the bound that a certificate states."""
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
    told = ", ".join(f"{name} = {_number_text(name, v)}" for name, v in _stated_numbers(c).items())
    say(console, f"It states, with {told}: {_formula(c)}")
    say(console, answer.env.text)
    rows = []
    for part in answer.found.parts:
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
    say(console, f"{answer.word}: the certificate is {proof}, for continuous control")
