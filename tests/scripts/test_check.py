"""`safe-envs check`, as a person types it."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from safe_envs.filters.certificates.files import save_certificate
from tests.filters.certificates.examples import FALSE, TRUE, brownian, disk
from tests.scripts.conftest import strictly


@pytest.fixture
def written(tmp_path):
    def write(certificate, name="psi.json"):
        save_certificate(certificate, tmp_path / name)
        return name

    return write


def test_a_proof_ends_with_0_and_says_what_it_proves(safe_envs_command, written):
    starts = ("--state=0,0", "--state", "-.1,.7", "--state", "0,1.5")
    found = safe_envs_command("check", written(disk()), *starts, "--json found.json")
    status, out, err = found
    assert (status, err) == (0, "")
    for text in ("psi has degree 2 in x_1, x_2", "every input", "m = 0.080000001", "T = 1"):
        assert text in out.replace("horizon = 1", "T = 1")
    for text in ("exactly that of safe_envs/CubicSDEDisk-v0", "A psi >= -a psi - m", ">= 91.99 %"):
        assert text in out
    assert "checked: the certificate is a proof" in out
    document = strictly("found.json")
    assert document["word"] == "checked"
    assert [b["state"] for b in document["bounds"]] == [[0, 0], [-0.1, 0.7], [0, 1.5]]
    bounds = [b["bound"] for b in document["bounds"]]
    assert bounds == pytest.approx([0.92, 0.42, 0.0], abs=1e-6)
    assert bounds[1] < 0.42
    shown = [float(text) for text in re.findall(r">= ([\d.]+) %", out)]
    assert all(text <= 100.0 * bound for text, bound in zip(shown, bounds, strict=True))
    statements = document["statements"]
    assert {part["word"] for part in statements} == {"checked"}
    assert (document["degree"], document["control"], document["c"]) == (
        2,
        "constraint",
        1.000000001,
    )


def test_what_is_refuted_or_undecided_ends_with_1(safe_envs_command, written):
    status, out, err = safe_envs_command("check", written(FALSE["the disk with a smaller m"]))
    assert (status, err) == (1, "")
    assert "at (1.9" in out
    assert "it is false" in out
    assert "refuted: the certificate is no proof" in out
    asked = ("--seconds", 1e-9, "--state", "0,0", "--json", "-")
    status, out, err = safe_envs_command("check", written(TRUE["the disk"]), *asked)
    assert (status, err) == (1, "")
    assert json.loads(out)["word"] == "undecided"
    assert json.loads(out)["bounds"] == [{"state": [0, 0], "bound": None}]
    status, out, _ = safe_envs_command("check psi.json --seconds 1e-9 --state 0,0")
    assert status == 1
    assert "not proved" in out
    assert ">= 9" not in out


def test_a_proof_of_another_system_is_none_of_the_env(safe_envs_command, written):
    other = replace(brownian(), env_id="safe_envs/Scalar-v0")
    status, out, _ = safe_envs_command("check", written(other), "--json found.json")
    assert status == 1
    assert "differs from that of safe_envs/Scalar-v0" in out
    document = strictly("found.json")
    assert document["word"] == "refuted"
    assert {part["word"] for part in document["statements"]} == {"checked"}
    status, out, _ = safe_envs_command("check", written(brownian()))
    assert status == 0
    assert "no env of this project" in out
