"""Policies that are no files, bombs, damaged, or written by whoever wants to do harm: loaded as
they were saved, or refused."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from safe_envs.agents.policies.base import DESCRIPTION, TENSORS
from safe_envs.agents.policies.network import _checksum, load_policy
from safe_envs.agents.policies.registry import make_policy
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from tests.agents.policies.test_network import small
from tests.test_bounded_reading import damaged_by
from tests.wrappers.learning.models.test_hostile_files import changed

pytestmark = pytest.mark.slow

ENV_ID = "safe_envs/StochasticDubins-v0"


@pytest.fixture(scope="module")
def problem():
    return make_problem(ENV_ID)


@pytest.fixture(scope="module")
def saved(problem, tmp_path_factory) -> Path:
    from safe_envs.agents.policies.network import save_policy

    folder = tmp_path_factory.mktemp("saved") / "policy"
    save_policy(small(policy_kwargs={"net_arch": [8]}), folder, problem)
    return folder


def loaded(folder: Path, problem) -> Any:
    """A policy, None where it is refused."""
    found, message = None, ""
    try:
        found = load_policy(folder, problem)
    except ConfigurationError as error:
        message = str(error)
    assert len(message) < 1500
    return found


def observed(problem) -> np.ndarray:
    return np.zeros((2, len(problem.features)), dtype=np.float32)


@hypothesis.settings(
    max_examples=30, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(data=st.data(), name=st.sampled_from([TENSORS, DESCRIPTION]))
def test_a_damaged_policy_is_the_same_or_refused(saved, problem, tmp_path, data, name):
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    (tmp_path / name).write_bytes(damaged_by(data, (saved / name).read_bytes()))
    found = loaded(tmp_path, problem)
    if found is not None:
        expected = load_policy(saved, problem)
        np.testing.assert_array_equal(
            found.predict(observed(problem))[0], expected.predict(observed(problem))[0]
        )


@hypothesis.settings(
    max_examples=30, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(data=st.data())
def test_wrong_content_under_the_right_checksum(saved, problem, tmp_path, data):
    description = json.loads((saved / DESCRIPTION).read_text())
    del description["sha256"]
    description = changed(data, description)
    hypothesis.assume(isinstance(description, dict))
    tensors = load_tensors((saved / TENSORS).read_bytes())
    content = save_tensors(tensors, metadata={"description": _checksum(description)})
    (tmp_path / TENSORS).write_bytes(content)
    (tmp_path / DESCRIPTION).write_text(
        json.dumps({**description, "sha256": hashlib.sha256(content).hexdigest()})
    )
    found = loaded(tmp_path, problem)
    if found is not None:
        assert (abs(found.predict(observed(problem))[0]) <= 1.0).all()


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "[1, 2]", '{"format": 2, "sha256": ' + "9" * 10_000 + "}", '{"format": [2]}'],
)
def test_descriptions_of_another_shape_are_refused(saved, problem, tmp_path, text):
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    (tmp_path / DESCRIPTION).write_text(text)
    assert loaded(tmp_path, problem) is None


@pytest.mark.parametrize("name", [TENSORS, DESCRIPTION])
@pytest.mark.parametrize("what", ["pipe", "device", "sparse"])
def test_a_folder_with_what_is_no_regular_file_is_refused(saved, problem, tmp_path, name, what):
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    path = tmp_path / name
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "device":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as stream:
            stream.truncate(10**12)
    with pytest.raises(ConfigurationError, match=f"{name} cannot be read: it is "):
        load_policy(tmp_path, problem)


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000, "x" * 10**5, "a\0b"], ids=len)
def test_names_that_no_file_can_have_are_unknown_policies(problem, name):
    with pytest.raises(ConfigurationError, match="unknown policy") as raised:
        make_policy(name, problem)
    assert len(str(raised.value)) < 500


def archive_of(**parts: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name.replace("_", "."), content)
    return stream.getvalue()


BOMB = archive_of(data=bytes(101_000_000), policy_pth=b"")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\5\6" + bytes(18),
        archive_of(data=b"{}", policy_pth=b"").replace(b"PK\1\2", b"PK\0\2"),
        archive_of(data=b"{}", policy_pth=b"\0" * 1000)[:-100],
        BOMB,
        archive_of(data=b"{}", policy_pth=BOMB),
    ],
    ids=["empty", "nothing", "directory", "truncated", "bomb", "bomb within"],
)
def test_archives_that_are_damaged_or_bombs_are_refused_before_they_are_trusted(
    problem, tmp_path, content
):
    assert len(content) < 200_000
    (tmp_path / "policy.zip").write_bytes(content)
    with pytest.raises(
        ConfigurationError,
        match="is not a policy that Stable-Baselines3 saved, or damaged, or larger than 100 MB",
    ):
        make_policy(str(tmp_path / "policy.zip"), problem, trust=True)


@pytest.mark.parametrize(
    "data", [b"{}", b"[]", b"9" * 5000, b'{"policy_class": {":serialized:": "x"}}']
)
def test_archives_without_a_policy_are_refused(problem, tmp_path, data):
    (tmp_path / "policy.zip").write_bytes(archive_of(data=data, policy_pth=b"no tensors"))
    with pytest.raises(ConfigurationError, match="cannot be read as a policy"):
        make_policy(str(tmp_path / "policy.zip"), problem, trust=True)


def test_pipes_are_no_archives(problem, tmp_path):
    os.mkfifo(tmp_path / "policy.zip")
    with pytest.raises(ConfigurationError, match="unknown policy"):
        make_policy(str(tmp_path / "policy.zip"), problem, trust=True)
