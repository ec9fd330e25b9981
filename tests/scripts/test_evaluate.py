"""`safe-envs evaluate` as a person types it: its table, its JSON and its picture."""

from __future__ import annotations

import io
import json
from dataclasses import fields, replace
from pathlib import Path

import pytest
from rich.console import Console

from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.attainable import chained
from safe_envs.agents.evaluation.results import EvaluationRow
from safe_envs.scripts.reports.evaluation import print_evaluation
from tests.agents.evaluation.made_up import attainable
from tests.scripts.conftest import strictly
from tests.scripts.figures.svg_texts import svg_texts

pytestmark = pytest.mark.usefixtures("coarse_bounds")
DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", "8", "--horizon", "0.3")
# Only of rows that have something to say.
SELDOM = {"below_rounding", "worst_below_rounding", "estimation"}
ROW_KEYS = {field.name for field in fields(EvaluationRow)} - SELDOM


def test_json_has_the_documented_keys(safe_envs_command):
    status, _, err = safe_envs_command(
        "evaluate", DUBINS, "--filter none --filter hocbf:alpha=1,2", *QUICK, "--json out.json"
    )
    assert (status, err) == (0, "")
    document = strictly("out.json")
    assert list(document) == ["config", "versions", "rows", "comparisons", "timing", "best"]
    assert [{*row} for row in document["rows"]] == [ROW_KEYS, ROW_KEYS]
    assert [row["filter"] for row in document["rows"]] == ["none", "hocbf:alpha=1,2"]
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
    assert [row["filter"] for row in document["timing"]["rows"]] == ["none", "hocbf:alpha=1,2"]
    assert {(row["engine"], row["jobs"]) for row in document["timing"]["rows"]} == {("numpy", 1)}
    assert [p.name for p in Path().iterdir()] == ["out.json"]


def test_json_is_strict_where_no_step_counts(safe_envs_command):
    status, out, _ = safe_envs_command(
        "evaluate Scalar-v0 --start 1.0 --noise 0", *QUICK, "--json out.json"
    )
    assert status == 0
    assert "Note: nothing is random here" in out
    for row in strictly("out.json")["rows"]:
        assert row["safe"] == 0
        assert row["effort_mean"] is row["intervention_rate"] is row["infeasible_rate"] is None


def test_every_option_reaches_the_evaluation(safe_envs_command):
    status, out, _ = safe_envs_command(
        "evaluate StochasticDubins-v0 --filter hocbf --policy zero --episodes 6 --seed 5 --noise",
        ".1,.3 --plant v=1.5 --model v=1.7 --barrier radius=2.5 --knowledge plant --dt .02",
        "--substeps 2 --horizon .4 --input-bounds -3,4 --start -0.5,0,1 --num-envs 4"
        " --confidence .9",
        "--json out.json",
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
        "input_bounds": [-3.0, 4.0],
        "start": [-0.5, 0.0, 1.0],
    }
    wanted = evaluate(
        DUBINS,
        "zero",
        ["hocbf"],
        options=options,
        episodes=6,
        seed=5,
        knowledge="plant",
        confidence=0.9,
    )
    document = strictly("out.json")
    assert document["rows"] == [row.as_dict() for row in wanted.rows]
    assert document["config"] == json.loads(json.dumps(wanted.config))
    for text in (
        DUBINS,
        "policy zero",
        "6 episodes",
        "seed 5",
        "v = 1.5 (model 1.7)",
        "sigma_1 = 0.1, sigma_2 = 0.3",
        "dt = 0.02 s",
    ):
        assert text in out
    assert "filters know the plant" in out
    assert "safe [90 % interval]" in out


def test_table_shows_the_rows(safe_envs_command):
    _, out, _ = safe_envs_command(
        "evaluate", DUBINS, "--no-bounds --episodes 40 --horizon 2 --filter none --filter scbf"
    )
    answer = evaluate(
        DUBINS, filters=["none", "scbf"], options={"horizon": 2.0}, episodes=40, bounds=False
    )
    # Columns that do not fit are in a second table, with the same names.
    lines: dict[str, str] = {}
    for line in out.splitlines():
        if line and line.split()[0] in ("none", "scbf"):
            lines[line.split()[0]] = f"{lines.get(line.split()[0], '')} {line} "
    assert list(lines) == ["none", "scbf"]
    for row in answer.rows:
        line = lines[row.filter]
        for shown in (
            f"{100 * row.safety_rate:.1f} % [{100 * row.ci_low:.1f}, {100 * row.ci_high:.1f}]",
            f"{row.min_h_median:.3g}",
            f" {row.violations} ",
            f"{row.effort_mean:.3g}",
            f"{row.return_mean:.4g}",
        ):
            assert shown in line
    assert f"{100 * answer.rows[1].intervention_rate:.1f} %" in lines["scbf"]
    assert "Note: nothing is random" not in out


