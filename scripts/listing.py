"""`safe-envs list`: what there is to evaluate."""

from __future__ import annotations

from rich import box
from rich.markup import escape
from rich.table import Table

from agents.problems import make_env
from safe_envs import ENV_IDS, SafeEnv, SafetyProblem
from safe_envs.calculus import relative_degree
from scripts.console import stdout

_COLUMNS = ("states", "inputs", "degree", "filter", "noise", "dt", "horizon")


def list_envs() -> None:
    """Print a table of the registered envs, with what each is about and its defaults."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False, collapse_padding=True)
    table.add_column("id, and what is to be kept safe", max_width=50)
    for name in _COLUMNS:
        table.add_column(name, no_wrap=True)
    for env_id in ENV_IDS:
        env = make_env(env_id)
        table.add_row(f"[bold]{env_id}[/]\n{escape(_about(env))}\n", *_defaults(env.problem))
    stdout().print(table)


def _about(env: SafeEnv) -> str:
    return (type(env).__doc__ or "").strip().partition("\n")[0]


def _defaults(problem: SafetyProblem) -> list[str]:
    levels = {p.name: value for p, value in problem.plant.parameters.items()}
    return [
        str(problem.plant.n),
        str(problem.plant.m),
        ", ".join(str(relative_degree(problem.model, b.expression)) for b in problem.barriers),
        problem.filter,
        ", ".join(f"{levels[name]:g}" for name in problem.noise) or "-",
        f"{problem.dt:g} s",
        f"{problem.horizon:g} s",
    ]
