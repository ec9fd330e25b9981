"""Learned files that were damaged, or written by whoever wants to do harm: what was saved, or an
error of ours."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from safe_envs.errors import ConfigurationError, SafeEnvsError
from safe_envs.filters.learning import load_learned
from safe_envs.filters.learning.data import LearnedFileError, Signature, Transitions, load, save
from safe_envs.wrappers import SafetyFilter, parse_conditions
from tests.conftest import problem_of
from tests.test_bounded_reading import damaged_by

pytestmark = pytest.mark.slow

SIGNATURE = Signature.of(problem_of("safe_envs/CubicSDEDisk-v0"))
ARRAYS = {"weights": np.linspace(0.0, 1.0, 4), "count": np.array(3)}

json_values = st.sampled_from(
    [
        None,
        True,
        0,
        1,
        -1,
        2,
        3.5,
        1e300,
        1e-300,
        10**400,
        10**9,
        "",
        "x",
        [],
        [1],
        {},
        {"a": 1},
        [[1, 2]],
    ]
)
numbers = st.sampled_from([0.0, -1.0, 5.0, 1e50, -1e99, 1e300, 1e-300, math.nan, math.inf])


def archive_of(arrays: dict[str, Any]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def loaded(content: bytes) -> Any:
    """What is loaded of a file with a content; None where it is refused."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.npz"
        path.write_bytes(content)
        try:
            return load(path)
        except LearnedFileError:
            return None


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("learned") / "model.npz"
    save(path, "regression", SIGNATURE, {"degree": 3}, ARRAYS)
    return path.read_bytes()


@hypothesis.settings(max_examples=50)
@hypothesis.given(st.data())
def test_a_damaged_file_is_the_same_or_refused(whole, data):
    content = loaded(damaged_by(data, whole))
    if content is not None:
        assert (content.kind, content.signature, content.details) == (
            "regression",
            SIGNATURE,
            {"degree": 3},
        )
        assert all(np.array_equal(content.arrays[name], array) for name, array in ARRAYS.items())


@pytest.mark.parametrize("part", ["header", "weights"])
def test_a_bomb_is_not_unpacked(tmp_path, whole, part):
    arrays = dict(np.load(io.BytesIO(whole)))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.save(content, np.zeros(10**7, dtype=np.uint8) if name == part else array)
            archive.writestr(f"{name}.npy", content.getvalue())
    assert len(stream.getvalue()) < 20_000
    (tmp_path / "bomb.npz").write_bytes(stream.getvalue())
    with pytest.raises(LearnedFileError, match=r"truncated or altered \(ValueError\)"):
        load(tmp_path / "bomb.npz")


@pytest.mark.parametrize(
    "shape", ["(10000000000,)", "(1000000000000000000,)", "(-1,)", "(3,)", f"({'1,' * 200})"]
)
def test_an_array_is_as_large_as_its_header_says(whole, shape):
    content = io.BytesIO()
    header = (
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(500).encode()
        + b"\n"
    )
    content.write(b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + bytes(32))
    stream = io.BytesIO(whole)
    with zipfile.ZipFile(stream, "a") as archive:
        archive.writestr("more.npy", content.getvalue())
    assert loaded(stream.getvalue()) is None


def test_pipes_and_devices_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "endless.npz").symlink_to("/dev/zero")
    for name in ("pipe", "endless"):
        with pytest.raises(LearnedFileError, match="cannot be read: it is a pipe or a device"):
            load(tmp_path / f"{name}.npz")
    with pytest.raises(LearnedFileError, match="cannot be read: File name too long"):
        load(tmp_path / ("x" * 300))


def test_what_could_not_be_loaded_is_not_saved(tmp_path):
    large = np.broadcast_to(0.0, (10**5, 10**4))
    with pytest.raises(ConfigurationError, match="would take 8e"):
        save(tmp_path / "model.npz", "regression", SIGNATURE, {}, {"weights": large})
    assert list(tmp_path.iterdir()) == []


