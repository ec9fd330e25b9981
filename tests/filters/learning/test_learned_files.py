"""Files of learned models and data: what was saved, or an error of ours, whoever wrote them."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import pickle
import tempfile
import zipfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from safe_envs.errors import ConfigurationError, SafeEnvsError
from safe_envs.files import MOST_BYTES
from safe_envs.filters.learning import load_learned
from safe_envs.filters.learning.data import LearnedFileError, Signature, load, save
from safe_envs.wrappers import SafetyFilter, parse_conditions
from tests.conftest import problem_of
from tests.test_files import damaged_by

DISK = problem_of("safe_envs/CubicSDEDisk-v0")
SIGNATURE = Signature.of(DISK)
ARRAYS = {"weights": np.linspace(0.0, 1.0, 40).reshape(8, 5), "count": np.array(3)}
DETAILS = {"degree": 3, "names": ["f", "g"], "scale": 0.1}


@pytest.fixture
def path(tmp_path):
    """A file as it should be."""
    path = tmp_path / "model.npz"
    save(path, "regression", SIGNATURE, DETAILS, ARRAYS)
    return path


def archived(path):
    """What NumPy finds in a file."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def with_header(path, **changes):
    """Write the file again, with another header and nothing else changed."""
    arrays = archived(path)
    header = {**json.loads(arrays["header"].tobytes()), **changes}
    np.savez(
        path, **{**arrays, "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}
    )


def test_what_is_saved_is_loaded(path):
    content = load(path)
    assert (content.kind, content.signature, content.details) == ("regression", SIGNATURE, DETAILS)
    assert set(content.arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(content.arrays[name], array)
    content.signature.require(DISK, "barriers", "model", "dt")
    # The order in memory does not matter, and numbers of NumPy are numbers.
    turned = {name: np.asfortranarray(array) for name, array in ARRAYS.items()}
    save(path, "regression", SIGNATURE, {**DETAILS, "degree": np.int64(3)}, turned)
    assert load(path).sha256 == content.sha256


def test_the_checksum_is_of_everything(path):
    known = {load(path).sha256}
    for kind, signature, details, arrays in (
        ("network", SIGNATURE, DETAILS, ARRAYS),
        ("regression", replace(SIGNATURE, dt=0.02), DETAILS, ARRAYS),
        ("regression", SIGNATURE, {**DETAILS, "degree": 4}, ARRAYS),
        ("regression", SIGNATURE, DETAILS, {**ARRAYS, "weights": ARRAYS["weights"].T}),
        ("regression", SIGNATURE, DETAILS, {**ARRAYS, "weights": ARRAYS["weights"].astype("f4")}),
        ("regression", SIGNATURE, DETAILS, {"w": ARRAYS["weights"], "count": ARRAYS["count"]}),
    ):
        save(path, kind, signature, details, arrays)
        known.add(load(path).sha256)
    assert len(known) == 7


def rewritten(path, **changes):
    """Write the arrays of a file again, with others in their place, or without them."""
    arrays = {**archived(path), **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


NPY = b"\x93NUMPY\x01\0" + np.lib.format.magic(1, 0)
WEIGHTS = ARRAYS["weights"] + 1e-12 * (np.arange(40).reshape(8, 5) == 17)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        *(
            (lambda p, left=left: p.write_bytes(p.read_bytes()[: int(left * 1700)]), "truncated")
            for left in (0.0, 0.1, 0.5, 0.9)
        ),
        (lambda p: rewritten(p, weights=WEIGHTS), "was altered"),
        (lambda p: rewritten(p, more=np.zeros(1)), "was altered"),
        (lambda p: with_header(p, kind="network"), "was altered"),
        (lambda p: with_header(p, sha256="0" * 64), "was altered"),
        (lambda p: with_header(p, signature={**asdict(SIGNATURE), "system": "S"}), "was altered"),
        (lambda p: with_header(p, signature={}), "no file"),
        (lambda p: with_header(p, signature={**asdict(SIGNATURE), "color": "red"}), "no file"),
        (lambda p: with_header(p, format=99), "format 99"),
        (lambda p: p.unlink(), "does not exist"),
        (lambda p: (p.unlink(), p.mkdir()), "is a folder"),
        (lambda p: (p.unlink(), os.mkfifo(p)), "a pipe or a device"),
        (lambda p: (p.unlink(), p.symlink_to("/dev/zero")), "a pipe or a device"),
        (lambda p: p.write_bytes(b"weights: 1, 2, 3\n"), "no file"),
        (lambda p: p.write_bytes(pickle.dumps({"weights": [1.0]})), "no file"),
        (lambda p: p.write_bytes(NPY), "no file"),
        (lambda p: np.savez(p, weights=np.zeros(3)), "no file"),
    ],
)
def test_what_was_altered_or_is_no_file_of_ours_is_refused(path, change, told):
    change(path)
    with pytest.raises(LearnedFileError, match=told):
        load(path)


class Trap:
    """Says so where it is unpickled."""

    sprung = False

    @staticmethod
    def spring():
        Trap.sprung = True
        return 0

    def __reduce__(self):
        return Trap.spring, ()


@pytest.mark.parametrize("name", ["header", "weights"])
def test_nothing_is_unpickled(path, name):
    arrays = archived(path)
    np.savez(path, **{**arrays, name: np.array([Trap()], dtype=object)})
    with pytest.raises(LearnedFileError, match="no file of `safe-envs identify`"):
        load(path)
    assert not Trap.sprung
    # The trap works.
    pickle.loads(pickle.dumps(Trap()))
    assert Trap.sprung
    Trap.sprung = False


@pytest.mark.parametrize(
    ("details", "arrays", "error"),
    [
        ({}, {"weights": np.array([Trap()], dtype=object)}, ValueError),
        ({"degree": object()}, ARRAYS, TypeError),
        ({}, {"weights": np.broadcast_to(0.0, MOST_BYTES // 8 + 1)}, ConfigurationError),
    ],
)
def test_what_could_not_be_loaded_is_not_saved(path, details, arrays, error):
    whole = path.read_bytes()
    with pytest.raises(error):
        save(path, "regression", SIGNATURE, details, arrays)
    assert path.read_bytes() == whole
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(ConfigurationError, match="does not exist"):
        save(path.parent / "none" / "model.npz", "regression", SIGNATURE, {}, ARRAYS)


@pytest.mark.parametrize(
    ("env_id", "options", "named"),
    [
        ("Scalar-v0", {}, "system"),
        ("CubicSDEDisk-v0", {"dt": 0.02}, "dt"),
        ("CubicSDEDisk-v0", {"noise": 0.5}, "model"),
        ("CubicSDEDisk-v0", {"barrier": {"radius": 0.5}}, "barriers"),
    ],
)
def test_what_has_to_fit_is_named(env_id, options, named):
    problem, parts = problem_of(f"safe_envs/{env_id}", **options), {"dt", "model", "barriers"}
    with pytest.raises(LearnedFileError, match=f"its {named}"):
        SIGNATURE.require(problem, named)
    if named in parts:
        SIGNATURE.require(problem, *(parts - {named}))
    with pytest.raises(LearnedFileError, match="its state units"):
        replace(SIGNATURE, state_units=("m", "m")).require(DISK)


def test_data_are_no_model(tmp_path):
    save(tmp_path / "data.npz", "transitions", SIGNATURE, DETAILS, ARRAYS)
    for method in (None, "bayesian"):
        with pytest.raises(LearnedFileError, match=r"data\.npz holds transitions"):
            load_learned(tmp_path / "data.npz", DISK, method)
    with pytest.raises(LearnedFileError, match="empty"):
        load_learned("", DISK)


def test_the_plant_is_kept_and_compared_but_not_required(tmp_path):
    other = problem_of("safe_envs/CubicSDEDisk-v0", plant={"a": 0.8})
    signature = Signature.of(other)
    signature.require(DISK, "model", "barriers", "dt")
    save(tmp_path / "model.npz", "regression", signature, DETAILS, ARRAYS)
    kept = load(tmp_path / "model.npz").signature
    assert kept == signature
    assert kept.differences(DISK) == ("a = 0.8 (here 0.6)",)
    assert kept.differences(other) == replace(kept, plant=()).differences(DISK) == ()


# Written to do harm.


json_values = st.sampled_from([None, True, 0, 1, -1, 2, 3.5, 1e300, 1e-300, 10**400, 10**9])
json_values |= st.sampled_from(["", "x", [], [1], {}, {"a": 1}, [[1, 2]]])
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
    save(path, "regression", SIGNATURE, DETAILS, ARRAYS)
    return path.read_bytes()


@hypothesis.settings(max_examples=50)
@hypothesis.given(st.data())
def test_a_damaged_file_is_the_same_or_refused(whole, data):
    content = loaded(damaged_by(data, whole))
    if content is not None:
        found = (content.kind, content.signature, content.details)
        assert found == ("regression", SIGNATURE, DETAILS)
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


def places(document: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Of all that a JSON document holds."""
    inner = enumerate(document) if isinstance(document, list) else ()
    inner = document.items() if isinstance(document, dict) else inner
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
    header = {"format": 2, "kind": model.method, **document, "versions": {}}
    text = json.dumps(header | {"sha256": digest.hexdigest()}).encode()
    path.write_bytes(archive_of({**arrays, "header": np.frombuffer(text, dtype=np.uint8)}))


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
def test_each_model_is_saved_as_it_is_and_loaded_again(request, tmp_path, what, env, filter_name):
    model, problem = (request.getfixturevalue(name) for name in (what, env))
    model.save(tmp_path / "saved.npz")
    write(tmp_path / "written.npz", model, document_of(model), model.arrays())
    for name in ("saved", "written"):
        again = load_learned(tmp_path / f"{name}.npz", problem)
        assert again.sha256 == model.sha256
        assert again.record == model.record
        for part, array in model.arrays().items():
            np.testing.assert_array_equal(again.arrays()[part], array)
    with pytest.raises(LearnedFileError, match="another problem"):
        load_learned(tmp_path / "saved.npz", problem_of("safe_envs/Scalar-v0"))


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
        safety_filter = SafetyFilter.for_problem(problem, conditions)
        state, proposed = np.full(problem.plant.n, 0.1), np.zeros(problem.plant.m)
        action = safety_filter.filter(state, proposed).action
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
