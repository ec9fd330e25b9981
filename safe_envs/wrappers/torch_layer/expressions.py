"""The constraints of a filter as functions of torch tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import sympy as sp
import torch
from sympy.printing.pytorch import TorchPrinter

from safe_envs.dynamics.plain_expressions import in_plain_names
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.filter_qp import FilterQP


class _Printer(TorchPrinter):
    """Writes Python's operators, or `_FUNCTIONS`, where torch takes tensors only."""

    def _print_Pow(self, expr: Any) -> str:  # noqa: N802  (sympy's dispatch by name)
        return f"({self._print(expr.base)})**({self._print(expr.exp)})"

    def _print_Relational(self, expr: Any) -> str:  # noqa: N802
        return f"({self._print(expr.lhs)}) {expr.rel_op} ({self._print(expr.rhs)})"

    def _print_Piecewise(self, expr: Any) -> str:  # noqa: N802
        parts = [self._print(part) for piece in expr.args for part in piece.args]
        return f"Piecewise({', '.join(parts)})"

    def _named(self, expr: Any) -> str:
        return f"{expr.func.__name__}({', '.join(map(self._print, expr.args))})"

    _print_Max = _print_Min = _print_Heaviside = _named  # noqa: N815


def _tensors(parts: Sequence[Any]) -> tuple[torch.Tensor, ...]:
    return torch.broadcast_tensors(*[torch.as_tensor(part, dtype=torch.float64) for part in parts])


def _pieces(*parts: Any) -> torch.Tensor:
    """Return the first of value, condition, value, condition, ... whose condition holds."""
    values, conditions = _tensors(parts[::2]), parts[1::2]
    result = torch.full_like(values[0], float("nan"))
    for value, condition in reversed(list(zip(values, conditions, strict=True))):
        result = torch.where(torch.as_tensor(condition), value, result)
    return result


_FUNCTIONS: dict[str, Any] = {
    "Max": lambda *parts: torch.stack(_tensors(parts)).amax(dim=0),
    "Min": lambda *parts: torch.stack(_tensors(parts)).amin(dim=0),
    "Heaviside": lambda *parts: torch.heaviside(*_tensors(parts)),
    "Piecewise": _pieces,
    "torch": torch,
}


def compiled_constraints(
    qp: FilterQP,
) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    """Return the function from states (B, n) to the constraints' a (B, k, m) and b (B, k).

    Raises:
        ConfigurationError: A constraint holds a function that torch does not have.
    """
    model, k = qp.model, len(qp.constraints)
    expressions = [model.numeric(e) for c in qp.constraints for e in (*c.coefficient, c.offset)]
    unknown = {
        f.func
        for e in expressions
        for f in e.atoms(sp.Function)
        if f.func not in TorchPrinter.mapping
    }
    unknown -= {sp.Piecewise, sp.Heaviside}
    if unknown:
        raise ConfigurationError(
            f"torch has no {', '.join(sorted(map(str, unknown)))}, which a constraint holds;"
            " write it with other functions"
        )
    # Torch's functions take no plain numbers.
    numbers = [
        e.xreplace({c: c.evalf(17) for c in e.atoms(sp.NumberSymbol, sp.Function) if c.is_number})
        for e in expressions
    ]
    names, formulas = in_plain_names(model.states, numbers)
    function = sp.lambdify(
        names, formulas, modules=[_FUNCTIONS], printer=_Printer, cse=True, docstring_limit=0
    )

    def rows(states: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        entries = torch.stack(
            [states.new_zeros(len(states)) + e for e in function(*states.unbind(dim=1))], dim=-1
        )
        table = entries.reshape(len(states), k, model.m + 1)
        return table[:, :, :-1], table[:, :, -1]

    return rows
