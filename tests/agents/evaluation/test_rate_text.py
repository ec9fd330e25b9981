import pytest

from safe_envs.agents.evaluation.statistics import percent, percent_in, points_in, rate_interval


@pytest.mark.parametrize(
    ("safe", "episodes", "text"),
    [
        (1000, 1000, "100.0 % [99.6, 100.0]"),
        (0, 1000, "0.0 % [0.0, 0.4]"),
        (988, 1000, "98.8 % [97.9, 99.3]"),
        # By Wilson's formula 99.44 and 99.982.
        (999, 1000, "99.90 % [99.44, 99.98]"),
        (9, 100_000, "0.009 % [0.005, 0.017]"),
        (99_991, 100_000, "99.991 % [99.983, 99.995]"),
    ],
)
def test_what_is_not_certain_does_not_read_so(safe, episodes, text):
    assert percent_in(safe / episodes, *rate_interval(safe, episodes)) == text


def test_a_share_that_is_small_is_not_none():
    assert [percent(share) for share in (None, 0.0, 0.00004, 0.5, 0.99996, 1.0)] == [
        "-",
        "0.0 %",
        "0.004 %",
        "50.0 %",
        "99.996 %",
        "100.0 %",
    ]


def test_roundings_are_no_digits():
    assert percent_in(1.0, 1.0 - 1e-16, 1.0) == "100.0 % [100.0, 100.0]"


@pytest.mark.parametrize(
    ("difference", "text"),
    [
        ((0.158, 0.136, 0.182), "+15.8 points [13.6, 18.2]"),
        ((0.004, -0.001, 0.011), "+0.4 points [-0.1, 1.1]"),
        # What is significant is not shown as 0, and neither is the end of its interval.
        ((0.0002, 0.0001, 0.0003), "+0.02 points [0.01, 0.03]"),
        ((-0.0002, -0.0004, -0.000004), "-0.0200 points [-0.0400, -0.0004]"),
        # What is not may be, but its interval has an end.
        ((0.00001, -0.0001, 0.01), "+0.0 points [0.0, 1.0]"),
        ((0.0, -0.0002, 0.0002), "+0.00 points [-0.02, 0.02]"),
        ((0.0, 0.0, 0.0), "+0.0 points [0.0, 0.0]"),
        ((1e-17, -1e-17, 1e-17), "+0.0 points [0.0, 0.0]"),
    ],
)
def test_a_difference_is_told_from_0_where_its_interval_is(difference, text):
    assert points_in(*difference) == text
    assert points_in(*difference, unit="") == text.replace(" points", "")
