"""Filters as text: what they say is read and written, and those of whoever wants to do harm are
read, or refused with a message, in no time and without running anything."""

from __future__ import annotations

import time

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SystemDefinitionError
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.class_k import S
from safe_envs.wrappers import (
    CBF,
    CONDITIONS,
    ECBF,
    HOCBF,
    SCBF,
    SRCBF,
    SZCBF,
    ClassK,
    parse_condition,
    parse_conditions,
    power,
    spec_of,
)
from tests.conftest import problem_of

SCALAR = problem_of("safe_envs/Scalar-v0")

_SECONDS = 2.0
"""Of the processor, that an answer may take; it takes a hundredth of that mostly."""

names = st.sampled_from(["s", "s", "s", "1", "9", "99", "0", "2", "0.5", "1e300", "1e-300", "pi"])
functions = st.sampled_from(["Abs", "asinh", "atan", "cos", "cosh", "exp", "log", "sin", "sinh"])
functions |= st.sampled_from(["sqrt", "tanh", "erf", "gamma"])


def combined(parts):
    """Arithmetic of smaller parts; the last way makes functions that increase of whatever is real
    and finite."""
    return st.one_of(
        st.builds("({}{}{})".format, parts, st.sampled_from(["+", "-", "*", "/", "**"]), parts),
        st.builds(
            "({})**{}".format, parts, st.sampled_from(["2", "3", "99", "(1/3)", "-2", "0.5"])
        ),
        st.builds("{}({})".format, functions, parts),
        st.builds("s*(1+({})**2)".format, parts),
    )


expressions = st.recursive(names, combined, max_leaves=12)


def alpha_of(text: str) -> ClassK | None:
    """The function of a text, None where it is refused; whatever else happens fails."""
    began, message, alpha = time.process_time(), "", None
    try:
        alpha = ClassK(text)
        alpha.is_smooth(2)
    except ConfigurationError as error:
        message = str(error)
    assert time.process_time() - began < _SECONDS
    assert len(message) < 600
    return alpha


@hypothesis.settings(max_examples=40)
@hypothesis.given(expressions)
def test_arithmetic_is_a_class_k_function_or_refused(text):
    alpha = alpha_of(text)
    if alpha is not None:
        assert ClassK(str(alpha)) == alpha
        assert alpha.expression.free_symbols == {S}


@hypothesis.settings(max_examples=50)
@hypothesis.given(st.text() | st.text(alphabet="s0123456789.+-*/^()[]{}_eEjx,'\"\\ ", max_size=30))
def test_any_text_is_a_class_k_function_or_refused(text):
    alpha_of(text)


@pytest.mark.parametrize(
    "text",
    [
        "(((9**99)**99)**99)**99*s",
        "(9**99)**99*s",
        "((9*s)**99)**99",
        "((1+1/9**99)**99)**99*s",
        "exp(exp(exp(exp(s))))-exp(exp(E))",
        "exp(exp(exp(s)))-exp(E)",
        "exp(exp(exp(9)))*s",
        "s**exp(exp(exp(9)))",
        "s+sin(exp(exp(s)))-sin(E)",
        "tanh(" * 60 + "s" + ")" * 60,
        "+".join(f"{i}*s" for i in range(1200)),
        "+".join(f"tanh({i}*s)" for i in range(1, 13)),
        "-" * 3000 + "s",
        "-" * 350 + "s",
        "9" * 5000 + "*s",
        "9" * 350 + "*s",
        "1_000*s",
        "0x10*s",
        "٣*s",
        "ｓ",  # noqa: RUF001  (NFKC of it is s)
        "erf(s)",
        "s*Abs(sqrt(s))+s",
        "s\0",
        "True*s",
    ],
    ids=lambda text: text[:24],
)
def test_bombs_and_texts_that_only_python_takes_are_refused(text):
    assert alpha_of(text) is None


