"""What is read as a number, and how errors show what is none."""

from __future__ import annotations

import math

import hypothesis
import hypothesis.strategies as st
import pytest

from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown
from safe_envs.text import finite_number, real, real_or_complex, whole_or_real
from tests.conftest import problem_of


@hypothesis.given(st.floats(allow_nan=False) | st.integers(-(10**300), 10**300))
def test_numbers_are_read_as_they_are_written(number):
    assert real(repr(float(number))) == float(number)
    assert whole_or_real(str(number)) == number
    assert type(whole_or_real(str(number))) is type(number)


@pytest.mark.parametrize("text", ["1_000", "٣", "１", "0x10", "1e", "", "1 2", "--1", "1,5", "1j"])  # noqa: RUF001  (digits of other scripts)
def test_what_only_python_takes_for_a_number_is_none(text):
    for read in (real, whole_or_real):
        with pytest.raises(ValueError, match=r"number|float"):
            read(text)


def test_complex_numbers_too():
    assert real_or_complex("-1+2j") == -1 + 2j
    assert real_or_complex("-1") == -1
    for text in ("1_0j", "x"):
        with pytest.raises(ValueError, match=r"digits|complex"):
            real_or_complex(text)


def test_long_whole_numbers_are_no_python_error():
    assert whole_or_real("9" * 5000) == math.inf
    assert whole_or_real("9" * 300) == int("9" * 300)
    for value in ("1_0", "9" * 5000, 10**400, 10**5000):
        with pytest.raises(ConfigurationError) as raised:
            finite_number("dt", value)
        assert len(str(raised.value)) < 300
    with pytest.raises(ConfigurationError, match="seed = a int with too many digits"):
        require_whole("seed", -(10**5000), 0)


def test_texts_are_no_numbers_in_a_start():
    problem = problem_of("safe_envs/Scalar-v0")
    problem.configured(start=[1.0])
    for start in (["1_0"], ["٣"], [10**400]):
        with pytest.raises(ConfigurationError, match="start has 0 numbers"):
            problem.configured(start=start)


@hypothesis.given(
    st.text(max_size=5).map(lambda text: 50 * text)
    | st.integers()
    | st.lists(st.floats(), max_size=20)
)
def test_what_is_shown_is_short_and_whole_where_it_fits(given):
    assert len(shown(given)) <= 170
    if len(repr(given)) <= 120:
        assert shown(given) == repr(given)


def test_long_texts_lose_their_middle():
    assert (
        shortened("a" * 60 + "b" * 1000 + "c" * 60)
        == "a" * 60 + "...(1000 more characters)..." + "c" * 60
    )
    assert nearest("x" * 10**6, ["one"]) == "allowed: one"


@pytest.mark.parametrize(
    ("name", "allowed", "phrase"),
    [
        ("on", ["one"], "did you mean 'one'? (allowed: one; or 7)"),
        ("x", ["one"], "allowed: one; or 7"),
        ("name_3", [f"name_{i}" for i in (3, 50, 60)] + list("abcd"), "did you mean 'name_3'? ("),
        ("evalute", ["evaluate", *"abcdef"], "did you mean 'evaluate'? (or 7)"),
        ("x", "abcdefg", "allowed: a, b, c and 4 more; or 7"),
    ],
)
def test_what_else_helps_stands_after_the_names(name, allowed, phrase):
    assert nearest(name, allowed, "or 7").startswith(phrase)
    assert "?;" not in nearest(name, allowed, "or 7")
