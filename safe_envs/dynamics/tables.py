"""Functions of many states at once, from a table of states to a table of values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, stacked


def tabulated(
    states: Sequence[sp.Symbol], expressions: Sequence[Any]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that gives the values (B, k) of expressions at states (B, n).

    Args:
        states: n symbols.
        expressions: k of them, with numbers for all parameters.
    """
    compiled = compile_function(tuple(states), tuple(expressions), "arrays")
    return partial(_table, compiled)


def _table(compiled: Callable[..., Any], x: np.ndarray) -> np.ndarray:
    return stacked(compiled(*np.ascontiguousarray(x.T)), len(x))
