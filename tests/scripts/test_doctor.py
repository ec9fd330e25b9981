"""The doctor finds a sound installation sound, and says what is wrong with another."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import PackageNotFoundError

import pytest

import safe_envs
from safe_envs.scripts.reports import installation
from safe_envs.wrappers import SafetyFilterWrapper
from tests.scripts.conftest import strictly


@pytest.fixture
def quick(monkeypatch):
    """Two envs, and no measurement of speed."""
    monkeypatch.setattr(installation, "ENV_IDS", ("safe_envs/Scalar-v0", "safe_envs/DubinsDisk-v0"))
    monkeypatch.setattr(installation, "speeds", lambda: {"env": 1000.0})


def test_a_sound_installation_is_sound(safe_envs_command, quick):
    status, out, err = safe_envs_command("doctor --json found.json")
    assert (status, err) == (0, "")
    assert "All is well." in out
    assert "1,000 steps/s" in out
    document = strictly("found.json")
    assert document["healthy"]
    assert document["safe-envs"] == safe_envs.__version__
    checks = document["checks"]
    assert {"gymnasium", "torch", "proxsuite", "python"} <= {
        check["name"] for check in checks["packages"]
    }
    names = [check["name"] for check in checks["solvers"]]
    assert names == [
        f"{program.name}{by}"
        for program in installation.KNOWN_QPS
        for by in ["", ", by DAQP", ", by PROXQP"]
    ]
    assert [check["name"] for check in checks["envs"]] == [
        "safe_envs/Scalar-v0",
        "safe_envs/DubinsDisk-v0",
    ]
    assert document["steps_per_second"] == {"env": 1000.0}


def test_each_solver_is_looked_at():
    kinds = {
        (len(program.proposed), len(program.b) > 1, program.feasible)
        for program in installation.KNOWN_QPS
    }
    assert kinds == {
        (1, True, True),
        *(
            (m, several, met)
            for m, several in ((2, False), (2, True), (3, True))
            for met in (True, False)
        ),
    }
    assert all(check.ok for check in installation.solvers())


@pytest.mark.parametrize("change", [{"answer": (0.6, 0.5)}, {"feasible": False}])
def test_a_wrong_answer_ends_with_status_1(safe_envs_command, quick, monkeypatch, change):
    monkeypatch.setattr(installation, "KNOWN_QPS", (replace(installation.KNOWN_QPS[0], **change),))
    status, out, _ = safe_envs_command("doctor --json found.json")
    assert status == 1
    assert "WRONG" in out
    document = strictly("found.json")
    assert document["checks"]["solvers"][0]["advice"] == "reinstall safe-envs, numba and numpy"
    assert not document["healthy"]
    assert document["steps_per_second"] == {}


def test_an_env_that_breaks_is_named(quick, monkeypatch):
    monkeypatch.setattr(installation, "ENV_IDS", ("safe_envs/Nothing-v0",))
    (check,) = installation.envs()
    assert check.ok is False
    assert "ConfigurationError" in check.found
    assert check.advice


@pytest.mark.parametrize("bad", [0, installation._STEPS - 1])
@pytest.mark.parametrize("what", ["action", "reward"])
def test_one_bad_step_of_an_env_is_found(quick, monkeypatch, bad, what):
    steps = []
    step = SafetyFilterWrapper.step

    def stepped(self, action):
        observation, reward, terminated, truncated, info = step(self, action)
        if len(steps) == bad:
            reward = float("nan") if what == "reward" else reward
            info["safe_action"] = info["safe_action"] + (1e3 if what == "action" else 0.0)
        steps.append(info)
        return observation, reward, terminated, truncated, info

    monkeypatch.setattr(installation, "ENV_IDS", ("safe_envs/Scalar-v0",))
    monkeypatch.setattr(SafetyFilterWrapper, "step", stepped)
    (check,) = installation.envs()
    assert len(steps) == installation._STEPS
    assert (check.ok, check.found) == (
        False,
        "an action outside of the input bounds, or a reward that is not finite",
    )


def test_what_is_missing_says_how_to_install_it(monkeypatch):
    def version(package):
        if package in ("tensorboard", "torch"):
            raise PackageNotFoundError(package)
        return "1.0"

    monkeypatch.setattr(installation, "version", version)
    monkeypatch.setattr(
        installation,
        "requires",
        lambda _: [
            "torch>=2.3",
            "numpy>=2",
            "tensorboard>=2; extra == 'tensorboard'",
            "ruff; extra == 'dev'",
        ],
    )
    found = {check.name: check for check in installation.packages()}
    assert list(found) == ["python", "torch", "numpy", "tensorboard"]
    assert (found["torch"].ok, found["torch"].advice) == (False, 'pip install "torch"')
    assert (found["tensorboard"].ok, found["tensorboard"].advice) == (
        None,
        'pip install --editable ".[tensorboard]" in a checkout',
    )
    assert found["numpy"].ok
    assert found["numpy"].found == "1.0"


def test_a_folder_on_the_path_is_named(monkeypatch):
    def requires(package):
        raise PackageNotFoundError(package)

    monkeypatch.setattr(installation, "requires", requires)
    check = list(installation.packages())[-1]
    assert (check.name, check.ok) == ("safe-envs", False)
    assert "pip install" in check.advice


def test_speeds_are_of_single_envs(monkeypatch):
    monkeypatch.setattr(installation, "NUM_ENVS", 8)
    found = installation.speeds()
    assert len(found) == 4
    assert all(steps > 0 for steps in found.values())
