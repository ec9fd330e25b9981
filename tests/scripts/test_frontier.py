"""`safe-envs frontier` as a person types it."""

from __future__ import annotations

import pytest

from tests.scripts.conftest import strictly

SMALL = ("--cells", "101", "--horizon", "0.3", "--episodes", "40", "--attained", "40")


@pytest.fixture
def frontier(safe_envs_command):
    """Runs the command."""
    return lambda *arguments: safe_envs_command("frontier", *arguments)


def test_points_lie_on_or_below_the_curve(frontier, tmp_path):
    path, picture = tmp_path / "found.json", tmp_path / "found.png"
    options = ("--filter", "cbf", "--policy", "zero", "--json", path, "--plot", picture)
    status, out, _ = frontier("Scalar-v0", *SMALL, *options)
    assert status == 0
    assert "error of the grid that is not bounded" in out
    found = strictly(path)
    names = [point["name"] for point in found["points"]]
    assert names[:2] == ["nominal", "zero"]
    assert {"scbf", "cbf"} <= {*names}
    # Those of other kinds are measured too, or left out with a reason.
    assert {"promise:p=0.99", "best"} <= {*names, *found["left_out"]}
    for point in (*found["points"], *found["attained"]):
        width = point["return_high"] - point["return_low"]
        curve = min(
            value + price * point["violation_high"]
            for value, price in zip(point["start_values"], found["computed"]["prices"], strict=True)
        )
        assert point["return_mean"] <= curve + width, point
    free = found["attained"][0]
    assert free["price"] == 0.0
    assert free["return_mean"] >= free["start_values"][0] - 0.5 * (
        free["return_high"] - free["return_low"]
    )
    returns = found["computed"]["returns"]
    assert returns == sorted(returns)
    assert picture.stat().st_size > 10_000


def test_leaving_may_count_as_safe(frontier, tmp_path):
    path = tmp_path / "found.json"
    status, _, _ = frontier(
        "Scalar-v0", *SMALL, "--leaving safe --start=-2.99 --policy random --json", path
    )
    assert status == 0
    assert all(point["left"] == 0 for point in strictly(path)["points"])
