"""Hostile policies are loaded as they were saved, or refused.

The file itself is read by `safe_envs.filters.learning.data`; see its tests.
"""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from safe_envs.agents.policies.network import load_policy
from safe_envs.agents.policies.registry import make_policy
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.data import load, save
from safe_envs.registry import make_problem
from tests.agents.policies.test_network import small
from tests.test_bounded_reading import damaged_by
from tests.filters.learning.test_learned_files import altered, changed

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
@hypothesis.given(data=st.data())
def test_a_damaged_policy_is_the_same_or_refused(saved, problem, tmp_path, data):
    path = tmp_path / "policy.npz"
    path.write_bytes(damaged_by(data, (saved / "policy.npz").read_bytes()))
    found = loaded(path, problem)
    if found is not None:
        expected = load_policy(saved, problem)
        np.testing.assert_array_equal(
            found.predict(observed(problem))[0], expected.predict(observed(problem))[0]
        )


@hypothesis.settings(
    max_examples=60, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(data=st.data())
def test_wrong_content_under_the_right_checksum(saved, problem, tmp_path, data):
    content = load(saved / "policy.npz")
    details, arrays = content.details, dict(content.arrays)
    if data.draw(st.booleans()):
        details = changed(data, details)
        hypothesis.assume(isinstance(details, dict))
    else:
        altered(data, arrays)
    save(tmp_path / "policy.npz", content.kind, content.signature, details, arrays)
    found = loaded(tmp_path, problem)
    if found is not None:
        assert (abs(found.predict(observed(problem))[0]) <= 1.0).all()


@pytest.mark.parametrize("what", ["pipe", "device", "sparse"])
def test_what_is_no_regular_file_is_refused(problem, tmp_path, what):
    path = tmp_path / "policy.npz"
    if what == "pipe":
        os.mkfifo(path)
    elif what == "device":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as stream:
            stream.truncate(10**12)
    with pytest.raises(ConfigurationError, match=r"policy\.npz cannot be read: it is "):
        load_policy(tmp_path, problem)


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000, "x" * 10**5, "a\0b"], ids=len)
def test_names_that_no_file_can_have_are_unknown_policies(problem, name):
    with pytest.raises(ConfigurationError, match=r"unknown policy|there is no such file") as raised:
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
    with pytest.raises(ConfigurationError, match="is not a policy that Stable-Baselines3 saved"):
        make_policy(str(tmp_path / "policy.zip"), problem, trust=True)
