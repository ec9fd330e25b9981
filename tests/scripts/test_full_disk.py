"""Commands on a full disk: status 2, a line that says so, earlier results, and nothing else."""

from __future__ import annotations

import pytest
import yaml

from safe_envs.scripts.options import console
from tests.oracles.full_disk import no_file_larger_than

pytestmark = pytest.mark.slow

SCALAR = ("Scalar-v0", "--horizon", 0.2, "--episodes", 5)
TRAINED = "Scalar-v0 --algo ppo --n-timesteps 64 --num-envs 2 --eval-episodes 2 --set n_steps=16"


@pytest.mark.parametrize(
    ("arguments", "written", "size"),
    [
        (("evaluate", *SCALAR, "--json", "a.json"), "a.json", 300),
        # ffmpeg writes all of such a short film at its end.
        (("render", "Scalar-v0", "--horizon", 0.1, "--out", "a.mp4"), "a.mp4", 300),
        (("sweep", "s.yaml", "--out", "swept", "--jobs", 1), "swept/cells", 300),
        (("train", TRAINED, "--out", "run"), "run/checkpoint_000000000032", 2000),
        (("train", TRAINED, "--out", "run"), "run/config.json", 0),
    ],
)
def test_commands_on_a_full_disk(arguments, written, size, safe_envs_command, tmp_path):
    (tmp_path / "s.yaml").write_text(
        yaml.safe_dump(
            {"fixed": {"env": "Scalar-v0", "filter": "none", "episodes": 5, "horizon": 0.2}}
        )
    )
    (tmp_path / "a.json").write_text("before")
    for suffix in ("png", "npz", "mp4", "gif"):
        (tmp_path / f"a.{suffix}").write_text("before")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with no_file_larger_than(size):
        status, out, err = safe_envs_command(*arguments)
    assert (status, "Traceback" in out + err) == (2, False)
    assert f"Error: cannot write {written}" in " ".join(err.split())
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
    rests = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} - set(before)
    assert rests <= {
        "swept",
        "swept/cells",
        "swept/sweep.json",
        "run",
        "run/config.json",
        "run/progress.jsonl",
    }


@pytest.mark.parametrize("length", [10, 100_000])
def test_an_output_that_takes_nothing(length, monkeypatch, capsys):
    """In the buffer of the output or beyond it."""
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        with pytest.raises(SystemExit) as ended:
            console.run(lambda: print("a" * length))
    assert ended.value.code == 2
    assert "Error: cannot write the output: No space left on device" in capsys.readouterr().err


def test_a_reader_that_has_read_enough(monkeypatch, capsys):
    def closed():
        raise BrokenPipeError

    with pytest.raises(SystemExit) as ended:
        console.run(closed)
    assert ended.value.code == 1
    assert capsys.readouterr().err == ""
