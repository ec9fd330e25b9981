"""`safe-envs export` as a person types it."""

from __future__ import annotations

import pytest

from safe_envs.export.comparison import c_compiler
from tests.scripts.conftest import strictly

NEEDS_COMPILER = pytest.mark.skipif(c_compiler() is None, reason="there is no C compiler")


@pytest.fixture
def export(safe_envs_command):
    """Runs the command."""
    return lambda *arguments: safe_envs_command("export", *arguments)


@NEEDS_COMPILER
def test_the_files_and_the_comparison(export, tmp_path):
    path = tmp_path / "found.json"
    options = ("--filter", "scbf", "--out", "c", "--compare", "--states", "2000", "--json", path)
    status, out, _ = export("StochasticDubins-v0", *options)
    assert status == 0
    assert "scbf for h" in out
    assert "flags that differ" in out
    found = strictly(path)
    assert found["comparison"]["flags_different"] == 0
    assert (found["filter"], found["barriers"]) == ("scbf for h", {"h": "-x**2 - y**2 + 9.0"})
    assert found["comparison"]["states"] == 2000
    assert [q["unit"] for q in found["states"]] == ["m", "m", "rad"]
    header = (tmp_path / "c" / "filter.h").read_text()
    assert "double theta; /* theta, in rad */" in header


def test_without_a_compiler_it_says_so(export, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    status, out, _ = export("Pendulum-v0", "--out", "c", "--compare", "--float32", "--name", "own")
    assert status == 0
    assert "No comparison was made" in out
    assert "float theta;" in (tmp_path / "c" / "filter.h").read_text()
    assert "own_decide" in (tmp_path / "c" / "filter.c").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--filter", "promise:p=0.9", "--out", "c", "--float32"), "double precision"),
        (("--filter", "promise:p=0.9", "--out", "c", "--objective", "clf"), "objective"),
        (("--filter", "scbf", "--out", "c", "--name", "a b"), "is no name of C"),
        (("--out", "no/such/c"), "no/such"),
        (("--out", "c", "--states", "0"), "states"),
    ],
)
def test_errors_end_with_status_2(export, arguments, message, tmp_path):
    status, _, err = export("Pendulum-v0", *arguments)
    assert status == 2
    assert message in err
    assert not (tmp_path / "c").exists()


def test_the_backup_filter_has_no_form_in_c(export, tmp_path):
    status, _, error = export("DubinsDisk-v0", "--filter", "backup", "--out", tmp_path / "c")
    assert status == 2
    assert "it simulates plans" in error
