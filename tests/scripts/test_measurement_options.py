"""`--measurement` and `--sensor-noise`: mistakes are told before anything heavy is imported."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.scripts.conftest import strictly

ACC = "safe_envs/ACC-v0"
WITHOUT_SYMPY = """
import sys
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.options.env_options import EnvOptions
try:
    EnvOptions("ACC-v0", None, {"measurement": [sys.argv[1]]}).require_known()
except ConfigurationError as error:
    print(error)
print(sorted({"numpy", "sympy", "gymnasium"} & set(sys.modules)))
"""


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["x_1"], "has no noise"),
        (["speed:noise=1"], "unknown name 'speed'"),
        (["x_1:noise=-1"], "give a number from 0"),
        (["delay=-1"], "from 0 to 1000"),
        (["gap", "gap"], "more than once"),
        (["__import__('os'):noise=1"], "measurement"),
        (["x" * 100_000], "at most 1000 characters"),
        (["\0x_1:noise=1"], "measurement"),
    ],
)
def test_mistakes_end_with_status_2_and_one_line(safe_envs_command, texts, message):
    given = [f"--measurement={text}" for text in texts]
    status, out, error = safe_envs_command("evaluate", ACC, "--episodes", 1, *given)
    assert (status, out) == (2, "")
    assert message in " ".join(error.split())
    assert "Traceback" not in error
    assert len(error) < 700


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed:noise=1", "did you mean 'own_speed'"),
        ("x_1:dropout=1", "give a probability"),
        ("default:bia=1", "did you mean 'bias'"),
    ],
)
def test_mistakes_are_told_without_the_symbols(text, message):
    command = [sys.executable, "-c", WITHOUT_SYMPY, text]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert message in found
    assert found.endswith("[]\n")


def test_a_factor_without_a_sensor_is_refused(safe_envs_command):
    status, _, error = safe_envs_command("evaluate", ACC, "--episodes", 1, "--sensor-noise", 2)
    assert status == 2
    assert "nothing is measured" in " ".join(error.split())


def test_the_list_tells_the_default_sensors(safe_envs_command, tmp_path):
    safe_envs_command("list", "--json", tmp_path / "envs.json")
    rows = {row["env_id"]: row for row in strictly(tmp_path / "envs.json")["envs"]}
    assert rows[ACC]["sensor"] == {"own_speed": 0.1, "relative_speed": 0.25, "gap": 0.5}
