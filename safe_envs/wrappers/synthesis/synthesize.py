"""The search for a barrier over degrees, rates and first inputs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.candidate import BarrierCandidate
from safe_envs.wrappers.synthesis.domain import Domain
from safe_envs.wrappers.synthesis.generator import Generator
from safe_envs.wrappers.synthesis.improvement import CuttingPlanes, Improvement
from safe_envs.wrappers.synthesis.linear_program import MeanBound
from safe_envs.wrappers.synthesis.settings import SynthesisSettings
from safe_envs.wrappers.synthesis.witnesses import witnesses_of

Progress = Callable[[float], None]

_DEGREES = {1: (8, 14, 20), 2: (6, 10, 14, 16), 3: (4, 6, 8), 4: (2, 4)}
_LAST_DEGREES = (2,)
_MOST_STATES = 6
"""With more states neither the search nor the proof, which bisects along all, ends in minutes."""

_MOST_MEMBERS = 800
"""Members of a basis up to which linear programs are fast enough."""

_RATES = (0.0, 0.1, 0.5, 1.0)
"""Rates that are tried, for 1/T."""

_FIRST_ROUNDS = 3
_NOTHING = 1e-3
"""Mean bound from which a barrier is one."""

_NEAR, _STEP = 64, 0.01
"""States drawn near one where the inequality fails, and how far, for the width of C 2."""


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
        members: coefficients that the linear programs find.
        candidate: the barrier; nothing where none was found with a bound above 0.
        inputs: what the first linear program took for the input.
        seconds: of computing.
        carried: whether the barrier is that of the degree before, than which none is better.
    """

    degree: int
    members: int
    candidate: BarrierCandidate | None
    inputs: str
    seconds: float
    carried: bool = False


