"""The decisions of the backup filter as the text of a compiled program."""

from __future__ import annotations

from collections.abc import Iterable

import sympy as sp

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.dynamics.integrators import rate
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.wrappers.backup import source_texts
from safe_envs.wrappers.backup.plans import Plans
from safe_envs.wrappers.backup.slope_search import DIFFERENCE, LEFT, SWEEPS


def backup_source(plans: Plans, floor: float, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.compiled.slots` of a backup filter.

    Args:
        plans: that are simulated.
        floor: below which no barrier may be on a plan.
        data: receives the numbers.
    """
    system, count, m = plans.system, plans.count, plans.system.m
    source = _step(plans, data) + _within(plans, data) + Source(source_texts.LOWER)
    for j, numbers in enumerate(plans.readings):
        source += formulas(f"backup_reading_{j}", {"x": system.states}, numbers, data)
        source += Source(_input(j, plans))
        words = {"j": j, "periods": plans.periods, "count": count, "infinite": "inf, " * count}
        smaller = _lines(
            f"        if values[{i}] < h:\n            h, failed = values[{i}], {i}"
            for i in range(1, count)
        )
        total = " + ".join(f"values[{i}]" for i in range(count))
        source += Source(source_texts.FOLLOW.format(smaller=smaller, total=total, **words))
        lower = _tuple(f"backup_lower(lows[{i}], values[{i}])" for i in range(count))
        source += Source(source_texts.WHOLE.format(smaller=lower, **words))
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
        further = start + further + source_texts.ON.format(between=way)
    decide = source_texts.DECIDE.format(
        further=further,
        floor=data.add([floor]),
        part=_tuple(f"x[{i}]" for i in plans.places),
        zeros="0.0, " * count,
        infinite="-inf, " * count,
        segments="".join(source_texts.OF_SEGMENT.format(j=j, away=away) for j in laws),
        plans="".join(source_texts.OF_PLAN.format(j=j, least=least, first=j == 0) for j in laws),
        slack=_tuple(f"-lows[{i}] if not good and lows[{i}] < 0.0 else 0.0" for i in range(count)),
    )
    return (
        source
        + Source(source_texts.KEPT.format(others=others))
        + Source(source_texts.SEGMENT.format(between=between))
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
        slopes += source_texts.SLOPE.format(i=i, j=j, moved=moved, slopes=lines, **places)
    needed, sweep = "", ""
    for k in barriers:
        names = [f"slope_{k}_{i}" for i in range(m)]
        needed += source_texts.NEEDED.format(
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
        sweep += source_texts.SWEEP.format(k=k, product=product, aim=aim)
    return source_texts.AIM.format(j=j, slopes=slopes, needed=needed, sweep=sweep, sweeps=SWEEPS)


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
