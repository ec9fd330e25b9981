"""What a training goes on from: all of it, nothing that runs code, nothing of another size, and
nothing half written."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import zipfile
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import ConfigurationError
from safe_envs.agents.training.trainer import train
from tests.agents.training.small import SCALAR, evaluations, outcome, stopped, training
from tests.oracles.full_disk import no_file_larger_than

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a training that is not finished, with everything that a checkpoint can have."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    stopped(WHOLE, folder)
    return folder


WHOLE = training("sac", {"normalize": True})


@pytest.fixture
def copied(run, tmp_path):
    shutil.copytree(run, tmp_path / "copy")
    (checkpoint,) = (tmp_path / "copy").glob("checkpoint_*")
    return tmp_path / "copy", checkpoint


class Trap:
    """Leaves a trace where it is unpickled."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return open, (str(self.trace), "w")


READ = ("state.json", "learner.safetensors", "replay_buffer.safetensors", "envs.safetensors")
"""Of a checkpoint."""

TEXTS = ("config.json", "evaluations.json", "progress.jsonl")
"""Of the folder, read too."""


@pytest.fixture
def trap(tmp_path):
    """A pickle that leaves a trace where it is loaded, and the trace."""
    content, trace = pickle.dumps(Trap(tmp_path / "trace")), tmp_path / "trace"
    pickle.loads(content).close()
    trace.unlink()  # so it is there, or this would be no trap
    return content, trace


def test_code_in_what_is_for_others_or_of_old_checkpoints_is_not_run(copied, trap):
    (folder, checkpoint), (content, trace) = copied, trap
    for place in (folder, checkpoint, folder / "best"):
        for path in place.iterdir():
            if path.is_file() and path.name not in (*READ, *TEXTS):
                path.write_bytes(content)
        for name in ("replay_buffer.pkl", "normalization.pkl"):
            (place / name).write_bytes(content)
        with zipfile.ZipFile(place / "model.zip", "w") as archive:
            for entry in ("data", "policy.pth", "pytorch_variables.pth"):
                archive.writestr(entry, content)
        np.savez(place / "envs.npz", state=np.array([Trap(trace)], dtype=object))
    train(WHOLE, folder, resume=True)
    assert not trace.exists()


@pytest.mark.parametrize("name", [*READ, *TEXTS])
def test_code_in_what_is_read_is_not_run(name, copied, trap):
    (folder, checkpoint), (content, trace) = copied, trap
    (checkpoint / name if name in READ else folder / name).write_bytes(content)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        train(WHOLE, folder, resume=True)
    assert not trace.exists()


@pytest.mark.parametrize("name", READ)
def test_files_that_are_not_there_or_endless_or_too_large_are_refused_before_they_are_read(
    name, copied
):
    folder, checkpoint = copied
    path = checkpoint / name
    for damage, reason in (
        (lambda: None, "No such file"),
        (lambda: path.symlink_to("/dev/zero"), "pipe or a device"),
        (lambda: os.mkfifo(path), "pipe or a device"),
        (lambda: enlarge(path), "larger than"),
    ):
        path.unlink(missing_ok=True)
        damage()
        with pytest.raises(ConfigurationError, match=f"cannot be read .*{reason}"):
            train(WHOLE, folder, resume=True)


def enlarge(path):
    """Make a file that takes no room on the disk, and more than there is in memory."""
    path.touch()
    os.truncate(path, 50_000_000_000)


@settings(max_examples=12)
@given(data=st.data())
def test_an_altered_checkpoint_is_refused_or_a_checkpoint(data, run, tmp_path_factory):
    """Whatever its bytes are: an error of ours, or a training that goes on."""
    folder = tmp_path_factory.mktemp("altered") / "run"
    shutil.copytree(run, folder)
    (checkpoint,) = folder.glob("checkpoint_*")
    path = checkpoint / data.draw(st.sampled_from(READ))
    content = bytearray(path.read_bytes())
    # The headers are at the beginning, and say most.
    place = data.draw(st.integers(0, min(len(content), 4000) - 1))
    length = data.draw(st.integers(0, 8))
    content[place : place + length] = data.draw(st.binary(max_size=8))
    path.write_bytes(content)
    with suppress(ConfigurationError):
        train(WHOLE, folder, resume=True)
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def limited(tmp_path_factory):
    """The folder of a finished training with a limit."""
    folder = tmp_path_factory.mktemp("limited") / "run"
    train(LIMITED, folder)
    return folder


