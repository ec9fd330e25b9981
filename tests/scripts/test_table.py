"""What the table of an evaluation says around its rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scripts.conftest import strictly
from tests.scripts.own_system import SYSTEM


@pytest.fixture
def evaluated(safe_envs_command):
    """Evaluates a system of `SYSTEM`."""
    Path("own.py").write_text(SYSTEM)
    return lambda name, *arguments: safe_envs_command("evaluate", "--system", f"own.py:{name}", "--episodes", 40, *arguments)


@pytest.mark.parametrize(("name", "noise"), [("problem", "noise sigma = 0.1,"), ("fixed", "fixed noise,"), ("still", "no noise,")])
def test_the_heading_has_the_noise_and_the_horizon_of_what_is_simulated(evaluated, name, noise):
    status, out, err = evaluated(name, "--filter", "none")
    assert (status, err) == (0, "")
    # 33 whole periods.
    assert out.splitlines()[1] == f"{noise} model = plant, dt = 0.03 s, horizon 0.99 s; filters know the model"


@pytest.mark.parametrize(
    ("name", "told"), [("fixed", "write it as a parameter, so that it can be changed"), ("still", "no noise channels\n")]
)
def test_noise_that_is_no_parameter_cannot_be_set(evaluated, name, told):
    status, _, err = evaluated(name, "--noise", 0.2)
    assert status == 2
    assert "cart has no noise channels" in err
    assert told in err


def test_starts_from_which_nothing_is_promised_are_told(evaluated):
    status, out, _ = evaluated("falling", "--filter", "none", "--filter", "scbf", "--json", "out.json")
    assert status == 0
    bare, scbf = strictly("out.json")["rows"]
    assert bare["outside_rate"] is None
    # b_1 = v, and v is even in [-3, 1].
    assert 0.5 < scbf["outside_rate"] < 0.95
    told = "lie outside the sets C_j = {b_j >= 0}, j >= 1, that scbf keeps: nothing is promised from there"
    assert f"Note: {100 * scbf['outside_rate']:.3g} % of the starts {told}\n" in out
    assert "nothing is promised" not in evaluated("falling", "--filter", "scbf", "--start", "1,1")[1]
