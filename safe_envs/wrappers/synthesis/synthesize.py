"""The search for a barrier over degrees, rates and first inputs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.candidate import Candidate
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.generator import Generator
from safe_envs.wrappers.synthesis.candidate import Improvement
from safe_envs.wrappers.synthesis.linear_program import Bound
from safe_envs.wrappers.synthesis.settings import SynthesisSettings
from safe_envs.wrappers.synthesis.witnesses import Witness, witnesses_of

Progress = Callable[[float], None]

_DEGREES = {1: (8, 16, 24), 2: (6, 10, 14, 16), 3: (4, 6, 8), 4: (3, 4, 5)}
_LAST_DEGREES = (2, 3)
_MOST_MEMBERS = 800
"""Members of a basis up to which linear programs are fast enough."""

_RATES = (0.0, 0.1, 0.5, 1.0)
"""Rates that are tried, for 1/T."""

_FIRST_ROUNDS = 3
_NOTHING = 1e-4
"""Mean bound from which a barrier is one."""


@dataclass(frozen=True)
class Task:
    """What is asked for: a barrier for starts up to a horizon.

    Attributes:
        plant: the system.
        horizon: T in s.
        starts: initial states over which the bound is averaged, shape (B, n).
        closed: states of which the workspace holds one period, where episodes do not end, n flags.
        nominal: laws of the nominal controller, of the states; () where they are unknown.
    """

    plant: Plant
    horizon: float
    starts: np.ndarray
    closed: tuple[bool, ...]
    nominal: tuple[sp.Expr, ...] = ()


@dataclass(frozen=True)
class Attempt:
    """The best barrier of a degree.

    Attributes:
        degree: total degree.
        candidate: the barrier; nothing where none was found with a bound above 0.
        inputs: what the first linear program took for the input.
        seconds: of computing.
    """

    degree: int
    candidate: Candidate | None
    inputs: str
    seconds: float


def synthesize(
    task: Task, settings: SynthesisSettings, progress: Progress | None = None
) -> tuple[Attempt, ...]:
    """Return the best barrier of each degree, whose numbers hold where states were sampled.

    The input, for which a linear program needs a formula, is the one that raises the barrier of the
    program before it most: so each program can keep the last barrier, but for the states added.

    Args:
        task: what is asked for.
        settings: of the search.
        progress: called with the part of the work that is done.

    Returns:
        Attempts of increasing degree; fewer than the settings list where the time is over.

    Raises:
        ConfigurationError: There are too many states, or no state of C was found, or the workspace
            is unbounded.
        NumericalError: The system has no finite value at a state of C.
    """
    begin = time.monotonic()
    domain = Domain.of(task.plant, task.closed, settings.seed)
    generator = Generator(task.plant)
    improvement = Improvement(domain, generator, task.starts, settings)
    witnesses: dict[str, Witness | Candidate] = dict(
        witnesses_of(generator, domain, task.nominal)
    )
    degrees = degrees_of(task.plant, settings)
    bounds = [
        Bound(rate, task.horizon)
        for rate in settings.rates or [r / task.horizon for r in _RATES]
    ]
    found: list[Attempt] = []
    last, name = None, ""
    for k, degree in enumerate(degrees):
        started = time.monotonic()
        if found and started - begin > settings.seconds:
            break
        basis = ChebyshevBasis(task.plant.states, *domain.frame, degree, domain.even)
        if last is None:
            tried = [
                (improvement.best(basis, bound, first, _FIRST_ROUNDS), own)
                for bound in bounds
                for own, first in witnesses.items()
            ]
            best, name = max(tried, key=lambda each: _mean(each[0]))
            if best is not None and len(degrees) == 1:
                best = _better(best, improvement.best(basis, best.bound, best, settings.rounds))
        else:
            best = improvement.best(basis, last.bound, last, settings.rounds)
        if _mean(best) < _NOTHING:
            best = None
        found.append(Attempt(degree, best, name, time.monotonic() - started))
        last = best if best is not None else last
        if progress is not None:
            progress((k + 1) / len(degrees))
    return tuple(found)


def degrees_of(plant: Plant, settings: SynthesisSettings) -> tuple[int, ...]:
    """Return the degrees that are tried, increasing.

    Args:
        plant: the system.
        settings: of the search.

    Raises:
        ConfigurationError: A polynomial of a degree has too many coefficients.
    """
    n = len(plant.states)
    degrees = tuple(sorted(set(settings.degrees))) or _DEGREES.get(n, _LAST_DEGREES)
    members = sp.binomial(n + degrees[-1], n)
    if members > _MOST_MEMBERS:
        raise ConfigurationError(
            f"a polynomial of {n} states and degree {degrees[-1]} has {members} coefficients; linear"
            f" programs up to {_MOST_MEMBERS} are solved: give a lower degree"
            + ("" if settings.degrees else ", or take a system of fewer states")
        )
    return degrees


def _mean(candidate: Candidate | None) -> float:
    return -1.0 if candidate is None else candidate.mean


def _better(a: Candidate, b: Candidate | None) -> Candidate:
    return a if b is None or a.mean >= b.mean else b
