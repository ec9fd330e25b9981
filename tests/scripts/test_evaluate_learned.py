"""`safe-envs evaluate` of filters that rest on something learned."""

from __future__ import annotations

import pytest

from safe_envs.agents.evaluation.table import bound_text
from tests.scripts.conftest import strictly

pytestmark = pytest.mark.usefixtures("coarse_bounds")
DISK = ("CubicSDEDisk-v0", "--start=-0.1,0.7")
QUICK = ("--episodes", 20)
SMALL = ("--set", "starts=50", "--set", "repetitions=20")


@pytest.fixture
def evaluate(safe_envs_command):
    """Runs `safe-envs evaluate` on the disk."""
    return lambda *arguments: safe_envs_command("evaluate", *DISK, *QUICK, *arguments)


@pytest.fixture
def learned(safe_envs_command, tmp_path):
    """A file of `safe-envs identify`."""
    assert (
        safe_envs_command(
            "identify", DISK[0], "--method bayesian", *SMALL, "--seed 7 --out disk.npz"
        )[0]
        == 0
    )
    return tmp_path / "disk.npz"


@pytest.mark.slow
def test_a_file_is_used_in_its_place(evaluate, learned):
    filters = "--filter bayesian-scbf --filter bayesian-scbf:confidence=0.9"
    status, out, _ = evaluate(filters, "--learned", learned, "--json out.json")
    assert status == 0
    assert "bayesian-scbf was learned before, from 2,000 transitions: " in " ".join(out.split())
    assert (
        evaluate(
            "--filter",
            f"bayesian-scbf:file={learned}",
            "--filter",
            f"bayesian-scbf:file={learned}:confidence=0.9",
            "--json named.json",
        )[0]
        == 0
    )
    given, named = strictly("out.json")["rows"], strictly("named.json")["rows"]
    for row, other in zip(given, named, strict=True):
        assert {**row, "filter": None} == {**other, "filter": None}
        assert (
            row["learning"]["seeds"],
            row["learning"]["files"],
            row["learning"]["transitions"],
        ) == ([7], [str(learned)], 2000)


@pytest.mark.slow
def test_repeats_give_the_worst_identification_and_intervals_over_them(evaluate):
    filters = "--filter scbf --filter bayesian-scbf --filter bayesian-scbf:simultaneous=0.9"
    status, out, err = evaluate(filters, "--repeats 2 --timing --json out.json")
    assert (status, err) == (0, "")
    document = strictly("out.json")
    assert document["config"]["repeats"] == 2
    plain, row, robust = document["rows"]
    assert (plain["learning"], row["learning"]["transitions"]) == (None, 200_000)
    unlearned, learned, _ = (timed["learning_seconds"] for timed in document["timing"]["rows"])
    assert unlearned is None
    assert f"{learned:.2f} s" in out
    assert f"{100 * min(row['learning']['rates']):.1f} %" in out
    assert row["episodes"] == 40
    bound = robust["posterior_bound"]
    assert f" {bound_text(bound['probability'], bound['word'])}\n" in out
    assert f", {bound['word']} given the posterior, with probability delta" in out
    for text in (
        "20 episodes x 2 identifications",
        "over identifications and episodes",
        "200,000 transitions each",
    ):
        assert text in out


def test_files_for_something_else_end_with_status_2(evaluate, learned, safe_envs_command):
    status, _, err = safe_envs_command(
        "evaluate Pendulum-v0 --filter bayesian-scbf --learned", learned, *QUICK
    )
    assert status == 2
    assert "CubicSDEDisk" in err
    status, _, err = evaluate("--filter", f"ddscbf:file={learned}")
    assert status == 2
    assert "bayesian" in err
    learned.write_bytes(learned.read_bytes()[:-200])
    status, _, err = evaluate("--filter bayesian-scbf --learned", learned)
    assert status == 2
    assert "truncated" in err
