"""Probabilities of rare violations, by adaptive multilevel splitting on h."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from safe_envs.dynamics.noise import DRIFTING, PILOTS, SPLIT, StreamReader, key_of


@dataclass(frozen=True)
class PathKeys:
    """The keys of paths, of which each generation has its own.

    Whatever is drawn for a path is a function of the seed, the path, its generation and the control
    period.

    Attributes:
        seed: of all randomness.
        purpose: what the paths are for: `PILOTS`, `SPLIT` or `DRIFTING` of
            `safe_envs.dynamics.noise`.
    """

    seed: int
    purpose: int

    def of(self, paths: int, generation: int) -> np.ndarray:
        """Return the keys of paths 0, ..., `paths` - 1 of a generation, uint64 (paths,).

        Args:
            paths: how many.
            generation: 0 for paths from the start, and one more for each level from which paths
                are continued.
        """
        reader = StreamReader().seek(key_of(self.seed), generation, self.purpose)
        return reader.words(paths)

    def generator(self, repetition: int) -> np.random.Generator:
        """Return the generator that chooses among the paths of a repetition."""
        return np.random.default_rng(
            np.random.SeedSequence(self.seed, spawn_key=(self.purpose, repetition))
        )


class Heights:
    """The heights of paths.

    The height of a path at control instant k of K is its smallest h since the last one, times (1 -
    k/(K + 1))^-p: for p = 0 that is h, and for p = 1/2 it is h against what a Brownian motion may
    do in the time that is left. It is 0 or less at a violation. Of several barriers, which may have
    units of their own, each is divided by its mean at the starts.

    Args:
        powers: p of each path.
        steps: K.
        barriers: at the starts, shape (paths, k).

    Attributes:
        kinds: column of `weights` for each path, int64 (paths,).
        weights: (1 - k/(K + 1))^-p for each control instant, (K + 1, kinds).
        units: of the barriers, (k,).
    """

    def __init__(self, powers: np.ndarray, steps: int, barriers: np.ndarray) -> None:
        different, self.kinds = np.unique(powers, return_inverse=True)
        left = 1.0 - np.arange(steps + 1) / (steps + 1)
        self.weights = left[:, None] ** -different
        self.units = np.ones(barriers.shape[1])
        if len(self.units) > 1:
            at_start = barriers.mean(axis=0)
            self.units = np.where(at_start > 0.0, at_start, 1.0)

    def relative(self, barriers: np.ndarray) -> np.ndarray:
        """Return the smallest of the barriers, relative to their units: (B,) for (B, k)."""
        shares = barriers / self.units
        return shares[:, 0] if shares.shape[1] == 1 else shares.min(axis=1)

    def weight(self, instants: np.ndarray, paths: np.ndarray) -> np.ndarray:
        """Return what the smallest barriers of paths at control instants are multiplied by.

        Args:
            instants: at most K, shape (B,).
            paths: shape (B,).
        """
        return self.weights[instants, self.kinds[paths]]


FIRST_ROOM = 64


class Records:
    """The instants at which each path was nearer to a violation than ever before.

    Arrays grow as they fill.

    Args:
        paths: how many.
        states: entries of a state.

    Attributes:
        count: records of each path, int64 (paths,).
        heights: of the records, (paths, room); minus infinity where there is none.
        instants: control instants, int64 (paths, room).
        ended: whether the episode ended there, bool (paths, room).
        states: (paths, room, states).
        integrals: `TiltedNoiseEnv.girsanov_integrals`, (paths, room, 2).
    """

    def __init__(self, paths: int, states: int) -> None:
        self.count = np.zeros(paths, dtype=np.int64)
        shape = (paths, FIRST_ROOM)
        self.heights = np.full(shape, -np.inf)
        self.instants = np.zeros(shape, dtype=np.int64)
        self.ended = np.zeros(shape, dtype=bool)
        self.states = np.zeros((*shape, states))
        self.integrals = np.zeros((*shape, 2))

    @property
    def room(self) -> int:
        """How many records of a path there is room for."""
        return self.heights.shape[1]

    def keep(self, paths: np.ndarray, count: int) -> None:
        """Forget all but the first records of some paths.

        Args:
            paths: which.
            count: of the records that each keeps.
        """
        self.count[paths] = count
        self.heights[paths, count:] = -np.inf

    def add(self, paths: np.ndarray, *entries: np.ndarray) -> None:
        """Note a record of each of some paths.

        Args:
            paths: which.
            *entries: height, control instant, whether the episode ended there, state, and
              `TiltedNoiseEnv.girsanov_integrals`.
        """
        rows = self.count[paths]
        if rows.size and int(rows.max()) == self.room:
            self.grow()
        for kept, values in zip(self._all(), entries, strict=True):
            kept[paths, rows] = values
        self.count[paths] += 1

    def first_below(self, levels: np.ndarray, paths: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the first records of paths below levels, as the arguments of `add`.

        Args:
            levels: heights, shape (B,).
            paths: shape (B,).
        """
        # Records fall along a row, and what was not filled is lower than all.
        rows = (self.heights[paths] >= levels[:, None]).sum(axis=1)
        return tuple(kept[paths, rows] for kept in self._all())

    def last(self, paths: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the last records of paths, in the order of the arguments of `add`."""
        rows = self.count[paths] - 1
        return tuple(kept[paths, rows] for kept in self._all())

    def grow(self) -> None:
        """Double the room."""
        heights, *others = self._all()
        self.heights = np.concatenate([heights, np.full_like(heights, -np.inf)], axis=1)
        self.instants, self.ended, self.states, self.integrals = (
            np.concatenate([old, np.zeros_like(old)], axis=1) for old in others
        )

    def _all(self) -> tuple[np.ndarray, ...]:
        return (
            self.heights,
            self.instants,
            self.ended,
            self.states,
            self.integrals,
        )


class PathPlayer(Protocol):
    """Simulates paths; what comes of one depends on nothing but its key and its last record.

    Attributes:
        steps: control periods of an episode.
    """

    steps: int

    def starts(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states, (B, n), and the barriers, (B, k), at the starts of paths.

        Args:
            keys: of the paths, uint64 (B,).
        """
        ...

    def play(
        self,
        paths: np.ndarray,
        keys: np.ndarray,
        heights: Heights,
        records: Records,
        length: float,
    ) -> np.ndarray:
        """Simulate paths from their only record until they end or violate, and add the others.

        Args:
            paths: their numbers, shape (B,).
            keys: of all paths, uint64.
            heights: of all paths.
            records: of all paths.
            length: of the drift, in 1/sqrt(s).

        Returns:
            The control instants at which they ended, shape (B,).
        """
        ...


class Particles:
    """Paths of a policy in an env, up to their first violations; see `Heights`.

    Args:
        player: simulates them.
        keys: gives each generation of a path a key.
        powers: p of the height of each path.
        length: of the drift of their noise, in 1/sqrt(s).

    Attributes:
        lowest: smallest height of each path, shape (paths,).
        steps: control periods that were simulated.
        outside: how many paths start where h <= 0.
        kept_length: mean length of the paths from the starts that do not violate, in control
            periods; None without any.
    """

    def __init__(
        self, player: PathPlayer, keys: PathKeys, powers: np.ndarray, length: float = 0.0
    ) -> None:
        self._player, self._keys, self._length = player, keys, length
        self._generation = 0
        count = len(powers)
        paths = np.arange(count)
        self.lowest = np.full(count, np.inf)
        self._now = keys.of(count, 0)
        states, barriers = player.starts(self._now)
        self._heights = Heights(powers, player.steps, barriers)
        self._records = Records(count, states.shape[1])
        # At the start the weight is 1.
        h = self._heights.relative(barriers)
        self.outside, self.steps = int(np.count_nonzero(h <= 0.0)), 0
        instants, ended = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool)
        integrals = np.zeros((count, 2))
        lengths = self._play(paths, (h, instants, ended, states, integrals))
        kept = lengths[self.lowest > 0.0]
        self.kept_length = float(kept.mean()) if kept.size else None

    def h_at_lowest(self, paths: np.ndarray) -> np.ndarray:
        """Return h of paths where their heights were smallest, shape as given.

        Of several barriers it is relative to the starts.
        """
        instants = self._records.last(paths)[1]
        return self.lowest[paths] / self._heights.weight(instants, paths)

    def girsanov_integrals(self, paths: np.ndarray) -> np.ndarray:
        """Return `girsanov_integrals` of paths where their heights were smallest, shape (B, 2)."""
        return self._records.last(paths)[4]

    def branch(self, paths: np.ndarray, parents: np.ndarray, levels: np.ndarray) -> None:
        """Replace paths by what goes on from where others of the same p first fell below levels.

        Each gets a key of its own, so that its noise is new.

        Args:
            paths: those that are replaced, shape (B,).
            parents: those that are continued, none of which is replaced, shape (B,).
            levels: heights, each above its parent's smallest, shape (B,).
        """
        self._generation += 1
        self._now = self._keys.of(len(self.lowest), self._generation)
        entries = self._records.first_below(levels, parents)
        self._records.keep(paths, 0)
        self._play(paths, entries)

    def _play(self, paths: np.ndarray, entries: tuple[np.ndarray, ...]) -> np.ndarray:
        """Simulate paths from entries of `Records.add`; return when they ended."""
        self._records.add(paths, *entries)
        ends = self._player.play(paths, self._now, self._heights, self._records, self._length)
        self.steps += int((ends - entries[1]).sum())
        self.lowest[paths] = self._records.last(paths)[0]
        return ends