@pytest.mark.parametrize(
    "text",
    [
        "log(1+exp(s))-log(2)",
        "exp(exp(s))-E",
        "tanh(exp(exp(s)))-tanh(E)+s",
        "s*Abs(s)**(1/3)",
        "sinh(sinh(s))",
    ],
)
def test_functions_that_grow_far_are_still_taken(text):
    assert alpha_of(text) is not None


def test_expressions_of_sympy_are_as_small_as_texts():
    large = sp.Add(*[sp.Float(i) * S**i for i in range(1, 200, 2)])
    with pytest.raises(ConfigurationError, match="characters; give at most 400"):
        ClassK(large)


pieces = st.sampled_from(
    ["cbf", "hocbf", "ecbf", "rcbf", "scbf", "szcbf", "none", "alpha", "poles"]
)
pieces |= st.sampled_from([":", "+", ",", "=", "p", "k", "1", "-2", "1_0"])


@hypothesis.settings(max_examples=50)
@hypothesis.given(st.lists(pieces | st.text(max_size=3), max_size=12).map("".join))
def test_any_text_is_a_filter_or_refused(text):
    began, message, conditions = time.process_time(), "", None
    try:
        conditions = parse_conditions(text, SCALAR)
    except ConfigurationError as error:
        message = str(error)
    assert time.process_time() - began < _SECONDS
    assert len(message) < 1000
    assert conditions is None or parse_conditions(spec_of(conditions), SCALAR) == conditions


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x" * 10**5, "unknown filter"),
        ("cbf:" + "x" * 10**5, "no parameter"),
        ("+".join(["cbf"] * 10**4), "has 10000 conditions"),
        ("hocbf:alpha=" + ",".join(["1"] * 10**4), "at most 12 values; 10000 were given"),
        ("ecbf:k=" + ",".join(f"1e{300 - 50 * i}" for i in range(12)), "poles"),
        ("szcbf:alpha=1_0", "alpha = 1_0; give positive numbers"),
        ("cbf:sampling_margin=٣", "sampling_margin = '٣'"),
        ("ecbf:poles=-1_0", "poles"),
        ("ddscbf:file=" + "x" * 300, "cannot be read: File name too long"),
    ],
    ids=lambda text: text[:20],
)
def test_long_texts_and_odd_numbers_are_refused_in_short(text, message):
    began = time.process_time()
    with pytest.raises(ConfigurationError, match=message) as raised:
        parse_conditions(text, SCALAR)
    assert len(str(raised.value)) < 1000
    assert time.process_time() - began < _SECONDS


def test_texts_are_never_run(tmp_path):
    target = tmp_path / "owned"
    code = f"__import__('pathlib').Path('{target}').touch()"
    for filter_name, name in (
        *(("ecbf", "poles"), ("ecbf", "k"), ("cbf", "alpha"), ("hocbf", "alpha")),
        *(("rcbf", "gamma"), ("rcbf", "form"), ("scbf", "sampling_margin")),
    ):
        with pytest.raises(ConfigurationError):
            parse_condition(f"{filter_name}:{name}={code}", (1.0,))
    for wrong in (("-1",), (code,)):
        with pytest.raises(ConfigurationError, match="poles"):
            ECBF(poles=wrong)
    assert not target.exists()


def test_several_barriers_take_one_text_or_one_each():
    problem = problem_of("safe_envs/QuadrotorLimits-v0")
    same = parse_conditions("scbf", problem)
    assert same == (SCBF(),) * 3
    assert spec_of(same) == "scbf"
    each = parse_conditions("hocbf:alpha=1,2+ecbf:poles=-1,-2+hocbf:alpha=s+s**3,2", problem)
    assert [c.name for c in each] == ["hocbf", "ecbf", "hocbf"]
    assert parse_conditions(spec_of(each), problem) == each
    by_gains = parse_conditions("hocbf", problem)
    assert [c.alpha for c in by_gains] == [problem.gains_of(i) for i in range(3)]
    with pytest.raises(ConfigurationError, match="2 conditions"):
        parse_conditions("hocbf+scbf", problem)


