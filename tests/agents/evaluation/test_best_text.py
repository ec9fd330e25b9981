"""The best attainable safety as text: bounds are rounded outwards."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from safe_envs.agents.evaluation.table import attainable_text, ends_text, times_text
from safe_envs.agents.evaluation.yardstick import TimesUnavoidable
from tests.agents.evaluation.made_up import attainable


@pytest.mark.parametrize(
    ("lower", "upper", "text"),
    [
        (0.9895, 0.9989, "98.9..99.9 %"),
        (0.98999, 0.99501, "98.9..99.6 %"),
        (0.9, 0.9, "90.0 %"),
        (0.9, 0.99951, "90.00..99.96 %"),
        (0.9, 0.99999, "90.000..99.999 %"),
        (0.99999, 1.0, "99.9..100.0 %"),
        (1.0, 1.0, "100.0 %"),
        (0.0, 0.5, "0.0..50.0 %"),
        (None, None, "-"),
    ],
)
def test_ends_are_rounded_outwards(lower, upper, text):
    assert ends_text(lower, upper) == text


def test_nothing_below_one_is_called_certain():
    low, high = ends_text(0.0, 1.0 - 1e-9).removesuffix(" %").split("..")
    assert high < "99.99999995"
    assert not low.startswith("-")


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (1.0, 1.6001, "1..1.7"),
        (2.57, 15.2, "2.5..16"),
        (13.9, None, ">= 13"),
        (1.0, 1.0, "1"),
        (141.7, 1000.2, "141..1001"),
    ],
)
def test_times_are_rounded_outwards(low, high, text):
    assert times_text(TimesUnavoidable(low, high)) == text


def test_there_may_be_no_times():
    assert times_text(None) == "-"


def test_only_a_certified_end_stands_after_a_sign():
    found = attainable(0.9, 0.99981)
    certified = replace(found, check=SimpleNamespace(lower=1e-6, upper=1e-6))
    of_lower = replace(found, check=SimpleNamespace(lower=1e-6, upper=None))
    texts = [attainable_text(best) for best in (None, found, of_lower, certified)]
    assert texts == [[], ["99.99 %"], ["99.99 %"], ["<= 99.99 %"]]
    assert attainable_text(replace(found, upper=None)) == []
