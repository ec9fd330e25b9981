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
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.trainer import train
from tests.oracles.full_disk import no_file_larger_than

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"
SAC = {
    "learning_starts": 16,
    "batch_size": 16,
    "train_freq": 4,
    "gradient_steps": 1,
    "policy_kwargs": {"net_arch": [8]},
}
PPO = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}}


def training(algorithm="ppo", changes=None, **arguments):
    """Two parts of a few steps; episodes of 10 steps do not end where they do."""
    known = {"ppo": PPO, "ppo-lag": PPO, "a2c": {"policy_kwargs": {"net_arch": [8]}}}.get(
        algorithm, SAC
    )
    given = {
        "filter": "scbf",
        "num_envs": 2,
        "n_timesteps": 96,
        "eval_freq": 32,
        "eval_episodes": 2,
        "options": {"horizon": 0.5},
    }
    return Training.of(DUBINS, algorithm, settings=known | (changes or {}), **given | arguments)


def stopped(wanted, folder, steps=64):
    """Train up to a checkpoint, and some steps more."""

    def stop(part):
        if part * wanted.n_timesteps > steps:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(wanted, folder, progress=stop)
    (checkpoint,) = folder.glob("checkpoint_*")
    return checkpoint


def outcome(folder):
    """All that a training leaves but for the clock."""
    lines = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    logged = [{k: v for k, v in line.items() if not k.startswith("time/")} for line in lines]
    return (
        logged,
        json.loads((folder / "evaluations.json").read_text()),
        (folder / "policy.npz").read_bytes(),
    )


@pytest.mark.parametrize(
    ("algorithm", "changes", "arguments"),
    [
        ("ppo", {"normalize": True}, {}),
        ("ppo", {"normalize": {"norm_obs": False}, "stats_window_size": 3}, {"filter": None}),
        ("a2c", {"use_sde": True}, {}),
        ("sac", {"normalize": True}, {"action": "both", "intervention_penalty": 0.1}),
        ("sac", {"n_steps": 3, "buffer_size": 40}, {}),
        (
            "sac",
            {
                "optimize_memory_usage": True,
                "replay_buffer_kwargs": {"handle_timeout_termination": False},
                "ent_coef": 0.1,
            },
            {"filter": None},
        ),
        (
            "td3",
            {
                "noise_type": "ornstein-uhlenbeck",
                "noise_std": 0.3,
                "policy_kwargs": {"optimizer_kwargs": {"amsgrad": True}},
            },
            {},
        ),
        ("ppo-lag", {"normalize": True}, {"filter": None}),
        ("ppo-lag", {"use_sde": True, "multiplier_smoothing": 0.5}, {"cost_limit": 0.5}),
    ],
    ids=[
        "normalised",
        "rewards-normalised",
        "gsde",
        "both-actions",
        "n-step-full-buffer",
        "small-memory",
        "noise",
        "violation-limit",
        "cost-limit",
    ],
)
def test_a_stopped_training_ends_as_one_that_was_not(algorithm, changes, arguments, tmp_path):
    wanted = training(algorithm, changes, **arguments)
    train(wanted, tmp_path / "whole")
    stopped(wanted, tmp_path / "run")
    train(wanted, tmp_path / "run", resume=True)
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")


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


def test_a_checkpoint_with_a_pickle_is_of_another_version(copied):
    folder, checkpoint = copied
    (checkpoint / "state.json").write_text('{"timesteps": 64, "counts": {}, "seconds": 1.0}')
    with pytest.raises(ConfigurationError, match="written by another version"):
        train(WHOLE, folder, resume=True)


def test_a_state_that_is_a_list_is_refused_in_words(copied):
    folder, checkpoint = copied
    (checkpoint / "state.json").write_text("[]")
    with pytest.raises(ConfigurationError, match=r"state.json holds no names with values"):
        train(WHOLE, folder, resume=True)


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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("counters", {"num_timesteps": -4, "_n_updates": 1, "_episode_num": 1}),
        ("counters", {"num_timesteps": 64}),
        ("counts", {"steps": 1, "violations": 0, "episodes": [["a", "b"]]}),
        ("counts", {"steps": 1, "violations": 0, "episodes": [], "extra": 1}),
        ("counts", []),
        ("buffer", {"pos": 10**9, "full": False}),
        ("buffer", {"pos": 1, "full": False}),
        ("buffer", None),
        ("seconds", "long"),
    ],
)
def test_a_state_of_another_shape_is_refused(name, value, copied):
    folder, checkpoint = copied
    state = json.loads((checkpoint / "state.json").read_text())
    (checkpoint / "state.json").write_text(json.dumps({**state, name: value}))
    with pytest.raises(ConfigurationError, match="cannot be read"):
        train(WHOLE, folder, resume=True)


@pytest.mark.parametrize(
    "text", ["[1]", "[" * 20_000, '[{"timesteps": 32}]', "null", '[{"timesteps": "a"}]', "\udcff"]
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


@pytest.mark.parametrize("size", [0, 300, 3000, 20_000])
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