@pytest.mark.parametrize(
    "text",
    [
        "cbf:alpha=0.3",
        "cbf:alpha=2*s**3",
        "ecbf:k=2.0,3.0",
        "hocbf:alpha=2.0,8.0",
        "hocbf:alpha=2.0,tanh(s)",
        "rcbf:gamma=0.5:form=log",
        "srcbf:gamma=0.1:form=inverse",
        "szcbf:alpha=1.0,0.5",
        "scbf",
        "scbf:sampling_margin=first-order",
        "cbf:alpha=1.0:sampling_margin=0.25",
    ],
)
def test_text_round_trips(text):
    condition = parse_condition(text, (1.0,))
    assert spec_of(condition) == text
    assert parse_condition(spec_of(condition), ()) == condition


def test_parameters_default_to_the_gains():
    assert parse_condition("hocbf", (2.0, 8.0)) == HOCBF((2.0, 8.0))
    assert parse_condition("cbf", (5.0,)) == CBF(5.0)
    assert parse_condition("ecbf", (2.0, 8.0)) == ECBF((16.0, 10.0))
    assert parse_condition("szcbf", (2.0, 8.0)) == SZCBF((2.0, 8.0))
    assert parse_condition("srcbf", (5.0,)) == SRCBF(1.0)  # gamma is no rate
    assert set(CONDITIONS) == {"cbf", "ecbf", "hocbf", "rcbf", "srcbf", "scbf", "szcbf"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scfb", "scfb"),
        ("hocbf:q=1", "'q'"),
        ("hocbf:alpha=1,x", "'x'"),
        ("hocbf:alpha=", "expression of s"),
        ("hocbf:alpha=1,-2", "positive"),
        ("scbf:alpha=1", "alpha"),
        ("hocbf:alpha=2,8:p=3,3", "'p'"),
        ("szcbf:alpha=s", "alpha = s"),
        ("srcbf:gamma=0", "gamma = 0.0"),
        ("cbf:sampling_margin=second-order", "second-order"),
        ("cbf:sampling_margin=-1", "sampling_margin = -1.0"),
        ("ecbf:poles=-1+1j,-1-1j", "poles"),
        ("scbf+scbf", "scbf"),
    ],
)
def test_text_that_makes_no_condition_is_explained(text, message):
    with pytest.raises(ConfigurationError, match=message):
        parse_conditions(text, problem_of("safe_envs/StochasticDubins-v0"))


# Class-K functions: what they refuse, and what the chains make of them.


x, y, u = sp.symbols("x y u", real=True)


@pytest.mark.parametrize(
    "text",
    [
        "s",
        "2*s**3",
        "2*s^3",
        "tanh(s)",
        "s*Abs(s)",
        "pi*s",
        "s+sin(s)/2",
        "s + s**5/10",
        "sinh(s)",
        "atan(3*s)",
        "exp(s) - 1",
    ],
)
def test_functions_that_increase_through_0_are_taken_and_round_trip(text):
    alpha = ClassK(text)
    assert alpha(sp.Integer(0)) == 0
    assert ClassK(str(alpha)) == alpha
    assert "," not in str(alpha)
    assert ":" not in str(alpha)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s**2", "not strictly increasing"),
        ("-s", "not strictly increasing"),
        ("s**3 - s/1000", "not strictly increasing"),
        ("s + 1", "is 1.0 at 0"),
        ("sqrt(s)", "not real and finite"),
        ("cbrt(s)", "unknown function 'cbrt'"),
        ("sign(s)*sqrt(Abs(s))", "unknown function 'sign'"),
        ("s**9**9**9", "exponent 9 \\*\\* 9 is no number up to 100"),
        ("s + 0.0005", "is 0.0005 at 0"),
        ("log(s + 1)", "not real and finite|no value"),
        ("1/s", "no value"),
        ("s + t", "'t' is not allowed"),
        ("3", "expression of s alone"),
        ("s if s else 1", "is not allowed"),
        ("s.real", "is not allowed"),
        ("__import__('os').system('true')", "is not allowed|unknown function"),
        ("2*", "no expression of s"),
        ("s/0", "finite expression of s alone"),
        ("'s'", "is not allowed"),
    ],
)
def test_others_are_refused_with_the_reason(text, message):
    with pytest.raises(ConfigurationError, match=message):
        ClassK(text)


