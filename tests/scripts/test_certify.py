"""`safe-envs certify`, as a person types it."""

from __future__ import annotations

import json
import re
from decimal import Decimal

from safe_envs.filters.certificates.files import load_certificate
from tests.scripts.conftest import strictly

SCALAR = ("safe_envs/Scalar-v0", "--degree", 6, "--rate", 0, "--horizon", 0.5)


def assert_says_no_more_than(found, out):
    """What is printed as proved is what JSON says, less the margin of the draw, rounded down."""
    (text,) = re.findall(r">= ([\d.]+) %", out)
    least = Decimal(repr(found["proved"])) - Decimal(repr(found["proved_margin"]))
    assert 100 * least - Decimal("0.1") < Decimal(text) <= 100 * least
    (degree,) = found["degrees"]
    rows = (line.split() for line in out.splitlines())
    (row,) = (row for row in rows if row[:1] == [str(degree["degree"])])
    assert Decimal(row[6]) <= 100 * Decimal(repr(degree["proved"]))


def test_it_prints_the_bound_and_writes_what_check_accepts(safe_envs_command):
    files = ("--out", "psi.json", "--json", "all.json")
    status, out, _ = safe_envs_command("certify", *SCALAR, *files)
    assert status == 0
    for text in (
        "Proved: P(safe for 0.5 s",
        "every policy",
        "continuous control",
        "safe-envs check",
    ):
        assert text in out
    found = strictly("all.json")
    assert 0.7 < found["proved"] < 0.99
    assert_says_no_more_than(found, out)
    m, c = re.search(r"m = (\S+) 1/s, c = ([\d.e+-]+);", out).groups()
    assert float(m) >= found["shortfall"]
    assert float(c) >= found["supremum"]
    assert found["degrees"][0]["degree"] == 6
    assert found["degrees"][0]["coefficients"] > 1
    assert abs(found["degrees"][0]["proved"] - found["degrees"][0]["sampled"]) < 0.02
    certificate = load_certificate("psi.json")
    assert (certificate.env_id, certificate.options) == ("safe_envs/Scalar-v0", {"horizon": 0.5})
    assert float(certificate.shortfall) == found["shortfall"]
    status, out, _ = safe_envs_command("check psi.json")
    assert (status, "checked:" in out) == (0, True)


def test_the_nominal_controller_alone(safe_envs_command):
    status, out, _ = safe_envs_command("certify", *SCALAR[:-1], "0.2 --policy nominal")
    assert status == 0
    assert "barrier certificate for the nominal controller" in out


def test_what_is_not_found_is_said(safe_envs_command):
    asked = ("--start", 1, "--json", "-")
    status, out, _ = safe_envs_command("certify", *SCALAR, *asked)
    assert status == 1
    assert json.loads(out)["proved"] is None
    status, out, _ = safe_envs_command("certify", *SCALAR, "--start 1 --out psi.json")
    assert status == 1
    assert "No bound above 0 is proved" in out
    assert "no barrier of degree 6" in out
