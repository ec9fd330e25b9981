"""One-step data: what is accepted, what is refused, and how they are divided and kept."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from safe_envs.errors import ConfigurationError, InvalidInputError
from safe_envs.filters.learning import data
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.data import LearnedFileError, Signature, Transitions
from safe_envs.registry import make_problem

DISK = make_problem("safe_envs/CubicSDEDisk-v0")
SIGNATURE = Signature.of(DISK)


def logged(**changes):
    """Three steps, each repeated twice."""
    data = {
        "x": [[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]],
        "u": [[1.0], [-1.0], [1.0]],
        "successors": np.arange(12.0).reshape(3, 2, 2),
        "dt": 0.01,
    }
    return Transitions(SIGNATURE, **{**data, **changes})


def assert_same(one, other):
    for name in ("x", "u", "successors", "dt"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert (one.signature, one.seed) == (other.signature, other.seed)


def test_sizes_and_time():
    data = logged(dt=[0.01, 0.02, 0.03])
    assert (data.points, data.repetitions, data.count) == (3, 2, 6)
    assert data.observed == pytest.approx(0.12)
    assert data.x.dtype == data.u.dtype == data.successors.dtype == float
    np.testing.assert_array_equal(logged().dt, [0.01] * 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": [[0.0], [0.2], [0.4]]}, r"x \(3, 1\).*give x \(P, 2\)"),
        ({"x": [0.0, 0.2]}, r"x \(2,\)"),
        ({"u": [[1.0], [1.0]]}, r"u \(2, 1\)"),
        ({"successors": np.ones((3, 2))}, r"successors \(3, 2\).*give .*\(P, K, 2\)"),
        ({"dt": [0.01, 0.01]}, r"dt \(2,\)"),
        (
            {"x": np.empty((0, 2)), "u": np.empty((0, 1)), "successors": np.empty((0, 2, 2))},
            "there are no data",
        ),
        ({"successors": np.empty((3, 0, 2))}, "there are no data"),
        ({"x": [[0.0, 0.1], [0.2]]}, "x is no array of numbers"),
        ({"u": [["fast"], [1.0], [1.0]]}, "u is no array of numbers"),
        (
            {"x": np.ma.masked_greater([[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]], 0.45)},
            "x has masked entries",
        ),
        (
            {"x": list(np.ma.masked_greater([[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]], 0.45))},
            "x has masked entries",
        ),
        ({"u": np.array([[1.0], [1j], [1.0]])}, "u is complex; give real numbers"),
        ({"u": [[1.0], [1j], [1.0]]}, "u is complex"),
        ({"x": [[0.0, 0.1], [0.2, np.nan], [0.4, 0.5]]}, r"x\[1, 1\] = nan, one of 1 entries"),
        (
            {"successors": np.full((3, 2, 2), np.inf)},
            r"successors\[0, 0, 0\] = inf, one of 12 entries",
        ),
        ({"dt": 0.0}, r"dt\[0\] = 0.0 s; a step needs a positive duration"),
        ({"dt": [0.01, -0.01, 0.01]}, r"dt\[1\] = -0.01 s"),
    ],
)
def test_what_is_no_data_is_refused(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        logged(**changes)


def test_seed_is_a_whole_number_or_none():
    assert logged(seed=None).seed is None
    with pytest.raises(ConfigurationError, match="seed = -1"):
        logged(seed=-1)


def test_copied_rows_are_refused():
    x, u, successors = (
        [[0.0, 0.1], [0.2, 0.3], [0.0, 0.1]],
        [[1.0]] * 3,
        np.arange(12.0).reshape(3, 2, 2),
    )
    successors[2] = successors[0]
    with pytest.raises(InvalidInputError, match=r"rows 0 and 2 are the same.*drop the copies"):
        logged(x=x, u=u, successors=successors)
    # Another input, another duration, or another second successor is another row.
    assert logged(x=x, successors=successors, u=[[1.0], [1.0], [-1.0]]).points == 3
    assert logged(x=x, successors=successors, u=u, dt=[0.01, 0.01, 0.02]).points == 3
    successors[2, 1, 1] += 1e-9
    assert logged(x=x, u=u, successors=successors).points == 3


def test_repetitions_may_agree_without_noise():
    assert logged(successors=np.repeat(np.arange(6.0).reshape(3, 1, 2), 4, axis=1)).repetitions == 4


def test_a_log_equals_collected_data():
    data = collect(DISK, 20, seed=3)
    log = Transitions.from_log(
        DISK, data.x.tolist(), data.u.tolist(), data.successors[:, 0].tolist(), DISK.dt
    )
    # Of which plant a log is, nobody knows.
    data = replace(data, seed=None, signature=replace(data.signature, plant=()))
    assert_same(data, log)
    assert_same(
        Transitions.from_log(SIGNATURE, data.x, data.u, data.successors[:, 0], data.dt), log
    )


def test_a_log_has_no_repetitions():
    with pytest.raises(InvalidInputError, match=r"\(3, 2, 2\); give \(P, 2\)"):
        Transitions.from_log(DISK, logged().x, logged().u, logged().successors, 0.01)


def test_split_keeps_rows_of_one_state_together():
    data = collect(DISK, 30, repetitions=2, inputs=[(-1.0,), (0.0,), (1.0,)])
    rest, held = data.split(0.2, np.random.default_rng(0))
    assert (rest.points, held.points) == (24 * 3, 6 * 3)
    assert not {row.tobytes() for row in rest.x} & {row.tobytes() for row in held.x}
    # Nothing is lost, and what is left keeps its order.
    position = {row.tobytes(): i for i, row in enumerate(data.successors)}
    found = [[position[row.tobytes()] for row in part.successors] for part in (rest, held)]
    assert all(rows == sorted(rows) for rows in found)
    assert sorted(found[0] + found[1]) == list(range(90))
    assert_same(held, data.split(0.2, np.random.default_rng(0))[1])


def test_split_leaves_both_parts_something():
    two = collect(DISK, 2)
    for share in (1e-6, 1.0 - 1e-6):
        assert [part.points for part in two.split(share, np.random.default_rng(0))] == [2, 2]
    with pytest.raises(InvalidInputError, match="two states at least"):
        collect(DISK, 1).split(0.5, np.random.default_rng(0))
    with pytest.raises(ConfigurationError, match=r"share = 1\.0"):
        two.split(1.0, np.random.default_rng(0))


def test_saved_and_loaded(tmp_path):
    for kept in (collect(DISK, 5, repetitions=3, seed=8), logged()):
        kept.save(tmp_path / "data.npz")
        assert_same(Transitions.load(tmp_path / "data.npz"), kept)


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "data.npz"
    data.save(path, "network", SIGNATURE, {}, {"x": np.zeros(2)})
    with pytest.raises(LearnedFileError, match="holds 'network', not 'transitions'"):
        Transitions.load(path)
    data.save(path, "transitions", SIGNATURE, {"seed": 0}, {"x": np.zeros((1, 2))})
    with pytest.raises(LearnedFileError, match="incomplete: 'u'"):
        Transitions.load(path)
    arrays = {
        "x": np.zeros((1, 3)),
        "u": np.zeros((1, 1)),
        "successors": np.zeros((1, 1, 3)),
        "dt": np.ones(1),
    }
    data.save(path, "transitions", SIGNATURE, {"seed": 0}, arrays)
    with pytest.raises(LearnedFileError, match="the shapes do not fit"):
        Transitions.load(path)


def test_a_saved_file_is_plain_numbers(tmp_path):
    logged().save(tmp_path / "data.npz")
    with np.load(tmp_path / "data.npz", allow_pickle=False) as archive:
        assert set(archive.files) == {"header", "x", "u", "successors", "dt"}
        assert json.loads(archive["header"].tobytes())["details"] == {"seed": None}


def test_masks_that_hide_nothing_are_let_through():
    assert logged(u=np.ma.masked_invalid([[1.0], [-1.0], [1.0]])).points == 3


def test_what_data_are_of_is_a_problem_or_a_signature(tmp_path):
    for source in ("safe_envs/CubicSDEDisk-v0", None):
        with pytest.raises(ConfigurationError, match="give a SafetyProblem"):
            Transitions.from_log(source, logged().x, logged().u, logged().x, 0.01)
    with pytest.raises(ConfigurationError, match=r"signature = .* give a Signature"):
        Transitions("CubicSDEDisk", logged().x, logged().u, logged().successors, 0.01)


def test_data_of_another_problem_are_told_from_models():
    logged().require(DISK)
    with pytest.raises(
        LearnedFileError,
        match="the data are of another problem: its system: CubicSDEDisk, that of Scalar",
    ):
        logged().require(make_problem("safe_envs/Scalar-v0"))


def test_a_seed_of_numpy_is_kept(tmp_path):
    logged(seed=np.int64(5)).save(tmp_path / "data.npz")
    assert Transitions.load(tmp_path / "data.npz").seed == 5
