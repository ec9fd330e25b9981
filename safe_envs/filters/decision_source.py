"""The filter as a function of a compiled program."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import sympy as sp

from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.qp.kernels.interval import project_interval, work_of_interval
from safe_envs.engine.qp.kernels.many import project_many, work_of_many
from safe_envs.engine.qp.kernels.one_constraint import (
    project_one_constraint,
    project_scalar,
    row_margin,
    row_tolerance,
    work_of_one_constraint,
)
from safe_envs.engine.qp.kernels.plane import project_plane, work_of_plane
from safe_envs.engine.qp.kernels.second_order import (
    majorant_plane,
    project_second_order,
    work_of_majorant,
    work_of_second_order,
)
from safe_envs.engine.slots import Data
from safe_envs.filters.conditions.base import terms_source
from safe_envs.filters.decision_kernel import (
    COEFFICIENTS,
    ENOUGH,
    ROUNDS,
    SLOW,
    aim_outwards,
    constraints_hold,
    end_of_period,
    furthest_constraint,
    move_on_line,
    take_nearest_function,
)
from safe_envs.filters.qp import FilterQP
from safe_envs.filters.solver import (
    FilterQPSolver,
    change_coefficients,
    domain_of,
    functions_of,
    solved_as_cones,
)


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


def write_period(
    body: Body,
    values: Values,
    qp: FilterQP,
    constraints: tuple[Sequence[Sequence[str]], Sequence[str]],
    method: tuple[Callable[..., Any], int],
    counts: Sequence[str],
) -> list[str]:
    """Write how the action moves to where the constraints hold; see `period_search`.

    Args:
        body: receives the statements, which name the arrays of `ArrayDecision`.
        values: receives the formulas.
        qp: the QP.
        constraints: texts of the coefficients and offsets of its k constraints.
        method: kernel that projects the m inputs, and the scratch entries that it needs.
        counts: text of whether each constraint has a meaning; "" where it always has.

    Returns:
        Texts of sums that are to be finite.
    """
    k, m = len(qp.constraints), qp.model.m
    sampled = [i for i, c in enumerate(qp.constraints) if c.change is not None]
    dt, bends, size = body.number(qp.dt), m * (m + 1) // 2, k + len(sampled)
    owners = [*range(k), *sampled]
    body.table("held", [[constraints[1][i], *constraints[0][i], *["0.0"] * bends] for i in owners])
    finite = []
    for place, i in enumerate(sampled, start=k):
        change = values.call(f"filter_change_{i}", change_coefficients(qp, i))
        lines = [f"end_of_period({place}, {dt}, {change}, held)"]
        if counts[i]:
            lines = [f"if {counts[i]}:", *(f"    {line}" for line in lines)]
        body.add(*lines)
        finite.append(" + ".join(f"held[{place}, {e}]" for e in range(1 + m + bends)))
    form = [[f"form[{i}, {e}]" for e in range(3)] for i in range(k)] if solved_as_cones(qp) else []
    body.table("held_form", form + [["0.0"] * 3] * (size - len(form)))
    body.table("slopes", [["0.0"] * m] * size)
    body.table("line", [["0.0"] * COEFFICIENTS] * size)
    body.vector("held_priority", [f"priority[{i}]" for i in owners])
    body.vector("missed", ["0.0"] * size)
    for name in ("held_offsets", "value", "target_margin", "target_active"):
        body.room(name, size)
    body.room("target", m)
    body.room("target_scratch", method[1])
    views = ", ".join(f"vector_view({name}, 0, {m})" for name in ("action", "low", "high", "w"))
    hold = f"constraints_hold({m}, held, held_form, action, slopes, held_offsets, value, missed)"
    body.uses += [end_of_period, constraints_hold, move_on_line, method[0]]
    step = f"move_on_line({m}, held, held_form, low, high, held_priority, action, target, line)"
    axes = [
        f"    if left > {SLOW}:",
        f"        for j in range({m}):",
        *(f"            target[{n}] = action[{n}]" for n in range(m)),
        "            target[j] += 1.0",
        f"            left *= {step}",
    ]
    body.add(
        f"feasible = {hold}",
        f"for _ in range({ROUNDS}):",
        "    if feasible:",
        "        break",
        f"    {method[0].__name__}(slopes, held_offsets, {views}, held_priority, target,"
        " target_margin, target_active, target_scratch)",
        f"    left = {step}",
        *(axes if m > 1 else ()),
        f"    feasible = {hold}",
        f"    if not left < {ENOUGH}:",
        "        break",
    )
    for place, i in enumerate(owners):
        value = f"value[{place}]"
        body.add(
            f"margin[{i}] = {value if place < k else f'min(margin[{i}], {value})'}",
            f"if missed[{place}] > 0.0:",
            f"    active[{i}] = 1.0",
        )
    return finite


def projection_for(k: int, m: int, *, uncertain: bool = False) -> tuple[Callable[..., Any], int]:
    """Return the kernel for k constraints on m inputs, and the scratch entries that it needs.

    Args:
        k: number of constraints.
        m: number of inputs.
        uncertain: whether the constraints on one input are uncertain.
    """
    if uncertain:
        return project_second_order, work_of_second_order(k, m)
    if k == 1:
        return project_one_constraint, work_of_one_constraint(k, m)
    if m == 1:
        return project_interval, work_of_interval(k, m)
    if m == 2:
        return project_plane, work_of_plane(k, m)
    return project_many, work_of_many(k, m)


class ArrayDecision:
    """Writes `decide` as `FilterQPSolver.solve` decides; what a QP has not leaves no statement.

    The statements name these arrays, for k constraints on m inputs and with one more of both for a
    goal: `a` and `b` as the conditions say, `asked` for b less what is asked for, `coefficients`
    and `offsets` of the QP, `inside` with 0 for conditions outside their domain.

    Args:
        qp: the QP.
        data: receives its numbers.

    Raises:
        NotCompilableError: Learned terms have no compiled form.
    """

    parameters = "x, u, data, work"

    def __init__(self, qp: FilterQP, data: Data) -> None:
        self._qp = qp
        self._k, self._m, self._goal = len(qp.constraints), qp.model.m, int(qp.clf is not None)
        constraints = list(enumerate(qp.constraints))
        self._reciprocal = [i for i, c in constraints if c.demand is not None]
        self._sampled = [i for i, c in constraints if c.change is not None]
        self._maxima = [i for i, c in constraints if c.alternatives]
        self._uncertain = [i for i, c in constraints if c.uncertainty is not None]
        self._second_order = solved_as_cones(qp)
        self._method, self._room = projection_for(
            self._k + self._goal, self._m + self._goal, uncertain=self._second_order
        )
        self._values, self._body = Values(qp, data), Body(data)
        self._planes = self._values.solver.planes
        self._single = self._k == 1 and qp.plain
        width = self._m + 1
        self._a = [[self._value(i * width + j, i) for j in range(self._m)] for i in range(self._k)]
        self._b = [self._value(i * width + self._m, i) for i in range(self._k)]
        self._growth = self._k * width
        self._h = self._growth + self._goal * width
        self._levels = [len(domain_of(qp.constraints[i])) for i in self._reciprocal]
        self._heights = self._h + sum(self._levels)
        self._forms = self._heights + len(qp.partial)
        self._finite: list[str] = []

    def _value(self, place: int, i: int) -> str:
        """Return the text of a value of constraint i; 0 where its barrier has none."""
        value = f"values[{place}]"
        return f"({value} if known[{i}] > 0.0 else 0.0)" if i in self._qp.partial else value

    def source(self) -> Source:
        """Return the function, and those that it calls."""
        body, m, size = self._body, self._m + self._goal, self._k + self._goal
        body.add(*self._values.lines)
        if self._qp.partial:
            known = ["1.0"] * self._k
            for place, i in enumerate(self._qp.partial, start=self._heights):
                row = range(i * (self._m + 1), (i + 1) * (self._m + 1))
                total = " + ".join(f"values[{entry}]" for entry in (place, *row))
                known[i] = f"1.0 if isfinite({total}) else 0.0"
            body.vector("known", known)
        body.table("a", self._a)
        body.vector("b", self._b)
        for name, count in (("action", m), ("margin", size), ("active", size)):
            body.room(name, count)
        body.room("scratch", self._room)
        self._bounds()
        self._wish()
        self._choose_functions()
        if not self._single:
            self._finite.append(" + ".join([*self._b, *(e for row in self._a for e in row)]))
        self._domains()
        self._constraints()
        self._minimise()
        if self._sampled:
            method = projection_for(self._k + len(self._sampled), self._m)
            rows = self._rows, self._offsets[: self._k]
            counts = [self._counts(i) for i in range(self._k)]
            self._finite += write_period(body, self._values, self._qp, rows, method, counts)
        self._leave_domains()
        self._check()
        self._answer()
        return self._values.source + body.source(self.parameters)

    def _bounds(self) -> None:
        """Write the constants of the QP."""
        goal, weights = self._goal, self._values.solver.weights
        self._input_bounds()
        self._body.constants("w", [*weights, weights[0]][: self._m + goal])
        self._body.constants("priority", [*self._qp.priorities, 1.0][: self._k + goal])

    def _input_bounds(self) -> None:
        """Write the bounds of the inputs; the upper ones of a goal are written with it."""
        self._body.constants("low", [*self._qp.low, 0.0][: self._m + self._goal])
        if not self._goal:
            self._body.constants("high", self._qp.high)

    def _ends(self) -> tuple[list[str], list[str]]:
        """Return the texts of the lower and of the upper bounds of the inputs."""
        low, high = (list(map(self._body.number, ends)) for ends in (self._qp.low, self._qp.high))
        return low, high

    def _wish(self) -> None:
        """Write what the constraints change: the given input, or the best one of the goal."""
        body, m, goal = self._body, self._m, self._growth
        if not self._goal:
            body.vector("proposed", [f"u[{j}]" for j in range(m)])
            if self._reciprocal:
                body.vector("aim", [f"u[{j}]" for j in range(m)])
            return
        low, high = self._ends()
        unit = body.number(self._values.solver.goal_unit)
        growth, along = f"values[{goal}]", [f"values[{goal + 1 + j}]" for j in range(m)]
        self._finite.append(" + ".join([growth, *along]))
        ends = zip(along, low, high, strict=True)
        most = " + ".join(f"max({rate} * {lo}, {rate} * {hi})" for rate, lo, hi in ends)
        body.add(f"most = {growth} + ({most})")
        body.vector("high", [*high, f"2.0 * most / {unit} if most > 0.0 else 1.0"])
        body.table("goal_row", [[*(f"-{rate}" for rate in along), unit]])
        body.vector("goal_offset", [f"-{growth}"])
        body.vector("aim", [*(f"0.0 * u[{j}]" for j in range(m)), "0.0 * u[0]"])
        body.room("proposed", m + 1)
        body.room("goal_scratch", work_of_one_constraint(1, m + 1))
        body.call(
            project_one_constraint,
            "goal_row, goal_offset, aim, low, high, w, priority, proposed, margin, active,"
            " goal_scratch",
        )

    def _choose_functions(self) -> None:
        """Write which functions of maxima count, and take their constraints."""
        m = self._m
        for i in self._maxima:
            expressions = functions_of(self._qp.constraints[i])
            self._body.add(f"of_{i} = {self._values.call(f'filter_functions_{i}', expressions)}")
            entries = [f"of_{i}[{e}]" for e in range(len(expressions))]
            if i in self._qp.partial:
                defined = f"known[{i}] > 0.0 and isfinite({' + '.join(entries)})"
                self._body.add(f"known[{i}] = 1.0 if {defined} else 0.0")
                entries = [f"({entry} if known[{i}] > 0.0 else 0.0)" for entry in entries]
            lines = [entries[k : k + m + 2] for k in range(0, len(entries), m + 2)]
            self._body.table(f"given_{i}", lines)
            self._finite.append(" + ".join(line[-1] for line in lines))
            self._body.call(
                take_nearest_function, f"{i}, {m}, given_{i}, proposed, low, high, w, a, b"
            )
            self._a[i], self._b[i] = [f"a[{i}, {j}]" for j in range(m)], f"b[{i}]"

    def _domains(self) -> None:
        """Write which conditions are inside their domain, and aim outwards where one is not."""
        body = self._body
        if self._single:
            return
        inside, start = ["1.0"] * self._k, self._h
        for i, count in zip(self._reciprocal, self._levels, strict=True):
            above = " and ".join(f"values[{start + j}] > 0.0" for j in range(count))
            above = f"known[{i}] == 0.0 or {above}" if i in self._qp.partial else above
            inside[i] = f"1.0 if {above} else 0.0"
            start += count
        body.vector("inside", inside)
        if self._reciprocal:
            body.room("rise", self._m)
            body.call(aim_outwards, f"{self._m}, a, inside, low, high, w, rise, aim")

    def _constraints(self) -> None:
        """Write the QP's constraints."""
        body, k = self._body, self._k
        asked, held = list(self._b), [list(row) for row in self._a]
        for i in self._reciprocal:
            demand = self._values.call(f"filter_demand_{i}", [self._qp.constraints[i].demand])
            asked[i] = f"{asked[i]} - {demand}[0] if {self._counts(i)} else 0.0"
            held[i] = [f"({entry} if inside[{i}] > 0.0 else 0.0)" for entry in held[i]]
        self._asked = "asked" if self._reciprocal else "b"
        if self._reciprocal:
            body.vector("asked", asked)
        self._offsets = [f"{self._asked}[{i}]" for i in range(k)]
        for place, i in enumerate(self._uncertain):
            self._form(place, i, held)
        if self._second_order:
            forms = {i: place for place, i in enumerate(self._uncertain)}
            entries = [
                [
                    self._value(self._forms + 3 * forms[i] + e, i) if i in forms else "0.0"
                    for e in range(3)
                ]
                for i in range(k)
            ]
            body.table("form", entries)
        self._rows = held
        if self._goal:
            goal_row = [f"goal_row[0, {j}]" for j in range(self._m + 1)]
            held = [*([*row, "0.0"] for row in held), goal_row]
            self._offsets.append("goal_offset[0]")
        self._in_place = held == self._a
        if not self._in_place:
            body.table("coefficients", held)
            body.room("offsets", k + self._goal)

    def _form(self, place: int, i: int, held: list[list[str]]) -> None:
        """Take the uncertainty of a constraint into account: as it is, or as a plane above it.

        Args:
            place: its number among the uncertain ones.
            i: its number.
            held: coefficients of all, which are changed.
        """
        body, m = self._body, self._m
        count = (m + 1) * (m + 2) // 2
        form = [self._value(self._forms + place * count + e, i) for e in range(count)]
        self._finite.append(" + ".join(form))
        if self._second_order:
            return
        if i in self._planes:
            slopes, constant = self._planes[i]
            slopes, constant = [body.number(s) for s in slopes], body.number(constant)
        else:
            pairs = itertools.combinations_with_replacement(range(m + 1), 2)
            entry = dict(zip(pairs, form, strict=True))
            square = range(m + 1)
            body.table(f"form_{i}", [[entry[min(j, e), max(j, e)] for e in square] for j in square])
            body.room(f"slopes_{i}", m)
            body.room(f"corners_{i}", work_of_majorant(m))
            constant = f"constant_{i}"
            body.call(
                majorant_plane,
                f"form_{i}, vector_view(low, 0, {m}), vector_view(high, 0, {m}), slopes_{i},"
                f" corners_{i}",
                f"{constant} = ",
            )
            slopes = [f"slopes_{i}[{j}]" for j in range(m)]
        held[i] = [f"{entry} - {slope}" for entry, slope in zip(held[i], slopes, strict=True)]
        self._offsets[i] += f" - {constant}"

    def _minimise(self) -> None:
        """Write the solution of the QP."""
        body, coefficients, offsets = self._body, "a", self._asked
        if not self._in_place:
            coefficients, offsets = "coefficients", "offsets"
            body.fill("offsets", self._offsets)
        form = ", form" if self._second_order else ""
        aim = "aim" if self._goal or self._reciprocal else "proposed"
        arguments = f"{coefficients}, {offsets}{form}, {aim}, low, high, w, priority"
        body.call(self._method, f"{arguments}, action, margin, active, scratch", "feasible = ")
        if self._goal:
            # The goal's constraint, which can always be met, has no say in that, nor has its
            # rounding.
            met = [
                f"margin[{i}] >= -row_tolerance(coefficients, {i}, offsets[{i}], action)"
                for i in range(self._k)
            ]
            body.add(f"feasible = {' and '.join(met)}")
            body.uses.append(row_tolerance)

    def _counts(self, i: int) -> str:
        """Return the text of whether constraint i has a meaning; "" where it always has."""
        parts = [f"inside[{i}] > 0.0"] if i in self._reciprocal else []
        parts += [f"known[{i}] > 0.0"] if i in self._qp.partial else []
        return " and ".join(parts)

    def _leave_domains(self) -> None:
        """Write what conditions without a meaning make of the decision."""
        body = self._body
        for i in self._reciprocal:
            body.uses.append(row_margin)
            body.add(
                f"if inside[{i}] == 0.0:",
                f"    margin[{i}] = row_margin(a, {i}, b[{i}], vector_view(action, 0, {self._m}))",
                f"    active[{i}] = 1.0",
                "    feasible = False",
            )

    def _check(self) -> None:
        """Write whether all numbers are finite, and what barriers without a value make of them."""
        body = self._body
        action = [f"action[{j}]" for j in range(0 if self._single else self._m)]
        self._finite.append(" + ".join([*action, *(f"margin[{i}]" for i in range(self._k))]))
        body.add(f"sound = {' and '.join(f'isfinite({total})' for total in self._finite)}")
        for i in self._qp.partial:
            lost = f"margin[{i}], active[{i}], feasible = -inf, 1.0, False"
            body.add(f"if known[{i}] == 0.0:", f"    {lost}")

    def _answer(self) -> None:
        """Write the decision."""
        body, k, m = self._body, self._k, self._m
        action = [f"action[{j}]" for j in range(m)]
        cause = "0"
        if not self._single:
            arguments = f"{m}, a, {self._asked}, proposed, w, inside, active"
            body.call(furthest_constraint, arguments, "cause = ")
            cause = causing_barrier(self._qp)
        slack = "".join(f"{each}, " for each in largest_slacks(self._qp))
        proposed = "".join(f"proposed[{j}], " for j in range(m))
        body.add(
            f"acts = {' or '.join(f'active[{i}] > 0.0' for i in range(k))}",
            f"chosen = ({''.join(f'{entry}, ' for entry in action)})",
            f"slack = ({slack})",
            f"wanted = {f'({proposed})' if self._goal else 'u'}",
            f"return chosen, wanted, acts, feasible, slack, {cause}, sound",
        )


