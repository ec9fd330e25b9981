"""QPs that solvers once got wrong, or easily get wrong; each in every way.

Where a QP has no input in its row, the answer is that of rational arithmetic.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.engine.test_qp import assert_feasible, judge
from tests.oracles.qps import KINDS, WAYS, QPs, random_qps

one = QPs.one
HARD: dict[str, tuple[QPs, Any, bool | None]] = {}
"""Name: QP, input or None, and whether the constraints can be met; None where that is a matter of
rounding, and the flag is what the margins say."""


def hard(name: str, qps: QPs, u: Any, feasible: bool | None) -> None:
    assert name not in HARD
    HARD[name] = qps, u, feasible


def numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def wide(row: list[float], m: int) -> list[float]:
    """A row of more inputs, without a say."""
    return [*row, *[0.0] * (m - len(row))]


# Constraints that no input changes are met or not by their sign alone, and leave the others their
# say.
for m in (1, 2, 3):
    for value in (0.5, -0.5):
        rows = [wide([], m), wide([1.0], m)]
        hard(
            f"flat {value} beside one that acts, {m}",
            one(rows, [value, -0.5], wide([], m)),
            wide([0.5], m),
            value > 0,
        )
    for value in (0.0, 1e-300, -1e-300, -2.0):
        hard(
            f"only flat {value}, {m}",
            one([wide([], m)], [value], wide([3.0], m)),
            wide([1.0], m),
            value >= 0,
        )
hard("flat beside two opposite", one([0, 1, -1], [-1, -0.5, 2], [0.0]), [0.5], False)
hard("all flat", one([[0, 0], [0, 0]], [-1, 0], [3, 0.2]), [1.0, 0.2], False)
for value in (-1e-12, 0.0, 1e-12, -5.0):
    rows = [[1, 0.2, 0], [0.3, 1, 0.1], [0, 0, 0]]
    hard(f"flat {value} beside two", one(rows, [-0.5, -0.5, value], [0] * 3), None, value >= 0)

# Coefficients that are nothing but rounding do not drive inputs to their ends.
rows = [[1, 2, 3, 1], [-1, -2, -3, -1], [-8e-16, 4e-15, 8e-16, 5e-15]]
hard(
    "coefficients of rounding",
    one(rows, [-1.0, 1.0, -1.2], [0.1, 0.2, 0.1, 0.2]),
    [0.1, 0.2, 0.1, 0.2],
    False,
)

# Duplicates, opposite constraints, and constraints that meet in a point.
hard("duplicates", one([[1, 1, 0]] * 2, [-1, -1], [0] * 3), [0.5, 0.5, 0], True)
hard("opposite", one([[1, 0, 0], [-1, 0, 0]], [-0.3, 0.3], [0] * 3), [0.3, 0, 0], True)
hard("contradictory", one([[1, 0, 0], [-1, 0, 0]], [-0.5, 0.1], [0] * 3), [0.3, 0, 0], False)
for size in (0.1, 3.0, 1e-3, 1e6):
    rows, foot = [[0.7, 0.1], [0.7 * size, 0.1 * size]], 0.3 / 0.5
    hard(
        f"duplicates, one {size} times",
        one(rows, [-0.3, -0.3 * size], [0, 0]),
        [0.7 * foot, 0.1 * foot],
        True,
    )
    hard(
        f"one point, one {size} times",
        one([1, -size], [-0.3, size * 0.3], [0.9]),
        [0.3],
        True,
    )
    hard(
        f"almost one point, one {size} times",
        one([1, -size], [-0.3 * (1 + 1e-13), size * 0.3], [0.9]),
        [0.3],
        False,
    )
hard("a corner alone", one([1, 1], [-2], [0, 0.3]), [1, 1], True)
hard(
    "a corner out of reach",
    one([[1, 0.2], [0.4, 1], [0.5, 0.5]], [-3, -3, -2], [0, 0], -1, [1, 1.5]),
    [1, 1.5],
    False,
)
for far in (1.0, 1e3, 1e5):
    lines = [[-0.004512174099505522, -0.4388414080680893]]
    lines += [[-0.39491110755425435, 0.5863303579870851]]
    offsets = [0.0, 0.2574523271255308]
    hard(
        f"a crossing, {far} away",
        one(lines, offsets, [4.29731531704134 * far, -0.9034445409930839]),
        np.linalg.solve(lines, -np.array(offsets)),
        True,
    )

# Of equally violating inputs the nearest.
for v, u in ((0.2, 0.2), (0.9, 0.4), (-7.0, -1.0)):
    hard(
        f"two contradict and leave an input free, from {v}",
        one([[1, 0], [-1, 0], [0, -1]], [-0.5, 0.1, 0.4], [0, v]),
        [0.3, u],
        False,
    )
hard(
    "an input that no constraint mentions",
    one([[1, 0, -0.1], [-1, 0, 0.1]], [1, -1.3], [-3, 2.7, 2.3]),
    [-1, 1, 1],
    False,
)
for gap in (1e-6, 1.0, 100.0):
    hard(
        f"opposite ones share {gap}",
        one(
            [[1, 1, 0], [-2, -2, 0]],
            [-gap, -2 * gap],
            [0, 0, 5],
            -1000,
            1000,
            priority=[1, 0.75],
        ),
        [-gap / 4, -gap / 4, 5.0],
        False,
    )
for m in (1, 2, 3):
    rows = [wide([1.0], m), wide([-1.0], m)]
    hard(
        f"the higher priority gives way by as much less, {m}",
        one(rows, [-0.5, 0], wide([], m), priority=[1e4, 1]),
        wide([0.5 * 1e4 / (1e4 + 1)], m),
        False,
    )

# Scales.
for m in (2, 3):
    rows = [wide([-1.1e-3, 0], m), wide([2e-4, 1], m)]
    ends = [5000.0, *[1.0] * (m - 1)]
    u = -2.0 / 1.1e-3
    hard(
        f"newtons beside thousandths, {m}",
        one(rows, [-2, 0.2], wide([4000.0], m), [-end for end in ends], ends),
        wide([u, -0.2 - 2e-4 * u], m),
        True,
    )
for half in (1e6, 1e30, 1e100):
    hard(
        f"bounds of {half}",
        one([[1, 0.5, 0], [0, 1, 1]], [-3, -1], [0] * 3, -half, half, [1, 2, 1]),
        None,
        True,
    )
    hard(
        f"a contradiction in bounds of {half}",
        one([[1, 0.5, 0], [-1, -0.5, 0]], [-3, 1], [0] * 3, -half, half),
        [1.6, 0.8, 0],
        False,
    )
for exponent in (100, 170, 200, 290):
    row = np.array([0.9, 0.4, 1.2, 1.2]) * 10.0**-exponent
    hard(
        f"squares that vanish, {exponent}",
        one([row, [-0.14, 1.16, -2.58, 0.67]], [0, 0.15], [2.5, -1.7, -1.5, -1.3]),
        None,
        True,
    )
for size in (1e-300, 1e-200, 1e200, 1e300):
    hard(
        f"a constraint of size {size}",
        one([size, 2 * size], [-1.5 * size], [0, 0.3]),
        [0.18, 0.66],
        True,
    )
hard("a gain too small to divide by", one([1e-320], [-1], [0]), [1], False)
hard("and beside another", one([1e-320, 1], [-1, 0.5], [0]), [1], False)
hard("and beside a flat one", one([1e-320, 0], [-1, 1], [0]), [1], False)
hard("a root that is denormal", one([1e300, 1], [-1e-20, 1], [0]), None, None)
hard(
    "sides that differ by a million",
    one(
        [[1, 1e-6, 0], [0, 0, 1]],
        [-1.5, -0.25],
        [0] * 3,
        [-1, -1e6, -1],
        [1, 1e6, 1],
        [1, 1e-12, 1],
    ),
    [0.75, 7.5e5, 0.25],
    True,
)
for m in (2, 3):
    hard(
        f"a long way inside the bounds, {m}",
        one([wide([-1], m)], [1e-3], wide([1e6], m), -1e7, 1e7),
        wide([1e-3], m),
        True,
    )
    for rows, offsets in (([[1, 1]], [-0.5]), ([[1, 1], [0.3, 1]], [-0.5, 2])):
        hard(
            f"a proposal of 1e16, {m}, {len(rows)}",
            one([wide(row, m) for row in rows], offsets, wide([-1e16, 0.3], m)),
            wide([-0.5, 1], m),
            True,
        )
hard("a proposal outside the bounds", one([-1, -1], [1], [3, 1]), [1, 0], True)
hard("least violating, and flagged", one([1], [-13], [3], -10, 10), [10], False)

# A steep constraint beside flat ones: it is a wall to them, or has no part.
for m in (2, 3):
    for steep in (1e3, 1e6, 1e9):
        rows = [wide([-steep, -steep], m), wide([1e-3, -1e-3], m), wide([1e-3], m)]
        offsets, v = [0, -2.2e-3, -5e-3], [0.0, 0.0, 0.2][:m]
        hard(f"a wall of {steep}, {m}", one(rows, offsets, v), None, False)
        rows = [wide([steep, steep], m), *rows[1:]]
        hard(
            f"no wall of {steep}, {m}",
            one(rows, offsets, [-0.3, 0.2, 0.2][:m]),
            [1, -1, 0.2][:m],
            False,
        )
hard(
    "a step that meets a wall slides along it",
    one(
        [[-235515.086, -123224.314], [0.0021163, -0.0110864]],
        [40517.378, -0.0148531],
        [0, 0],
        -1,
        [1, 1.5],
        priority=[20.5, 0.08],
    ),
    [(40517.378 + 123224.314) / 235515.086, -1],
    False,
)
hard(
    "of an endless and a near edge the near one",
    one([[0.8, -1], [-0.65, -1]], [-1.3, 0.1], [0, 0], 0, 1e100),
    [(0.8 * 1.3 + 0.65 * 0.1) / (0.8**2 + 0.65**2), 0],
    False,
)

# As they were found.
hard(
    "the reach of the bounds decides",
    one(
        [-1.0202216377232305, 0.14422933038232305],
        [-0.011445797228288595],
        [2.182723419535889, -0.11143900878845633],
        [-1.5263859058894809, -0.4477092783909338],
        [0.27884684919436314, 2.9190568849119978],
    ),
    [0.01632375909475714, 0.19482617988487125],
    True,
)
hard(
    "a steep constraint is not missed for a flat one",
    one(
        [
            [0.00095467, 0.00083554, 0.00115792, -0.00130886],
            [306403.5, -982680.2, -1361077.7, -301636.4],
        ],
        [-0.001293006, -1338006.1],
        [1.16465, 2.15, 2.3758, -1.2736],
        [-1.02, -1, -1.4467, -0.5496],
        [0.785, 0.7545, 0.5675, 0.8436],
    ),
    # Where the steep one is met exactly, the flat one is missed least there.
    [
        0.785,
        -1.0,
        (1338006.1 - 306403.5 * 0.785 - 982680.2 - 301636.4 * 0.5496) / -1361077.7,
        -0.5496,
    ],
    False,
)
hard(
    "a miss is never called feasible on the way there",
    one(
        [
            [58.587457063119814, 160571986.1745277],
            [-8650.462775442928, -1255103405.2969155],
            [-0.49231216962370533, -44.42495682814076],
            [5.894081711817454e-08, 0.033354829041236],
        ],
        [0.04911269124857201, 0.2976744556968492, -0.49194699507253264, 0.1995416648164488],
        [395911001.8559354, 439281258.9179358],
    ),
    None,
    None,
)
hard(
    "a steep constraint met with room to spare lets go",
    one(
        [
            [208.26152489751715, 478.81823232530795, 473.39052954289167],
            [-0.50984162908369, 0.56405661689997, 0.47190637789455],
            [-1.49283308835e-3, 7.5841902551e-4, -5.8054635124e-4],
            [-5.2353039445e-3, -2.4708513022e-2, 3.7908425575e-2],
        ],
        [-412.768911191307, 0.114749375170422, -1.4806099082e-3, -1.9471364240e-2],
        [1.46724946406, 3.1629908946, -0.83154555956],
        [-0.8957285648, -1.0963488786775, -0.6095237162],
        [0.9434476957, 0.534211151, 1.52364823926],
        priority=[6.183767680033, 0.904524468956, 0.291185329034, 7.892208614194],
    ),
    None,
    False,
)
hard(
    "the rounding of a way of a million",
    one(
        [
            [
                -2.517655585092737e-4,
                4.172288702672463e-7,
                -1.5094574851107956,
                -3.72511864414773e-7,
            ],
            [
                -3.6470802386148696e-5,
                -1.030246137748674e-6,
                0.6242011531473187,
                -4.361699173632114e-8,
            ],
        ],
        [1.3032068751995545, -0.8993053416602996],
        [-1344.9906588339315, 843534.2707760541, 0.20908820645082052, 109003.3633315919],
        [-733.2585068425497, -1018841.2850137962, -1.0389243788772098, -1088294.5766171087],
        [953.7441083930224, 1035622.8909829491, 1.5325121588809307, 1275631.2915935216],
        [1.0372023271717195, 0.8272750006418648, 0.6081565564645655, 1.078193157759883],
        [2.997265185756112, 4.451373739084678],
    ),
    None,
    True,
)
hard(
    "one that binds beside slacks by rounding does not fix three inputs",
    random_qps(
        np.random.default_rng([21, KINDS.index("parallel"), 3, 11, 1]), 90, 11, 3, "parallel", 1.8
    ).states([43]),
    None,
    False,
)
row = np.array([1.7805065471418149, -2.3891471658881356])
hard(
    "nor two",
    one(
        [
            row,
            [-1.0914865469310746, 0.5658844556140599],
            [-0.468054665762019, -0.15944171162702206],
            [-0.2880221325181234, -0.6348367833529868],
            -0.5 * row,
            2 * row,
            -row,
            2 * row,
            [-1.8319347478921195, -1.3305860370650529],
            [-1.414143464465495, -0.9637906730485152],
            -row,
            [0.5480775385817698, -0.39759823467319033],
        ],
        numbers(
            "-2.7480151244508932 0.9019564175687251 0.6758737354911123 "
            "-0.46551939951735277 -0.30427293631575625 -6.873339586519217 "
            "-0.6342577853663001 -5.6851638220313925 -1.281235699952133 "
            "-1.0655098602441648 -3.529702012123098 0.7682627633159256"
        ),
        [-1.5881960807241322, -1.6581099754477813],
        [-1.10623332666011, -1.333968235916579],
        [1.656062700386216, 1.5876282933418533],
        [1.9943365729290874, 0.5920933786992519],
        numbers(
            "0.20977352561176763 1.0576158978028596 0.6321477186962632 "
            "3.026881780175434 0.11208658375856324 5.005643075821219 "
            "0.4966930260671996 2.9828190640727774 0.2188022357472905 "
            "0.3119182825526954 2.184439695979284 6.1990598166147795"
        ),
    ),
    None,
    False,
)


@pytest.mark.parametrize("name", HARD)
def test_it_is_right_in_every_way(name):
    qps, u, feasible = HARD[name]
    for label, way in WAYS.items():
        answers = way(qps)
        if label != "program":
            assert_feasible(qps, answers)
        if feasible is None:
            continue
        assert bool(answers.feasible[0]) is feasible, label
        error, wrong = 0.0, False
        if u is not None:
            error = (np.abs(answers.u - u) / qps.reach(np.array([u]))).max()
        else:
            found = judge(qps, 0, answers)
            assert found is not None, label
            error, wrong = found
        assert error <= 1e-9, label
        assert not wrong, label
