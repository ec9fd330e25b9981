"""What a caller of the exported filter gives and gets: names, units and order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy as sp

from safe_envs.dynamics.declarations import declared_sign
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.signals import TIME
from safe_envs.wrappers.conditions import spec_of
from safe_envs.wrappers.export.c_names import c_name, c_names, comment
from safe_envs.wrappers.export.c_numbers import Precision
from safe_envs.wrappers.filter_qp.limits import takes_endless
from safe_envs.wrappers.safety_filter import SafetyFilter


@dataclass(frozen=True)
class Quantity:
    """A number that goes in or comes out.

    Attributes:
        name: in C.
        symbol: as the model calls it.
        unit: its unit, "" where none is known.
        sign: "positive", "nonnegative", "negative", "nonpositive" or "nonzero" where the model
            relies on that of a measured quantity.
        default: its value where none is given.
    """

    name: str
    symbol: str
    unit: str
    sign: str = ""
    default: float = 0.0

    @property
    def described(self) -> str:
        """The symbol and the unit, for a comment."""
        unit = f", in {self.unit}" * bool(self.unit)
        return comment(f"{self.symbol}{unit}{f', {self.sign}' * bool(self.sign)}")


@dataclass(frozen=True)
class Interface:
    """The interface of an exported filter.

    Attributes:
        name: with which all public names of C begin.
        title: what the filter is, in one line: its full text, as for `--filter`.
        precision: of its numbers.
        states: n states, in the order of the model.
        runtime: quantities that are measured at run time.
        inputs: m inputs.
        constraints: names of C of the k constraints.
        barriers: names of their barriers.
        formulas: h of each barrier.
        low: lower input bounds, if nothing else is known.
        high: upper ones.
        proposes: whether the filter pursues a goal, in place of the proposed input.
        endless: whether input bounds may be infinite.
        scratch: numbers on the stack.
    """

    name: str
    title: str
    precision: Precision
    states: tuple[Quantity, ...]
    runtime: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    constraints: tuple[str, ...]
    barriers: tuple[str, ...]
    formulas: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    proposes: bool
    endless: bool
    scratch: int

    @property
    def macro(self) -> str:
        """The name in capitals."""
        return self.name.upper()

    @property
    def about(self) -> str:
        """What the filter is and keeps, for the comment at the head of a file."""
        lines = [self.title, "Barriers, safe where none is negative:"]
        lines += [
            f"{comment(name)} = {comment(h)}"
            for name, h in zip(self.barriers, self.formulas, strict=True)
        ]
        return "\n * ".join(lines)


def interface_of(
    safety_filter: SafetyFilter,
    name: str,
    precision: Precision,
    units: Mapping[str, str],
    scratch: int,
) -> Interface:
    """Return the interface of a filter.

    Args:
        safety_filter: the filter.
        name: with which all public names of C begin.
        precision: of its numbers.
        units: of states, inputs and other quantities, by symbol.
        scratch: numbers that it needs on the stack.

    Raises:
        ConfigurationError: The name is no name of C.
    """
    require_name(name)
    qp, model = safety_filter.qp, safety_filter.model
    quantities = quantities_of(qp.symbols, {TIME.name: "s", **units}, model.parameters)
    names = [barrier.name for barrier, _ in safety_filter.pairs]
    of_condition: dict[str, list[str]] = {}
    for barrier, condition in safety_filter.pairs:
        of_condition.setdefault(spec_of(condition), []).append(barrier.name)
    title = "; ".join(f"{c} for {', '.join(each)}" for c, each in of_condition.items())
    goal = "" if qp.clf is None else f"; goal V = {formula_text(qp.model.numeric(qp.clf.V))}"
    return Interface(
        name,
        comment(title + goal),
        precision,
        quantities[: model.n],
        quantities[model.n :],
        quantities_of(model.inputs, units, {}),
        tuple(c_names(names)),
        tuple(names),
        tuple(formula_text(barrier.expression) for barrier, _ in safety_filter.pairs),
        tuple(qp.low),
        tuple(qp.high),
        qp.clf is not None,
        takes_endless(qp.constraints, qp.clf),
        scratch,
    )


def formula_text(expression: sp.Expr) -> str:
    """Return an expression as text, without zeros at the end of numbers."""
    return sp.sstr(expression, full_prec=False)


def require_name(name: str) -> None:
    """Raise ConfigurationError where public names of C cannot begin with a name."""
    if c_name(name) != name or not name.isidentifier():
        raise ConfigurationError(
            f"name = {shown(name)} is no name of C; give letters, digits and _, no keyword"
        )


def quantities_of(
    symbols: Sequence[sp.Symbol], units: Mapping[str, str], defaults: Mapping[sp.Symbol, float]
) -> tuple[Quantity, ...]:
    """Return quantities, with their names in C.

    Args:
        symbols: of them.
        units: by symbol.
        defaults: their values where none are given, by symbol.
    """
    return tuple(
        Quantity(
            name,
            symbol.name,
            units.get(symbol.name, ""),
            (declared_sign(symbol) or "").replace("real", ""),
            float(defaults.get(symbol, 0.0)),
        )
        for name, symbol in zip(c_names(s.name for s in symbols), symbols, strict=True)
    )
