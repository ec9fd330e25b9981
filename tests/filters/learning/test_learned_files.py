"""Files of learned models and data: kept exactly, refused where they are not what was written."""

from __future__ import annotations

import json
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning import load_learned
from safe_envs.filters.learning.data import LearnedFileError, Signature, load, save
from safe_envs.registry import make_problem

DISK = make_problem("safe_envs/CubicSDEDisk-v0")
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


def test_the_order_in_memory_does_not_matter(path):
    before = load(path).sha256
    save(
        path,
        "regression",
        SIGNATURE,
        DETAILS,
        {name: np.asfortranarray(array) for name, array in ARRAYS.items()},
    )
    assert load(path).sha256 == before


def test_the_checksum_is_of_everything(path):
    known = {load(path).sha256}
    for kind, signature, details, arrays in (
        ("network", SIGNATURE, DETAILS, ARRAYS),
        ("regression", replace(SIGNATURE, dt=0.02), DETAILS, ARRAYS),
        ("regression", SIGNATURE, {**DETAILS, "degree": 4}, ARRAYS),
        ("regression", SIGNATURE, DETAILS, {**ARRAYS, "weights": ARRAYS["weights"].T}),
        (
            "regression",
            SIGNATURE,
            DETAILS,
            {**ARRAYS, "weights": ARRAYS["weights"].astype(np.float32)},
        ),
        ("regression", SIGNATURE, DETAILS, {"w": ARRAYS["weights"], "count": ARRAYS["count"]}),
    ):
        save(path, kind, signature, details, arrays)
        known.add(load(path).sha256)
    assert len(known) == 7


@pytest.mark.parametrize("left", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(path, left):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(left * len(whole))])
    with pytest.raises(LearnedFileError, match="it is truncated or altered"):
        load(path)


def test_an_altered_byte_is_refused(path):
    whole = path.read_bytes()
    place = whole.index(ARRAYS["weights"].tobytes()) + 100
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    with pytest.raises(LearnedFileError, match="no file of `safe-envs identify`"):
        load(path)


def test_altered_arrays_under_the_old_header_are_refused(path):
    arrays = archived(path)
    weights = arrays["weights"].copy()
    weights[3, 2] += 1e-12
    for changed in (
        {**arrays, "weights": weights},
        {**arrays, "more": np.zeros(1)},
        {k: v for k, v in arrays.items() if k != "count"},
    ):
        np.savez(path, **changed)
        with pytest.raises(LearnedFileError, match="was altered"):
            load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "network"},
        {"details": {}},
        {"sha256": "0" * 64},
        {"signature": {**asdict(SIGNATURE), "system": "Scalar"}},
    ],
)
def test_an_altered_header_is_refused(path, changes):
    with_header(path, **changes)
    with pytest.raises(LearnedFileError, match="was altered"):
        load(path)


@pytest.mark.parametrize("signature", [{}, {**asdict(SIGNATURE), "color": "red"}, [1, 2], None])
def test_a_header_without_a_signature_is_refused(path, signature):
    with_header(path, signature=signature)
    with pytest.raises(LearnedFileError, match="no file of `safe-envs identify`"):
        load(path)


def test_a_later_format_is_refused(path):
    with_header(path, format=99)
    with pytest.raises(LearnedFileError, match="has the format 99; this version reads 2"):
        load(path)


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(LearnedFileError, match="does not exist"):
        load(tmp_path / "none.npz")
    with pytest.raises(LearnedFileError, match="is a folder; name a file in it"):
        load(tmp_path)
    with pytest.raises(LearnedFileError, match="path of a learned model is empty"):
        load_learned("", DISK)


def test_what_is_no_npz_is_refused(tmp_path):
    path = tmp_path / "model.npz"
    for content in (b"", b"weights: 1, 2, 3\n", pickle.dumps({"weights": [1.0]})):
        path.write_bytes(content)
        with pytest.raises(LearnedFileError, match="no file of `safe-envs identify`"):
            load(path)
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(LearnedFileError, match="no file of `safe-envs identify`"):
        load(path)
    np.savez(path, weights=np.zeros(3))
    with pytest.raises(LearnedFileError, match="no file of `safe-envs identify`"):
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


def test_objects_are_not_saved(path):
    whole = path.read_bytes()
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        save(path, "regression", SIGNATURE, {}, {"weights": np.array([Trap()], dtype=object)})
    assert path.read_bytes() == whole
    assert list(path.parent.iterdir()) == [path]


def test_a_folder_that_does_not_exist_is_an_error(tmp_path):
    with pytest.raises(ConfigurationError, match="does not exist"):
        save(tmp_path / "none" / "model.npz", "regression", SIGNATURE, {}, ARRAYS)


def test_another_system_is_refused():
    with pytest.raises(
        LearnedFileError, match="its system: CubicSDEDisk, that of Scalar: Scalar; learn again"
    ):
        SIGNATURE.require(make_problem("safe_envs/Scalar-v0"))
    with pytest.raises(LearnedFileError, match="its state units"):
        replace(SIGNATURE, state_units=("m", "m")).require(DISK)


def test_what_else_has_to_fit():
    slower = make_problem("safe_envs/CubicSDEDisk-v0", dt=0.02)
    SIGNATURE.require(slower, "barriers", "model")
    with pytest.raises(LearnedFileError, match=r"its dt: 0\.01, that of CubicSDEDisk: 0\.02"):
        SIGNATURE.require(slower, "dt")
    noisier = make_problem("safe_envs/CubicSDEDisk-v0", noise=0.5)
    SIGNATURE.require(noisier, "barriers", "dt")
    with pytest.raises(LearnedFileError, match="its model"):
        SIGNATURE.require(noisier, "model")
    smaller = make_problem("safe_envs/CubicSDEDisk-v0", barrier={"radius": 0.5})
    SIGNATURE.require(smaller, "model", "dt")
    with pytest.raises(LearnedFileError, match="its barriers"):
        SIGNATURE.require(smaller, "barriers")


def test_data_are_no_model(tmp_path):
    save(tmp_path / "data.npz", "transitions", SIGNATURE, DETAILS, ARRAYS)
    for method in (None, "bayesian"):
        with pytest.raises(
            LearnedFileError,
            match=r"data\.npz holds transitions \(data\), no model; `safe-envs identify --data",
        ):
            load_learned(tmp_path / "data.npz", DISK, method)


def test_the_plant_is_kept_and_compared_but_not_required(tmp_path):
    other = make_problem("safe_envs/CubicSDEDisk-v0", plant={"a": 0.8})
    signature = Signature.of(other)
    signature.require(DISK, "model", "barriers", "dt")
    save(tmp_path / "model.npz", "regression", signature, DETAILS, ARRAYS)
    kept = load(tmp_path / "model.npz").signature
    assert kept == signature
    assert kept.differences(DISK) == ("a = 0.8 (here 0.6)",)
    assert kept.differences(other) == replace(kept, plant=()).differences(DISK) == ()


def test_numbers_of_numpy_are_kept_as_such(path):
    save(path, "regression", SIGNATURE, {"degree": np.int64(3), "scale": np.float64(0.1)}, ARRAYS)
    assert load(path).details == {"degree": 3, "scale": 0.1}
    with pytest.raises(TypeError, match="no JSON"):
        save(path, "regression", SIGNATURE, {"degree": object()}, ARRAYS)
