"""`safe-envs evaluate --rare` and `--monitoring` as a person types them."""

from __future__ import annotations

import math

import pytest

from tests.scripts.conftest import strictly

pytestmark = pytest.mark.slow

ACC = "evaluate safe_envs/ACC-v0 --filter scbf --start=10,10,40 --horizon 6 --dt 0.1"
FEW = ("--particles", "50", "--repetitions", "10")


@pytest.mark.slow
def test_acceptance_in_small(safe_envs_command):
    status, out, err = safe_envs_command(ACC, "--rare", *FEW, "--json rare.json")
    assert (status, err) == (0, "")
    assert "rare violations, 10 repetitions" in out
    assert "P(violation) [95 % interval]" in out
    found = strictly("rare.json")
    (row,), (speed,) = found["rows"], found["timing"]["rows"]
    assert (speed["filter"], speed["engine"], speed["jobs"]) == ("scbf", "numpy", 1)
    # h_0 = 22 m is 5 deviations of the Gaussian law away: 2 Phi(-h_0/(tau sigma sqrt(T))), and a
    # little less at control instants.
    law = math.erfc((22 + 0.5826 * 1.8 * math.sqrt(0.1)) / (1.8 * math.sqrt(6)) / math.sqrt(2))
    assert law < 1e-6
    assert row["ci_low"] < law < row["ci_high"]
    assert f"{row['probability']:.3g} [" in out
    assert row["particles"] == 50
    check = row["check"]
    if check is not None:
        assert (
            f"the check on scbf, by {check['method']}, is {check['probability']:.3g}"
            f" [{check['ci_low']:.3g}" in out
        )
    assert max(map(len, out.splitlines()[3:7])) < 140


def test_reason_in_place_of_a_number(safe_envs_command):
    status, out, _ = safe_envs_command(
        "evaluate DubinsDisk-v0 --filter hocbf --knowledge plant --rare", *FEW, "--json -"
    )
    assert status == 0
    assert '"probability": null' in out
    assert '"knowledge": "plant"' in out
    for quiet in ((), ("--quiet",)):
        status, out, _ = safe_envs_command(
            "evaluate DubinsDisk-v0 --filter hocbf --rare", *FEW, *quiet
        )
        assert status == 0
        assert "none, see below" in out
        assert "Splitting cannot work here for hocbf: nothing is random after the start" in out


def test_starts_outside_the_safe_set_are_told(safe_envs_command):
    arguments = "evaluate Scalar-v0 --filter scbf --start 2 --horizon 0.2 --json out.json"
    told = "all episodes start where h <= 0: they count as violated whatever a filter does"
    assert told in safe_envs_command(arguments, "--episodes 20")[1]
    assert told in safe_envs_command(arguments, "--rare", *FEW)[1]
    (row,) = strictly("out.json")["rows"]
    assert (row["method"], row["plain"]["outside"], row["plain"]["kept_length"]) == (
        "plain episodes",
        500,
        None,
    )
    inside = "evaluate Scalar-v0 --filter scbf --horizon 0.2 --episodes 20"
    assert "h <= 0" not in safe_envs_command(inside)[1]


def test_continuous_monitoring_is_told_in_the_heading(safe_envs_command):
    arguments = "evaluate Scalar-v0 --filter none --episodes 20 --horizon 0.2"
    assert "monitored" not in safe_envs_command(arguments)[1]
    status, out, _ = safe_envs_command(arguments, "--monitoring continuous")
    assert status == 0
    assert "horizon 0.2 s, monitored continuously" in out
    status, out, _ = safe_envs_command(
        "evaluate Scalar-v0 --horizon 0.2 --filter none --rare --monitoring continuous", *FEW
    )
    assert "monitored continuously" in out
