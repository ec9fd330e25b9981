"""Files of certificates: exact, with a checksum, and read without running code."""

from __future__ import annotations

import copy
import json
import random
from dataclasses import replace
from fractions import Fraction

import hypothesis
import hypothesis.strategies as st
import pytest
import sympy as sp

from safe_envs.dynamics.expression_text import number_text, read_expression
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.checker import check
from safe_envs.filters.certificates.files import checksum, load_certificate, save_certificate
from safe_envs.filters.certificates.matching import difference, env_difference, plant_of
from safe_envs.registry import make_problem
from safe_envs.systems import CUSTOM_ID
from tests.conftest import EVERY_ENV
from tests.filters.certificates.examples import TRUE, brownian, disk, in_line, with_plant, x


def saved(certificate, tmp_path):
    path = tmp_path / "psi.json"
    save_certificate(certificate, path)
    return path


def rewritten(path, change):
    """Change the content of a file, with the right checksum."""
    content = json.loads(path.read_text())
    content.pop("sha256")
    changed = change(content)
    content = content if changed is None else changed
    path.write_text(json.dumps({**content, "sha256": checksum(content)}))
    return path


@pytest.mark.parametrize("name", TRUE)
def test_a_file_states_what_was_written(name, tmp_path):
    assert load_certificate(saved(TRUE[name], tmp_path)) == TRUE[name]


@pytest.mark.parametrize("env_id", [p for p in EVERY_ENV if p.values[0] != CUSTOM_ID])
def test_the_system_of_each_env_is_written_exactly(env_id, tmp_path):
    plant = plant_of(make_problem(env_id))
    assert not any(e.atoms(sp.Float) for e in (*plant.drift, *plant.barriers))
    n = len(plant.states)
    psi = replace(
        disk().psi,
        states=plant.states,
        center=(Fraction(0),) * n,
        scale=(Fraction(1, 3),) * n,
        coefficients={(0,) * n: Fraction(1, 7)},
    )
    certificate = replace(disk(), env_id=env_id, plant=plant, psi=psi, options={"start": [0.5, 1]})
    read = load_certificate(saved(certificate, tmp_path))
    assert read == certificate
    assert not difference(read.plant, plant_of(make_problem(env_id)))


def test_each_changed_digit_is_found(tmp_path):
    path = saved(disk(), tmp_path)
    text = path.read_text()
    digits = [i for i, letter in enumerate(text) if letter.isdigit()]
    for i in digits:
        other = str((int(text[i]) + 1) % 10)
        path.write_text(text[:i] + other + text[i + 1 :])
        with pytest.raises(ConfigurationError, match=r"changed|format"):
            load_certificate(path)


