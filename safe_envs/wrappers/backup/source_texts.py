"""Functions of a compiled program of the backup filter, with places for what depends on a problem.

The states `x` of these functions are the p components that plans need, but in `decide`, which takes
all of them.
"""

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
