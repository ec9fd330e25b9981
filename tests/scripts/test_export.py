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
    status, out, _ = export("Pendulum-v0 --out c --compare --float32 --name own")
    assert status == 0
    assert "No comparison was made" in out
    assert "float theta;" in (tmp_path / "c" / "filter.h").read_text()
    assert "own_decide" in (tmp_path / "c" / "filter.c").read_text()


@pytest.mark.parametrize("text", ["promise:p=0.9", "backup"])
def test_filters_without_a_form_in_c_are_refused_in_one_line(export, text):
    status, _, error = export("Scalar-v0 --filter", text, "--out", "c")
    assert status == 2
    assert f"the filter {text} has no form in C" in " ".join(error.split())
    assert "Traceback" not in error
