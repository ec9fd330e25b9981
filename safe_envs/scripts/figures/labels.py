"""Labels of figures: names as mathematical symbols, units upright in brackets."""

from __future__ import annotations

import re
from collections.abc import Mapping

import sympy as sp

from safe_envs.errors import shortened
from safe_envs.wrappers.decision_log.columns import printable

_GREEK = frozenset(
    re.findall(
        r"\w+",
        "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau"
        " upsilon phi chi psi omega Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega",
    )
)
_ACCENTS = ("ddot", "dot", "hat", "bar", "tilde")
_NAME = re.compile(r"([A-Za-z]+?)(\d*)((?:_[A-Za-z0-9]+)*)")
_ASSIGNED = re.compile(r"\b[A-Za-z]\w*(?= = )")
_MEASURED = re.compile(r"(?<=\d) (?=[A-Za-z%]\b)")
_FACTOR = re.compile(r"(?:√|sqrt)\(?([A-Za-z]+)\)?|([A-Za-z]+|1)(?:\^(-?\d+)|([²³]))?")
_RAISED = {"²": "2", "³": "3"}


def plain(text: str, most: int = 40) -> str:
    """Return a text without what would be read as mathematics; it may come from a file.

    Args:
        text: a name, say.
        most: characters, about.
    """
    return shortened(printable(text), most).replace("$", r"\$")


def symbol(name: str) -> str:
    r"""Return the name of a quantity as mathematics, or as upright text where it is a word.

    Args:
        name: such as x, sigma_1, thetadot, rotor_1 or speed; other texts are written as they are.

    Returns:
        Mathtext, such as "$\sigma_{1}$" and "$\dot{\theta}$"; "speed" for a word.
    """
    match = _NAME.fullmatch(name)
    if match is None or len(name) > 40:
        return plain(name)
    base, digits, indices = match.groups()
    letter = _letter(base)
    parts = [part for part in (digits, *indices.split("_")) if part]
    if letter is None:
        # A word keeps its index, and further words are written after it.
        if not parts or any(not part.isdigit() for part in parts):
            return plain(name.replace("_", " "))
        letter = rf"\mathrm{{{base}}}"
    below = ",".join(
        f"\\{part}" if part in _GREEK else part if len(part) == 1 else rf"\mathrm{{{part}}}"
        for part in parts
    )
    return f"${letter}_{{{below}}}$" if below else f"${letter}$"


def _letter(base: str) -> str | None:
    """Return a Latin or Greek letter with its accent; None for a word."""
    for accent in _ACCENTS:
        inner = base.removesuffix(accent)
        if inner != base and (found := _letter(inner)):
            return f"\\{accent}{{{found}}}"
    if base in _GREEK:
        return f"\\{base}"
    return base if len(base) == 1 else None


def unit_text(unit: str) -> str:
    """Return a unit, upright, with its powers raised.

    Args:
        unit: such as m/s^2, N m, rad^2/s^2, m/s/sqrt(s); another text is written as it is.

    Returns:
        Mathtext. What several strokes divide by is in parentheses, as ISO 80000-1 asks for.
    """
    groups = [
        [_factor(factor) for factor in part.replace("·", " ").split()] for part in unit.split("/")
    ]
    if not all(groups) or any(factor is None for group in groups for factor in group):
        return plain(unit)
    above, *below = ([str(factor) for factor in group] for group in groups)
    divisors = [factor for group in below for factor in group]
    text = r"\,".join(above)
    if divisors:
        under = r"\,".join(divisors)
        text += f"/({under})" if len(divisors) > 1 else f"/{under}"
    return f"${text}$"


def _factor(text: str) -> str | None:
    match = _FACTOR.fullmatch(text)
    if match is None:
        return None
    rooted, name, power, raised = match.groups()
    if rooted:
        return rf"\sqrt{{\mathrm{{{rooted}}}}}"
    exponent = power or _RAISED.get(raised)
    return rf"\mathrm{{{name}}}" + (f"^{{{exponent}}}" if exponent else "")


def labelled(text: str, unit: str = "") -> str:
    """Return a text with a unit, as every axis has it.

    Args:
        text: of the quantity, which may hold mathematics.
        unit: of the quantity; empty for none, "%" for shares.

    Returns:
        Such as "time [s]".
    """
    if not unit:
        return text
    return f"{text} [{unit if unit == '%' else unit_text(unit)}]"


def quantity(name: str, unit: str = "") -> str:
    r"""Return the label of a state, an input or a parameter.

    Args:
        name: as in the problem.
        unit: as in the problem.

    Returns:
        Such as "$\theta$ [$\mathrm{rad}$]".
    """
    return labelled(symbol(name), unit)


def expression(text: str, units: Mapping[str, str]) -> str:
    """Return the label of an expression of states, such as a coordinate.

    Args:
        text: as SymPy prints it.
        units: of the states, by name.
    """
    if text in units:
        return quantity(text, units[text])
    states = {name: sp.Symbol(name, real=True) for name in units}
    parsed = sp.parse_expr(text, local_dict=dict(states))
    names = {state: symbol(name).strip("$") for name, state in states.items()}
    return f"${sp.latex(parsed, symbol_names=names)}$"


def mathematics(text: str) -> str:
    """Return a text in which names that are given values are mathematics, and units stay at them.

    Args:
        text: such as "sigma_1 = 0.1, dt = 0.05 s".

    Returns:
        The text, with mathtext.
    """
    joined = _MEASURED.sub("\u00a0", text.replace("$", r"\$"))
    return _ASSIGNED.sub(lambda match: symbol(match.group()), joined)