class Synthesis:
    """Barriers of a task by linear programs, whose numbers hold where states were sampled.

    The input, for which a linear program needs a formula, is the one that raises the barrier of the
    program before it most: so each program can keep the last barrier, but for the states added.

    Args:
        task: what is asked for.
        settings: of the search.

    Attributes:
        domain: the safe set.
        starts: those of the task that are in it, their angles within the period.

    Raises:
        ConfigurationError: There are too many states, or no state of C was found, or no start is in
            it, or the workspace is unbounded.
        NumericalError: The system has no finite value at a state of C.
    """

    def __init__(self, task: Task, settings: SynthesisSettings) -> None:
        self._task, self._settings = task, settings
        self._degrees = _climbed(degrees_of(task.plant, settings), len(task.plant.states))
        self.domain = Domain.of(task.plant, task.closed, settings.seed)
        generator = Generator(task.plant)
        starts = self.domain.wrapped(task.starts)
        self.starts = starts[self.domain.inside(starts)]
        if not len(self.starts):
            raise ConfigurationError("no start is in the safe set and in the workspace")
        self._improvement = Improvement(self.domain, generator, self.starts, settings)
        self._laws = witnesses_of(generator, self.domain, task.nominal)
        rates = settings.rates or [float(f"{r / task.horizon:.6g}") for r in _RATES]
        self._bounds = [MeanBound(rate, task.horizon) for rate in rates]

    def attempts(self, progress: Progress | None = None) -> tuple[Attempt, ...]:
        """Return the best barrier of each degree, which is never worse than that of a lower one.

        Args:
            progress: called with the part of the work that is done.

        Returns:
            Attempts of increasing degree. Where the settings list none, a degree that is no better
            than the one before, or nothing to gain, ends them. Where the time is over only the
            lowest degree of the settings is begun.
        """
        deadline = time.monotonic() + self._settings.seconds
        lowest = min(self._settings.degrees, default=None)
        found, last, first, name = list[Attempt](), None, None, ""
        for k, degree in enumerate(self._degrees):
            started = time.monotonic()
            if found and started > deadline and degree != lowest:
                continue
            basis = ChebyshevBasis(
                self._task.plant.states, *self.domain.frame, degree, self.domain.even
            )
            before = None if last is None else last.embedded(basis)
            if first is None:
                planes, name = self._begun(basis)
                # The next degree starts from the first rounds: more of them fix the inputs and
                # the set where psi > 0, and end lower, as measured for CubicSDE and Pendulum.
                first = planes and planes.best
                own = planes and planes.improve(self._settings.rounds, deadline)
            else:
                planes = CuttingPlanes(self._improvement, basis, first.bound, first)
                own = planes.improve(self._settings.rounds, deadline)
                first = own if _mean(own) > _NOTHING else first
            last = max(before, own, key=_mean)
            carried = last is not None and last is before
            seconds = time.monotonic() - started
            found.append(Attempt(degree, len(basis.exponents), last, name, seconds, carried))
            if progress is not None:
                progress((k + 1) / len(self._degrees))
            gain = 0.0 if carried else 1.0 - _mean(last)
            if last is not None and not self._settings.degrees and gain < self._settings.tolerance:
                break
        return tuple(found)

    def repaired(self, candidate: BarrierCandidate, worst: np.ndarray) -> BarrierCandidate | None:
        """Return a better barrier, where the inequality is asked near a state too.

        Args:
            candidate: the barrier.
            worst: state where its inequality fails, shape (n,).
        """
        rng = np.random.default_rng(self._settings.seed)
        scale = np.array([float(s) for s in self.domain.frame[1]])
        near = worst + _STEP * scale * rng.standard_normal((_NEAR, len(worst)))
        if self.domain.even:
            near = np.concatenate([near, -near])
        extra = np.concatenate([worst[None], near[self.domain.inside(near)]])
        improvement = replace(self._improvement, extra=extra)
        planes = CuttingPlanes(improvement, candidate.basis, candidate.bound, candidate)
        return planes.improve(self._settings.rounds, time.monotonic())

    def _begun(self, basis: ChebyshevBasis) -> tuple[CuttingPlanes | None, str]:
        """Return the best begun programs over all rates and first inputs, and the latter's name."""
        best, name, most = None, "", _NOTHING
        for bound in self._bounds:
            for law, inputs in self._laws.items():
                planes = CuttingPlanes(self._improvement, basis, bound, inputs)
                mean = _mean(planes.improve(_FIRST_ROUNDS, least=most))
                if mean > most:
                    best, name, most = planes, law, mean
        return best, name


def degrees_of(plant: Plant | ControlAffineSDE, settings: SynthesisSettings) -> tuple[int, ...]:
    """Return the degrees that are tried, increasing.

    Args:
        plant: the system.
        settings: of the search.

    Raises:
        ConfigurationError: There are too many states, or a polynomial of a degree has too many
            coefficients.
    """
    n = len(plant.states)
    if n > _MOST_STATES:
        raise ConfigurationError(
            f"the system has {n} states, and certificates are looked for with up to {_MOST_STATES}:"
            " each state multiplies the coefficients of psi and the boxes of its proof; give a"
            " system of the states that the barriers need"
        )
    degrees = tuple(sorted(set(settings.degrees))) or _DEGREES.get(n, _LAST_DEGREES)
    members = sp.binomial(n + degrees[-1], n)
    if members > _MOST_MEMBERS:
        raise ConfigurationError(
            f"a polynomial of {n} states and degree {degrees[-1]} has {members} coefficients;"
            f" linear programs up to {_MOST_MEMBERS} are solved: give a lower degree"
        )
    return degrees


def _climbed(degrees: tuple[int, ...], n: int) -> tuple[int, ...]:
    """Return degrees after the lower ones of `_DEGREES`, whose first linear programs are fast."""
    lower = (d for d in _DEGREES.get(n, _LAST_DEGREES) if d < degrees[0])
    return (*lower, *degrees)


def _mean(candidate: BarrierCandidate | None) -> float:
    return -1.0 if candidate is None else candidate.mean
