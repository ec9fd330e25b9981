"""Named regions of a problem, for specifications such as "always safe & eventually (A then B)"."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import formula
from safe_envs.errors import SystemDefinitionError, shown

SAFE, GOAL = "safe", "goal"
"""Names of the sets that a problem has of its own: of its barriers, and where an episode ends."""

OPERATORS = ("always", "eventually", "until", "then", "and", "or", "not")
"""Words of specifications, which name no region."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,39}")
_MOST = 20


def sound_regions(given: Any, system: ControlAffineSDE) -> dict[str, sp.Expr]:
    """Return regions as they were given, each an expression that is >= 0 inside.

    Args:
        given: the expressions by name.
        system: whose states they are of.

    Raises:
        SystemDefinitionError: A name is none or taken, or a region is no expression of the states.
    """
    if not isinstance(given, Mapping) or len(given) > _MOST:
        raise SystemDefinitionError(
            f"regions = {shown(given)}; give a mapping of up to {_MOST} names to expressions of the"
            ' states, >= 0 inside, like {"gate": 1 - x**2 - y**2}'
        )
    taken = (SAFE, GOAL, *OPERATORS)
    for name in given:
        if not isinstance(name, str) or not _NAME.fullmatch(name) or name in taken:
            raise SystemDefinitionError(
                f"a region is named {shown(name)}; give letters, digits and _, at most 40, first no"
                f" digit, and none of {', '.join(taken)}"
            )
    regions = {name: formula(f"region {name}", each) for name, each in given.items()}
    for name, expression in regions.items():
        system.require_known(f"region {name}", expression.free_symbols, system.states)
    return regions
