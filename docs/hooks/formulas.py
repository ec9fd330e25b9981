r"""Formulas of docstrings, written in ASCII between dollars, as LaTeX for the pages.

A terminal shows `$h = r^2 - x_1^2$`; a page shows it set in mathematics. Between two dollars on
each side fractions are built up. The grammar is that of arithmetic with a blank for a product:

    relation  = sum {("=" | "<=" | ">=" | "<" | ">" | ",") sum}
    sum       = ["+" | "-" | "+-"] product {("+" | "-" | "+-") product}
    product   = power {["/"] power}
    power     = atom ["'"] ["^" atom]
    atom      = number | name | function "(" relation ")" | "(" relation ")" | "[" relation "]"
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_FORMULA = re.compile(r"(\$\$?)([^$]+)\1")
_TOKEN = re.compile(r"\s*(<=|>=|\+-|\d*\.?\d+(?:e-?\d+)?|[A-Za-z]+(?:_[A-Za-z0-9]+)?|[^\s\w])")
_NAME = re.compile(r"([A-Za-z]+?)(d?dot)?(?:_([A-Za-z0-9]+))?")
_GREEK = frozenset(["alpha", "gamma", "mu", "omega", "phi", "pi", "psi", "sigma", "tau", "theta"])
_FUNCTIONS = frozenset(["cos", "exp", "log", "max", "min", "sin", "sup"])
_RELATIONS = {"=": "=", "<=": r"\leq", ">=": r"\geq", "<": "<", ">": ">", ",": r",\;"}
_SUMS = {"+": "+", "-": "-", "+-": r"\pm"}
_CLOSING = {"(": ")", "[": "]"}


def with_latex(text: str) -> str:
    """Return text with every formula between dollars turned into LaTeX.

    Raises:
        ValueError: a formula is outside the grammar.
    """

    def turned(found: re.Match[str]) -> str:
        latex = latex_of(found[2], display=found[1] == "$$")
        return f"\n$$\n{latex}\n$$\n" if found[1] == "$$" else f"${latex}$"

    return _FORMULA.sub(turned, text)


def with_set_units(text: str) -> str:
    """Return text with the exponents and roots of units as one would print them."""
    text = re.sub(r"(?<=[A-Za-z])\^([23])", lambda found: "²³"[int(found[1]) - 2], text)
    return text.replace("sqrt(s)", "√s")


def latex_of(formula: str, display: bool = False) -> str:
    """Return the LaTeX of a formula.

    Args:
        formula: in the grammar of this module.
        display: build fractions up, in place of a slash.

    Raises:
        ValueError: it is outside the grammar.
    """
    tokens = _TOKEN.findall(formula)
    if "".join(tokens) != "".join(formula.split()):
        raise ValueError(f"{formula!r} has a letter that no formula can have")
    parser = _Parser(tokens, display)
    latex = parser.relation()
    if parser.token:
        raise ValueError(f"{formula!r} has {parser.token!r} where an operator is needed")
    return latex


@dataclass
class _Parser:
    tokens: Sequence[str]
    display: bool
    at: int = 0

    @property
    def token(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def take(self) -> str:
        token = self.token
        self.at += 1
        return token

    def relation(self) -> str:
        parts = [self.sum()]
        while self.token in _RELATIONS:
            parts += [_RELATIONS[self.take()], self.sum()]
        return " ".join(parts)

    def sum(self) -> str:
        # Braces keep a sign close to what follows it, also after "=".
        sign = _SUMS[self.take()] if self.token in _SUMS else ""
        parts = [f"{{{sign}{self.product()}}}" if sign else self.product()]
        while self.token in _SUMS:
            parts += [_SUMS[self.take()], self.product()]
        return " ".join(parts)

    def product(self) -> str:
        latex, single = self.power()
        while self.token == "/" or self._begins_atom():
            divided = self.token == "/" and self.take() == "/"
            factor, _ = self.power()
            if not divided:
                latex, single = rf"{latex}\, {factor}", False
            elif self.display:
                latex = rf"\frac{{{_bare(latex) if single else latex}}}{{{_bare(factor)}}}"
                single = True
            else:
                latex, single = f"{latex}/{factor}", False
        return latex

    def power(self) -> tuple[str, bool]:
        """Return an atom with its exponent, and whether it is a pair of parentheses alone."""
        latex = self.atom()
        alone = latex.startswith(r"\left(")
        if self.token == "'":
            self.take()
            latex, alone = rf"{latex}^\top", False
        if self.token == "^":
            self.take()
            latex, alone = rf"{latex}^{{{_bare(self.atom())}}}", False
        return latex, alone

    def atom(self) -> str:
        token = self.take()
        if token in _CLOSING:
            inner = self.relation()
            if self.take() != _CLOSING[token]:
                raise ValueError(f"{''.join(self.tokens)!r} has a {token!r} that is not closed")
            return rf"\left{token}{inner}\right{_CLOSING[token]}"
        if token[:1].isdigit() or token[:1] == ".":
            return _number(token)
        if not token[:1].isalpha():
            raise ValueError(f"{' '.join(self.tokens)!r} has {token!r} where a value is needed")
        if self.token == "(" and token in ("sqrt", "abs"):
            inner = _bare(self.atom())
            return rf"\sqrt{{{inner}}}" if token == "sqrt" else rf"\lvert {inner} \rvert"
        if token in _FUNCTIONS:
            return rf"\{token}" if self.token != "(" else rf"\{token}{self.atom()}"
        return _name(token)

    def _begins_atom(self) -> bool:
        return self.token[:1].isalnum() or self.token[:1] in ("(", ".")


def _bare(latex: str) -> str:
    """Return what is between the outer parentheses."""
    if latex.startswith(r"\left(") and latex.endswith(r"\right)"):
        inner, depth = latex[6:-7], 0
        for found in re.findall(r"\\left\(|\\right\)", inner):
            depth += 1 if "left" in found else -1
            if depth < 0:
                return latex
        return inner
    return latex


def _number(text: str) -> str:
    mantissa, _, exponent = text.partition("e")
    mantissa = f"0{mantissa}" if mantissa.startswith(".") else mantissa
    return rf"{mantissa} \cdot 10^{{{exponent}}}" if exponent else mantissa


def _name(text: str) -> str:
    """Return a letter, a Greek letter or a word, with its dots and its index."""
    found = _NAME.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r} is no name")
    stem, dots, index = found.groups()
    plain = len(stem) == 1 or stem == "dt"
    letter = rf"\{stem}" if stem in _GREEK else stem if plain else rf"\mathrm{{{stem}}}"
    if dots:
        letter = rf"\{dots}{{{letter}}}"
    if index:
        letter += f"_{{{index}}}" if len(index) == 1 else rf"_{{\mathrm{{{index}}}}}"
    return letter