def test_with_a_new_checksum_the_checker_finds_what_is_false(tmp_path):
    def twice(content):
        for entry in content["psi"]["coefficients"]:
            entry[1] = number_text(2 * Fraction(entry[1]))

    changes = [
        twice,
        lambda content: content.update(m="0.9"),
        lambda content: content.update(c="2.4"),
        lambda content: content.update(diffusion=[["1.1"]]),
        lambda content: content["states"][0].update(low="-20"),
    ]
    tilted = in_line(["1", "-0.1"], drift=-x, h=11 - x, shortfall="0.01", supremum=2)
    assert check(tilted).word == "checked"
    for change in changes:
        path = rewritten(saved(tilted if change is changes[-1] else brownian(), tmp_path), change)
        assert check(load_certificate(path), boxes=20_000).word == "refuted"
    # What is true is checked, for it is another certificate.
    path = rewritten(saved(brownian(), tmp_path), lambda content: content.update(m="1.1"))
    assert check(load_certificate(path)).word == "checked"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("kind", "poem", "is no barrier certificate"),
        ("format", 2, "reads format 1"),
        ("format", True, "reads format 1"),
        ("a", "-1", "at least 0"),
        ("m", 0.5, "as text"),
        ("c", "0", "above 0"),
        ("c", "1/0", "above 0"),
        ("c", "1e999", "above 0"),
        ("horizon", "inf", "above 0"),
        ("drift", ["x"], "a list of 2 expressions"),
        ("drift", ["x_1", "__import__('os').system('touch it')"], "not allowed"),
        ("drift", ["x_1", "(lambda: 1)()"], "not allowed"),
        ("drift", ["x_1", "x_1.diff"], "not allowed"),
        ("drift", ["x_1", "x_3"], "unknown name 'x_3'"),
        ("drift", ["x_1", "9**9**9"], "exponent"),
        ("drift", ["x_1", "((9**99)**99)**99"], "beyond floats"),
        ("drift", ["x_1", "sqrt(-1)"], "not real"),
        ("drift", ["x_1", "1/0"], "number"),
        ("drift", ["x_1", "x_1 +"], "no expression"),
        ("drift", ["x_1", "(" * 300 + "x_1" + ")" * 300], "no expression|nested"),
        ("drift", ["x_1", "+".join(["x_1"] * 4000)], "parts"),
        ("drift", ["x_1", "sin(" * 90 + "x_1" + ")" * 90 + "*sin(x_1)" * 20], "functions|nested"),
        ("drift", ["x_1", "x" * 30_000], "characters"),
        ("drift", ["x_1", "gamma(x_1)"], "unknown function"),
        ("drift", ["x_1", "sin(x_1, x_2)"], "unknown function"),
        ("drift", ["x_1", "Max(" + "x_1, " * 12 + "x_2)"], "of 13 arguments"),
        ("drift", ["x_1", "1_000"], "not allowed"),
        ("drift", ["x_1", "True"], "not allowed"),
        ("input_matrix", [["0"]], "2 lists"),
        ("input_matrix", [["0"], ["0", "1"]], "1 expressions"),
        ("diffusion", [["0", "1"], ["0"]], "2 expressions"),
        ("diffusion", [], "2 lists"),
        ("barriers", [], "1 to 40"),
        ("policy", ["1", "2"], "1 expressions"),
        ("states", [], "1 to 12"),
        ("states", [{"name": "sin", "low": "0", "high": "1"}] * 2, "the name 'sin'"),
        ("states", [{"name": "x_1", "low": "0", "high": "1"}] * 2, "names that differ"),
        ("states", [{"name": "x_1", "low": "1", "high": "1"}] * 2, "below the upper"),
        ("states", [{"name": "x_1", "low": "0", "high": "oo"}] * 2, "unknown name 'oo'"),
        ("inputs", [{"name": "lambda", "low": "0", "high": "1"}], "the name 'lambda'"),
        ("env", {"id": 3, "options": {}}, "id = 3"),
        ("env", {"id": "", "options": {"a": "b" * 30_000}}, "characters of options"),
        ("psi", [], "psi"),
        ("control", "held", "held input are gone"),
        ("psi.center", ["0"], "a list of 2 numbers"),
        ("psi.scale", ["1", "0"], "above 0"),
        ("psi.coefficients", [], "coefficients"),
        ("psi.coefficients", [[[0, 0], "1"], [[0, 0], "1"]], "no other"),
        ("psi.coefficients", [[[0, 21], "1"]], "exponents"),
        ("psi.coefficients", [[[0, True], "1"]], "exponents"),
        ("psi.coefficients", [[[0, -1], "1"]], "exponents"),
        ("psi.coefficients", [[[0], "1"]], "exponents"),
        ("psi.coefficients", [[[0, 0], "nan"]], "a number"),
        ("psi.coefficients", ["x"], "exponents"),
    ],
)
def test_malformed_parts_are_errors(key, value, message, tmp_path):
    def change(content):
        part, _, name = key.rpartition(".")
        (content[part] if part else content).update({name: value})

    path = rewritten(saved(disk(), tmp_path), change)
    with pytest.raises(ConfigurationError, match=message) as error:
        load_certificate(path)
    assert "psi.json" in str(error.value)
    assert len(str(error.value)) < 1000


def test_a_large_polynomial_is_refused_before_it_takes_memory(tmp_path):
    n = 12
    states = [{"name": f"x_{i}", "low": "0", "high": "1"} for i in range(n)]
    large = {"states": states, "drift": ["0"] * n, "barriers": ["1"], "policy": []}
    large |= {"input_matrix": [["0"]] * n, "diffusion": [["0"]] * n}
    coefficients = [[[20] * n, "1"]]
    large["psi"] = {"center": ["0"] * n, "scale": ["1"] * n, "coefficients": coefficients}
    path = rewritten(saved(disk(), tmp_path), lambda content: content.update(large))
    with pytest.raises(ConfigurationError, match="lower degree"):
        load_certificate(path)


@pytest.mark.parametrize("text", ["", "[", "[]", "{}", "[" * 100_000, '"x"', "NaN"])
def test_what_is_no_certificate_is_an_error(text, tmp_path):
    path = tmp_path / "psi.json"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=r"psi\.json"):
        load_certificate(path)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_certificate(tmp_path / "none.json")


