"""Standard normal and exponential numbers of uniforms, one by one: a kernel module.

The normal distribution function is inverted by rational functions whose relative error is about
1e-16. The arrays of `safe_envs.dynamics.noise` get the same bits, but for the logarithm.

Source: Wichura: Algorithm AS 241, the percentage points of the normal distribution. Applied
Statistics 37 (1988), routine PPND16.
"""

from __future__ import annotations

from math import log, sqrt

HALF_STEP = 2.0**-54
"""Half the distance of two uniforms: by it they are moved off 0, and lie symmetric to 1/2."""

CENTRAL = 0.425
"""Greatest distance from 1/2 of the central function; it is one of CENTRAL_SQUARE - q * q."""

CENTRAL_SQUARE = 0.180625
NEAR_END = 5.0
"""Greatest sqrt(-log p) of the near tail."""

NEAR_SHIFT = 1.6
FAR_SHIFT = 5.0

# Central function.
A0 = 3.3871328727963666080e0
A1 = 1.3314166789178437745e2
A2 = 1.9715909503065514427e3
A3 = 1.3731693765509461125e4
A4 = 4.5921953931549871457e4
A5 = 6.7265770927008700853e4
A6 = 3.3430575583588128105e4
A7 = 2.5090809287301226727e3
B1 = 4.2313330701600911252e1
B2 = 6.8718700749205790830e2
B3 = 5.3941960214247511077e3
B4 = 2.1213794301586595867e4
B5 = 3.9307895800092710610e4
B6 = 2.8729085735721942674e4
B7 = 5.2264952788528545610e3
# Near tail.
C0 = 1.42343711074968357734e0
C1 = 4.63033784615654529590e0
C2 = 5.76949722146069140550e0
C3 = 3.64784832476320460504e0
C4 = 1.27045825245236838258e0
C5 = 2.41780725177450611770e-1
C6 = 2.27238449892691845833e-2
C7 = 7.74545014278341407640e-4
D1 = 2.05319162663775882187e0
D2 = 1.67638483018380384940e0
D3 = 6.89767334985100004550e-1
D4 = 1.48103976427480074590e-1
D5 = 1.51986665636164571966e-2
D6 = 5.47593808499534494600e-4
D7 = 1.05075007164441684324e-9
# Far tail.
E0 = 6.65790464350110377720e0
E1 = 5.46378491116411436990e0
E2 = 1.78482653991729133580e0
E3 = 2.96560571828504891230e-1
E4 = 2.65321895265761230930e-2
E5 = 1.24266094738807843860e-3
E6 = 2.71155556874348757815e-5
E7 = 2.01033439929228813265e-7
F1 = 5.99832206555887937690e-1
F2 = 1.36929880922735805310e-1
F3 = 1.48753612908506148525e-2
F4 = 7.86869131145613259100e-4
F5 = 1.84631831751005468180e-5
F6 = 1.42151175831644588870e-7
F7 = 2.04426310338993978564e-15


def standard_normal(uniform: float) -> float:
    """Return the standard normal number of a uniform of `StreamReader`, in [0, 1)."""
    # Both operations are exact, and q is never 0.
    q = (uniform - 0.5) + HALF_STEP
    if abs(q) <= CENTRAL:
        return normal_center(q)
    return normal_tail(q)


def normal_center(q: float) -> float:
    """Return the standard normal number at 1/2 + q, where |q| <= `CENTRAL`."""
    r = CENTRAL_SQUARE - q * q
    top = ((((((A7 * r + A6) * r + A5) * r + A4) * r + A3) * r + A2) * r + A1) * r + A0
    low = ((((((B7 * r + B6) * r + B5) * r + B4) * r + B3) * r + B2) * r + B1) * r + 1.0
    return q * (top / low)


def normal_tail(q: float) -> float:
    """Return the standard normal number at 1/2 + q, where |q| > `CENTRAL`."""
    r = sqrt(-log(0.5 - abs(q)))
    found = near_tail(r) if r <= NEAR_END else far_tail(r)
    if q < 0.0:
        return -found
    return found


def near_tail(root: float) -> float:
    """Return the standard normal number of root = sqrt(-log p) up to `NEAR_END`."""
    r = root - NEAR_SHIFT
    top = ((((((C7 * r + C6) * r + C5) * r + C4) * r + C3) * r + C2) * r + C1) * r + C0
    low = ((((((D7 * r + D6) * r + D5) * r + D4) * r + D3) * r + D2) * r + D1) * r + 1.0
    return top / low


def far_tail(root: float) -> float:
    """Return the standard normal number of root = sqrt(-log p) above `NEAR_END`."""
    r = root - FAR_SHIFT
    top = ((((((E7 * r + E6) * r + E5) * r + E4) * r + E3) * r + E2) * r + E1) * r + E0
    low = ((((((F7 * r + F6) * r + F5) * r + F4) * r + F3) * r + F2) * r + F1) * r + 1.0
    return top / low


def standard_exponential(uniform: float) -> float:
    """Return the standard exponential number of a uniform of `StreamReader`, in [0, 1)."""
    return -log(uniform + HALF_STEP)
