"""The answer of an evaluation as a table, and as a file."""

from __future__ import annotations

import json
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from agents.episodes import Row
from agents.evaluation import BARE, Evaluation
from safe_envs.files import write_atomically
from safe_envs.problem import SafetyProblem

_COLUMNS = (
    "safe [95 % interval]",
    "min h\nmedian",
    "min h\n5 %",
    "viola-\ntions",
    "inter-\nvened",
    "infeas-\nible",
    "effort",
    "return",
    "steps/s",
)


def print_evaluation(console: Console, evaluation: Evaluation) -> None:
    """Print a heading, a row for each filter, and what has to be known to read them."""
    console.print(heading(evaluation), soft_wrap=True, highlight=False)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False, collapse_padding=True)
    table.add_column("filter", overflow="fold", vertical="bottom")
    for name in _COLUMNS:
        table.add_column(name, justify="right", no_wrap=True, vertical="bottom")
    for row, speed in zip(evaluation.rows, evaluation.timing["rows"], strict=True):
        table.add_row(*_cells(row, speed["steps_per_second"]))
    console.print()
    console.print(table)
    console.print()
    whole = evaluation.problem.steps * evaluation.config["episodes"]
    for row, speed in zip(evaluation.rows, evaluation.timing["rows"], strict=True):
        if speed["steps"] < 0.99 * whole:
            length = speed["steps"] / evaluation.config["episodes"]
            console.print(
                f"Note: with {row['filter']} the mean episode ends after {length:.1f} of {evaluation.problem.steps} steps, at the goal or "
                "outside the workspace; its safety is that of the instants until then.",
                soft_wrap=True,
                highlight=False,
            )
    if evaluation.repeats:
        console.print(
            "Note: nothing is random here (no noise, a fixed start, a deterministic policy), so that all episodes are "
            "one and the same: the interval says nothing.",
            soft_wrap=True,
            highlight=False,
        )


def write_json(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation as strict JSON, whole or not at all."""
    text = json.dumps(evaluation.document(), indent=2, allow_nan=False)
    write_atomically(path, lambda part: part.write_text(text + "\n"))


def heading(evaluation: Evaluation) -> Text:
    """What was evaluated, in two lines."""
    config = evaluation.config
    title = Text(config["env_id"] or evaluation.problem.name, style="bold")
    title.append(f" | policy {config['policy']['name']} | {config['episodes']} episodes | seed {config['seed']}", style="not bold")
    title.append(f"\n{describe_system(evaluation.problem)}; filters know the {config['knowledge']}", style="not bold")
    return title


def describe_system(problem: SafetyProblem) -> str:
    """Noise, mismatch and timing of a problem."""
    plant = {p.name: value for p, value in problem.plant.parameters.items()}
    model = {p.name: value for p, value in problem.model.parameters.items()}
    noise = ", ".join(f"{name} = {plant[name]:g}" for name in problem.noise)
    differing = [f"{name} = {plant[name]:g} (model {model[name]:g})" for name in plant if plant[name] != model[name]]
    parts = [
        f"noise {noise}" if any(plant[name] for name in problem.noise) else "no noise",
        f"plant {', '.join(differing)}" if differing else "model = plant",
        f"dt = {problem.dt:g} s",
        f"horizon {problem.horizon:g} s",
    ]
    return ", ".join(parts)


def _cells(row: Row, speed: float) -> list[str]:
    filtered = row["filter"] != BARE
    return [
        row["filter"],
        f"{_percent(row['safety_rate'])} [{100 * row['ci_low']:.1f}, {100 * row['ci_high']:.1f}]",
        f"{row['min_h_median']:.3g}",
        f"{row['min_h_p05']:.3g}",
        str(row["violations"]),
        _percent(row["intervention_rate"]) if filtered else "-",
        _percent(row["infeasible_rate"]) if filtered else "-",
        "-" if row["effort_mean"] is None else f"{row['effort_mean']:.3g}",
        f"{row['return_mean']:.4g}",
        _thousands(speed),
    ]


def _percent(rate: float | None) -> str:
    return "-" if rate is None else f"{100 * rate:.1f} %"


def _thousands(number: float) -> str:
    return f"{number / 1e6:.2f} M" if number >= 1e6 else f"{number / 1e3:.0f} k"
