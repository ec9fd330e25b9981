"""The backup filter: an input is allowed if a backup law keeps the system safe after it.

Let F(x, u) be the state that a held input leads to in one control period, and let each backup law
pi_j have a terminal set T_j, a part of the safe set from which F(x, pi_j(x)) is in T_j again. The
*plan* of law j from a state is the sequence that begins there and goes on under pi_j. It is *good*
if no barrier is negative at its states until one of them is in T_j, at most N periods on. An input
is *allowed* at x if the plan of some law from F(x, u) is good. The filter executes

1. the proposed input, if it is allowed;
2. else the nearest allowed one that it finds between the input of a backup law and the proposed
   one: of a few points on each of these segments, and then of points between the last allowed one
   and the next. With several inputs it goes on from there, see `backup_search`. Of every input that
   is executed, its own plan was simulated;
3. else the input of the law with the best plan. It says that it is infeasible if that plan is not
   good either.

*It stays feasible.* Let the plant be the model, without noise, and let u_k be allowed, by law j.
Then pi_j(x_{k+1}) is allowed at x_{k+1} = F(x_k, u_k). Proof: the plan x_{k+1} = z_0, z_1, ... is
good. If z_0 is not in T_j, the plan from z_1 = F(z_0, pi_j(z_0)) is the same one without its first
state: it reaches T_j one period earlier, and has no other states. If z_0 is in T_j, so is z_1, and
the plan from there is good at once. So from a start at which some input is allowed, an allowed
input is executed for ever, and no barrier is negative at any control instant, whatever is proposed:
F(x_k, u_k) is the first state of a good plan. The filter need remember nothing for that; the law by
which an input was allowed is found again.

*Rounding.* The plan is computed by the operations of the env, but in batches of another shape, in
which the last bits may differ. So 1. and 2. take plans on which no barrier is below `ROUNDING`, and
3. counts a plan as good without that: it is one that was good with it, but for rounding.

*A margin.* The proof holds for a floor m > 0 in the place of 0 if the laws keep m in their terminal
sets too: those that are derived for a problem are proved to; of those that are stated, it is for
the statement to say. Else 3. takes a plan that keeps 0, and says that it is feasible.

*What it does not cover.* What lies between control instants: a margin, as far as it is kept, of at
least half the distance that a barrier can fall and rise within a period does. Noise: the plan is
then that of the mean of a step, and an allowed input may lead to where none is allowed. A model
that differs from the plant. A start from which no law keeps the system safe.

Source: T. Gurriet, M. Mote, A. Singletary, P. Nilsson, E. Feron, A. D. Ames, "A scalable safety
critical control framework for nonlinear systems", IEEE Access 8 (2020), for backup laws under input
bounds; D. R. Agrawal, R. Chen, D. Panagou, "gatekeeper: Online safety verification and control for
nonlinear systems in dynamic environments", IEEE Transactions on Robotics 40 (2024), for plans that
are accepted or refused as a whole. The proof is for held inputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components, stacked
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.formulas import Source
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionError, shown
from safe_envs.filters import arguments
from safe_envs.filters.arguments import doubles, require_finite
from safe_envs.filters.conditions.names import BACKUP
from safe_envs.filters.conditions.text import FilterSettings, settings_in
from safe_envs.filters.qp import FilterDecision
from safe_envs.problem.backup import Backup, backup_of
from safe_envs.problem.builder import named_barriers
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.proofs.backup_plans import Plans, require_kept, sampled_states
from safe_envs.proofs.backup_search import Search
from safe_envs.proofs.backup_sets import with_terminal_sets
from safe_envs.proofs.backup_source import backup_source
from safe_envs.text import finite_number

_KEYS = ("horizon", "margin")
_EXAMPLE = f"{BACKUP}:horizon=2"

LONGEST = 10_000
"""Control periods of a plan at most."""


@dataclass(frozen=True)
class BackupSettings(FilterSettings):
    """What a backup filter is asked for.

    Attributes:
        horizon: how long a law may take to reach its terminal set, in s; None for what the problem
            states.
        margin: which no barrier may fall below on a plan, in its unit.

    Raises:
        ConfigurationError: A value is out of range.
    """

    name = BACKUP
    only_of_steps = "its plans are of the env's own steps"

    horizon: float | None = None
    margin: float = 0.0

    def __post_init__(self) -> None:
        if self.horizon is not None:
            horizon = finite_number("horizon of the backup filter", self.horizon)
            if not horizon > 0.0:
                raise ConfigurationError(
                    f"horizon = {horizon:g} s of the backup filter; give a positive time, like"
                    f" {_EXAMPLE}"
                )
            object.__setattr__(self, "horizon", horizon)
        margin = finite_number("margin of the backup filter", self.margin)
        if margin < 0.0:
            raise ConfigurationError(
                f"margin = {margin:g} of the backup filter; give a number >= 0 in the unit of the"
                f" barriers, like {BACKUP}:margin=0.1"
            )
        object.__setattr__(self, "margin", margin)

    @classmethod
    def of_text(cls, text: str) -> BackupSettings:
        """Read the text of a backup filter.

        Args:
            text: `backup`, and if need be `:horizon=2` in s and `:margin=0.1`.

        Raises:
            ConfigurationError: It has another form, or a value is out of range.
        """
        given = settings_in(text, BACKUP, _KEYS, _EXAMPLE)
        return cls(**{key: finite_number(f"{key} of {BACKUP}", v) for key, v in given.items()})

    @property
    def text(self) -> str:
        """The text from which `of_text` makes the same settings."""
        horizon = "" if self.horizon is None else f":horizon={self.horizon!r}"
        margin = f":margin={self.margin!r}" if self.margin else ""
        return f"{BACKUP}{horizon}{margin}"

    def require_fit(self, problem: SafetyProblem, objective: str = "nearest") -> None:
        """Raise ConfigurationError where a problem has no backup, or the settings do not fit it.

        Args:
            problem: that is to be kept safe.
            objective: of the filter.
        """
        if problem.backup is None:
            raise ConfigurationError(_none_stated(problem))
        if self.horizon is not None and self.horizon > LONGEST * problem.dt:
            raise ConfigurationError(
                f"horizon = {self.horizon:g} s of the backup filter; plans of {problem.name} have"
                f" {LONGEST} control periods of {problem.dt:g} s at most"
            )
        self.require_nearest(objective)


def _none_stated(problem: SafetyProblem) -> str:
    if problem.rates:
        return (
            f"{problem.name} with rate_limit has no backup: its laws give the inputs, of which the"
            " rates are now decided. Leave rate_limit out, or state a backup for the rates with"
            " dataclasses.replace(problem, backup=Backup(...))"
        )
    return (
        f"{problem.name} states no backup: a law that brings the system to a set which it never"
        " leaves. Give one, define_problem(..., backup=Backup((BackupLaw(name, law, terminal),),"
        " horizon)), dataclasses.replace(problem, backup=...), or FilterSpec(..., backup=...) for a"
        " third-party env, from safe_envs.problem.backup; or take another filter, such as"
        f" {problem.filter}"
    )


ROUNDING = 1e-9
"""Below which no barrier falls on the plan of an input that is executed in place of a backup."""


def _put(parts: Sequence[np.ndarray], rows: np.ndarray, values: Sequence[np.ndarray]) -> None:
    for part, value in zip(parts, values, strict=True):
        part[rows] = value


class _Stated(NamedTuple):
    """What a filter was made for."""

    system: ControlAffineSDE
    barriers: tuple[Barrier, ...]
    bounds: tuple[tuple[float, float], ...]
    dt: float
    substeps: int


class BackupFilter:
    """Chooses an input near a proposed one after which a backup law keeps the system safe.

    Args:
        system: that the filter knows. Noise is left out of its plans.
        barriers: h, safe where h >= 0: a `Barrier` or an expression of the states, or several.
        backup: laws with their terminal sets, and their horizon.
        bounds: (low, high) of all inputs in physical units, or one such pair for each; finite.
        dt: control period in s.
        substeps: integration steps in it, as the plant is simulated.
        settings: a horizon or a margin in place of the usual.

    Attributes:
        model: the system, as given.
        settings: as given.
        text: of the settings.
        plans: that are simulated.
        floor: below which no barrier may be on a plan.
        stated: names of the laws whose terminal sets nothing but samples was checked of.

    Raises:
        SystemDefinitionError: The system or a barrier is none, or they do not fit.
        ConfigurationError: A bound or a number is not allowed.
    """

    def __init__(
        self,
        system: ControlAffineSDE,
        barriers: Any,
        backup: Backup,
        bounds: Any,
        dt: float,
        substeps: int = 1,
        settings: BackupSettings | None = None,
    ) -> None:
        self.model = arguments.require_system(system)
        named = named_barriers(barriers)
        for barrier in named:
            used: set[Any] = barrier.expression.free_symbols
            system.require_known(f"barrier {barrier.name}", used, system.states)
        if not isinstance(backup, Backup):
            raise SystemDefinitionError(
                f"backup = {shown(backup)}; give a Backup of safe_envs.problem.backup"
            )
        for law in backup.laws:
            law.require_known(system)
            if law.terminal is None:
                raise SystemDefinitionError(
                    f"backup law {law.name} has no terminal set; give terminal=..., an expression"
                    " that is >= 0 in a set that the law never leaves; or take"
                    " BackupFilter.for_problem, which derives it from the equilibrium"
                )
        self.settings = BackupSettings() if settings is None else settings
        self.text = self.settings.text
        self.stated = tuple(law.name for law in backup.laws)
        low, high = arguments.read_bounds(system.inputs, bounds, endless=False)
        period = finite_number("dt", dt)
        if period <= 0.0:
            raise ConfigurationError(f"dt = {dt} s; a control period is positive and finite")
        horizon = backup.horizon if self.settings.horizon is None else self.settings.horizon
        # A horizon of whole periods is not to lose one to rounding.
        periods = math.ceil(horizon / period * (1.0 - 1e-12))
        if periods > LONGEST:
            raise ConfigurationError(
                f"horizon = {horizon:g} s of the backup filter has {periods} control periods of"
                f" {period:g} s; {LONGEST} at most"
            )
        plans = Plans(
            system,
            [barrier.expression for barrier in named],
            backup.laws,
            (low, high),
            period,
            substeps,
            periods,
        )
        self.plans, self.floor = plans, max(self.settings.margin, ROUNDING)
        self._search = Search(plans, self.floor)
        self._stated = _Stated(
            system, tuple(named), tuple(zip(low, high, strict=True)), period, substeps
        )

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        settings: BackupSettings | str | None = None,
        knowledge: str = "model",
    ) -> BackupFilter:
        """Return the filter for the barriers and the backup of a problem.

        Args:
            problem: that is to be kept safe.
            settings: or their text; the problem's own horizon and no margin by default.
            knowledge: "model" for what the designer believes, "plant" for the true system.

        Raises:
            SystemDefinitionError: What is given is no problem, or a law leaves its stated terminal
                set at a sampled state.
            ConfigurationError: The problem states no backup, or a word or number is not allowed.
        """
        arguments.require_problem(problem)
        arguments.require_word("knowledge", knowledge, ("model", "plant"))
        if isinstance(settings, str):
            settings = BackupSettings.of_text(settings)
        settings = BackupSettings() if settings is None else settings
        settings.require_fit(problem)
        system = problem.model if knowledge == "model" else problem.plant
        given, backup = backup_of(problem), with_terminal_sets(problem, system, settings.margin)
        assert given is not None
        assert backup is not None
        timing = problem.dt, problem.substeps
        made = cls(system, problem.barriers, backup, problem.input_bounds, *timing, settings)
        stated = [j for j, law in enumerate(given.laws) if law.terminal is not None]
        made.stated = tuple(given.laws[j].name for j in stated)
        require_kept(made.plans, stated, sampled_states(problem), settings.margin)
        return made

    def domain(self, x: Components) -> np.ndarray:
        """Return whether the input of some law is allowed at states, bool (B,).

        Args:
            x: n components (B,).
        """
        with np.errstate(all="ignore"):
            return self._search.last_resort(self.plans.part(x)).good

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one state.

        Args:
            x: n finite components of the state.
            u: m finite components of the proposed input.

        Returns:
            The decision in components.
        """
        x = self.plans.part(x)
        wanted = [min(max(c, a), b) for c, a, b in zip(u, *self.plans.bounds, strict=True)]
        given = self.plans.kept_after_one(x, wanted, self.floor)
        count = self.plans.count
        if given.allowed:
            action = list(u) if wanted == list(u) else wanted
            none = [0.0] * count
            return FilterDecision(action, [given.height] * count, [False], True, none, -1, u)
        found = self._search.of_one(x, wanted)
        if found is not None:
            action, lowest = found
            margin, none = [lowest] * count, [0.0] * count
            return FilterDecision(action, margin, [True], True, none, given.failed, u)
        with np.errstate(all="ignore"):
            last = self._search.last_resort(tuple([np.array([c]) for c in x]))
        action, lowest, slack = [[c.item() for c in part] for part in last[:3]]
        return FilterDecision(action, lowest, [True], last.good.item(), slack, given.failed, u)

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for a batch; as `decide_floats`, with an array (B,) for each component.

        Args:
            x: n components of the states.
            u: m components of the proposed inputs.

        Returns:
            The decisions in components.
        """
        with np.errstate(all="ignore"):
            return self._decide(self.plans.part(x), u)

    def _decide(self, x: Components, u: Components) -> FilterDecision:
        wanted = tuple([np.clip(c, *ends) for c, ends in zip(u, self.plans.ends, strict=True)])
        kept, lowest, failed = self.plans.kept_after(x, wanted, self.floor)
        count, size = self.plans.count, len(kept)
        rows = np.flatnonzero(~kept)
        none = np.zeros(size)
        if not rows.size:
            return FilterDecision(
                wanted, (lowest,) * count, (~kept,), kept, (none,) * count, failed, u
            )
        action = tuple([c.copy() for c in wanted])
        margin = tuple([lowest.copy() for _ in range(count)])
        slack = tuple([none.copy() for _ in range(count)])
        feasible = np.ones(size, dtype=bool)
        at, goal = [tuple([c[rows] for c in part]) for part in (x, wanted)]
        points, lowest, found = self._search.of_batch(at, goal)
        _put((*action, *margin), rows, (*points, *(lowest,) * count))
        lost = np.flatnonzero(~found)
        if lost.size:
            last, rows = self._search.last_resort(tuple([c[lost] for c in at])), rows[lost]
            _put((*action, *margin, *slack), rows, (*last.action, *last.heights, *last.slack))
            feasible[rows] = last.good
        return FilterDecision(action, margin, (~kept,), feasible, slack, failed, u)

    def require_problem(self, problem: SafetyProblem) -> None:
        """Raise ConfigurationError where the filter was made for something else than a problem."""
        ours = self._stated
        for what, fits in (
            ("system", ours.system in (problem.model, problem.plant)),
            ("barriers", ours.barriers == problem.barriers),
            ("input bounds", ours.bounds == problem.input_bounds),
            ("control period", (ours.dt, ours.substeps) == (problem.dt, problem.substeps)),
        ):
            if not fits:
                raise ConfigurationError(
                    f"the {what} of the backup filter: {problem.name} has others; make the filter"
                    " for the env's own problem, BackupFilter.for_problem(env.problem)"
                )

    def why_not(self, plant: ControlAffineSDE) -> str:
        """Return why nothing is guaranteed of a plant; "" where it is.

        Args:
            plant: that is simulated.
        """
        if plant.noisy:
            return "the plant has noise, which the plans of a backup filter leave out"
        if plant != self.model:
            return "the plans are of the filter's model, from which the plant differs"
        return ""

    def source(self, data: Data) -> Source:
        """Return the function `decide` of a compiled program.

        Args:
            data: receives its numbers.
        """
        return backup_source(self.plans, self.floor, data)

    def filter(self, x: Any, u_nominal: Any) -> FilterDecision:
        """Decide for one state or a batch.

        Args:
            x: states, shape (n,) or (..., n).
            u_nominal: proposed inputs in physical units, shape (m,) or (..., m).

        Returns:
            Arrays with the same leading axes. All barriers share one constraint, so that `active`
            has shape (..., 1); `margin` is the smallest barrier on the plan of the action, `slack`
            by how much each barrier is violated on it where the filter is infeasible, and `cause`
            the barrier that the proposed input would have violated first, -1 where it was taken or
            led too far from every terminal set.

        Raises:
            InvalidInputError: A shape does not fit, or an entry is no finite real number.
        """
        x, u = doubles("state", x), doubles("nominal input", u_nominal)
        n, m = self.model.n, self.model.m
        if x.shape[-1:] != (n,) or u.shape[-1:] != (m,) or x.shape[:-1] != u.shape[:-1]:
            raise InvalidInputError(
                f"state {x.shape} and input {u.shape} do not fit; give (..., {n}) and (..., {m})"
                " with the same leading axes"
            )
        with np.errstate(over="ignore"):
            require_finite(x, u)
        batch = x.shape[:-1]
        states, inputs = (
            tuple(np.ascontiguousarray(part.reshape(-1, part.shape[-1]).T)) for part in (x, u)
        )
        found = self.decide_arrays(states, inputs)
        size = len(inputs[0])
        barriers = stacked(self.plans.barriers(self.plans.part(states)), size)
        action, margin, active, slack = [
            stacked(part, size).reshape(*batch, len(part))
            for part in (found.action, found.margin, found.active, found.slack)
        ]
        return FilterDecision(
            action,
            margin,
            active > 0.0,
            found.feasible.reshape(batch),
            slack,
            found.cause.reshape(batch),
            u.copy(),
            barriers.reshape(*batch, self.plans.count),
        )


__all__ = ["BackupFilter", "BackupSettings"]