@pytest.mark.slow
def test_refinement_says_which_rates_have_converged(safe_envs_command):
    arguments = "evaluate ACC-v0 --filter none --filter scbf --episodes 1000 --horizon 0.1"
    status, out, err = safe_envs_command(
        arguments, "--refine --confidence .9 --json out.json --plot out.svg"
    )
    assert (status, err) == (0, "")
    plain, _, refined = out.partition("Refinement: safe [90 % interval]")
    assert "safe [90 % interval]" in plain
    for text in (
        "dt = 0.05 s",
        "dt = 0.025 s",
        "dt = 0.0125 s",
        "on the same noise, in integration steps of 0.0125 s",
        "no further than 3 points",
    ):
        assert text in refined
    row = strictly("out.json")["refinement"]["rows"][1]
    lows = [*row["ci_low"], row["limit_low"]]
    lines = [line for line in refined.splitlines() if line.startswith("scbf")]
    shown = " ".join(" ".join(line.removeprefix("scbf").split()) for line in lines)
    assert shown == " ".join(f"100.0 % [{100 * low:.1f}, 100.0]" for low in lows)
    assert (
        f"  scbf: off its limit by +0.0 points [{100 * row['error_low']:.1f},"
        f" {100 * row['error_high']:.1f}], converged" in refined
    )
    picture = svg_texts("out.svg")
    assert "dt = 0.05 s" in picture
    assert "90 % band" in picture


def line_of(text, name):
    """Return the row of a filter in a table."""
    return next(line for line in text.splitlines() if line.startswith(f"{name} "))


def test_the_columns_read_as_a_chain():
    answer = evaluate(
        "Scalar-v0", filters=["none", "scbf"], options={"horizon": 0.1}, episodes=5, bounds=False
    )
    held = {"held_bound": 0.8, "held_word": "proved", "held_note": "of a certificate"}
    rows = [answer.rows[0], replace(answer.rows[1], **held)]

    def printed(best):
        console = Console(width=200, file=io.StringIO())
        judged_best, judged_rows = chained(best, rows)
        print_evaluation(console, replace(answer, rows=judged_rows, best=judged_best))
        return console.file.getvalue()

    rate = f"100.0 % [{100 * rows[0].ci_low:.1f}, 100.0]"
    found = printed(attainable(0.9, 0.99981))
    assert f" >= 80.0 %  {rate}  " in line_of(found, "scbf")
    assert "\nattainable by any policy: 99.99 %\n" in found
    assert "bound, held input <= safe <= attainable is a chain: all three are of the env" in found
    # A bound above what is attainable, and a rate above it: the table is wrong.
    low = printed(attainable(0.3, 0.7))
    assert "attainable by any policy" not in low
    assert "best attainable safety: withheld" in low
    assert f" >= 80.0 %  {rate}  " in line_of(low, "scbf")


def test_the_plants_mass_saves_the_quadrotor(safe_envs_command):
    for knowledge in ("model", "plant"):
        line = f"evaluate QuadrotorAltitude-v0 --filter none --filter hocbf --knowledge {knowledge}"
        given = f"--no-bounds --episodes 6 --json {knowledge}.json"
        assert safe_envs_command(line, given)[0] == 0
    bare, model = strictly("model.json")["rows"]
    again, plant = strictly("plant.json")["rows"]
    assert bare == again
    assert bare["violations"] == model["violations"] == 6
    assert bare["min_h_median"] < model["min_h_median"] < 0
    assert plant["violations"] == 0
    assert plant["min_h_p05"] > 0


@pytest.mark.parametrize(
    ("line", "name"),
    [
        (f"{DUBINS} --policy random --filter none --filter hocbf --filter scbf", "a.SVG"),
        # h is the same number throughout: there is no range to draw.
        ("Scalar-v0 --noise 0 --start 1", "flat.jpg"),
    ],
)
def test_plot_writes_a_picture(safe_envs_command, line, name):
    status, _, err = safe_envs_command("evaluate", line, *QUICK, "--no-bounds --plot", name)
    assert (status, err) == (0, "")
    starts = {".svg": b"<?xml", ".jpg": b"\xff\xd8"}
    content = Path(name).read_bytes()
    assert content.startswith(starts[Path(name).suffix.lower()])
    assert len(content) > 5000
    if name == "a.SVG":
        for text in (
            "barrier h",
            "safe so far",
            "pointwise 95 % band",
            "none: ",
            "hocbf: ",
            "scbf: ",
            "unsafe",
            "scbf, first episode",
            r"[\mathrm{rad}/\mathrm{s}]",
            "nominal input",
            "intervention",
        ):
            assert text in svg_texts(name)
    assert [p.name for p in Path().iterdir()] == [name]


def test_latex_goes_to_a_file_or_alone_to_stdout(safe_envs_command, tmp_path):
    asked = ("evaluate", "Scalar-v0", "--horizon", 0.1, "--episodes", 5, "--filter", "cbf")
    status, out, err = safe_envs_command(*asked, "--latex -")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert (lines[0], lines[-1]) == (r"% \usepackage{booktabs}", r"\end{table}")
    status, out, _ = safe_envs_command(*asked, "--latex table.tex --timing")
    assert status == 0
    assert Path("table.tex").read_text().splitlines() == lines
    assert "steps/s" in out
    assert "toprule" not in out