LIMITED = training("ppo-lag", env_id=SCALAR, filter=None)
MISSING = object()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("counters", {"num_timesteps": -4, "_n_updates": 1, "_episode_num": 1}),
        ("counts", {"steps": 1, "violations": 0, "episodes": [["a", "b"]]}),
        ("counts", {"steps": 1, "violations": 0, "episodes": [], "extra": 1}),
        ("buffer", {"pos": 10**9, "full": False}),
        ("buffer", {"pos": 1, "full": False}),
        ("seconds", "long"),
        ("format", 1),
        (None, "[]"),
        ("constraint", None),
        ("constraint", MISSING),
        ("constraint", {"ended": [0.0]}),
        ("constraint", {"multiplier": {"value": 1.0}}),
    ],
)
def test_a_state_of_another_shape_is_refused(name, value, run, limited, tmp_path):
    wanted, source = (LIMITED, limited) if name == "constraint" else (WHOLE, run)
    folder = shutil.copytree(source, tmp_path / "copy")
    (checkpoint,) = folder.glob("checkpoint_*")
    state = json.loads((checkpoint / "state.json").read_text())
    if name == "constraint" and isinstance(value, dict):
        value = state[name] | value
    state |= {name: value}
    if value is MISSING:
        del state[name]
    text = value if name is None else json.dumps(state)
    (checkpoint / "state.json").write_text(text)
    with pytest.raises(ConfigurationError, match=r"cannot be read|another version"):
        train(wanted, folder, resume=True)


@pytest.mark.parametrize(
    "changes",
    [
        None,
        [],
        {"high": MISSING},
        {"saturated": float("inf")},
        {"met": 1},
        {"kind": "speed"},
    ],
)
def test_an_altered_judgement_is_refused(changes, limited, tmp_path):
    folder = shutil.copytree(limited, tmp_path / "copy")
    *rows, last = evaluations(folder)
    altered = changes
    if isinstance(changes, dict):
        altered = {k: v for k, v in (last["constraint"] | changes).items() if v is not MISSING}
    (folder / "evaluations.json").write_text(json.dumps([*rows, last | {"constraint": altered}]))
    with pytest.raises(ConfigurationError, match=r"evaluations\.json"):
        train(LIMITED, folder, resume=True)


@pytest.mark.parametrize(
    "text", ["[1]", "[" * 20_000, '[{"timesteps": 32}]', "null", '[{"timesteps": NaN}]', "\udcff"]
)
@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_another_shape_are_refused(name, text, copied):
    folder, _ = copied
    (folder / name).write_bytes(f"{text}\n".encode(errors="surrogateescape"))
    with pytest.raises(ConfigurationError, match=f"{name} cannot be read"):
        train(WHOLE, folder, resume=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What the training leaves where nothing stops it."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    train(WHOLE, folder)
    return outcome(folder)


@pytest.mark.parametrize("size", [300, 20_000])
def test_a_full_disk_leaves_what_was_there_and_nothing_else(size, whole, copied):
    folder, _ = copied
    for_more = {path.name for path in folder.iterdir()} | {"policy.npz"}
    with (
        no_file_larger_than(size),
        pytest.raises(ConfigurationError, match=r"cannot write .*File too large"),
    ):
        train(WHOLE, folder, resume=True)
    assert {path.name for path in folder.iterdir()} <= for_more
    train(WHOLE, folder, resume=True)
    assert outcome(folder) == whole


def test_a_full_disk_at_the_beginning_leaves_the_folder_to_others(tmp_path):
    with no_file_larger_than(0), pytest.raises(ConfigurationError, match="cannot write"):
        train(training(), tmp_path / "run")
    train(training("a2c"), tmp_path / "run")


def test_two_trainings_do_not_write_to_one_folder(tmp_path):
    told = []

    def begin_another(part):
        if not told:
            for resume in (False, True):
                with pytest.raises(
                    ConfigurationError, match=r"another training is writing to .*run just now; wait"
                ):
                    train(training(), tmp_path / "run", resume=resume)
        told.append(part)

    train(training(), tmp_path / "run", progress=begin_another)
    assert told
    assert not (tmp_path / "run" / ".lock").exists()


def test_a_training_that_was_killed_holds_its_folder_no_more(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / ".checkpoint_000000000096").mkdir()
    lock = tmp_path / "run" / ".lock"
    code = "import sys, time\nfrom pathlib import Path\nfrom safe_envs.files import locked\n"
    code += "with locked(Path(sys.argv[1]), ''):\n    print('held', flush=True)\n    time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(lock)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    with pytest.raises(ConfigurationError, match="another training"):
        train(WHOLE, tmp_path / "run", resume=True)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert lock.exists()
    train(WHOLE, tmp_path / "run", resume=True)
    assert not [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]
