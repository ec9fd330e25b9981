"""The decisions of the backup filter as the text of a compiled program.

The states `x` of these functions are the p components that plans need, but in `decide`, which takes
all of them.
"""

from __future__ import annotations

from collections.abc import Iterable

import sympy as sp

from safe_envs.dynamics.integrators import rate
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.proofs.backup_plans import Plans
from safe_envs.proofs.backup_search import DIFFERENCE, LEFT, SWEEPS

KEPT = """\
def backup_kept(x, u, floor, data):
    reached = backup_step(x, u, data)
    kept, lowest, failed = backup_follow_0(reached, floor, data)
    if kept:
        return True, lowest, failed
{others}    return False, lowest, failed
"""

FOLLOW = """\
def backup_follow_{j}(x, floor, data):
    lowest = inf
    for k in range({periods} + 1):
        values = backup_reading_{j}(x, data)
        h, failed, total = values[0], 0, {total}
{smaller}        if not h >= floor or total != total:
            return False, h if h < lowest else lowest, failed
        lowest = h if h < lowest else lowest
        if values[{count}] >= 0.0:
            return True, lowest, -1
        if k < {periods}:
            x = backup_step(x, backup_input_{j}(values, data), data)
    return False, lowest, -1
"""

WHOLE = """\
def backup_whole_{j}(x, u, data):
    entered, lows = False, ({infinite})
    for k in range({periods} + 1):
        x = backup_step(x, u, data)
        values = backup_reading_{j}(x, data)
        lows = ({smaller})
        if values[{count}] >= 0.0:
            entered = True
            break
        u = backup_input_{j}(values, data)
    return entered, lows
"""

LOWER = """\
def backup_lower(a, b):
    if b != b:
        return -inf
    return b if b < a else a
"""

SEGMENT = """\
def backup_segment(x, begin, end, floor, data):
    share, width, found, lowest, best = 0.0, 1.0, False, 0.0, begin
    for stage in range(3):
        for i in range(4 if stage == 0 else 3):
            at = share + width * (0.75 - 0.25 * i)
            point = backup_within(({between}), data)
            kept, low, failed = backup_kept(x, point, floor, data)
            if kept:
                share, lowest, best, found = at, low, point, True
                break
        if not found:
            break
        width *= 0.25
    return found, best, lowest
"""

AIM = """\
def backup_aim_{j}(x, point, wanted, floor, data):
    none, base = backup_whole_{j}(x, point, data)
{slopes}{needed}    found = wanted
    for _ in range({sweeps}):
{sweep}    return found
"""

SLOPE = """\
    step_{i} = {difference} * (data[{high}] - data[{low}])
    if point[{i}] + step_{i} > data[{high}]:
        step_{i} = -step_{i}
    none, lows = backup_whole_{j}(x, ({moved}), data)
{slopes}"""

NEEDED = """\
    if not isfinite({total}):
        {none} = {zeros}
    needed_{k} = {product} - {share} * max(base[{k}] - floor, 0.0)
    square_{k}, y_{k} = {square}, 0.0
"""

SWEEP = """\
        if square_{k} > 0.0:
            y_{k} = max(0.0, y_{k} + (needed_{k} - ({product})) / square_{k})
        found = backup_within(({aim}), data)
"""

ON = """\
        for i in range(4):
            at = 1.0 - 0.25 * i
            point = backup_within(({between}), data)
            kept, other, none = backup_kept(state, point, floor, data)
            if kept:
                chosen = point
                break
"""

DECIDE = """\
def decide(x, u, data, work):
    floor = data[{floor}]
    state = ({part})
    wanted = backup_within(u, data)
    kept, lowest, failed = backup_kept(state, wanted, floor, data)
    if kept:
        return wanted, u, False, True, ({zeros}), -1, True
    nearest, chosen, law = inf, wanted, 0
{segments}    if nearest < inf:
{further}        return chosen, u, True, True, ({zeros}), failed, True
    good, low, lows = False, -inf, ({infinite})
{plans}    slack = ({slack})
    return chosen, u, True, good, slack, failed, True
"""