def test_sympy_expressions_are_taken_as_they_are():
    assert CBF(S**3).alpha == ClassK("s**3")
    assert HOCBF((1, sp.tanh(S))).alpha == (1.0, ClassK("tanh(s)"))
    assert CBF(sp.Symbol("s") ** 3).alpha == ClassK("s**3")
    with pytest.raises(ConfigurationError, match="s alone"):
        CBF(x**3)
    for no_text in (
        S + 10 * sp.sign(S),
        sp.Max(S, 2 * S),
        sp.Piecewise((S, S < 1), (2 * S - 1, True)),
    ):
        with pytest.raises(ConfigurationError, match="class-K function"):
            CBF(no_text)
    for nothing in (None, [1], object()):
        with pytest.raises(ConfigurationError):
            CBF(nothing)


def test_specs_keep_every_digit():
    alpha = power(0.1 + 0.2, 3)
    assert ClassK(str(alpha)) == alpha
    assert alpha != power(0.3, 3)


def test_power():
    for exponent in (1, 3, 2, 1.5):
        alpha = power(2.0, exponent)
        for value in (-1.7, -0.2, 0.0, 0.4, 3.0):
            assert float(alpha(sp.Float(value))) == pytest.approx(
                2 * np.sign(value) * abs(value) ** exponent
            )
    for arguments in ((0.0, 3), (-1.0, 3), (1.0, 0.5), (1.0, float("nan"))):
        with pytest.raises(ConfigurationError):
            power(*arguments)


def test_chain_of_curved_functions_follows_the_chain_rule():
    # x' = y, y' = u, h = 1 - x: b_1 = -y + (1 - x)^3, b_2 = -u - 3 (1 - x)^2 y + tanh(b_1).
    chain = ControlAffineSDE((x, y), (u,), [y, 0], [0, 1], [0, 0])
    found = HOCBF((power(1, 3), ClassK("tanh(s)"))).constraint(chain, Barrier(1 - x))
    b_1 = -y + (1 - x) ** 3
    assert sp.simplify(found.chain[1] - b_1) == 0
    assert found.coefficient == (-1,)
    assert sp.simplify(found.offset + 3 * (1 - x) ** 2 * y - sp.tanh(b_1)) == 0


def test_functions_that_are_not_smooth_enough_are_refused():
    third = ControlAffineSDE(
        (x, y, sp.Symbol("w", real=True)),
        (u,),
        [y, sp.Symbol("w", real=True), 0],
        [0, 0, 1],
        [0, 0, 0],
    )
    barrier = Barrier(1 - x)
    HOCBF((1.0, power(1.0, 2), power(1.0, 2))).constraint(third, barrier)
    with pytest.raises(
        SystemDefinitionError,
        match=r"s\*Abs\(s\) is the 1\. of 3 and needs 2 continuous derivatives",
    ):
        HOCBF((power(1, 2), 1.0, 1.0)).constraint(third, barrier)
    with pytest.raises(
        SystemDefinitionError, match=r"is the 2\. of 3 and needs 1 continuous derivatives"
    ):
        HOCBF((1.0, power(1, 1.5), 1.0)).constraint(third, barrier)


def test_a_steeper_function_near_the_edge_lets_the_policy_go_nearer():
    problem = problem_of("safe_envs/Scalar-v0", noise=0.0)
    rows = {
        c: c.constraint(problem.model, problem.barriers[0])
        for c in (CBF(1.0), CBF(power(1.0, 3)), CBF(ClassK("tanh(5*s)")))
    }
    margins = [float(r.offset.subs(problem.model.states[0], 0.9)) for r in rows.values()]
    assert margins == pytest.approx([0.1 - 0.9, 0.001 - 0.9, np.tanh(0.5) - 0.9])
