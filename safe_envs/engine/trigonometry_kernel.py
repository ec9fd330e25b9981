"""Sine, cosine and arc tangent of two numbers, as kernels.

Within their reach they give the same bits on every machine. They are sums and products without
branches, so that compiled code has no calls, computes what the sine and the cosine of an angle have
in common once, and goes on while it waits for other results.
Errors are below 1 unit in the last place for sine and cosine, and about 1 for the arc tangent.

The C library computes the rest: angles beyond 2**17, sines of 0, vectors with tiny components, and
infinities. An angle out of reach is detected at the end, by a result that is NaN: a test of the
argument would let the compiler move the sums and products into one of its branches, where they
could not be shared.

The coefficients are those of minimax polynomials of z = r * r for the relative error, by Lawson's
algorithm: sin(r) = r + r z S(z) to 2**-57.8 and cos(r) = 1 - z / 2 + z z C(z) to 2**-63.8, both up
to |r| = pi / 4, and atan(t) = t + t z T(z) to 2**-56.6 up to |t| = 1. The first ones were rounded
before the others were fitted.

Source: W. Cody, W. Waite, Software Manual for the Elementary Functions, 1980 (reduction by parts of
pi / 2); T. Dekker, A floating-point technique for extending the available precision, Numerische
Mathematik 18 (1971) (remainder of a quotient).
"""

from __future__ import annotations

from math import copysign

from safe_envs.engine.plain_natives import library_arc_tangent, library_cosine, library_sine

PER_QUARTER = 0.6366197723675814
"""2 / pi."""

WHOLE = 1.5 * 2.0**52
"""A number that leaves the nearest whole number where it is added and subtracted."""

FAR_BEYOND = 2.0**1007
"""Its product with an angle overflows from 2**17 on."""

# Parts of pi / 2: the first two have 36 bits, so that their products with up to 2**17 are exact.
QUARTER_1 = 1.5707963267923333
QUARTER_2 = 2.5633441515839558e-12
QUARTER_3 = 1.0562999066987428e-23

SINE_1 = -0.1666666666666663
SINE_2 = 0.008333333333321898
SINE_3 = -0.00019841269829442044
SINE_4 = 2.755731357790701e-06
SINE_5 = -2.505074187861118e-08
SINE_6 = 1.5895930879637206e-10
COSINE_1 = 0.041666666666666595
COSINE_2 = -0.001388888888887336
COSINE_3 = 2.480158728901899e-05
COSINE_4 = -2.7557314222879375e-07
COSINE_5 = 2.087570625441331e-09
COSINE_6 = -1.1358794992035242e-11
TANGENT_1 = -0.33333333333333065
TANGENT_2 = 0.1999999999995104
TANGENT_3 = -0.14285714282554973
TANGENT_4 = 0.11111111006523088
TANGENT_5 = -0.09090906995225967
TANGENT_6 = 0.07692279758305239
TANGENT_7 = -0.06666403455191709
TANGENT_8 = 0.058805245034380685
TANGENT_9 = -0.052535047714861824
TANGENT_10 = 0.04722278063203228
TANGENT_11 = -0.0421906891809618
TANGENT_12 = 0.03663976648987946
TANGENT_13 = -0.029900589448708322
TANGENT_14 = 0.021980974449957884
TANGENT_15 = -0.013897018326011286
TANGENT_16 = 0.0071940643705009286
TANGENT_17 = -0.002883694184745054
TANGENT_18 = 0.0008308992355839798
TANGENT_19 = -0.00015207121094185918
TANGENT_20 = 1.3216266606723662e-05

HALF_PI = 1.5707963267948966
HALF_PI_REST = 6.123233995736766e-17
TINY = 2.0**-900
"""From here on the remainder of a quotient by `arc_tangent` is exact."""

SPLITTER = 2.0**27 + 1.0


def sine(x: float) -> float:
    """Return the sine of an angle in rad."""
    quarters, s, c = turned_back(x)
    beyond = x * FAR_BEYOND
    # One factor is 0 and the other one 1 or -1; the first is no number for large angles.
    own = (1.0 - abs(quarters)) + (beyond - beyond)
    found = s * own + c * (quarters * (abs(quarters) - 2.0))
    # Zeros too, for their signs.
    if not abs(found) > 0.0:
        found = library_sine(x)
    return found


