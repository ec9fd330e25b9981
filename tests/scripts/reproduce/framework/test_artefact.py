"""Numbers with their intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safe_envs.scripts.reproduce.framework.artefact import Number


def test_a_mean_has_students_interval_within_its_bounds():
    # The quantile of 3 degrees of freedom is 3.182446; the deviation of the four is sqrt(500/3).
    values, half = [10.0, 20.0, 30.0, 40.0], 3.182446 * math.sqrt(500.0 / 3.0) / 2.0
    for given in (values, np.array(values)):
        number = Number.mean("n", given, "s")
        assert (number.low, number.ours, number.high) == pytest.approx(
            (25.0 - half, 25.0, 25.0 + half)
        )
        assert (number.name, number.unit, number.printed) == ("n", "s", None)
    number = Number.mean("n", values, "%", 10.0, 30.0)
    assert (number.low, number.high) == (10.0, 30.0)


def test_equal_repetitions_have_an_interval_of_no_width_and_a_single_one_says_nothing():
    for values, expected in (([3.0, 3.0, 3.0], (3.0, 3.0, 3.0)), ([3.0], (0.0, 3.0, 100.0))):
        number = Number.mean("n", values, "%", 0.0, 100.0)
        assert (number.low, number.ours, number.high) == expected
