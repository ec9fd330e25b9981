"""One call for each question answers as the commands and the modules behind do."""

from __future__ import annotations

from pathlib import Path

import pytest

import safe_envs
from safe_envs import ConfigurationError
from safe_envs.filters.certificates.files import save_certificate
from tests.conftest import problem_of

SCALAR = "safe_envs/Scalar-v0"


def test_a_filter_is_verified_for_an_id_or_a_problem():
    found = safe_envs.verify(SCALAR, "szcbf", seed=1)
    assert found.barriers[0].filter == "szcbf:alpha=1.0"
    again = safe_envs.verify(problem_of(SCALAR), "szcbf", seed=1)
    assert again.barriers[0].supremum == found.barriers[0].supremum
    with pytest.raises(ConfigurationError, match="szcb"):
        safe_envs.verify(SCALAR, "szcb")


def test_what_is_certified_is_checked_from_its_file(tmp_path: Path):
    found = safe_envs.certify(SCALAR, degrees=(14,), seconds=5.0)
    assert found.certificate is not None
    save_certificate(found.certificate, tmp_path / "psi.json")
    assert safe_envs.check(tmp_path / "psi.json").word == "checked"
    with pytest.raises(ConfigurationError, match="seconds = 0"):
        safe_envs.check(found.certificate, seconds=0.0)


def test_the_best_attainable_safety_is_of_the_plant():
    problem = problem_of(SCALAR)
    coarse, _ = safe_envs.best(problem, episodes=0, cells=(31,))
    fine, policy = safe_envs.best(SCALAR, episodes=0, cells=(121,))
    assert (policy.settings.knowledge, policy.settings.cells) == ("plant", (121,))
    ends = [(found.lower or 0.0, found.upper or 0.0) for found in (coarse, fine)]
    (low, high), (finer_low, finer_high) = ends
    assert low <= finer_high
    assert 0.0 < finer_high - finer_low <= high - low


def test_a_sweep_is_computed_once_and_read_as_a_table(tmp_path: Path):
    pytest.importorskip("pyarrow")
    file = tmp_path / "sweep.yaml"
    file.write_text(
        "fixed: {env: Scalar-v0, episodes: 3, horizon: 0.1}\ngrid: {filter: [none, scbf]}\n"
    )
    table = safe_envs.sweep(file, tmp_path / "out", jobs=1)
    assert table.num_rows == 2
    assert safe_envs.sweep(file, tmp_path / "out", jobs=1).equals(table)
    file.write_text("fixed: {env: Scalar-v0, box: [-1, 1]}\n")
    with pytest.raises(ConfigurationError, match="it is input_bounds now"):
        safe_envs.sweep(file, tmp_path / "other")


def test_an_old_name_tells_the_new_one():
    with pytest.raises(ImportError, match="define_problem"):
        exec("from safe_envs import state_problem")
    assert not hasattr(safe_envs, "box")
    with pytest.raises(TypeError, match="it is input_bounds now"):
        safe_envs.make_problem(SCALAR, box=(-1, 1))
    with pytest.raises(ConfigurationError, match="it is alpha now"):
        safe_envs.SafetyFilter.for_problem(problem_of(SCALAR), "hocbf:p=1")
