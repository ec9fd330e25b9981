"""YAML of whoever wants to do harm: read, or refused with a message, in no time."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import pytest
import yaml

from safe_envs.agents.sweeps.spec import document_in, read_sweep, sweep_of, value_of
from safe_envs.errors import ConfigurationError

pytestmark = pytest.mark.slow

_SECONDS = 2.0


def refusal_of(path: Path, content: str) -> str:
    """What is said of a file; within two seconds of the processor, and in short."""
    path.write_text(content)
    began = time.process_time()
    with pytest.raises(ConfigurationError) as raised:
        read_sweep(path)
    assert time.process_time() - began < _SECONDS
    assert len(str(raised.value)) < 1000
    return str(raised.value)


BOMB = "fixed:\n  start: &a [1,1]\ngrid:\n" + "".join(
    f"  plant.p{i}: &p{i} [{','.join(['*' + ('a' if i == 0 else f'p{i - 1}')] * 10)}]\n"
    for i in range(8)
)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (BOMB, "an alias is not allowed"),
        ("fixed: &a {start: [*a]}", "an alias is not allowed"),
        ("[" * 3000 + "]" * 3000, "nested more than"),
        ("- " * 3000 + "x", "nested more than"),
        ("{" * 3000, "nested more than"),
        ("? [a, b]\n: 1", "a list or a mapping"),
        ("? {a: b}\n: 1", "a list or a mapping"),
        ("fixed: {bounds: !!bool foo}", "a tag is not allowed"),
        ("fixed: {dt: !!timestamp foo}", "a tag is not allowed"),
        ("fixed: !!python/object/apply:os.system [echo hi]", "a tag is not allowed"),
        ("fixed: {dt: 2001-13-45}", 'dt = "2001-13-45"; give a number'),
        ("fixed: {episodes: " + "9" * 5000 + "}", "episodes = inf; give a whole number"),
        ("fixed: {dt: " + "9" * 400 + "}", "dt = inf; give a finite number"),
        ("fixed: {dt: 1_0.5}", "1_0.5 is no plain number"),
        ("fixed: {dt: 1:30.5}", "1:30.5 is no plain number"),
        ("fixed: {dt: ٣}", "give a number"),
        ("fixed: {dt: '1_0'}", "give a number"),
        ("fixed: {policy: 'a', system: \"a\\0b.py:x\"}", "a character that ends texts"),
        ("fixed: {env: Scalar-v0, filter: cbf, policy: " + "x" * 300 + "}", "unknown policy"),
        ("fixed: {system: " + "x" * 60_000 + "}", "give FILE.py:NAME"),
        ("x" * 60_000 + ": 1", "is no YAML"),
        ("a" * 70_000, "larger than"),
        (
            "fixed: {env: Scalar-v0, filter: none}\ngrid: {seed: ["
            + "1," * 800
            + "], episodes: ["
            + "2," * 800
            + "]}",
            "640000 cells",
        ),
    ],
    ids=lambda text: text[:24],
)
def test_bombs_and_what_is_no_sweep_are_refused_at_once(tmp_path: Path, content: str, reason: str):
    assert reason in refusal_of(tmp_path / "sweep.yaml", content)


def test_the_largest_files_are_read_at_once(tmp_path: Path):
    # This takes the longest for its length.
    (tmp_path / "sweep.yaml").write_text("[" + "? ," * 21_000 + "]")
    began = time.process_time()
    assert len(document_in(tmp_path / "sweep.yaml")) == 21_000
    assert time.process_time() - began < _SECONDS


def test_files_that_a_sweep_reads_are_regular_ones(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    for settings in ({"filter": "ddscbf:file=pipe"}, {"filter": "none", "policy": "pipe"}):
        with pytest.raises(ConfigurationError, match="it is a pipe or a device"):
            sweep_of({"fixed": {"env": "Scalar-v0", **settings}})
    os.rename("pipe", "pipe.py")
    with pytest.raises(ConfigurationError, match="it is a pipe or a device"):
        sweep_of({"fixed": {"system": "pipe.py:problem", "filter": "none"}})
    with pytest.raises(ConfigurationError, match=r"pipe\.py cannot be read: it is a pipe"):
        document_in(Path("pipe.py"))


words = st.text(st.characters(codec="ascii"), max_size=5)
scalars = (
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats(-1e10, 1e10) | words
)
mappings = st.dictionaries(st.text("abc", max_size=3), scalars, max_size=3)
documents = st.recursive(
    scalars | mappings,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
)


@hypothesis.given(documents)
def test_what_json_can_say_is_read_as_it_was_written(document: Any):
    text = yaml.safe_dump(document)
    # PyYAML may write equal texts as aliases, and texts that look like numbers in odd forms with
    # tags.
    assert value_of(text, "sweep") == document


@hypothesis.given(st.text(alphabet="ab1.:-?{}[],&*!|>'\"#\n _", max_size=40))
def test_any_text_is_read_or_is_no_yaml(text: str):
    try:
        value_of(text, "sweep")
    except yaml.YAMLError:
        return


@hypothesis.given(documents)
def test_any_document_is_a_sweep_or_refused(document: Any):
    message = ""
    try:
        sweep_of(document)
    except ConfigurationError as error:
        message = str(error)
    assert 0 < len(message) < 1000
