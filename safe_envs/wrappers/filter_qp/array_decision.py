"""A filter's decision with its constraints in arrays, as the text of a compiled program."""

from __future__ import annotations

import itertools

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.wrappers.filter_qp.compiled import domain_of, functions_of, solved_as_cones
from safe_envs.wrappers.filter_qp.decision_kernel import (
    aim_outwards,
    furthest_constraint,
    take_nearest_function,
)
from safe_envs.wrappers.filter_qp.decision_text import Body, Values, causing_barrier, largest_slacks
from safe_envs.wrappers.filter_qp.period_text import write_period
from safe_envs.wrappers.filter_qp.projection_choice import projection_for
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.qp.kernels.majorant import majorant_plane, work_of_majorant
from safe_envs.wrappers.qp.kernels.one_constraint import (
    project_one_constraint,
    row_margin,
    row_tolerance,
    work_of_one_constraint,
)


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
