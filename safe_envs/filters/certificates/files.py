"""Files of barrier certificates: JSON with exact numbers, and a checksum."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, NoReturn

import sympy as sp

from safe_envs.dynamics.expression_text import (
    number_text,
    read_expression,
    read_number,
    require_name,
    write_expression,
)
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import (
    HELD_CERTIFICATES,
    ConfigurationError,
    SystemDefinitionError,
    shortened,
    shown,
)
from safe_envs.files import read_json, write_json
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant

FORMAT = 1
KIND = "barrier certificate of safe-envs"

_MOST_STATES = 12
_MOST_EXPRESSIONS = 40
_MOST_COEFFICIENTS = 20_000
_LARGEST_EXPONENT = 20
_LARGEST_TENSOR = 200_000
_MOST_OPTIONS = 20_000
_NOT_NEGATIVE: tuple[str, Callable[[Fraction], bool]] = ("a number of at least 0", lambda v: v >= 0)
_POSITIVE: tuple[str, Callable[[Fraction], bool]] = ("a number above 0", lambda v: v > 0)
_ADVICE = "write it again with `safe-envs certify`, or get another copy"


def save_certificate(certificate: BarrierCertificate, path: Path | str) -> None:
    """Write a certificate, whole or not at all.

    Args:
        certificate: with exact numbers.
        path: where the file is to be.

    Raises:
        ConfigurationError: it cannot be written there, or not in this format: it has a function
            that no checker knows, a float, more than 12 states or a name that is no word.
    """
    content = _content_of(certificate)
    _certificate_of(content)
    write_json(Path(path), {**content, "sha256": checksum(content)})


def load_certificate(path: Path | str) -> BarrierCertificate:
    """Read a certificate, which may be a stranger's: no code is run.

    Args:
        path: of the file.

    Returns:
        What it states; nothing of it is checked.

    Raises:
        ConfigurationError: it cannot be read, is damaged, or has a part that is not allowed.
    """
    name = shortened(path)
    content = read_json(Path(path), _ADVICE)
    if not isinstance(content, dict) or content.get("kind") != KIND:
        raise ConfigurationError(f"{name} is no {KIND}; {_ADVICE}")
    if type(content.get("format")) is not int or content["format"] != FORMAT:
        raise ConfigurationError(
            f"{name} has format {shown(content.get('format'))}; this version reads format {FORMAT}"
        )
    given = content.pop("sha256", None)
    try:
        known = given == checksum(content)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{name} is nested too deep or has no text; {_ADVICE}") from error
    if not known:
        raise ConfigurationError(
            f"{name} is damaged or was changed: its sha256 does not match its content; {_ADVICE}"
        )
    try:
        return _certificate_of(content)
    except (ConfigurationError, SystemDefinitionError) as error:
        raise ConfigurationError(f"{name}: {error}") from error


def checksum(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON of all of a file but its entry sha256."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _content_of(certificate: BarrierCertificate) -> dict[str, Any]:
    plant, psi = certificate.plant, certificate.psi
    if psi.states != plant.states:
        raise ConfigurationError(f"psi is of {psi.states}, the plant of {plant.states}; use one")
    names = {require_name(s.name, "a state"): s for s in plant.states}

    def write(expressions: Any, where: str) -> list[str]:
        return [write_expression(e, names, where) for e in expressions]

    def ranges(symbols: Any, ends: Any, what: str) -> list[dict[str, str]]:
        both = zip(symbols, ends, strict=True)
        texts = [(require_name(s.name, what), *write(pair, what)) for s, pair in both]
        return [{"name": name, "low": low, "high": high} for name, low, high in texts]

    return {
        "kind": KIND,
        "format": FORMAT,
        "env": {"id": certificate.env_id, "options": certificate.options},
        "states": ranges(plant.states, plant.workspace, "workspace"),
        "inputs": ranges(plant.inputs, plant.bounds, "input bounds"),
        "drift": write(plant.drift, "drift"),
        "input_matrix": [write(line, "input_matrix") for line in plant.input_matrix],
        "diffusion": [write(line, "diffusion") for line in plant.diffusion],
        "barriers": write(plant.barriers, "barriers"),
        "policy": write(plant.policy, "policy"),
        "psi": {
            "center": [number_text(v) for v in psi.center],
            "scale": [number_text(v) for v in psi.scale],
            "coefficients": [
                [list(key), number_text(v)] for key, v in sorted(psi.coefficients.items())
            ],
        },
        "m": number_text(certificate.shortfall),
        "c": number_text(certificate.supremum),
        "a": number_text(certificate.rate),
        "horizon": number_text(certificate.horizon),
    }


def _certificate_of(content: dict[str, Any]) -> BarrierCertificate:
    if "control" in content:
        raise ConfigurationError(HELD_CERTIFICATES)
    env = _part(content, "env", dict)
    options = _part(env, "options", dict)
    if len(json.dumps(options)) > _MOST_OPTIONS:
        _refuse("env.options", options, f"at most {_MOST_OPTIONS:,} characters of options")
    plant = _plant_of(content)
    env_id, psi = _part(env, "id", str), _psi_of(_part(content, "psi", dict), plant.states)
    shortfall = _number(content, "m", *_NOT_NEGATIVE)
    supremum = _number(content, "c", *_POSITIVE)
    rate = _number(content, "a", *_NOT_NEGATIVE)
    horizon = _number(content, "horizon", *_POSITIVE)
    return BarrierCertificate(env_id, options, plant, psi, rate, shortfall, supremum, horizon)


def _plant_of(content: dict[str, Any]) -> Plant:
    states, workspace = _ranges(content, "states")
    inputs, bounds = _ranges(content, "inputs")
    names = {s.name: s for s in states}
    if len({*names, *(u.name for u in inputs)}) < len(states) + len(inputs):
        _refuse("states and inputs", [s.name for s in (*states, *inputs)], "names that differ")

    def read(value: Any, where: str, least: int, most: int) -> tuple[sp.Expr, ...]:
        if not isinstance(value, list) or not least <= len(value) <= most:
            count = str(least) if least == most else f"{least} to {most}"
            _refuse(where, value, f"a list of {count} expressions")
        return tuple(read_expression(e, names, f"{where}[{i}]") for i, e in enumerate(value))

    def matrix(key: str, most: int, exactly: bool = False) -> tuple[tuple[sp.Expr, ...], ...]:
        lines = _part(content, key, list)
        if len(lines) != len(states):
            _refuse(key, lines, f"{len(states)} lists of expressions, one for each state")
        first = len(lines[0]) if isinstance(lines[0], list) else 0
        width = most if exactly else min(max(first, 1), most)
        return tuple(read(line, f"{key}[{i}]", width, width) for i, line in enumerate(lines))

    policy = _part(content, "policy", list)
    return Plant(
        states=states,
        workspace=workspace,
        inputs=inputs,
        bounds=bounds,
        drift=read(content.get("drift"), "drift", len(states), len(states)),
        input_matrix=matrix("input_matrix", len(inputs), exactly=True),
        diffusion=matrix("diffusion", _MOST_EXPRESSIONS),
        barriers=read(content.get("barriers"), "barriers", 1, _MOST_EXPRESSIONS),
        policy=read(policy, "policy", len(inputs), len(inputs)) if policy else (),
    )


def _ranges(content: dict[str, Any], key: str) -> tuple[tuple[sp.Symbol, ...], tuple[Any, ...]]:
    entries = _part(content, key, list)
    if not 1 <= len(entries) <= _MOST_STATES:
        _refuse(key, entries, f"a list of 1 to {_MOST_STATES} entries")
    symbols, ends = [], []
    for i, entry in enumerate(entries):
        where = f"{key}[{i}]"
        if not isinstance(entry, dict):
            _refuse(where, entry, "an object with name, low and high")
        symbols.append(sp.Symbol(require_name(entry.get("name"), where), real=True))
        low, high = (
            read_expression(entry.get(end), {}, f"{where}.{end}") for end in ("low", "high")
        )
        if not float(low) < float(high):
            _refuse(where, [str(low), str(high)], "a lower end below the upper one")
        ends.append((low, high))
    return tuple(symbols), tuple(ends)


def _psi_of(content: dict[str, Any], states: tuple[sp.Symbol, ...]) -> Polynomial:
    n, coefficients = len(states), {}
    vectors = {}
    for key in ("center", "scale"):
        values = _part(content, key, list)
        if len(values) != n:
            _refuse(f"psi.{key}", values, f"a list of {n} numbers")
        sound = (lambda v: v > 0) if key == "scale" else (lambda v: True)
        allowed = "a number above 0" if key == "scale" else "a number"
        vectors[key] = tuple(
            _number({f"psi.{key}[{i}]": v}, f"psi.{key}[{i}]", allowed, sound)
            for i, v in enumerate(values)
        )
    entries = _part(content, "coefficients", list)
    if not 1 <= len(entries) <= _MOST_COEFFICIENTS:
        _refuse("psi.coefficients", entries, f"1 to {_MOST_COEFFICIENTS:,} coefficients")
    for i, entry in enumerate(entries):
        where = f"psi.coefficients[{i}]"
        if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[0], list):
            _refuse(where, entry, 'a list of exponents and a number, like [[2, 0], "-0.5"]')
        exponents = entry[0]
        fits = all(type(e) is int and 0 <= e <= _LARGEST_EXPONENT for e in exponents)
        if len(exponents) != n or not fits or tuple(exponents) in coefficients:
            _refuse(
                where,
                exponents,
                f"{n} exponents from 0 to {_LARGEST_EXPONENT}, which no other coefficient has",
            )
        coefficients[tuple(exponents)] = _number({where: entry[1]}, where, "a number")
    if math.prod(max(key[i] for key in coefficients) + 1 for i in range(n)) > _LARGEST_TENSOR:
        _refuse("psi.coefficients", len(entries), "a psi of lower degree in its states")
    return Polynomial(states, vectors["center"], vectors["scale"], coefficients)


def _part(content: dict[str, Any], key: str, kind: type) -> Any:
    value = content.get(key)
    if not isinstance(value, kind):
        words = {dict: "an object", list: "a list", str: "a text"}
        _refuse(key, value, words[kind])
    return value


def _number(
    content: dict[str, Any],
    key: str,
    allowed: str,
    sound: Callable[[Fraction], bool] = lambda value: True,
) -> Fraction:
    text = content.get(key)
    value = read_number(text)
    if value is not None and sound(value):
        return value
    return _refuse(key, text, f'{allowed} as text, a decimal "0.25" or a fraction "1/3"')


def _refuse(where: str, given: Any, allowed: str) -> NoReturn:
    raise ConfigurationError(f"{where} = {shown(given)}; give {allowed}")
