"""The `safe-envs` command as a person types it."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

import safe_envs
from agents import evaluate, load_problem
from scripts import cli
from scripts.table import print_evaluation
from tests.scripts.conftest import strictly

ROOT = Path(__file__).parents[2]
DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", "8", "--horizon", "0.3")
ROW_KEYS = [
    "filter",
    "policy",
    "episodes",
    "safe",
    "safety_rate",
    "ci_low",
    "ci_high",
    "min_h_median",
    "min_h_p05",
    "violations",
    "intervention_rate",
    "infeasible_rate",
    "effort_mean",
    "return_mean",
    "curve",
    "bound",
    "bound_note",
    "certificate",
    "outside_rate",
    "learning",
]


def without_speed(text):
    """A printed table without its last column."""
    return [line.rpartition("  ")[0].rstrip() for line in text.splitlines() if line and "─" not in line]


def test_list_shows_every_id(safe_envs_command):
    status, out, err = safe_envs_command("list")
    assert (status, err) == (0, "")
    for env_id in safe_envs.ENV_IDS:
        assert env_id in out


def test_help_names_the_commands(safe_envs_command):
    status, out, _ = safe_envs_command("--help")
    assert status == 0
    for command in ("list", "evaluate", "verify", "demo", "benchmark"):
        assert command in out
    for command in ("evaluate", "verify", "demo", "benchmark"):
        assert safe_envs_command(command, "--help")[0] == 0


def test_json_has_the_documented_keys(safe_envs_command):
    status, _, err = safe_envs_command("evaluate", DUBINS, "--filter", "none", "--filter", "hocbf:p=1,2", *QUICK, "--json", "out.json")
    assert (status, err) == (0, "")
    document = strictly("out.json")
    assert list(document) == ["config", "versions", "rows", "comparisons", "timing"]
    assert [list(row) for row in document["rows"]] == [ROW_KEYS, ROW_KEYS]
    assert [row["filter"] for row in document["rows"]] == ["none", "hocbf:p=1,2"]
    assert {row["policy"] for row in document["rows"]} == {"nominal"}
    for row in document["rows"]:
        assert row["episodes"] == 8 == row["safe"] + row["violations"]
        assert 0 <= row["ci_low"] <= row["safety_rate"] <= row["ci_high"] <= 1
        assert row["min_h_p05"] <= row["min_h_median"]
        assert list(row["curve"]) == ["time", "safe", "rate", "ci_low", "ci_high"]
        assert {len(column) for column in row["curve"].values()} == {7}
    (comparison,) = document["comparisons"]
    assert list(comparison) == [
        *("first", "second", "both", "only_first", "only_second", "neither"),
        *("difference", "ci_low", "ci_high", "mcnemar_p"),
    ]
    assert {"safe-envs", "python", "numpy", "gymnasium"} <= set(document["versions"])
    assert document["timing"]["num_envs"] == 1024
    assert [row["filter"] for row in document["timing"]["rows"]] == ["none", "hocbf:p=1,2"]
    assert [p.name for p in Path().iterdir()] == ["out.json"]


def test_json_is_strict_where_no_step_counts(safe_envs_command):
    status, out, _ = safe_envs_command("evaluate", "Scalar-v0", "--start", "1.0", "--noise", "0", *QUICK, "--json", "out.json")
    assert status == 0
    assert "Note: nothing is random here" in out
    for row in strictly("out.json")["rows"]:
        assert row["safe"] == 0
        assert row["effort_mean"] is row["intervention_rate"] is row["infeasible_rate"] is None


def test_all_but_timing_is_the_same_for_every_num_envs(safe_envs_command):
    documents = []
    for num_envs in (1000, 1, 7):
        status, _, _ = safe_envs_command(
            "evaluate", DUBINS, "--policy", "random", *QUICK, "--seed", 4, "--num-envs", num_envs, "--json", f"{num_envs}.json"
        )
        assert status == 0
        documents.append(strictly(f"{num_envs}.json"))
        assert documents[-1].pop("timing")["num_envs"] == num_envs
    assert json.dumps(documents[0]) == json.dumps(documents[1]) == json.dumps(documents[2])


def test_every_option_reaches_the_evaluation(safe_envs_command):
    status, out, _ = safe_envs_command(
        *("evaluate", "StochasticDubins-v0", "--filter", "hocbf", "--policy", "zero", "--episodes", "6", "--seed", "5"),
        *("--noise", ".1,.3", "--plant", "v=1.5", "--model", "v=1.7", "--barrier", "radius=2.5", "--knowledge", "plant"),
        *("--dt", ".02", "--substeps", "2", "--horizon", ".4", "--box", "-3,4", "--start", "-0.5,0,1", "--num-envs", "4"),
        *("--confidence", ".9"),
        *("--json", "out.json"),
    )
    assert status == 0
    options = {
        "noise": [0.1, 0.3],
        "plant": {"v": 1.5},
        "model": {"v": 1.7},
        "barrier": {"radius": 2.5},
        "dt": 0.02,
        "substeps": 2,
        "horizon": 0.4,
        "box": [-3.0, 4.0],
        "start": [-0.5, 0.0, 1.0],
    }
    wanted = evaluate(DUBINS, "zero", ["hocbf"], options=options, episodes=6, seed=5, knowledge="plant", confidence=0.9)
    document = strictly("out.json")
    assert document["rows"] == wanted.rows
    assert document["config"] == json.loads(json.dumps(wanted.config))
    for text in (DUBINS, "policy zero", "6 episodes", "seed 5", "v = 1.5 (model 1.7)", "sigma_1 = 0.1, sigma_2 = 0.3", "dt = 0.02 s"):
        assert text in out
    assert "filters know the plant" in out
    assert "safe [90 % interval]" in out


def test_boxes_for_each_input_and_named_starts(safe_envs_command):
    boxes = [argument for high in (4e4, 5e4, 6e4, 7e4) for argument in ("--box", f"0,{high}")]
    status, *_ = safe_envs_command(
        "evaluate", "Quadrotor-v0", *boxes, "--start", "thesis", "--horizon", ".2", "--episodes", 2, "--json", "out.json"
    )
    assert status == 0
    problem = strictly("out.json")["config"]["problem"]
    assert problem["box"] == [[0.0, 4e4], [0.0, 5e4], [0.0, 6e4], [0.0, 7e4]]
    assert problem["start"] == "thesis"


def test_table_shows_the_rows(safe_envs_command):
    _, out, _ = safe_envs_command("evaluate", DUBINS, "--episodes", 40, "--horizon", 2, "--filter", "none", "--filter", "scbf")
    answer = evaluate(DUBINS, filters=["none", "scbf"], options={"horizon": 2.0}, episodes=40)
    lines = {line.split()[0]: line for line in out.splitlines() if line and line.split()[0] in ("none", "scbf")}
    assert list(lines) == ["none", "scbf"]
    for row in answer.rows:
        line = lines[row["filter"]]
        for shown in (
            f"{100 * row['safety_rate']:.1f} % [{100 * row['ci_low']:.1f}, {100 * row['ci_high']:.1f}]",
            f"{row['min_h_median']:.3g}",
            f" {row['violations']} ",
            f"{row['effort_mean']:.3g}",
            f"{row['return_mean']:.4g}",
        ):
            assert shown in line
    assert f"{100 * answer.rows[1]['intervention_rate']:.1f} %" in lines["scbf"]
    assert "Note: nothing is random" not in out


def test_filters_are_compared_under_the_table(safe_envs_command):
    filters = [argument for name in ("none", "hocbf", "scbf", "hocbf:p=1,1") for argument in ("--filter", name)]
    _, out, _ = safe_envs_command("evaluate", DUBINS, *filters, "--episodes", 200, "--noise", 0.4, "--json", "out.json")
    shown = out.partition("Difference of the safety rates on the same episodes [95 % interval]:\n")[2].partition("\n\n")[0].splitlines()
    comparisons = [c for c in strictly("out.json")["comparisons"] if "none" not in (c["first"], c["second"])]
    assert len(shown) == len(comparisons) == 3
    for line, c in zip(shown, comparisons, strict=True):
        assert f"{c['first']} - {c['second']}: {100 * c['difference']:+.1f} points " in line
        assert f"[{100 * c['ci_low']:.1f}, {100 * c['ci_high']:.1f}], McNemar p " in line
        assert line.endswith(f"(safe with one only: {c['first']} {c['only_first']}, {c['second']} {c['only_second']})")
    assert shown[0].lstrip().startswith("scbf - hocbf: +")
    assert "McNemar p < 1e-10" in shown[0]
    assert "Difference" not in safe_envs_command("evaluate", DUBINS, *QUICK)[1]


def test_all_safe_shows_the_exact_interval(safe_envs_command):
    _, out, _ = safe_envs_command("evaluate", "ACC-v0", "--filter", "scbf", "--episodes", "100", "--horizon", "0.2")
    # Clopper and Pearson's, .025^(1/100) = 96.38 %; Wilson's would begin at 96.3 %.
    assert "100.0 % [96.4, 100.0]" in out


def test_refinement_says_which_rates_have_converged(safe_envs_command):
    arguments = ("evaluate", "ACC-v0", "--filter", "none", "--filter", "scbf", "--episodes", "200", "--horizon", "0.2")
    status, out, err = safe_envs_command(*arguments, "--refine", "--confidence", ".9", "--json", "out.json", "--plot", "out.svg")
    assert (status, err) == (0, "")
    plain, _, refined = out.partition("Refinement: safe [90 % interval]")
    assert "safe [90 % interval]" in plain
    for text in ("dt = 0.05 s", "dt = 0.025 s", "dt = 0.0125 s", "noise that is not coupled", "no further than 3 points"):
        assert text in refined
    row = strictly("out.json")["refinement"]["rows"][1]
    rates = [f"100.0 % [{100 * low:.1f}, 100.0]" for low in row["ci_low"]]
    (line,) = [line for line in refined.splitlines() if line.startswith("scbf")]
    assert line.split() == ["scbf", *" ".join(rates).split()]
    assert f"scbf: converged, +0.0 points [{100 * row['change_low']:.1f}, {100 * row['change_high']:.1f}]" in refined
    few = safe_envs_command(*arguments, "--episodes", "10", "--refine")[1]
    assert "  scbf: not resolved, +0.0 points [-27.8, 27.8]: more episodes are needed" in few
    coarse = ("--dt", ".4", "--horizon", "1.6", "--start", ".5", "--noise", ".8", "--episodes", "2000")
    changing = safe_envs_command("evaluate", "Scalar-v0", "--filter", "none", *coarse, "--refine")[1]
    assert "  none: still changing by -" in changing
    picture = Path("out.svg").read_text()
    assert "dt = 0.05 s" in picture
    assert "90 % band" in picture


def test_bounds_are_shown_where_there_are_any():
    answer = evaluate(DUBINS, filters=["none", "hocbf", "scbf"], options={"horizon": 0.2}, episodes=5)

    def printed(*changes):
        console = Console(width=200, file=io.StringIO())
        rows = [{**row, **change} for row, change in zip(answer.rows, changes, strict=True)]
        print_evaluation(console, replace(answer, rows=rows))
        return console.file.getvalue()

    bounded = printed({}, {"bound": None, "bound_note": "it ignores the noise"}, {"bound": 0.492, "bound_note": ""})
    lines = {line.split()[0]: line for line in bounded.splitlines() if line.startswith(("none", "hocbf", "scbf"))}
    assert "≥ 49.2 %" in lines["scbf"]
    assert "] none " in " ".join(lines["hocbf"].split())
    assert "] - " in " ".join(lines["none"].split())
    assert "Note: no proved bound for hocbf: it ignores the noise\n" in bounded
    assert bounded.count("no proved bound") == 1
    below = printed({}, {}, {"bound": 0.999, "ci_high": 0.98})
    assert "the rate of scbf lies below its proved bound" in below
    assert "lies below" not in bounded


def test_the_plants_mass_saves_the_quadrotor(safe_envs_command):
    for knowledge in ("model", "plant"):
        arguments = ("--filter", "none", "--filter", "hocbf", "--episodes", "12", "--knowledge", knowledge, "--json", f"{knowledge}.json")
        assert safe_envs_command("evaluate", "safe_envs/QuadrotorAltitude-v0", *arguments)[0] == 0
    bare, model = strictly("model.json")["rows"]
    again, plant = strictly("plant.json")["rows"]
    assert bare == again
    assert bare["violations"] == model["violations"] == 12
    assert bare["min_h_median"] < model["min_h_median"] < 0
    assert plant["violations"] == 0
    assert plant["min_h_p05"] > 0


@pytest.mark.parametrize(
    ("env_id", "name", "options"),
    [
        (DUBINS, "a.png", ()),
        (DUBINS, "a.SVG", ("--policy", "random", "--filter", "none", "--filter", "hocbf", "--filter", "scbf")),
        ("DubinsObstacle-v0", "a.png", ()),
        ("Quadrotor-v0", "a.pdf", ()),
        ("ACC-v0", "a.png", ()),
        ("Scalar-v0", "a.jpg", ()),
        # h is the same number throughout: there is no range to draw.
        ("Scalar-v0", "flat.png", ("--noise", "0", "--start", "1")),
    ],
)
def test_plot_writes_a_picture(safe_envs_command, env_id, name, options):
    status, _, err = safe_envs_command("evaluate", env_id, *QUICK, "--plot", name, *options)
    assert (status, err) == (0, "")
    starts = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF", ".jpg": b"\xff\xd8"}
    content = Path(name).read_bytes()
    assert content.startswith(starts[Path(name).suffix.lower()])
    assert len(content) > 5000
    if name == "a.SVG":
        for text in (b"barrier h", b"safe so far", b"pointwise 95 % band", b"none: ", b"hocbf: ", b"scbf: ", b"unsafe"):
            assert text in content
    assert [p.name for p in Path().iterdir()] == [name]


USER_ERRORS = (
    (["safe_envs/StochasticDubin-v0"], ["unknown env 'safe_envs/StochasticDubin-v0'", "did you mean 'safe_envs/StochasticDubins-v0'"]),
    (["CartPole-v1"], ["not one of this project's envs", "safe_envs/DubinsDisk-v0", "`safe-envs evaluate CartPole-v1 --filter-spec"]),
    (["CartPole-v1", "--noise", "1"], ["CartPole-v1"]),
    ([":x"], [":x"]),
    ([DUBINS, "--filter", "hocb"], ["unknown filter 'hocb'", "did you mean 'hocbf'"]),
    ([DUBINS, "--filter", "hocbf:q=1,1"], ["no parameter 'q'", "allowed: p"]),
    ([DUBINS, "--filter", "hocbf:p=a"], ["'a' is not allowed"]),
    ([DUBINS, "--filter", "hocbf:p=-1,1"], ["positive"]),
    ([DUBINS, "--filter", "hocbf:p=1"], ["relative degree 2"]),
    ([DUBINS, "--filter", "scbf:alpha=1"], ["no parameter 'alpha'"]),
    ([DUBINS, "--filter", "ecbf:k=9,1"], ["complex poles"]),
    ([DUBINS, "--filter", "cbf"], ["relative degree 2", "use hocbf or ecbf"]),
    ([DUBINS, "--policy", "nominl"], ["unknown policy 'nominl'", "did you mean 'nominal'"]),
    ([DUBINS, "--policy", "missing.zip"], ["'missing.zip'", "there is no such file"]),
    ([DUBINS, "--policy", __file__], ["not a policy that Stable-Baselines3 saved"]),
    ([DUBINS, "--policy", __file__, "--trust"], ["not a policy that Stable-Baselines3 saved"]),
    ([DUBINS, "--policy", "."], ["policy.safetensors cannot be read: No such file", "`safe-envs train`"]),
    ([DUBINS, "--plant", "vv=1"], ["unknown parameter 'vv'", "did you mean 'v'"]),
    ([DUBINS, "--plant", "v=fast"], ["--plant 'v=fast'", "not a number"]),
    ([DUBINS, "--plant", "v"], ["NAME=VALUE"]),
    ([DUBINS, "--model", "v=inf"], ["parameter v"]),
    ([DUBINS, "--barrier", "raduis=2"], ["no barrier argument 'raduis'", "did you mean 'radius'"]),
    ([DUBINS, "--barrier", "radius=round"], ["radius"]),
    ([DUBINS, "--knowledge", "plan"], ["knowledge = 'plan'", "did you mean 'plant'"]),
    ([DUBINS, "--box", "1"], ["--box '1' has 1 numbers"]),
    ([DUBINS, "--box", "a,b"], ["--box 'a,b'"]),
    ([DUBINS, "--box", "2,1"], ["box of input omega"]),
    ([DUBINS, "--box", "0,1", "--box", "0,1"], ["box = "]),
    ([DUBINS, "--start", "1,2"], ["start has 2 numbers", "x, y, theta"]),
    ([DUBINS, "--start", "inwrd"], ["unknown start 'inwrd'", "did you mean 'inward'"]),
    ([DUBINS, "--start", "99,0,0"], ["outside the workspace"]),
    ([DUBINS, "--noise", "-1"], ["noise = -1"]),
    ([DUBINS, "--noise", "loud"], ["--noise 'loud'"]),
    ([DUBINS, "--noise", "1,2,3"], ["sigma_1, sigma_2"]),
    ([DUBINS, "--episodes", "0"], ["episodes = 0"]),
    ([DUBINS, "--num-envs", "0"], ["num_envs = 0"]),
    ([DUBINS, "--seed", "-1"], ["seed = -1"]),
    ([DUBINS, "--confidence", "1"], ["confidence = 1.0", "above 0 and below 1"]),
    ([DUBINS, "--confidence", "95"], ["confidence = 95.0", "such as 0.95"]),
    ([DUBINS, "--confidence", "nan"], ["confidence = nan"]),
    ([DUBINS, "--filter", "hocbf:p=1,2+scbf"], ["has 2 conditions"]),
    ([DUBINS, "--filter", "hocbf+none"], ["'hocbf+none'", "'none' is the bare env"]),
    ([DUBINS, "--filter", "none+hocbf:p=1,2"], ["'none' is the bare env"]),
    ([DUBINS, "--refine", "--episodes", "0"], ["episodes = 0"]),
    (["Scalar-v0", "--refine", "--dt", "5e-324", "--horizon", "5e-324"], ["dt = 0.0 s", "positive and finite"]),
    ([DUBINS, "--dt", "0"], ["dt = 0"]),
    ([DUBINS, "--horizon", "nan"], ["horizon = nan"]),
    ([DUBINS, "--substeps", "0"], ["substeps = 0"]),
    ([DUBINS, "--json", "nowhere/out.json"], ["cannot write nowhere/out.json", "does not exist"]),
    ([DUBINS, "--json", "."], ["it is a folder"]),
    ([DUBINS, "--json", "out.svg", "--plot", "./out.svg"], ["--plot out.svg would overwrite the file of --json out.svg"]),
    ([DUBINS, "--json", "x.npz", "--learned", "x.npz"], ["would overwrite the file of --learned x.npz"]),
    ([DUBINS, "--json", "x.npz", "--filter", "ddscbf:file=x.npz"], ["would overwrite the file of --filter x.npz"]),
    ([DUBINS, "--json", "ppo.zip", "--policy", "ppo.zip"], ["would overwrite the file of --policy ppo.zip"]),
    ([DUBINS, "--json", "policy.json", "--policy", "."], ["would overwrite the file of --policy policy.json"]),
    ([DUBINS, "--plot", "nowhere/out.png"], ["cannot write nowhere/out.png"]),
    ([DUBINS, "--plot", "out.pong"], ["unknown format 'pong'", "did you mean 'png'"]),
    ([DUBINS, "--plot", "out"], ["unknown format ''"]),
    (["CubicSDE-v0", "--dt", "1e200", "--horizon", "1e202"], ["left the finite numbers"]),
)


@pytest.mark.parametrize(
    ("arguments", "messages"), USER_ERRORS, ids=[" ".join(map(os.path.basename, arguments)) for arguments, _ in USER_ERRORS]
)
def test_errors_of_the_user_end_with_status_2_and_say_why(safe_envs_command, arguments, messages):
    files = [] if "--json" in arguments or "--plot" in arguments else ["--json", "out.json"]
    status, out, err = safe_envs_command("evaluate", *arguments, *files)
    assert status == 2
    assert err.startswith("Error:")
    assert "Traceback" not in out + err
    for message in messages:
        assert message in err
    assert list(Path().iterdir()) == []


@pytest.fixture
def ppo(tmp_path):
    """A folder as `safe-envs train` writes it, with the .zip of an untrained model."""
    import gymnasium as gym
    from stable_baselines3 import PPO

    from agents.weights import save_policy

    model = PPO("MlpPolicy", gym.make(DUBINS), policy_kwargs={"net_arch": [8]}, device="cpu")
    save_policy(model, tmp_path / "ppo", load_problem(DUBINS))
    model.save(tmp_path / "ppo" / "model.zip")


def test_a_trained_policy_needs_trust_only_as_a_zip(safe_envs_command, ppo):
    evaluation, verification = ("evaluate", DUBINS, *QUICK, "--filter", "none"), ("verify", "Scalar-v0", "--no-simulate")
    assert safe_envs_command(*evaluation, "--policy", "ppo")[0] == 0
    assert safe_envs_command(*evaluation, "--policy", "ppo/model.zip", "--trust")[0] == 0
    for command in (evaluation, verification):
        status, out, err = safe_envs_command(*command, "--policy", "ppo/model.zip")
        assert (status, out) == (2, "")
        assert "loading ppo/model.zip runs code that it contains; if you trust its source, pass --trust" in " ".join(err.split())
    status, _, err = safe_envs_command(*verification, "--policy", "ppo/model.zip", "--trust")
    assert (status, "another observation space" in " ".join(err.split())) == (2, True)


@pytest.mark.parametrize(
    "arguments", [["evalute"], ["evaluate"], ["evaluate", DUBINS, "--episodes", "many"], ["evaluate", DUBINS, "--nois", "1"]]
)
def test_usage_errors_end_with_status_2_too(safe_envs_command, arguments):
    status, out, err = safe_envs_command(*arguments)
    assert status == 2
    assert out == ""
    assert "Error" in err
    assert "Traceback" not in err


@pytest.mark.parametrize("command", ["benchmark", "demo"])
def test_other_commands_check_their_paths_before_they_begin(safe_envs_command, command):
    Path("file").touch()
    arguments = {"benchmark": ["--json", "nowhere/out.json"], "demo": ["--folder", "file"]}[command]
    status, _, err = safe_envs_command(command, *arguments)
    assert status == 2
    assert err.startswith("Error:")
    assert arguments[1] in err


def test_forces_beyond_floating_point_are_an_error_not_a_crash(safe_envs_command):
    # The square of such an input is not finite, and infinity is no JSON.
    arguments = ("--box", "-1e200,1e200", "--policy", "random", "--filter", "none", "--json", "out.json")
    status, _, err = safe_envs_command("evaluate", "Scalar-v0", *QUICK, *arguments)
    assert status in (0, 2)
    assert "Traceback" not in err
    if status == 0:
        strictly("out.json")


@pytest.mark.parametrize("suffix", ["pgf", "eps", "ps", "tif", "raw", "svgz", "webp", "gif"])
def test_every_format_is_refused_before_the_run_or_written(safe_envs_command, suffix):
    status, _, _ = safe_envs_command("evaluate", "Scalar-v0", *QUICK, "--plot", f"out.{suffix}")
    written = Path(f"out.{suffix}")
    assert (status == 0 and written.stat().st_size > 0) or (status == 2 and not written.exists())


def test_a_failed_picture_leaves_no_part_of_it(safe_envs_command, monkeypatch):
    from matplotlib.figure import Figure

    def fail(self, path, **_):
        Path(path).write_bytes(b"half a picture")
        raise OSError("no space left")

    monkeypatch.setattr(Figure, "savefig", fail)
    monkeypatch.setattr(sys, "argv", ["safe-envs", "evaluate", "Scalar-v0", *QUICK, "--plot", "out.png"])
    with pytest.raises(OSError, match="no space left"):
        cli.main()
    assert list(Path().iterdir()) == []


def run_process(*command, cwd=ROOT):
    return subprocess.run([*map(str, command)], capture_output=True, text=True, cwd=cwd, timeout=120)


def test_the_installed_command_and_the_script_give_the_same(tmp_path):
    arguments = [DUBINS, "--episodes", "20", "--horizon", "0.5"]
    commands = {
        "installed": [Path(sys.executable).with_name("safe-envs"), "evaluate"],
        "script": [sys.executable, ROOT / "scripts" / "evaluate.py"],
    }
    tables, documents = [], []
    for name, command in commands.items():
        done = run_process(*command, *arguments, "--json", tmp_path / f"{name}.json")
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        tables.append(without_speed(done.stdout))
        documents.append(strictly(tmp_path / f"{name}.json"))
        del documents[-1]["timing"]
    assert tables[0] == tables[1]
    assert len(tables[0]) > 4
    assert documents[0] == documents[1]


def test_errors_of_the_script_end_with_status_2():
    done = run_process(sys.executable, "-m", "scripts.evaluate", DUBINS, "--filter", "hocb")
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean 'hocbf'" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_terminal_gets_a_progress_bar():
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "scripts.evaluate", "Scalar-v0", "--episodes", "10"]
    environment = {**os.environ, "TERM": "xterm"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave, cwd=ROOT, env=environment)
    os.close(slave)
    shown = b""
    while True:
        try:
            part = os.read(master, 4096)
        except OSError:
            break
        if not part:
            break
        shown += part
    out = process.communicate(timeout=60)[0]
    os.close(master)
    assert process.returncode == 0
    assert b"Evaluating" in shown
    assert b"%" in shown
    assert b"Evaluating" not in out
    assert b"none" in out


def test_the_command_starts_light():
    code = (
        "import sys, agents, scripts.cli; "
        "print([m for m in ('torch', 'stable_baselines3', 'matplotlib', 'proxsuite', 'qpsolvers') if m in sys.modules])"
    )
    assert run_process(sys.executable, "-c", code).stdout == "[]\n"
