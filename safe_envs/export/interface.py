"""What goes into an exported filter and what comes out, with names and units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import sympy as sp

from safe_envs.dynamics.symbols import TIME, declared_sign
from safe_envs.errors import ConfigurationError, shown
from safe_envs.export.formulas import c_comment, c_name, c_names
from safe_envs.filters.arguments import takes_endless
from safe_envs.filters.conditions.text import spec_of
from safe_envs.filters.safety_filter import SafetyFilter


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
        """The symbol, the unit and the sign, for a comment."""
        unit = f", in {self.unit}" * bool(self.unit)
        return c_comment(f"{self.symbol}{unit}{f', {self.sign}' * bool(self.sign)}")


@dataclass(frozen=True)
class Interface:
    """The interface of an exported filter.

    Attributes:
        name: with which all public names of C begin.
        title: what the filter is, in one line: its full text, as for `--filter`, and its goal.
        single: whether it computes in single precision.
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
    """

    name: str
    title: str
    single: bool
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

    @property
    def macro(self) -> str:
        """The name in capitals."""
        return self.name.upper()

    @property
    def real(self) -> str:
        """The type of numbers in C."""
        return "float" if self.single else "double"


def interface_of(
    safety_filter: SafetyFilter,
    name: str,
    units: Mapping[str, str],
    taken: Iterable[str],
    single: bool,
) -> Interface:
    """Return the interface of a filter.

    Args:
        safety_filter: the filter.
        name: with which all public names of C begin.
        units: of states, inputs and other quantities, by symbol.
        taken: names of C that are not free.
        single: whether it computes in single precision.

    Raises:
        ConfigurationError: The name is no name of C.
    """
    if c_name(name) != name:
        raise ConfigurationError(
            f"name = {shown(name)} is no name of C; give letters, digits and _, no keyword"
        )
    qp, model = safety_filter.qp, safety_filter.model
    units = {TIME.name: "s", **units}

    def quantities(symbols: Sequence[sp.Symbol], names: Sequence[str]) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(
                own,
                symbol.name,
                units.get(symbol.name, ""),
                (declared_sign(symbol) or "").replace("real", ""),
                float(model.parameters.get(symbol, 0.0)),
            )
            for own, symbol in zip(names, symbols, strict=True)
        )

    n, symbols = model.n, (*qp.symbols, *model.inputs)
    names = c_names((s.name for s in symbols), taken)
    given = quantities(symbols, names)
    barriers = [barrier.name for barrier, _ in safety_filter.pairs]
    of_condition: dict[str, list[str]] = {}
    for barrier, condition in safety_filter.pairs:
        of_condition.setdefault(spec_of(condition), []).append(barrier.name)
    title = "; ".join(f"{c} for {', '.join(each)}" for c, each in of_condition.items())
    goal = "" if qp.clf is None else f"; goal V = {formula_text(qp.model.numeric(qp.clf.V))}"
    return Interface(
        name,
        c_comment(title + goal),
        single,
        given[:n],
        given[n : len(qp.symbols)],
        given[len(qp.symbols) :],
        tuple(c_names(barriers)),
        tuple(barriers),
        tuple(formula_text(barrier.expression) for barrier, _ in safety_filter.pairs),
        tuple(qp.low),
        tuple(qp.high),
        qp.clf is not None,
        takes_endless(qp.constraints, qp.clf),
    )


def formula_text(expression: sp.Expr) -> str:
    """Return an expression as text, without zeros at the end of numbers."""
    return sp.sstr(expression, full_prec=False)
