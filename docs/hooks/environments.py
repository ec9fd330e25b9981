"""A page for each env: its picture, its equations from the symbols that are simulated, and its docstring."""

from __future__ import annotations

import inspect
import io
from typing import Any

import gymnasium as gym
import sympy as sp
from PIL import Image

from agents import NominalController
from safe_envs import ENV_IDS, SafetyProblem
from safe_envs.calculus import relative_degree
from wrappers import SafetyFilterWrapper

_SHOWN = 0.4
"""Part of an episode after which the picture is taken."""

_MOST_STEPS = 400
_LONGEST_EQUATION = 12
"""Number of states up to which the equations of a system fit a page."""


def short_name(env_id: str) -> str:
    """The name of an env without its namespace and version."""
    return env_id.removeprefix("safe_envs/").removesuffix("-v0")


def env_pages() -> dict[str, str | bytes]:
    """Content by path of all env pages with their pictures, and of the table of envs."""
    pages: dict[str, str | bytes] = {}
    rows = []
    for env_id in ENV_IDS:
        name = short_name(env_id)
        env: Any = gym.make(env_id, render_mode="rgb_array")
        problem, summary, text = env.unwrapped.problem, *_docstring(env)
        pages[f"envs/{name}.md"] = _page(env_id, problem, summary, text)
        pages[f"envs/{name}.png"] = _picture(env)
        rows.append(_row(name, problem, summary))
        env.close()
    pages["envs/table.md"] = "\n".join(["| env | what is to be kept safe | states | inputs | degree | filter |", "|---|---|---|---|---|---|", *rows])
    return pages


def _docstring(env: Any) -> tuple[str, str]:
    """First line and the rest."""
    summary, _, text = (inspect.getdoc(type(env.unwrapped)) or "").partition("\n")
    return summary, text.strip()


def _page(env_id: str, problem: SafetyProblem, summary: str, text: str) -> str:
    name = short_name(env_id)
    facts = [
        f"| Control period, horizon | {problem.dt:g} s, {problem.horizon:g} s = {problem.steps} steps |",
        f"| Relative degree | {_degrees(problem)} |",
        f"| Natural filter, gains | [`{problem.filter}`](../filters/{problem.filter}.md), {_gains(problem)} |",
    ]
    return "\n".join(
        [
            f"# {name}",
            "",
            summary,
            "",
            f"![{name} under its filter](./{name}.png)",
            "",
            f"The nominal controller under `{problem.filter}`, {_SHOWN:.0%} into an episode, seed 0.",
            "",
            f'```python\nenv = gym.make("{env_id}")\n```',
            "",
            "| | |",
            "|---|---|",
            *facts,
            "",
            text,
            "",
            "## As it is simulated",
            "",
            "The plant and the barriers, from the symbols that the env is derived from.",
            "",
            *[f"$$\n{equation}\n$$\n" for equation in _equations(problem)],
        ]
    )


def _row(name: str, problem: SafetyProblem, summary: str) -> str:
    filter_name = f"[`{problem.filter}`](../filters/{problem.filter}.md)"
    return f"| [{name}]({name}.md) | {summary} | {problem.plant.n} | {problem.plant.m} | {_degrees(problem)} | {filter_name} |"


def _degrees(problem: SafetyProblem) -> str:
    return ", ".join(str(degree) for degree in sorted({relative_degree(problem.model, b.expression) for b in problem.barriers}))


def _gains(problem: SafetyProblem) -> str:
    gains: Any = problem.gains
    each = gains if isinstance(gains[0], tuple) else [gains]
    return "; ".join(", ".join(f"{p:g}" for p in rates) for rates in each)


def _equations(problem: SafetyProblem) -> list[str]:
    """LaTeX of the plant, a line for each state, and of the barriers; names alone where there are many states."""
    plant = problem.plant
    drift = plant.drift + plant.input_matrix * sp.Matrix(plant.inputs)
    noise = [sp.Symbol(f"dW_{j + 1}") for j in range(plant.diffusion.shape[1])]
    found = []
    for i, state in enumerate(plant.states):
        terms = [f"\\left({sp.latex(drift[i])}\\right) dt" if drift[i] != 0 else ""]
        terms += [f"{_factor(plant.diffusion[i, j])} {sp.latex(noise[j])}" for j in range(len(noise)) if plant.diffusion[i, j] != 0]
        found.append(f"d {sp.latex(state)} = {' + '.join(filter(None, terms)) or '0'}")
    return [*found[:_LONGEST_EQUATION], *(f"{_name(b.name)} = {sp.latex(b.expression)}" for b in problem.barriers)]


def _factor(expression: Any) -> str:
    return f"\\left({sp.latex(expression)}\\right)" if expression.is_Add else sp.latex(expression)


def _name(text: str) -> str:
    return sp.latex(sp.Symbol(text)) if len(text) < 4 else f"h_{{\\text{{{text}}}}}"


def _picture(env: Any) -> bytes:
    """A frame of an episode under the env's own filter."""
    problem = env.unwrapped.problem
    filtered, policy = SafetyFilterWrapper(env, problem.filter), NominalController(problem)
    observation, _ = filtered.reset(seed=0)
    for _ in range(min(int(_SHOWN * problem.steps), _MOST_STEPS)):
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, _ = filtered.step(action)
        if terminated or truncated:
            break
    written = io.BytesIO()
    Image.fromarray(filtered.render()).save(written, "PNG", optimize=True)
    return written.getvalue()