KILLED = 0.75
"""Share of a repetition's paths that are killed at a level, at least."""

LEAST = 1e-20
"""Below this a probability is given up: its next level may be one that is never reached."""

POWERS = (0.0, 0.5)
"""Of the time that is left, in the two scores: see
`safe_envs.agents.rare_events.splitting.Heights`."""

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
        """Return which paths to kill, which to continue in their place, and from which level."""
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


_STRONGEST = 64.0
"""The strongest drift that is thought of, in standard deviations of the noise over an episode."""


def log_ratio(girsanov_integrals: np.ndarray, lengths: Any) -> np.ndarray:
    """Return the log density of episodes' noise as it is over that with a drift.

    By Girsanov it is c int e'dW + c^2/2 int e'e dt.

    Args:
        girsanov_integrals: of the episodes, as in `TiltedNoiseEnv`, shape (..., 2).
        lengths: c of each, or one for all.
    """
    return lengths * girsanov_integrals[..., 0] + 0.5 * lengths**2 * girsanov_integrals[..., 1]


def optimal_tilt(
    girsanov_integrals: np.ndarray, shares: np.ndarray, horizon: float
) -> tuple[float, float]:
    """Return the drift whose weights differ least, judged by episodes that violate.

    It does not matter how these were found.

    With the weight w of an episode the second moment under the drift is E[w; violation] without it.
    So episodes that the drift would hardly ever show, since they violate on another way, count with
    their large weights.

    Args:
        girsanov_integrals: of episodes that violate, as in `TiltedNoiseEnv`, shape (B, 2).
        shares: of the probability for which each stands, shape (B,).
        horizon: of an episode, in s.

    Returns:
        The length c in 1/sqrt(s), and the deviation of the estimate of one episode with it,
        relative to the probability.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import logsumexp

    probability = math.fsum(shares)

    def log_second_moment(length: float) -> float:
        found: Any = logsumexp(log_ratio(girsanov_integrals, length), b=shares / probability)
        return float(found) - math.log(probability)

    # A sum of exponentials of convex functions: there is one minimum.
    found: Any = minimize_scalar(
        log_second_moment, bounds=(0.0, _STRONGEST / math.sqrt(horizon)), method="bounded"
    )
    return float(found.x), math.sqrt(max(math.exp(min(found.fun, 700.0)) - 1.0, 0.0))


@dataclass(frozen=True)
class ImportanceSampling:
    """How to estimate the probability that h comes down to 0, from episodes that are pushed there.

    Attributes:
        player: simulates the episodes. Where it looks between control instants too, the bridges
            between given ends do not depend on a drift.
        seed: of all randomness.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """

    player: PathPlayer
    seed: int

    def estimate(self, length: float, episodes: int, repetitions: int) -> tuple[np.ndarray, int]:
        """Estimate the probability.

        Args:
            length: of the drift, in 1/sqrt(s).
            episodes: of a repetition.
            repetitions: R.

        Returns:
            Unbiased estimates, shape (R,), and the control periods that were simulated.
        """
        powers = np.zeros(episodes * repetitions)
        paths = Particles(self.player, PathKeys(self.seed, DRIFTING), powers, length)
        violating = np.flatnonzero(paths.lowest <= 0.0)
        weights = np.zeros(len(powers))
        # The density ratio of each up to its violation; 0 without one.
        weights[violating] = np.exp(log_ratio(paths.girsanov_integrals(violating), length))
        return weights.reshape(repetitions, episodes).mean(axis=1), paths.steps