def unfiltered_source(m: int) -> Source:
    """Return the function `decide` of `safe_envs.engine.slots` that lets every input pass.

    Args:
        m: number of inputs.
    """
    action = "".join(f"u[{j}], " for j in range(m))
    return Source(
        f"def decide(x, u, data, work):\n    return ({action}), u, False, True, (0.0,), 0, True\n"
    )


def filter_source(qp: FilterQP, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.engine.slots`, which solves a QP.

    Args:
        qp: the QP.
        data: receives its numbers.

    Raises:
        NotCompilableError: Learned terms have no compiled form.
    """
    only = qp.constraints[0] if len(qp.constraints) == 1 else None
    if only and qp.model.m == 1 and qp.plain and only.uncertainty is None:
        return _scalar_decision(qp, data)
    return ArrayDecision(qp, data).source()


def _scalar_decision(qp: FilterQP, data: Data) -> Source:
    values, bounds = Values(qp, data), data.add([qp.low[0], qp.high[0]])
    body = Body(data)
    body.add(
        *values.lines,
        "action, margin, active, feasible = project_scalar("
        f"values[0], values[1], u[0], data[{bounds}], data[{bounds + 1}])",
        "slack = 0.0 if feasible else -margin",
        "return (action,), u, active, feasible, (slack,), 0, isfinite(margin)",
    )
    body.uses.append(project_scalar)
    return values.source + body.source(ArrayDecision.parameters)
