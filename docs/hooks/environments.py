"""A page for each env: its picture, its equations as simulated, and its docstring."""

from __future__ import annotations

import inspect
import io
import re
from typing import Any

import gymnasium as gym
import numpy as np
import sympy as sp
from formulas import with_latex, with_set_units
from navigation import short_name
from PIL import Image

from safe_envs import ENV_IDS, SafetyProblem
from safe_envs.agents import NominalController
from safe_envs.dynamics.lie import relative_degree
from safe_envs.rendering.style import SCENE
from safe_envs.wrappers import SafetyFilterWrapper

_SHOWN, _MOST_STEPS = 0.4, 400
"""Fraction of an episode after which the picture is taken, and the most steps until then."""

_TITLES = {
    "DubinsDisk": "Dubins vehicle in a disk",
    "DubinsObstacle": "Dubins vehicle and a moving obstacle",
    "DubinsObstacles": "Dubins vehicle among moving obstacles",
    "DubinsReach": "Dubins vehicle on its way to a goal",
    "StochasticDubins": "Dubins vehicle with noise",
    "QuadrotorAltitude": "Quadrotor: altitude",
    "Quadrotor": "Quadrotor with twelve states",
    "QuadrotorLimits": "Quadrotor: altitude and tilt limits",
    "ACC": "Adaptive cruise control: headway",
    "ACCGap": "Adaptive cruise control: distance",
    "Pendulum": "Inverted pendulum",
    "CubicSDE": "Cubic stochastic differential equation in a parabola",
    "CubicSDEDisk": "Cubic stochastic differential equation in a disk",
    "Scalar": "Scalar stochastic differential equation",
}
"""Full names for titles; an env without one is titled by its id."""

_THESIS = re.compile(r"\b([Tt])hesis(?= (?:Sec|Eq)\.)")
_EQUATIONS = "## Equations\n"

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
        frame, caption = _picture(env)
        pages[f"envs/{name}.png"] = _written(frame)
        pages[f"envs/{name}-narrow.png"] = _written(_stacked(frame))
        pages[f"envs/{name}.md"] = _page(env_id, problem, summary, text, caption)
        rows.append(_row(name, problem, summary))
        env.close()
    pages["envs/table.md"] = "\n".join([_HEADER, *rows])
    return pages


def _docstring(env: Any) -> tuple[str, str]:
    """Return the first line and the rest."""
    summary, _, text = (inspect.getdoc(type(env.unwrapped)) or "").partition("\n")
    return summary, text.strip()


def _page(env_id: str, problem: SafetyProblem, summary: str, text: str, caption: str) -> str:
    name = short_name(env_id)
    # Docstrings state the equations for a terminal; here they come from the symbols.
    before, _, after = text.partition(_EQUATIONS)
    after = re.sub(r"\A(?:    .*\n)+", "", after)
    text = "".join([_set(before), _EQUATIONS, _equations(problem), "\n", _set(after)])
    return f"""# {_title(name)}

{summary}

<picture>
  <source srcset="{name}-narrow.png" media="(max-width: 600px)">
  <img src="{name}.png" alt="{name}: the scene, the actions and h over time">
</picture>

*{caption}*

```python
env = gym.make("{env_id}")
```

{_defaults(problem)}

{text}
"""


def _defaults(problem: SafetyProblem) -> str:
    return (
        f"Control period {problem.dt:g} s, horizon {problem.horizon:g} s, relative degree"
        f" {_degrees(problem)}, gains {_gains(problem)}, default filter {_link(problem)}."
    )


def _title(name: str) -> str:
    return f"{_TITLES[name]} ({name})" if name in _TITLES else name


def _link(problem: SafetyProblem) -> str:
    return f"[`{problem.filter}`](../filters/{problem.filter}.md)"


def _row(name: str, problem: SafetyProblem, summary: str) -> str:
    return (
        f"| [{name}]({name}.md) | {summary} | {problem.plant.n} | {problem.plant.m} |"
        f" {_degrees(problem)} | {_link(problem)} |"
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
    """Return Markdown with the equations of the plant, one for each state."""
    plant = problem.plant
    inputs = plant.input_matrix * sp.Matrix(plant.inputs)
    drift = plant.drift.applyfunc(_shortest) + inputs.applyfunc(_shortest)
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


def _shortest(expression: Any) -> Any:
    """Return the form with the fewest symbols: a sum, or with common factors taken out."""
    forms = [expression, sp.factor_terms(expression), sp.factor(expression)]
    return min(forms, key=lambda form: sum(1 for _ in sp.preorder_traversal(form)))


def _set(text: str) -> str:
    """Return text of a docstring with its formulas and units set, and links to the thesis."""
    parts = re.split(r"(\$\$[^$]+\$\$|\$[^$]+\$|`[^`]+`)", text)
    parts[::2] = [
        _THESIS.sub(r"[\1hesis](../citing.md#the-thesis)", with_set_units(p)) for p in parts[::2]
    ]
    return with_latex("".join(parts))


def _picture(env: Any) -> tuple[np.ndarray, str]:
    """Return a frame of an episode under the env's default filter, and its caption."""
    problem = env.unwrapped.problem
    filtered: Any = SafetyFilterWrapper(env, problem.filter)
    policy = NominalController(problem)
    observation, info = filtered.reset(seed=0)
    count = 0
    for _ in range(min(int(_SHOWN * problem.steps), _MOST_STEPS)):
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, info = filtered.step(action)
        count += 1
        if terminated or truncated:
            break
    mismatch = problem.plant.parameters != problem.model.parameters
    why = ": the model differs from the plant, see [Mismatch](#mismatch)" if mismatch else ""
    seen = f" The minimum of $h$ so far is {info['h_min']:.3g}{why}." if info["h_min"] < 0 else ""
    return filtered.render(), (
        f"The nominal controller under {_link(problem)} after {count * problem.dt:g} s, seed 0."
        " Green: the safe set; hatched: $h < 0$. The axes have the units of the [states](#states);"
        " time is in s. The panel shows the executed action (bar) and the nominal action"
        f" (diamond) in physical units, and $h$ over time.{seen}"
    )


def _stacked(frame: np.ndarray) -> np.ndarray:
    """Return a frame with its panel below the scene, as wide, for narrow screens."""
    width = round(SCENE[2])
    scene, panel = frame[:, :width], Image.fromarray(frame[:, width:])
    # Letters of the panel are as large on a phone as on a desktop.
    size = width, round(panel.height * width / panel.width)
    return np.vstack([scene, np.asarray(panel.resize(size, Image.Resampling.LANCZOS))])


def _written(frame: np.ndarray) -> bytes:
    written = io.BytesIO()
    Image.fromarray(frame).save(written, "PNG", optimize=True)
    return written.getvalue()
