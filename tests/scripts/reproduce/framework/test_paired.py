"""The same episodes under several filters."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents import paired_difference_interval
from safe_envs.scripts.reproduce.framework.paired import (
    difference,
    is_above,
    is_below,
    with_interval,
)


def test_difference_is_of_pairs() -> None:
    """Pairs that agree make its interval narrower than that of two samples would be."""
    first, second = [np.arange(100) < 60], [np.arange(100) < 50]
    number = difference("gap", first, second)
    assert (number.name, number.unit, number.ours) == ("gap", "points", 10.0)
    assert is_above(number)
    assert is_below(difference("", second, first))
    assert not is_above(difference("", first, first))
    assert not is_below(difference("", first, first))
    assert (number.low, number.high) == pytest.approx(
        [100 * end for end in paired_difference_interval(50, 10, 0, 40)]
    )
    assert with_interval(number).startswith("+10.0 [")
    assert not is_above(difference("", first, [np.arange(100) >= 50]))