def places(document: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Of all that a JSON document holds."""
    inner = (
        document.items()
        if isinstance(document, dict)
        else enumerate(document)
        if isinstance(document, list)
        else ()
    )
    return [place, *(found for key, value in inner for found in places(value, (*place, key)))]


def changed(data: st.DataObject, document: Any) -> Any:
    """The document with another value in one place, or without it."""
    place, value = data.draw(st.sampled_from(places(document))), data.draw(json_values)
    if not place:
        return value
    inner = document
    for key in place[:-1]:
        inner = inner[key]
    if data.draw(st.booleans()):
        inner[place[-1]] = value
    else:
        del inner[place[-1]]
    return document


def altered(data: st.DataObject, arrays: dict[str, np.ndarray]) -> None:
    """Another number in an array, another shape, or another kind of numbers."""
    name = data.draw(st.sampled_from(sorted(arrays)))
    array = arrays[name].astype(float)
    way = data.draw(st.sampled_from(["entry", "entry", "all", "axis", "empty", "kind", "none"]))
    if way == "entry" and array.size:
        array.flat[data.draw(st.integers(0, array.size - 1))] = data.draw(numbers)
    elif way == "all":
        array[...] = data.draw(numbers)
    elif way == "none":
        del arrays[name]
        return
    arrays[name] = {"axis": array[None], "empty": array[:0], "kind": array > 0}.get(way, array)


def write(path: Path, model, document: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write a file with any content under the right checksum."""
    parts = [model.method, document["signature"], document["details"]]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(
            f"{name}{arrays[name].dtype.str}{arrays[name].shape}".encode() + arrays[name].tobytes()
        )
    header = {
        "format": 2,
        "kind": model.method,
        **document,
        "versions": {},
        "sha256": digest.hexdigest(),
    }
    path.write_bytes(
        archive_of({**arrays, "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)})
    )


def document_of(model) -> dict[str, Any]:
    return json.loads(
        json.dumps({"details": model._saved(), "signature": asdict(model.signature)}, default=float)
    )


LEARNED = pytest.mark.parametrize(
    ("what", "env", "filter_name"),
    [
        ("residual", "disk", "learned-hocbf"),
        ("network", "top", "ddscbf"),
        ("diffusion", "gap", "ddscbf"),
        ("posterior", "cubic", "bayesian-scbf"),
    ],
)


@LEARNED
def test_what_these_tests_write_is_taken_where_nothing_was_changed(
    request, tmp_path, what, env, filter_name
):
    model = request.getfixturevalue(what)
    write(tmp_path / "model.npz", model, document_of(model), model.arrays())
    found = load_learned(tmp_path / "model.npz", request.getfixturevalue(env))
    assert found.sha256 == model.sha256


@pytest.mark.slow
@hypothesis.settings(
    max_examples=25, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(data=st.data())
@LEARNED
def test_wrong_content_is_refused_or_gives_actions(request, tmp_path, what, env, filter_name, data):
    model, problem = request.getfixturevalue(what), request.getfixturevalue(env)
    document, arrays = document_of(model), dict(model.arrays())
    if data.draw(st.booleans()):
        document = changed(data, document)
    else:
        altered(data, arrays)
    hypothesis.assume(isinstance(document, dict) and {"details", "signature"} <= set(document))
    write(tmp_path / "model.npz", model, document, arrays)
    message, action = "", np.zeros(1)
    try:
        found = load_learned(tmp_path / "model.npz", problem)
        conditions = parse_conditions(filter_name, problem, {found.method: found})
        action = (
            SafetyFilter.for_problem(problem, conditions)
            .filter(np.full(problem.plant.n, 0.1), np.zeros(problem.plant.m))
            .action
        )
    except SafeEnvsError as error:
        message = str(error)
    assert len(message) < 2000
    assert np.isfinite(action).all()


@pytest.mark.parametrize("degrees", [[3], [0], [10**9], ["2"], [2, 2], None])
def test_degrees_are_those_of_the_barriers(tmp_path, disk, residual, degrees):
    details = {**residual._saved(), "degrees": degrees}
    save(tmp_path / "model.npz", residual.method, residual.signature, details, residual.arrays())
    with pytest.raises(LearnedFileError, match="the degrees"):
        load_learned(tmp_path / "model.npz", disk)


def test_data_of_another_shape_are_refused(tmp_path, cubic):
    arrays = {
        "x": np.zeros((2, 2)),
        "u": np.zeros((2, 1)),
        "successors": np.zeros((2, 1, 2)),
        "dt": np.ones(2),
    }
    for details in ({}, {"seed": "x"}, {"seed": 1.5}, {"seed": -1}, {"seed": [1]}):
        save(tmp_path / "data.npz", "transitions", Signature.of(cubic), details, arrays)
        with pytest.raises(LearnedFileError, match="incomplete"):
            Transitions.load(tmp_path / "data.npz")