def places(value, path=()):
    """All places in JSON data."""
    yield path
    entries = value.items() if isinstance(value, dict) else ()
    entries = enumerate(value) if isinstance(value, list) else entries
    for key, entry in entries:
        yield from places(entry, (*path, key))


def test_random_changes_give_a_certificate_or_an_error_of_ours(tmp_path):
    path = saved(disk(), tmp_path)
    original = json.loads(path.read_text())
    original.pop("sha256")
    spots = [place for place in places(original) if place]
    chance, refused = random.Random(0), 0
    values = [None, True, -1, 1e300, 10**40, "", "x_1", "1/0", "-1", "é", [], {}, [[]], "0" * 5000]
    values += [
        "x_1**x_2",
        "E",
        "pi",
        "exp(exp(exp(99)))",
        "log(0)",
        "0**-1",
        "Max()",
        "\0",
        "1e-400",
    ]
    for _ in range(200):
        content = copy.deepcopy(original)
        for _ in range(chance.randint(1, 2)):
            *before, last = chance.choice(spots)
            inner = content
            try:
                for key in before:
                    inner = inner[key]
                if chance.random() < 0.2:
                    del inner[last]
                else:
                    inner[last] = chance.choice(values)
            except (TypeError, KeyError, IndexError):
                continue  # the first change took that place
        path.write_text(json.dumps({**content, "sha256": checksum(content)}))
        try:
            load_certificate(path)
        except ConfigurationError:
            refused += 1
    assert refused > 100


def test_what_cannot_be_read_back_is_not_written(tmp_path):
    path = tmp_path / "psi.json"
    for drift in (sp.Float(0.1) * x, sp.gamma(x), 2**x, sp.Symbol("z")):
        with pytest.raises(ConfigurationError):
            save_certificate(with_plant(brownian(), drift=(drift,)), path)
    with pytest.raises(ConfigurationError, match="at least 0"):
        save_certificate(replace(brownian(), rate=Fraction(-1)), path)
    with pytest.raises(ConfigurationError, match="does not exist"):
        save_certificate(brownian(), tmp_path / "no" / "psi.json")
    assert not path.exists()


@hypothesis.given(st.fractions(-(10**6), 10**6, max_denominator=10**9))
def test_numbers_are_written_exactly(value):
    assert Fraction(number_text(value)) == value


def test_texts_are_read_as_exact_numbers():
    a, b = sp.symbols("a b", real=True)
    for text, exact in (
        ("0.1*a + 1e-3", a / 10 + sp.Rational(1, 1000)),
        ("-a**2/3 - b - (a - b)", -(a**2) / 3 - a),
        ("sqrt(a**2 + 3)*Max(a, b, 0)", sp.sqrt(a**2 + 3) * sp.Max(a, b, 0)),
        ("a - b - 2 + 3", a - b + 1),
        ("pi*.5", sp.pi / 2),
    ):
        assert read_expression(text, {"a": a, "b": b}, "here") == exact


def test_the_env_of_a_file_is_compared():
    assert env_difference(disk()).word == "same"
    other = with_plant(disk(), workspace=((sp.Integer(-1), sp.Integer(1)),) * 2)
    assert env_difference(other) == ("differs", env_difference(other).text)
    assert "workspace" in env_difference(other).text
    assert "drift" in env_difference(with_plant(disk(), drift=disk().plant.drift[::-1])).text
    assert env_difference(replace(disk(), options={"nois": 1})).word == "differs"
    noisy = replace(disk(), options={"noise": 0.3})
    assert "diffusion" in env_difference(noisy).text
    for env_id in ("", "somewhere:Env-v0", CUSTOM_ID):
        assert env_difference(replace(disk(), env_id=env_id)).word == "not compared"
    outside = replace(disk(), options={"system": "evil.py:run"})
    assert env_difference(outside).word == "not compared"


def test_angles_have_one_turn_and_other_unbounded_states_an_error():
    plant = plant_of(make_problem("safe_envs/StochasticDubins-v0"))
    assert (-sp.pi, sp.pi) in plant.workspace
    problem = make_problem("safe_envs/Scalar-v0")
    endless = replace(problem, states=(replace(problem.states[0], low=-float("inf")),))
    with pytest.raises(ConfigurationError, match="unbounded"):
        plant_of(endless)