OF_SEGMENT = """\
    begin_{j} = backup_input_{j}(backup_reading_{j}(state, data), data)
    found, point, lowest = backup_segment(state, begin_{j}, wanted, floor, data)
    if found:
        away = {away}
        if away < nearest:
            nearest, chosen, law = away, point, {j}
"""

OF_PLAN = """\
    entered, fallen = backup_whole_{j}(state, begin_{j}, data)
    least = {least}
    fine = entered and least >= 0.0
    if {first} or (least > low if fine == good else fine):
        good, low, lows, chosen = fine, least, fallen, begin_{j}
"""


def backup_source(plans: Plans, floor: float, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.engine.slots` of a backup filter.

    Args:
        plans: that are simulated.
        floor: below which no barrier may be on a plan.
        data: receives the numbers.
    """
    system, count, m = plans.system, plans.count, plans.system.m
    source = _step(plans, data) + _within(plans, data) + Source(LOWER)
    for j, numbers in enumerate(plans.readings):
        source += formulas(f"backup_reading_{j}", {"x": system.states}, numbers, data)
        source += Source(_input(j, plans))
        words = {"j": j, "periods": plans.periods, "count": count, "infinite": "inf, " * count}
        smaller = _lines(
            f"        if values[{i}] < h:\n            h, failed = values[{i}], {i}"
            for i in range(1, count)
        )
        total = " + ".join(f"values[{i}]" for i in range(count))
        source += Source(FOLLOW.format(smaller=smaller, total=total, **words))
        lower = _tuple(f"backup_lower(lows[{i}], values[{i}])" for i in range(count))
        source += Source(WHOLE.format(smaller=lower, **words))
    laws = range(len(plans.laws))
    others = _lines(
        f"    kept, other, none = backup_follow_{j}(reached, floor, data)\n"
        "    if kept:\n        return True, other, none"
        for j in laws[1:]
    )
    between = _tuple(f"begin[{i}] + at * (end[{i}] - begin[{i}])" for i in range(m))
    away = " + ".join(f"(point[{i}] - wanted[{i}]) ** 2" for i in range(m))
    least = "fallen[0]"
    for i in range(1, count):
        least = f"backup_lower({least}, fallen[{i}])"
    further = ""
    if m > 1:
        for j in laws:
            source += Source(_aim(j, plans, data))
            further += (
                f"        if law == {j}:\n"
                f"            aim = backup_aim_{j}(state, chosen, wanted, floor, data)\n"
            )
        start = "        aim = chosen\n"
        way = _tuple(f"chosen[{i}] + at * (aim[{i}] - chosen[{i}])" for i in range(m))
        further = start + further + ON.format(between=way)
    decide = DECIDE.format(
        further=further,
        floor=data.add([floor]),
        part=_tuple(f"x[{i}]" for i in plans.places),
        zeros="0.0, " * count,
        infinite="-inf, " * count,
        segments="".join(OF_SEGMENT.format(j=j, away=away) for j in laws),
        plans="".join(OF_PLAN.format(j=j, least=least, first=j == 0) for j in laws),
        slack=_tuple(f"-lows[{i}] if not good and lows[{i}] < 0.0 else 0.0" for i in range(count)),
    )
    return (
        source
        + Source(KEPT.format(others=others))
        + Source(SEGMENT.format(between=between))
        + Source(decide)
    )


def _aim(j: int, plans: Plans, data: Data) -> str:
    """Return what `slope_search.aims` finds for one state, as text."""
    (low, high), m, barriers = plans.bounds, plans.system.m, range(plans.count)
    first = data.add([*low, *high])
    slopes = ""
    for i in range(m):
        moved = _tuple(f"point[{e}] + step_{i}" if e == i else f"point[{e}]" for e in range(m))
        lines = _lines(f"    slope_{k}_{i} = (lows[{k}] - base[{k}]) / step_{i}" for k in barriers)
        places = {"low": first + i, "high": first + m + i, "difference": DIFFERENCE}
        slopes += SLOPE.format(i=i, j=j, moved=moved, slopes=lines, **places)
    needed, sweep = "", ""
    for k in barriers:
        names = [f"slope_{k}_{i}" for i in range(m)]
        needed += NEEDED.format(
            k=k,
            total=" + ".join(names),
            none=", ".join(names),
            zeros=", ".join(["0.0"] * m),
            product=" + ".join(f"{s} * point[{i}]" for i, s in enumerate(names)),
            square=" + ".join(f"{s} ** 2" for s in names),
            share=1.0 - LEFT,
        )
        aim = _tuple(
            f"wanted[{i}] + {' + '.join(f'slope_{e}_{i} * y_{e}' for e in barriers)}"
            for i in range(m)
        )
        product = " + ".join(f"{s} * found[{i}]" for i, s in enumerate(names))
        sweep += SWEEP.format(k=k, product=product, aim=aim)
    return AIM.format(j=j, slopes=slopes, needed=needed, sweep=sweep, sweeps=SWEEPS)


def _step(plans: Plans, data: Data) -> Source:
    """Return a control period without noise, as the plans integrate it."""
    system, h = plans.system, plans.step_size
    if not system.noise_channels:
        arguments = {"x": system.states, "u": system.inputs}
        return formulas("backup_rate", arguments, tuple(rate(system)), data) + Source(
            _runge_kutta(system.n, h, plans.substeps, data)
        )
    return _mean(system, h, data) + Source(
        "def backup_step(x, u, data):\n"
        f"    for _ in range({plans.substeps}):\n        x = backup_mean(x, u, data)\n"
        "    return x\n"
    )


def _mean(system: ControlAffineSDE, h: float, data: Data) -> Source:
    moved = sp.Matrix(system.states) + rate(system) * sp.Float(h, 17)
    arguments = {"x": system.states, "u": system.inputs}
    return formulas("backup_mean", arguments, tuple(moved), data)


def _runge_kutta(n: int, h: float, substeps: int, data: Data) -> str:
    first = data.add([0.5 * h, h, h / 6.0])
    half, whole, sixth = (f"data[{first + i}]" for i in range(3))

    def ahead(factor: str, k: str) -> str:
        return _tuple(f"x[{i}] + {factor} * {k}[{i}]" for i in range(n))

    total = _tuple(
        f"x[{i}] + {sixth} * (k1[{i}] + 2.0 * (k2[{i}] + k3[{i}]) + k4[{i}])" for i in range(n)
    )
    return (
        "def backup_step(x, u, data):\n"
        f"    for _ in range({substeps}):\n"
        "        k1 = backup_rate(x, u, data)\n"
        f"        k2 = backup_rate(({ahead(half, 'k1')}), u, data)\n"
        f"        k3 = backup_rate(({ahead(half, 'k2')}), u, data)\n"
        f"        k4 = backup_rate(({ahead(whole, 'k3')}), u, data)\n"
        f"        x = ({total})\n"
        "    return x\n"
    )


def _within(plans: Plans, data: Data) -> Source:
    """Return what clips inputs to their bounds, and puts the middle in place of none."""
    low, high = plans.bounds
    first = data.add([e for ends in zip(low, high, plans.middle, strict=True) for e in ends])
    clipped = _tuple(
        f"backup_clipped(u[{i}], {', '.join(f'data[{first + 3 * i + k}]' for k in range(3))})"
        for i in range(len(low))
    )
    return Source(
        "def backup_clipped(u, low, high, middle):\n"
        "    if u != u:\n        return middle\n"
        "    u = low if u < low else u\n"
        "    return high if u > high else u\n"
        f"def backup_within(u, data):\n    return ({clipped})\n"
    )


def _input(j: int, plans: Plans) -> str:
    """Return what makes the clipped input of a law of its readings."""
    first = plans.count + 1
    wanted = _tuple(f"values[{first + i}]" for i in range(plans.system.m))
    return f"def backup_input_{j}(values, data):\n    return backup_within(({wanted}), data)\n"


def _tuple(entries: Iterable[str]) -> str:
    return "".join(f"{entry}, " for entry in entries)


def _lines(entries: Iterable[str]) -> str:
    return "".join(f"{entry}\n" for entry in entries)
