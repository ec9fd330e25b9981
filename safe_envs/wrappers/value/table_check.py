"""Proofs of tables: both envelopes of a table, checked by outward-rounded arithmetic.

By proposition 2 of the page on values, a table L_k <= 1_C with L_k <= Q^u L_(k+1) + e_k, for an
input u of each cell, bounds the largest probability of a safe episode from below by L_0 - sum e_k;
by proposition 3, one with H_k >= Q^u H_(k+1) - e_k for all inputs from above by H_0 + sum e_k. Both
inequalities are checked here on every cell, whoever has computed the table: the sets, the images of
the cells, the probabilities of the noise and all sums are bounds, to the last place.

What is proved is proved of the reduced chain: of the step that was derived from the problem, with
its numbers in double precision, and in the frame that the problem declares, if it does.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.proved_chain import ProvedChain
from safe_envs.wrappers.value.proved_sweeps import Deficit, Progress, ProvedSweeps
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.table_files import load_table

TOLERANCE = 1e-6
"""Largest e_k of a table that is not refused."""


class TableRefusedError(ConfigurationError):
    """A table is no envelope: an inequality fails on a cell."""


@dataclass(frozen=True)
class TableCheck:
    """What was proved of a table.

    Attributes:
        lower: the sum of all e_k of the lower envelope: what is to be taken off it.
        upper: the same for the upper envelope, to be added to it; None where it was not checked.
        later: the sum without e_0, which is to be taken off a look-ahead at the first instant.
        unchecked: why the upper envelope was not checked; "" where it was.
        assumed: what is taken for granted besides the derivation of the chain; "" for nothing.
        seconds: that the check took.
    """

    lower: float
    upper: float | None
    later: tuple[float, float | None]
    unchecked: str
    assumed: str
    seconds: float


def check_table(
    table: ValueTable, problem: SafetyProblem, upper: bool = True, progress: Progress | None = None
) -> TableCheck:
    """Prove the envelopes of a table.

    Args:
        table: of the problem.
        problem: the problem.
        upper: whether the upper envelope is checked as well, which takes longer.
        progress: called with the part of the work that is done.

    Returns:
        What is to be taken off the lower envelope, and added to the upper one.

    Raises:
        TableRefusedError: An inequality fails on a cell by more than `TOLERANCE`.
        ConfigurationError: The table is of another problem, or of one that is not supported.
    """
    begun = time.perf_counter()
    settings = table.settings
    small = reduced(problem, settings.knowledge, settings.intervals, settings.specification)
    if small.fingerprint != table.fingerprint:
        raise ConfigurationError(
            f"the table is of another problem ({table.problem}, or other parameters, bounds or"
            f" periods) than {problem.name}; compute one for this problem"
        )
    if table.steps != small.steps:
        raise ConfigurationError(
            f"the table has {table.steps} steps, and {problem.name} has {small.steps}"
        )
    for values in (table.lower, table.upper):
        # NaN is not <= 1.
        if values.shape[1] != table.grid.cells or not (values.min() >= 0.0 and values.max() <= 1.0):
            raise TableRefusedError(
                f"the table of {table.problem} is refused: its values are not in [0, 1], one for"
                " each cell; compute it again"
            )
    sweeps = ProvedSweeps(table, ProvedChain(small, settings.leaving, table.grid))
    share = 0.5 if upper else 1.0
    losses = _required("lower", sweeps.lower(_scaled(progress, 0.0, share)), table)
    gains, unchecked = None, "it was not asked for"
    if upper:
        unchecked = sweeps.obstacle()
    if not unchecked:
        gains = _required("upper", sweeps.upper(_scaled(progress, share, 1.0 - share)), table)
    return TableCheck(
        lower=_total(losses),
        upper=None if gains is None else _total(gains),
        later=(_total(losses[1:]), None if gains is None else _total(gains[1:])),
        unchecked=unchecked,
        assumed="" if problem.frame is None or small.note else "the frame that is declared",
        seconds=time.perf_counter() - begun,
    )


def check_table_file(
    path: Path | str,
    problem: SafetyProblem,
    upper: bool = True,
    progress: Progress | None = None,
) -> TableCheck:
    """Prove the envelopes of a table in a file; see `check_table`.

    Args:
        path: of the file.
        problem: whose values it holds.
        upper: whether the upper envelope is checked as well.
        progress: called with the part of the work that is done.

    Returns:
        What is to be taken off the lower envelope, and added to the upper one.

    Raises:
        ValueFileError: The file is damaged, or holds no table of the problem.
        TableRefusedError: An inequality fails on a cell by more than `TOLERANCE`.
        ConfigurationError: Such tables are not checked.
    """
    return check_table(load_table(path, problem), problem, upper, progress)


def _required(envelope: str, found: list[Deficit], table: ValueTable) -> list[float]:
    """Return e_k of an envelope; raise `TableRefusedError` if one of them is too large."""
    worst = max(found, key=lambda each: each.amount)
    if not worst.amount <= TOLERANCE:
        low, high = table.grid.corners(np.array([worst.cell]))
        place = " x ".join(f"[{a[0]:.6g}, {b[0]:.6g}]" for a, b in zip(low, high, strict=True))
        raise TableRefusedError(
            f"the table of {table.problem} is refused: at k = {worst.k} on cell {worst.cell},"
            f" {place}, the {envelope} envelope is off by {worst.amount:.3g}; compute it again"
        )
    return [each.amount for each in found]


def _total(deficits: list[float]) -> float:
    return math.nextafter(math.fsum(deficits), math.inf) if any(deficits) else 0.0


def _scaled(progress: Progress | None, begin: float, share: float) -> Progress | None:
    return progress and (lambda done: progress(begin + share * done))
