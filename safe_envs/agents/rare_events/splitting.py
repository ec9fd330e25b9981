"""Probabilities of rare violations, by adaptive multilevel splitting on h."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from safe_envs.agents.rare_events.particles import Particles, PathPlayer
from safe_envs.agents.rare_events.path_keys import PathKeys
from safe_envs.dynamics.philox import PILOTS, SPLIT

KILLED = 0.75
"""Share of a repetition's paths that are killed at a level, at least."""

LEAST = 1e-20
"""Below this a probability is given up: its next level may be one that is never reached."""

POWERS = (0.0, 0.5)
"""Of the time that is left, in the two scores: see
`safe_envs.agents.rare_events.heights.Heights`."""

TARGET = 0.25
"""Standard deviation of the logarithms of estimates that the number of particles is chosen for: a
pilot knows it to some 20 %, and what it comes to is to be below .3."""

_MOST_TIMES = 16
"""By how much the number of particles of a pilot is raised at most."""

_OFTEN = 0.1


@dataclass(frozen=True)
class Splitting:
    """How to estimate the probability that h comes down to 0, several times, side by side.

    Each repetition begins with `particles` episodes. A level is the height that a given share of
    them did not fall below; those are killed, all of them where several stand at one level, and
    replaced: by copies of survivors, chosen at random, up to the first instant at which they fell
    below the level, and from there with noise of their own. With K_i of N killed at level i, the
    probability is the product of the 1 - K_i/N, times the share that violates in the end. That is
    unbiased for any share and for any score; both count for the spread alone.

    Attributes:
        player: simulates the episodes.
        seed: of all randomness.
        killed: share at a level, at least, between 0 and 1.

    Source: C.-E. Brehier, M. Gazeau, L. Goudenege, T. Lelievre, M. Rousset, Unbiasedness of some
        generalized adaptive multilevel splitting algorithms, Annals of Applied Probability 26
        (2016) 3559-3601.
    """

    player: PathPlayer
    seed: int
    killed: float = KILLED

    def pilot(
        self,
        particles: int,
        repetitions: int,
        progress: Callable[[float], None] | None = None,
    ) -> Pilot:
        """Run some repetitions with each score, with noise of their own.

        Both scores are unbiased, so that the better one has the estimates that lie higher: a large
        part of the probability that few repetitions find makes the others too low, and the spread
        of what they agree on does not show it.

        Args:
            particles: N.
            repetitions: R of each score.
            progress: called with the part that is done.

        Returns:
            The better score, with its estimates; the first one if violations are frequent.

        Raises:
            ConfigurationError: the policy has a memory.
        """
        run = Repetitions(self, np.repeat(POWERS, repetitions), particles, PILOTS)
        often = run.first > _OFTEN * run.paths.lowest.size
        if not often:
            run.finish(progress)
        parts = [range(k * repetitions, (k + 1) * repetitions) for k in range(len(POWERS))]
        chosen = 0 if often else _better(*(run.estimates[part] for part in parts))
        return Pilot(POWERS[chosen], particles, often, run, parts[chosen])

    def estimate(
        self,
        power: float,
        particles: int,
        repetitions: int,
        progress: Callable[[float], None] | None = None,
    ) -> Repetitions:
        """Estimate the probability.

        Args:
            power: of the score.
            particles: N.
            repetitions: R.
            progress: called with the part of the way from the first level to 0.

        Returns:
            The estimates, and what the repetitions found.

        Raises:
            ConfigurationError: the policy has a memory.
        """
        run = Repetitions(self, np.full(repetitions, power), particles, SPLIT)
        run.finish(progress)
        return run


def _better(first: np.ndarray, second: np.ndarray) -> int:
    """Return the index of the unbiased estimates that lose less; of the first ones in doubt."""
    if (lost := [np.count_nonzero(each == 0.0) for each in (first, second)])[0] != lost[1]:
        return lost.index(min(lost))
    logs = [np.log(each[each > 0.0]) for each in (first, second)]
    if min(map(len, logs)) < 2:
        return 0
    (mean, variance), (other_mean, other_variance) = (
        (float(each.mean()), float(each.var(ddof=1))) for each in logs
    )
    error = math.sqrt(variance / len(logs[0]) + other_variance / len(logs[1]))
    return int(other_mean - other_variance / 2.0 - (mean - variance / 2.0) > error)