def cosine(x: float) -> float:
    """Return the cosine of an angle in rad."""
    quarters, s, c = turned_back(x)
    beyond = x * FAR_BEYOND
    own = (1.0 - abs(quarters)) + (beyond - beyond)
    found = c * own - s * (quarters * (abs(quarters) - 2.0))
    if found != found:
        found = library_cosine(x)
    return found


def turned_back(x: float) -> tuple[float, float, float]:
    """Return the quarter turns to go back, and sine and cosine of the rest of an angle.

    The quarter turns are -2 to 2, those that remain after whole turns.
    """
    turns = (x * PER_QUARTER + WHOLE) - WHOLE
    quarters = 4.0 * ((turns * 0.25 + WHOLE) - WHOLE) - turns
    first = x - turns * QUARTER_1
    second = turns * QUARTER_2
    r = first - second
    # What r lacks.
    rest = ((first - r) - second) - turns * QUARTER_3
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    cube = r * z
    s = rest + cube * (SINE_1 + z * SINE_2)
    s += (cube * z2) * (SINE_3 + z * SINE_4)
    s += (cube * z4) * (SINE_5 + z * SINE_6)
    half = 0.5 * z
    c = 1.0 - half
    low = ((1.0 - c) - half) - r * rest
    low += z2 * (COSINE_1 + z * COSINE_2)
    low += z4 * (COSINE_3 + z * COSINE_4)
    low += (z4 * z2) * (COSINE_5 + z * COSINE_6)
    return quarters, r + s, c + low


def arc_tangent(y: float, x: float) -> float:
    """Return the angle of a vector in rad, from -pi to pi, like `atan2` of C.

    Args:
        y: its second component.
        x: its first component.
    """
    height = abs(y)
    width = abs(x)
    small = height if height < width else width
    large = width if height < width else height
    if not small >= TINY:
        return library_arc_tangent(y, x)
    t = small / large
    rest = remainder_of_quotient(small, large, t)
    z = t * t
    flat = copysign(1.0, width - height)
    side = copysign(1.0, x)
    sign = side * flat
    # The angle is 0, pi / 2 or pi, and the arc tangent of t is added or subtracted.
    quarters = 1.0 - 0.5 * (side * (1.0 + flat))
    base = HALF_PI * quarters
    step = sign * t
    high = base + step
    low = ((base - high) + step) + HALF_PI_REST * quarters
    low += sign * (rest / (large + large * z))
    found = high + (low + (step * z) * arc_tangent_series(z))
    if found != found:
        found = library_arc_tangent(y, x)
    return copysign(found, y)


def arc_tangent_series(z: float) -> float:
    """Return (atan(t) - t) / t**3 for z = t * t, up to 1."""
    z2 = z * z
    z4 = z2 * z2
    z8 = z4 * z4
    p0 = (TANGENT_1 + z * TANGENT_2) + z2 * (TANGENT_3 + z * TANGENT_4)
    p1 = (TANGENT_5 + z * TANGENT_6) + z2 * (TANGENT_7 + z * TANGENT_8)
    p2 = (TANGENT_9 + z * TANGENT_10) + z2 * (TANGENT_11 + z * TANGENT_12)
    p3 = (TANGENT_13 + z * TANGENT_14) + z2 * (TANGENT_15 + z * TANGENT_16)
    p4 = (TANGENT_17 + z * TANGENT_18) + z2 * (TANGENT_19 + z * TANGENT_20)
    return ((p0 + z4 * p1) + z8 * (p2 + z4 * p3)) + (z8 * z8) * p4


def remainder_of_quotient(a: float, b: float, quotient: float) -> float:
    """Return a - b * quotient, exactly; no number where b is above 2**996.

    Args:
        a: dividend.
        b: divisor.
        quotient: a / b, rounded.
    """
    b_high = upper_half(b)
    b_low = b - b_high
    q_high = upper_half(quotient)
    q_low = quotient - q_high
    return ((a - q_high * b_high) - q_high * b_low - q_low * b_high) - q_low * b_low


def upper_half(value: float) -> float:
    """Return the upper half of a number's digits."""
    shifted = value * SPLITTER
    return shifted - (shifted - value)
