"""The text of a filter's decision: the formulas that it calls, and its statements."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import sympy as sp

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.wrappers.conditions.constraint import terms_source
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.filter_qp.solver import FilterQPSolver


class Values:
    """The formulas of a QP in a program.

    Args:
        qp: the QP.
        data: receives their numbers.

    Attributes:
        solver: whose `expressions` they are.
        lines: statements that evaluate them, and name the results `values`.
    """

    def __init__(self, qp: FilterQP, data: Data) -> None:
        self._model, self._data = qp.model, data
        self._symbols: dict[str, Sequence[sp.Symbol]] = {"x": qp.symbols}
        self._text = Source("")
        self.solver = FilterQPSolver(qp, "floats")
        self.lines: list[str] = []
        # Learned terms are of the state alone.
        state = f"({''.join(f'x[{i}], ' for i in range(qp.model.n))})" if qp.runtime else "x"
        calls = []
        for i, term in enumerate(qp.terms):
            name = f"filter_terms_{i}"
            self._text += terms_source(term, name, data)
            calls.append(f"{name}({state}, data, work)")
        if calls:
            self._symbols["terms"] = tuple(s for term in qp.terms for s in term.symbols)
            self.lines.append(f"terms = {' + '.join(calls)}")
        self.lines.append(f"values = {self.call('filter_values', self.solver.expressions)}")

    @property
    def source(self) -> Source:
        """Functions that are called."""
        return self._text

    def call(self, name: str, expressions: Iterable[Any], inputs: str = "") -> str:
        """Add a function of the state that returns a tuple.

        Args:
            name: of the function.
            expressions: what it returns.
            inputs: text of a tuple of inputs, where the function takes some.

        Returns:
            The text of the call.
        """
        numbers = [self._model.numeric(e) for e in expressions]
        arguments, given = dict(self._symbols), list(self._symbols)
        if inputs:
            arguments["u"] = self._model.inputs
            given.append(inputs)
        self._text += formulas(name, arguments, numbers, self._data)
        return f"{name}({', '.join(given)}, data)"


def largest_slacks(qp: FilterQP) -> list[str]:
    """Return the texts of the largest slack of each barrier, of the `margin` of its constraints.

    Args:
        qp: the QP.
    """
    texts = [[f"margin[{i}]" for i in each] for each in qp.members]
    least = [functools.reduce(lambda a, b: f"min({a}, {b})", each) for each in texts]
    return [f"0.0 if feasible else max(-{margin}, 0.0)" for margin in least]


def causing_barrier(qp: FilterQP) -> str:
    """Return the text of the barrier that the constraint `cause` is of.

    Args:
        qp: the QP.
    """
    text = "cause" if not qp.owners else "-1"
    for owner, members in enumerate(qp.members if qp.owners else ()):
        text = f"{owner} if cause >= {members[0]} else ({text})"
    return text


class Body:
    """The statements of `decide`, and the arrays that they name.

    Args:
        data: receives constant arrays.

    Attributes:
        uses: kernels that are called.
    """

    def __init__(self, data: Data) -> None:
        self._data = data
        self._lines: list[str] = []
        self._work = 0
        self.uses: list[Callable[..., Any]] = []

    def source(self, parameters: str) -> Source:
        """Return the function.

        Args:
            parameters: their names, with commas.
        """
        text = "".join(f"    {line}\n" for line in self._lines)
        return Source(f"def decide({parameters}):\n{text}", tuple(self.uses), self._work)

    def add(self, *lines: str) -> None:
        """Append statements."""
        self._lines += lines

    def constants(self, name: str, numbers: Sequence[float]) -> None:
        """Name an array of constant numbers.

        Args:
            name: of the array.
            numbers: its entries.
        """
        self.add(f"{name} = vector_view(data, {self._data.add(numbers)}, {len(numbers)})")

    def number(self, value: float) -> str:
        """Return the text of a constant number."""
        return f"data[{self._data.add([value])}]"

    def call(self, kernel: Callable[..., Any], arguments: str, before: str = "") -> None:
        """Append the call of a kernel.

        Args:
            kernel: what is called.
            arguments: their texts, with commas.
            before: how the statement begins.
        """
        self.uses.append(kernel)
        self.add(f"{before}{kernel.__name__}({arguments})")

    def room(self, name: str, count: int) -> None:
        """Name a scratch array.

        Args:
            name: of the array.
            count: number of entries.
        """
        self.add(f"{name} = vector_view(work, {self._work}, {count})")
        self._work += count

    def vector(self, name: str, entries: Sequence[str]) -> None:
        """Name an array of values.

        Args:
            name: of the array.
            entries: texts of its entries.
        """
        self.room(name, len(entries))
        self.fill(name, entries)

    def fill(self, name: str, entries: Sequence[str]) -> None:
        """Write values to an array.

        Args:
            name: of the array.
            entries: texts of its entries.
        """
        self.add(*(f"{name}[{i}] = {entry}" for i, entry in enumerate(entries)))

    def table(self, name: str, entries: Sequence[Sequence[str]]) -> None:
        """Name an array of values with two axes.

        Args:
            name: of the array.
            entries: texts of its entries.
        """
        height, width = len(entries), len(entries[0])
        self.add(f"{name} = table_view(work, {self._work}, {height}, {width})")
        self._work += height * width
        for i, line in enumerate(entries):
            self.add(*(f"{name}[{i}, {j}] = {entry}" for j, entry in enumerate(line)))
