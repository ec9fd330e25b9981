"""Colours, sizes and texts that all pictures share."""

from __future__ import annotations

import math

import sympy as sp

Color = tuple[int, int, int]

# The palette of Okabe and Ito, which colour-blind people can tell apart.
BLUE: Color = (0, 114, 178)
SKY: Color = (86, 180, 233)
GREEN: Color = (0, 158, 115)
ORANGE: Color = (230, 159, 0)
DARK_VERMILLION: Color = (196, 80, 0)
"""Darker than theirs, so that white letters on it can be read."""

PURPLE: Color = (204, 121, 167)

INK: Color = (32, 36, 44)
GREY: Color = (104, 110, 120)
LINE: Color = (214, 218, 224)
PANEL: Color = (246, 247, 249)
PAPER: Color = (255, 255, 255)

EDGE: Color = (0, 106, 78)
"""Of h = 0."""

UNSAFE: Color = (252, 243, 236)
"""Where h < 0, between the hatching."""

HATCH: Color = (236, 200, 174)

EXECUTED = BLUE
INTERVENING = ORANGE
INFEASIBLE = DARK_VERMILLION
VIOLATION = DARK_VERMILLION
GOAL = PURPLE

SMALL, NORMAL, LARGE = 13, 15, 20
"""Heights of the letters, in pixels."""

SIZE = (960, 540)
"""Of a picture, in pixels: even numbers, as video codecs ask for."""

SCENE = (0, 0, 600, 540)
"""Left, top, width and height of the scene; the panel is to its right."""

_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def mix(color: Color, background: Color, share: float) -> Color:
    """Return a colour laid over another one.

    Args:
        color: on top.
        background: below.
        share: opacity of the upper one, from 0 to 1.

    Returns:
        The colour that is seen.
    """
    r, g, b = (
        round(share * c + (1 - share) * under) for c, under in zip(color, background, strict=True)
    )
    return r, g, b


def pretty(name: str) -> str:
    """Return a name with Greek letters, indices and rates: theta, x_1, zdot as θ, x₁, dz/dt."""
    base = name.removesuffix("dot")
    text = sp.pretty(sp.Symbol(base or name), use_unicode=True)
    return f"d{text}/dt" if base and base != name else text


def unit_text(unit: str) -> str:
    """Return a unit with raised exponents and a centred dot: rad^2/s^2 as rad²/s², N m as N·m."""
    head, *powers = unit.replace(" ", "·").split("^")
    return head + "".join(power[:1].translate(_SUPERSCRIPTS) + power[1:] for power in powers)


def label(name: str, unit: str = "") -> str:
    """Return a name with its unit, for an axis.

    Args:
        name: of a variable.
        unit: of the variable; empty for none.

    Returns:
        Such as "ω [rad/s]".
    """
    return f"{pretty(name)} [{unit_text(unit)}]" if unit else pretty(name)


def number(value: float, scale: float = 0.0) -> str:
    """Return a number with three significant digits and a true minus sign.

    Args:
        value: to write; a large one is rounded to a whole number, in groups of three digits.
        scale: a value below a thousandth of it is written as 0, and digits are significant at this
            size.

    Returns:
        The text.
    """
    size = abs(value)
    if size == math.inf:
        return "inf" if value > 0.0 else "\u2212inf"
    if size <= 1e-3 * scale:
        value = size = 0.0
    if size >= 1e6 or 0.0 < size < 1e-3:
        digits, power = f"{value:.2e}".split("e")
        text = f"{digits}\u00d710{str(int(power)).translate(_SUPERSCRIPTS)}"
    elif size >= 1000.0:
        text = f"{value:,.0f}".replace(",", "\u202f")
    else:
        # A value of a scale keeps its decimals while it moves around 0.
        counted = max(size, min(scale, 1.0)) or 1.0
        text = f"{value:.{max(0, 2 - math.floor(math.log10(counted)))}f}"
    return text.replace("-", "\u2212")


def bound(value: float) -> str:
    """Return a bound with three significant digits, without zeros at the end."""
    if value == 0.0 or 1e-3 <= abs(value) < 999.5:
        return f"{value:.3g}".replace("-", "\u2212")
    return number(value)