class Repetitions:
    """Independent estimates of one probability, which are final after `finish`.

    Args:
        how: who simulates, and the seed.
        powers: of the score of each repetition, shape (R,).
        particles: N.
        purpose: of the streams of keys, see `PathKeys`.

    Attributes:
        estimates: unbiased, shape (R,); those that were given up are 0.
        levels: that each took, shape (R,).
        paths: of all repetitions; those of the beginning are plain episodes.
        first: violations among the paths of the beginning.
        length: mean length of all of these, up to a violation, in control periods.
        stuck: for each repetition all of whose paths stood at one level, h there.
        endless: for each one that fell below `LEAST`, h of its last level.
    """

    def __init__(self, how: Splitting, powers: np.ndarray, particles: int, purpose: int) -> None:
        keys = PathKeys(how.seed, purpose)
        self._particles = particles
        self._rank = min(max(round(how.killed * particles), 1), particles - 1)
        self._generators = [keys.generator(r) for r in range(len(powers))]
        self.paths = Particles(how.player, keys, np.repeat(powers, particles))
        self.estimates, self.levels = np.ones(len(powers)), np.zeros(len(powers), dtype=np.int64)
        self.stuck: list[float] = []
        self.endless: list[float] = []
        self.first = int(np.count_nonzero(self.paths.lowest <= 0.0))
        self.length = self.paths.steps / self.paths.lowest.size

    def finish(self, progress: Callable[[float], None] | None) -> None:
        """Go from level to level until every repetition has its estimate or is given up."""
        active, highest = range(len(self.estimates)), 0.0
        while True:
            found = {r: kill for r in active if (kill := self._next_level(r)) is not None}
            if not found:
                return
            active = list(found)
            killed, parents, levels = (
                np.concatenate(parts) for parts in zip(*found.values(), strict=True)
            )
            self.levels[active] += 1
            highest = max(highest, float(levels.max()))
            if progress:
                progress(1.0 - float(levels.mean()) / highest)
            self.paths.branch(killed, parents, levels)

    def violating(self, part: range | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the `girsanov_integrals` of the paths that violate, and their shares.

        The share is the part of the estimated probability for which each stands.

        Args:
            part: of the repetitions; None for all.
        """
        part = part or range(len(self.estimates))
        violate = self.paths.lowest.reshape(len(self.estimates), self._particles) <= 0.0
        counts = violate[part].sum(axis=1)
        each = self.estimates[part] / (np.maximum(counts, 1) * len(part))
        own = np.zeros_like(violate)
        own[part] = violate[part]
        return self.paths.girsanov_integrals(np.flatnonzero(own)), np.repeat(each, counts)

    def _next_level(self, r: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return which paths to kill, which to continue in their place, and from which level.

        None if the repetition is at its end.
        """
        own = np.arange(r * self._particles, (r + 1) * self._particles)
        lowest = self.paths.lowest[own]
        place = self._particles - self._rank
        level = float(np.partition(lowest, place)[place])
        if level <= 0.0:
            self.estimates[r] *= np.count_nonzero(lowest <= 0.0) / self._particles
            return None
        killed, survivors = own[lowest >= level], own[lowest < level]
        self.estimates[r] *= survivors.size / self._particles
        if self.estimates[r] < LEAST:
            kept = self.endless if survivors.size else self.stuck
            kept.append(float(self.paths.h_at_lowest(killed).min()))
            self.estimates[r] = 0.0
            return None
        parents = self._generators[r].choice(survivors, killed.size)
        return killed, parents, np.full(killed.size, level)


@dataclass(frozen=True)
class Pilot:
    """What repetitions of their own say about an estimation that is to come.

    Attributes:
        power: of the better score.
        particles: N.
        often: whether violations are frequent, so that nothing has to be split.
        run: the repetitions, with all scores.
        part: those with the better one.
    """

    power: float
    particles: int
    often: bool
    run: Repetitions
    part: range

    @property
    def estimates(self) -> np.ndarray:
        """Estimates with the better score, 0 for those that were given up, shape (R,)."""
        return self.run.estimates[self.part]

    @property
    def deviation(self) -> float:
        """Standard deviation of the logarithms of the estimates that were not given up."""
        found = self.estimates[self.estimates > 0.0]
        return float(np.std(np.log(found), ddof=1)) if len(found) > 1 else 0.0

    def enough(self) -> int:
        """Return how many particles make the spread small, as far as that is affordable."""
        lost = np.count_nonzero(self.estimates == 0.0)
        if self.often or 2 * lost > len(self.part):
            return self.particles  # Where hardly any repetition gets there, more do not either.
        times = (self.deviation / TARGET) ** 2
        return math.ceil(self.particles * min(max(times, 4.0 if lost else 1.0), _MOST_TIMES))
