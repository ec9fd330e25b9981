"""Files of logs that strangers wrote: refused with a reason, never run, never too large."""

from __future__ import annotations

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError, DecisionLog
from safe_envs.filters import decision_log
from safe_envs.filters.decision_log import LogColumns

HEADINGS = LogColumns.of(("x",), ("u",), ("h",)).headings
TOP = ",".join(HEADINGS)
LINE = "0.0,1,1,1,-2,2,0.5,0,0,1,-1"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "columns"),
        ("t [s],x\n0,1\n", "columns"),
        (TOP.replace("state:x", "world:x") + f"\n{LINE}\n", "world:x"),
        (TOP.replace("state:x", "slack:x") + f"\n{LINE}\n", "in their order"),
        (f"{TOP}\n{LINE},5\n", "12 numbers in a line with 11"),
        (f"{TOP}\n{LINE}\n1,2\n", "columns changed"),
        (f"{TOP}\n{LINE.replace('1,1,1', '1,a,1')}\n", "could not convert"),
        (f"{TOP}\n{LINE.replace('0.0', 'nan', 1)}\n", "not finite"),
        (f"{TOP}\n{LINE.replace('0,1,-1', '0,2,-1')}\n", "neither 0 nor 1"),
        (f"{TOP}\n{LINE.replace('0,1,-1', '0,1,1')}\n", "none of its barriers"),
        (f"{TOP}\n\n{LINE}\n", "empty line"),
        (f"{TOP}\n{LINE}\n{LINE.replace('0.0', '-1.0', 1)}\n", "time goes back in it, after 0 s"),
        (f"{TOP.replace('h:h', 'h:h,h:h')}\n", "'h:h' twice"),
        (",".join(["t [s]"] * 2000), "1000 are the most"),
        ("x" * 200_000, "field limit"),
        ("\x00\xff", "holds no log"),
    ],
)
def test_a_text_that_is_no_log_is_refused(tmp_path, text, reason):
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigurationError, match=reason) as refused:
        DecisionLog.read(path)
    assert "DecisionLog.to_csv" in str(refused.value)


def test_the_line_of_these_tests_is_a_log(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(f"{TOP}\n{LINE}\n")
    assert len(DecisionLog.read(path)) == 1


def table(**changed):
    values = dict(zip(HEADINGS, map(float, LINE.split(",")), strict=True))
    return pa.table({name: [value] for name, value in (values | changed).items()})


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (table(cause="text"), "no numbers"),
        (table(cause=None), "no numbers"),
        (table(**{"t [s]": [0.0]}), "no numbers"),
        (pa.table({"a": [1.0]}), "columns"),
        (table(cause=5.0), "none of its barriers"),
        (pa.table({name: pa.array([None], pa.float64()) for name in HEADINGS}), "missing"),
    ],
)
def test_a_table_that_is_no_log_is_refused(tmp_path, given, reason):
    path = tmp_path / "log.parquet"
    pq.write_table(given, path)
    with pytest.raises(ConfigurationError, match=reason):
        DecisionLog.read(path)


def test_a_small_file_of_a_large_table_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table({name: pa.array([0.0] * 10_000) for name in HEADINGS}), path)
    monkeypatch.setattr(decision_log, "MOST_BYTES", 100_000)
    assert path.stat().st_size < 100_000
    with pytest.raises(ConfigurationError, match="the largest that is read"):
        DecisionLog.read(path)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "broken.parquet").write_bytes(b"PAR1 and no more")
    (tmp_path / "folder.csv").mkdir()
    for name, reason in (
        ("broken.parquet", "no Parquet"),
        ("folder.csv", "cannot be read"),
        ("none.csv", "cannot be read"),
        ("log.npz", "neither FILE.csv nor FILE.parquet"),
    ):
        with pytest.raises(ConfigurationError, match=reason):
            DecisionLog.read(tmp_path / name)


def test_without_pyarrow_the_message_names_the_extra(tmp_path, monkeypatch):
    log = DecisionLog(LogColumns.read(HEADINGS))
    monkeypatch.setattr(decision_log, "find_spec", lambda name: None)
    (tmp_path / "there.parquet").write_bytes(b"")
    with pytest.raises(ConfigurationError, match=r"\.\[sweep\].*CSV"):
        log.to_parquet(tmp_path / "log.parquet")
    with pytest.raises(ConfigurationError, match=r"\.\[sweep\]"):
        DecisionLog.read(tmp_path / "there.parquet")


def test_a_failed_writing_leaves_the_file_before(tmp_path, monkeypatch):
    log = DecisionLog(LogColumns.read(HEADINGS))
    log.append([float(entry) for entry in LINE.split(",")])
    path = tmp_path / "log.csv"
    path.write_text("before")
    monkeypatch.setattr(decision_log.csv, "writer", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        log.to_csv(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
