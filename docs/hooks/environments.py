"""A page for each env: its picture, its equations as simulated, and its docstring."""

from __future__ import annotations

import inspect
import io
import re
from typing import Any

import gymnasium as gym
import sympy as sp
from navigation import short_name
from PIL import Image

from safe_envs import ENV_IDS, SafetyProblem
from safe_envs.agents import NominalController
from safe_envs.dynamics.lie import relative_degree
from safe_envs.wrappers import SafetyFilterWrapper

_SHOWN, _MOST_STEPS = 0.4, 400
"""Fraction of an episode after which the picture is taken, and the most steps until then."""

_HEADER = (
    "| env | task and safety constraint | states | inputs | degree | filter"
    " |\n|---|---|---|---|---|---|"
)
_WORD = re.compile(r"^[A-Za-z]{2,}")
_FUNCTION = re.compile(r"(?<=[A-Za-z0-9}]) (?=\\(?:sin|cos|tan|exp|log)\b)")
_LOW = re.compile(r"\\left\(((?:(?!\\left|\\right|\\frac).)*)\\right\)")


def env_pages() -> dict[str, str | bytes]:
    """Return the content by path of all env pages and pictures, and of the table of envs."""
    pages: dict[str, str | bytes] = {}
    rows = []
    for env_id in ENV_IDS:
        name = short_name(env_id)
        env: Any = gym.make(env_id, render_mode="rgb_array")
        problem, (summary, text) = env.unwrapped.problem, _docstring(env)
        pages[f"envs/{name}.md"] = _page(env_id, problem, summary, text)
        pages[f"envs/{name}.png"] = _picture(env)
        rows.append(_row(name, problem, summary))
        env.close()
    pages["envs/table.md"] = "\n".join([_HEADER, *rows])
    return pages


def _docstring(env: Any) -> tuple[str, str]:
    """Return the first line and the rest."""
    summary, _, text = (inspect.getdoc(type(env.unwrapped)) or "").partition("\n")
    return summary, text.strip()


def _page(env_id: str, problem: SafetyProblem, summary: str, text: str) -> str:
    name = short_name(env_id)
    before, states, after = text.partition("## States\n")
    return f"""# {name}

{summary}

![{name} under its filter](./{name}.png)

*The nominal controller under [`{problem.filter}`](../filters/{problem.filter}.md), seed 0.*

```python
env = gym.make("{env_id}")
```

Control period {problem.dt:g} s, horizon {problem.horizon:g} s. Relative degree {_degrees(problem)}.
Gains {_gains(problem)}, default filter [`{problem.filter}`](../filters/{problem.filter}.md).

{before}
The plant and the barriers, as simulated:

{_equations(problem)}

{states}{after}
"""


def _row(name: str, problem: SafetyProblem, summary: str) -> str:
    filter_name = f"[`{problem.filter}`](../filters/{problem.filter}.md)"
    return (
        f"| [{name}]({name}.md) | {summary} | {problem.plant.n} | {problem.plant.m} |"
        f" {_degrees(problem)} | {filter_name} |"
    )


def _degrees(problem: SafetyProblem) -> str:
    return ", ".join(
        str(degree)
        for degree in sorted(
            {relative_degree(problem.model, b.expression) for b in problem.barriers}
        )
    )


def _gains(problem: SafetyProblem) -> str:
    gains: Any = problem.gains
    each = gains if isinstance(gains[0], tuple) else [gains]
    return "; ".join(", ".join(f"{p:g}" for p in rates) for rates in each)


def _equations(problem: SafetyProblem) -> str:
    """Return Markdown with the plant, a line for each state, and the barriers."""
    plant = problem.plant
    drift = plant.drift + plant.input_matrix * sp.Matrix(plant.inputs)
    noise = [f"dW_{{{j + 1}}}" for j in range(plant.diffusion.shape[1])]
    found = []
    for i, state in enumerate(plant.states):
        terms = [f"{_factor(drift[i])}\\, dt"] if drift[i] != 0 else []
        terms += [
            f"{_factor(level)}\\, {dW}"
            for level, dW in zip(plant.diffusion[i, :], noise, strict=True)
            if level != 0
        ]
        found.append(f"d{_latex(state)} = {' + '.join(terms) or '0'}")
    found += [f"{_name(b.name)} = {_latex(b.expression)}" for b in problem.barriers]
    return "\n".join(f"$$\n{equation}\n$$\n" for equation in found)


def _latex(expression: Any) -> str:
    """Return LaTeX with short numbers, upright words, and parentheses of fitting height."""
    floats = {
        f: sp.Integer(int(f)) if f == int(f) else sp.Float(f, 4) for f in expression.atoms(sp.Float)
    }
    words = {s: _WORD.sub(r"\\mathrm{\g<0>}", sp.latex(s)) for s in expression.free_symbols}
    latex, count = sp.latex(expression.xreplace(floats), symbol_names=words), 1
    while count:
        latex, count = _LOW.subn(r"(\1)", latex)
    return _FUNCTION.sub(r"\\, ", latex)


def _factor(expression: Any) -> str:
    return f"\\left({_latex(expression)}\\right)" if expression.is_Add else _latex(expression)


def _name(text: str) -> str:
    return _latex(sp.Symbol(text)) if len(text) < 4 else f"h_{{\\text{{{text}}}}}"


def _picture(env: Any) -> bytes:
    """Return a frame of an episode under the env's default filter."""
    problem = env.unwrapped.problem
    filtered: Any = SafetyFilterWrapper(env, problem.filter)
    policy = NominalController(problem)
    observation, _ = filtered.reset(seed=0)
    for _ in range(min(int(_SHOWN * problem.steps), _MOST_STEPS)):
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, _ = filtered.step(action)
        if terminated or truncated:
            break
    written = io.BytesIO()
    Image.fromarray(filtered.render()).save(written, "PNG", optimize=True)
    return written.getvalue()
