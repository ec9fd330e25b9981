"""Labels: names as mathematics, units upright in brackets."""

from __future__ import annotations

import pytest
from matplotlib.mathtext import MathTextParser

from safe_envs.scripts.figures.style import expression, labelled, mathematics, quantity, symbol
from safe_envs.systems import ENV_IDS
from tests.conftest import problem_of


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("x", "$x$"),
        ("theta", r"$\theta$"),
        ("sigma_1", r"$\sigma_{1}$"),
        ("x1", "$x_{1}$"),
        ("thetadot", r"$\dot{\theta}$"),
        ("v_ref", r"$v_{\mathrm{ref}}$"),
        ("rotor_1", r"$\mathrm{rotor}_{1}$"),
        ("rotor_speed", "rotor speed"),
        ("speed", "speed"),
        ("$\\frac{", r"\$\frac{"),
    ],
)
def test_names_are_mathematics_and_words_are_words(name, text):
    assert symbol(name) == text


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("", "$x$"),
        ("m", r"$x$ [$\mathrm{m}$]"),
        ("%", "$x$ [%]"),
        ("N m", r"$x$ [$\mathrm{N}\,\mathrm{m}$]"),
        ("rad^2/s^2", r"$x$ [$\mathrm{rad}^{2}/\mathrm{s}^{2}$]"),
        ("m/s²", r"$x$ [$\mathrm{m}/\mathrm{s}^{2}$]"),
        ("m/s/sqrt(s)", r"$x$ [$\mathrm{m}/(\mathrm{s}\,\sqrt{\mathrm{s}})$]"),
        ("a$b", r"$x$ [a\$b]"),
    ],
)
def test_units_are_upright_in_brackets(unit, text):
    assert quantity("x", unit) == text


@pytest.mark.parametrize("env_id", [name for name in ENV_IDS if "Custom" not in name])
def test_labels_of_every_env_can_be_set(env_id):
    problem, parser = problem_of(env_id), MathTextParser("path")
    for variable in (*problem.states, *problem.inputs):
        label = quantity(variable.symbol.name, variable.unit)
        parser.parse(label)
        assert "(" not in label
        assert label.endswith("]") == bool(variable.unit)


def test_texts_with_values_and_expressions():
    assert mathematics("noise sigma_1 = 0.1, dt = 0.05 s") == (
        "noise $\\sigma_{1}$ = 0.1, dt = 0.05\u00a0s"
    )
    assert expression("x", {"x": "m"}) == quantity("x", "m")
    label = expression("sqrt(x**2 + sigma_1**2)", {"x": "m", "sigma_1": ""})
    assert label == r"$\sqrt{\sigma_{1}^{2} + x^{2}}$"
    MathTextParser("path").parse(label)
    assert labelled("time", "s") == r"time [$\mathrm{s}$]"
