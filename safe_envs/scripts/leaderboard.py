"""`safe-envs leaderboard`: agents on every env, bare and filtered, with what they cost."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from safe_envs import ENV_IDS
from safe_envs.atomic_io import write_json
from safe_envs.bounded_reading import read_json
from safe_envs.errors import ConfigurationError, shown
from safe_envs.scripts.options import completion
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.rates import rate_of
from safe_envs.scripts.reports.tables import make_table

_RESULTS = "results.json"
_QUICK: dict[str, Any] = {"n_timesteps": 4096, "eval_freq": 4096, "eval_episodes": 50}
_QUICK_EPISODES, _EPISODES = 100, 1000
_KNOWLEDGE = "plant"
"""Of the filters: with a wrong model they are to be learned first, which is another comparison."""

_NAMES = ("env_id", "policy", "filter")
_FIGURES = ("safety_rate", "ci_low", "ci_high", "return_mean", "intervention_rate")

Row = dict[str, Any]


def leaderboard(
    env_ids: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENV_ID]...", help="Envs; by default all.", autocompletion=completion.env_ids
        ),
    ] = None,
    algo: Annotated[
        str,
        typer.Option(
            metavar="NAME", autocompletion=completion.algorithms, help="ppo, a2c, sac or td3."
        ),
    ] = "ppo",
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Where agents and results go. What is in it already is not done again.",
        ),
    ] = Path("leaderboard"),
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes of each evaluation; by default 1000, or 100 with --quick."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Train for moments only: to see that it works, not how good agents get."
        ),
    ] = False,
    markdown: Annotated[
        bool,
        typer.Option("--markdown", help="Print the table as Markdown, with a row for each env."),
    ] = False,
    json_file: Json = None,
) -> None:
    """Train an agent on each env, without a filter and with the env's own in the loop, and compare
    it with the nominal controller.

    Each policy is evaluated bare and behind the filter, which knows the plant; the agent that was
    trained behind it only there. The table has the safety rates with their 95 % intervals, the
    returns, and the processor time of the training. The intervals are of the episodes: there is one
    training of each kind, and another seed gives another agent.
    """
    from safe_envs.registry import full_id

    require_result(json_file)
    ids = list(dict.fromkeys(full_id(env_id) for env_id in env_ids or ENV_IDS))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"--out {out} cannot be made: {error.strerror}; give another folder"
        ) from error
    settings: dict[str, Any] = _QUICK if quick else {}
    known = {
        "algo": algo,
        "seed": seed,
        "quick": quick,
        "episodes": episodes or (_QUICK_EPISODES if quick else _EPISODES),
        "knowledge": _KNOWLEDGE,
    }
    rows = _read(out / _RESULTS, known)
    with progress_bar("Leaderboard") as bar:
        tell = bar or (lambda _: None)
        for k, env_id in enumerate(ids):
            if not any(row["env_id"] == env_id for row in rows):
                rows += _of_env(
                    env_id, known, settings, out, lambda part, k=k: tell((k + part) / len(ids))
                )
                _write(out / _RESULTS, known, rows)
            tell((k + 1) / len(ids))
    found = [row for env_id in ids for row in rows if row["env_id"] == env_id]
    if markdown:
        say(stdout(), "\n".join(_markdown(found)))
    else:
        stdout().print(_table(found))
    write_result(json_file, lambda: _document(known, found))


def _of_env(
    env_id: str, known: dict[str, Any], settings: dict[str, Any], out: Path, tell: Any
) -> list[Row]:
    """The rows of one env: the nominal controller, an agent trained bare, and one trained behind
    the filter."""
    from safe_envs.agents.training.config import Training
    from safe_envs.agents.training.trainer import train
    from safe_envs.registry import make_problem

    natural = make_problem(env_id).filter
    rows = _evaluated(env_id, "nominal", "nominal", ["none", natural], known, None)
    for i, (name, in_loop, filters) in enumerate(
        (
            (known["algo"], None, ["none", natural]),
            (f"{known['algo']}, filter in the loop", natural, [natural]),
        )
    ):
        folder = (
            out
            / f"{env_id.split('/')[-1]}-{known['algo']}-{'bare' if in_loop is None else 'filtered'}"
        )
        training = Training.of(
            env_id,
            known["algo"],
            filter=in_loop,
            knowledge=_KNOWLEDGE,
            seed=known["seed"],
            **settings,
        )
        seconds = train(
            training,
            folder,
            resume=(folder / "config.json").exists(),
            tell=lambda part, i=i: tell((i + part) / 2),
        )
        rows += _evaluated(env_id, name, str(folder), filters, known, seconds)
    return rows


def _evaluated(
    env_id: str,
    name: str,
    policy: str,
    filters: Sequence[str],
    known: dict[str, Any],
    seconds: float | None,
) -> list[Row]:
    from safe_envs.agents import evaluate

    found = evaluate(
        env_id,
        policy,
        filters,
        episodes=known["episodes"],
        seed=known["seed"],
        knowledge=_KNOWLEDGE,
        bounds=False,
    )
    figures = [{name: row[name] for name in ("filter", *_FIGURES)} for row in found.rows]
    return [{"env_id": env_id, "policy": name, **row, "trained_in": seconds} for row in figures]


def _read(path: Path, known: dict[str, Any]) -> list[Row]:
    """The rows that are there already, of the same settings."""
    if not os.path.exists(path):
        return []
    document = read_json(path, "give another --out")
    rows = document.get("rows") if isinstance(document, dict) else None
    if not isinstance(rows, list) or "settings" not in document or not all(map(_is_row, rows)):
        raise ConfigurationError(
            f"{path} is not what `safe-envs leaderboard` writes; give another --out"
        )
    if document["settings"] != known:
        raise ConfigurationError(
            f"{path} has the settings {shown(document['settings'])}, not {known}; give another"
            " --out"
        )
    return rows


def _is_row(row: Any) -> bool:
    """Whether something in a file has the form of `_evaluated`."""
    if not isinstance(row, dict) or row.keys() != {*_NAMES, *_FIGURES, "trained_in"}:
        return False
    numbers = [row[name] for name in _FIGURES] + [row["trained_in"] or 0.0]
    return all(isinstance(row[name], str) for name in _NAMES) and all(
        isinstance(number, int | float) for number in numbers
    )


def _write(path: Path, known: dict[str, Any], rows: Sequence[Row]) -> None:
    write_json(path, _document(known, rows))


def _document(known: dict[str, Any], rows: Sequence[Row]) -> dict[str, Any]:
    from safe_envs.agents.evaluation.evaluate import package_versions

    return {"settings": known, "versions": package_versions(), "rows": list(rows)}


def _time(row: Row) -> str:
    return "-" if row["trained_in"] is None else f"{row['trained_in']:.0f} s"


def _table(rows: Sequence[Row]) -> Table:
    """A row for each policy and filter."""
    titles = ("env", "policy", "filter", "safe [95 % interval]", "return", "processor time")
    table = make_table("lllr", *titles, tight=False)
    for row in rows:
        name = row["env_id"].removeprefix("safe_envs/")
        table.add_row(
            name,
            row["policy"],
            row["filter"],
            rate_of(row),
            f"{row['return_mean']:.4g}",
            _time(row),
        )
    return table


def _markdown(rows: Sequence[Row]) -> list[str]:
    """A row for each env: how safe each policy was, and its return."""
    from safe_envs.agents.evaluation.evaluate import BARE

    policies = [
        row["policy"] if row["filter"] == BARE or k == 4 else f"{row['policy']} + filter"
        for k, row in enumerate(rows[:5])
    ]
    table = [["env", "filter", *policies, "processor time"], ["---"] * 8]
    for k in range(0, len(rows), 5):
        of_env = rows[k : k + 5]
        cells = [f"{rate_of(row)}, {row['return_mean']:.4g}" for row in of_env]
        name = of_env[0]["env_id"].removeprefix("safe_envs/").removesuffix("-v0")
        table.append([name, of_env[1]["filter"], *cells, f"{_time(of_env[2])}, {_time(of_env[4])}"])
    return [f"| {' | '.join(line)} |" for line in table]


if __name__ == "__main__":
    run_alone("leaderboard", leaderboard)
