"""How safe any policy can be from an env's starts, and how safe the greedy policy of a table is.

The largest probability of a safe episode lies between the means, over the starts, of a lower and of
an upper envelope, which hold the error of their grid; see `safe_envs.wrappers.value`. They are
computed in floating point, and certified where the table was checked. The policy that follows the
table is simulated, and its rate must lie between them: where its interval does not meet them, they
are withheld.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.contradiction import SURE
from safe_envs.agents.evaluation.greedy_episodes import SimulatedRate, simulate
from safe_envs.agents.evaluation.rate_text import percent_in
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import exact_interval, require_confidence
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.errors import require_whole
from safe_envs.outward_text import number_at_least, number_at_most
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.proved_starts import ProvedStarts
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.starts import start_values
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.table_check import TableCheck, check_table

_TABLE_WORK = 0.8
"""Part of the work that is the table's, for the progress."""


@dataclass(frozen=True)
class AttainableSafety:
    """How safe any policy can be, from the starts of an env.

    Attributes:
        lower: bound of the largest probability of a safe episode from below, the mean over the
            starts; None where it is withheld.
        upper: the bound from above; None where it is withheld.
        simulated: rate of the greedy policy; None where it was not simulated.
        contradiction: why the bounds are withheld; "" where they are not.
        knowledge: whose step is taken, that of the "plant" or of the "model".
        leaving: how an episode counts that leaves the workspace in the safe set, as a "violation"
            or as "safe".
        specification: that an episode is to meet; "" for staying safe.
        coordinates: of the grid, expressions of the states.
        cells: of the grid along each coordinate.
        inputs: number of inputs that are scanned.
        steps: control periods of an episode.
        seconds: that the table took when it was computed.
        memory: of the table in bytes.
        check: of the table, whose result is in both ends; None where they are only computed.
    """

    lower: float | None
    upper: float | None
    simulated: SimulatedRate | None
    contradiction: str
    knowledge: str
    leaving: str
    specification: str
    coordinates: tuple[str, ...]
    cells: tuple[int, ...]
    inputs: int
    steps: int
    seconds: float
    memory: int
    check: TableCheck | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data; the rate of the greedy policy is a number, or null."""
        found = {**vars(self), "contradiction": self.contradiction or None}
        found |= {name: list(found[name]) for name in ("coordinates", "cells")}
        s = self.simulated
        found["check"] = self.check and vars(self.check)
        return found | {
            "simulated": s and s.rate,
            "simulated_interval": s and [s.low, s.high],
            "simulated_confidence": s and s.confidence,
            "leave_rate": s and s.leave_rate,
            "episodes": s and s.episodes,
            "seed": s and s.seed,
        }


def attainable_safety(
    problem: SafetyProblem,
    settings: ValueSettings,
    *,
    episodes: int = 1000,
    seed: int = 0,
    confidence: float = 0.95,
    num_envs: int = 1024,
    file: Path | None = None,
    progress: Progress | None = None,
) -> tuple[AttainableSafety, BestPolicy]:
    """Compute how safe any policy can be from a problem's starts.

    With the knowledge "model" it is the world of the model that is looked at, and simulated.

    Args:
        problem: with the starts.
        settings: of the table.
        episodes: of the simulation of the greedy policy; 0 for none.
        seed: of the simulation.
        confidence: of the interval of its rate.
        num_envs: episodes side by side.
        file: of the table, read or written, in place of the cache.
        progress: called with the part of the work that is done, from 0 to 1.

    Returns:
        What was found, and the greedy policy with its table.

    Raises:
        ConfigurationError: A number is out of range, or there is no table of the problem.
    """
    require_whole("episodes", episodes, 0)
    require_confidence(confidence)
    # A value is that of the true state, whatever is measured of it.
    problem = problem.unmeasured
    world = problem if settings.knowledge == "plant" else replace(problem, plant=problem.model)
    policy = BestPolicy(world, settings, file)
    part = _TABLE_WORK if episodes else 1.0
    policy.prepare(progress and (lambda done: progress(part * done)))
    found = of_table(world, policy.table, policy.look_ahead)
    if not episodes:
        return found, policy
    simulated = simulate(
        policy,
        episodes,
        seed,
        confidence,
        num_envs,
        progress and (lambda done: progress(part + (1.0 - part) * done)),
    )
    return judged(replace(found, simulated=simulated)), policy


def of_table(problem: SafetyProblem, table: ValueTable, look_ahead: LookAhead) -> AttainableSafety:
    """Return what a table says of a problem's starts, without a simulation.

    Args:
        problem: with the starts.
        table: of the problem.
        look_ahead: of the table.
    """
    settings = table.settings
    values = start_values(look_ahead, problem)
    coordinates = reduced(
        problem, settings.knowledge, settings.intervals, settings.specification
    ).coordinates
    return AttainableSafety(
        lower=values.lower,
        upper=values.upper,
        simulated=None,
        contradiction="",
        knowledge=settings.knowledge,
        leaving=settings.leaving,
        specification=settings.specification,
        coordinates=tuple(str(c.expression) for c in coordinates),
        cells=tuple(table.grid.shape),
        inputs=len(table.inputs),
        steps=table.steps,
        seconds=table.seconds,
        memory=table.memory,
    )


def certified(
    found: AttainableSafety, policy: BestPolicy, progress: Progress | None = None
) -> AttainableSafety:
    """Return what was found with certified ends in place of computed ones.

    The upper end is computed still where `check.upper` is None.

    Args:
        found: with bounds; without any it is returned as it is.
        policy: with the table.
        progress: called with the part of the work that is done, from 0 to 1.

    Raises:
        TableRefusedError: The table is no envelope.
        ConfigurationError: Such tables are not checked.
    """
    if found.lower is None or found.upper is None:
        return found
    table, problem, look_ahead = policy.table, policy.problem, policy.look_ahead
    check = check_table(table, problem, progress=progress)
    starts = ProvedStarts(table, problem, check, look_ahead)
    values = start_values(starts, problem, most=starts.most_starts)
    upper = found.upper if check.upper is None else values.upper
    return judged(replace(found, lower=values.lower, upper=upper, check=check))


def judged(found: AttainableSafety) -> AttainableSafety:
    """Return what was found, without bounds that the rate of the greedy policy contradicts."""
    s = found.simulated
    if s is None or found.lower is None or found.upper is None:
        return found
    low, high = exact_interval(s.safe, s.episodes, SURE)
    where = (
        f"above the upper bound {number_at_most(found.upper, 6)}"
        if low > found.upper
        else f"below the lower bound {number_at_least(found.lower, 6)}"
        if high < found.lower
        else ""
    )
    if not where:
        return found
    told = f"{percent_in(s.rate, low, high)} of {s.episodes} episodes ({100 * SURE:g} % interval)"
    return withheld(found, f"the greedy policy is safe in {told}, which is {where}")


def contradicted(
    found: AttainableSafety, rates: Sequence[tuple[str, int, int]]
) -> AttainableSafety:
    """Return what was found, without bounds that a measured rate exceeds.

    Args:
        found: with bounds, or without.
        rates: name, safe episodes and episodes of each rate, counted as the table does.
    """
    if found.upper is None:
        return found
    for name, safe, episodes in rates:
        low, high = exact_interval(safe, episodes, SURE)
        if low > found.upper:
            told = f"{percent_in(safe / episodes, low, high)} ({100 * SURE:g} % interval)"
            most = number_at_most(found.upper, 6)
            reason = f"{name} is safe in {told}, above the upper bound {most}"
            return withheld(found, reason)
    return found


def withheld(found: AttainableSafety, reason: str) -> AttainableSafety:
    """Return what was found without its bounds.

    Args:
        found: with bounds.
        reason: how they are contradicted.
    """
    return replace(found, lower=None, upper=None, contradiction=reason)
