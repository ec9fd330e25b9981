"""Backup laws: how a system is brought to, and kept in, a set that is known to be safe for good."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import formula
from safe_envs.errors import ConfigurationError, SafeEnvsError, SystemDefinitionError, shown
from safe_envs.text import finite_number


@dataclass(frozen=True)
class BackupLaw:
    """A law, and the terminal set that it brings the system to and never leaves.

    The law is executed as every input is: evaluated at control instants, clipped to the input
    bounds and held for one period. Its terminal set is a part of the safe set from which this leads
    back into it. It is either stated, as an expression that is >= 0 there; who states it answers
    for its invariance. Or it is derived from an equilibrium of the law, with a proof, see
    `safe_envs.proofs.backup_sets`.

    Attributes:
        name: of the law.
        law: one expression of the states and the system's parameters for each input.
        terminal: >= 0 in the terminal set, an expression of states and parameters; None to derive
            it.
        equilibrium: value of each coordinate of a set that is derived, by the symbol of the state:
            a number or an expression of the parameters. These states must form a system of their
            own under the law, and all barriers must be functions of them.
        extent: about how far a derived set is to reach in each coordinate, in proportion to the
            others; half the width of the workspace by default.

    Raises:
        SystemDefinitionError: neither or both of `terminal` and `equilibrium` are given, or a part
            is no expression.
        ConfigurationError: an extent is not positive and finite.
    """

    name: str
    law: tuple[sp.Expr, ...]
    terminal: sp.Expr | None = None
    equilibrium: Mapping[sp.Symbol, Any] = field(default_factory=dict)
    extent: Mapping[sp.Symbol, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise SystemDefinitionError(
                f"name of a backup law = {shown(self.name)}; give a text that is not empty"
            )
        if not isinstance(self.law, list | tuple):
            raise SystemDefinitionError(
                f"backup law {self.name} = {shown(self.law)}; give a tuple with an expression for"
                " each input"
            )
        if not isinstance(self.equilibrium, Mapping) or (
            (self.terminal is None) == (not self.equilibrium)
        ):
            raise SystemDefinitionError(
                f"backup law {self.name} needs its terminal set: give either terminal, an"
                " expression that is >= 0 there, or equilibrium, the state at rest around which"
                " it is derived, like {x: 0, v: 0}"
            )
        what = f"backup law {self.name}"
        object.__setattr__(self, "law", tuple(formula(what, e) for e in self.law))
        if self.terminal is not None:
            object.__setattr__(self, "terminal", formula(f"terminal of {what}", self.terminal))
        rest = {s: formula(f"equilibrium of {what}", e) for s, e in self.equilibrium.items()}
        object.__setattr__(self, "equilibrium", rest)
        extent = {s: finite_number(f"extent of {what}", w) for s, w in self.extent.items()}
        if not all(width > 0 for width in extent.values()):
            raise ConfigurationError(f"extent of {what} = {extent}; give positive numbers")
        object.__setattr__(self, "extent", extent)

    def require_known(self, system: ControlAffineSDE) -> None:
        """Check that the law fits a system.

        Args:
            system: with the inputs that the law gives.

        Raises:
            SystemDefinitionError: it has another number of inputs, or an unknown symbol is in it.
        """
        if len(self.law) != system.m:
            raise SystemDefinitionError(
                f"backup law {self.name} has {len(self.law)} expressions; give one for each of the"
                f" {system.m} inputs"
            )
        known, parameters = (*system.states, *system.parameters), tuple(system.parameters)
        for entry in (*self.law, *([] if self.terminal is None else [self.terminal])):
            system.require_known(f"backup law {self.name}", entry.free_symbols, known)
        system.require_known("its equilibrium", self.equilibrium, system.states)
        system.require_known("its extent", self.extent, tuple(self.equilibrium))
        for entry in self.equilibrium.values():
            system.require_known("its equilibrium", entry.free_symbols, parameters)


@dataclass(frozen=True)
class Backup:
    """The backup laws of a problem, any of which may be followed.

    Attributes:
        laws: at least one, each with a name of its own.
        horizon: how long a law may take to reach its terminal set, in s.

    Raises:
        SystemDefinitionError: there is no law, or two have the same name.
        ConfigurationError: the horizon is not positive and finite.
    """

    laws: tuple[BackupLaw, ...]
    horizon: float

    def __post_init__(self) -> None:
        laws = tuple(self.laws) if isinstance(self.laws, list | tuple) else (self.laws,)
        names = [law.name if isinstance(law, BackupLaw) else "" for law in laws]
        if not laws or not all(names) or len(set(names)) < len(names):
            raise SystemDefinitionError(
                f"laws of a backup = {shown(self.laws)}; give one `BackupLaw` or several, each with"
                " another name"
            )
        object.__setattr__(self, "laws", laws)
        horizon = finite_number("horizon of the backup", self.horizon)
        if not horizon > 0:
            raise ConfigurationError(f"horizon of the backup = {horizon} s; give a positive time")
        object.__setattr__(self, "horizon", horizon)


@dataclass(frozen=True)
class BackupFunction:
    """A function of the configured problem, with arguments; equal to its own copies.

    Attributes:
        function: called with the `SafetyProblem` and the arguments; one that a module names.
        arguments: by name.
    """

    function: Callable[..., Backup]
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, problem: Any) -> Backup:
        """Return the backup of a complete `SafetyProblem`."""
        return self.function(problem, **self.arguments)


BackupSource = Backup | Callable[[Any], Backup]
"""A backup, or a function from the complete `SafetyProblem` to it.

A function follows changes of dt and the input bounds; parameters may stay symbols.
"""


def require_backup(source: Any, system: ControlAffineSDE) -> None:
    """Check a backup as a problem states it; what a function returns is checked by `backup_of`.

    Args:
        source: None, a `Backup` or a function.
        system: the plant.

    Raises:
        SystemDefinitionError: it is something else, or does not fit the system.
    """
    if isinstance(source, Backup):
        for law in source.laws:
            law.require_known(system)
    elif source is not None and not callable(source):
        raise SystemDefinitionError(
            f"backup = {shown(source)}; give a `Backup`, or a function from the problem to one"
        )


def backup_of(problem: Any) -> Backup | None:
    """Return the backup that a problem states; None without.

    Args:
        problem: a `SafetyProblem`.

    Raises:
        SystemDefinitionError: its function failed, or returned no backup that fits the system.
    """
    source = problem.backup
    try:
        stated = source if source is None or isinstance(source, Backup) else source(problem)
    except SafeEnvsError:
        raise
    except Exception as error:
        raise SystemDefinitionError(
            f"the function of the backup of {problem.name} failed:"
            f" {type(error).__name__}: {shown(str(error))}"
        ) from error
    if stated is not None and not isinstance(stated, Backup):
        raise SystemDefinitionError(
            f"the function of the backup returned {shown(stated)}; it is to return a `Backup`"
        )
    require_backup(stated, problem.plant)
    return stated
