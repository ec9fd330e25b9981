"""The physics, rewards and observations of a problem as functions of a compiled program."""

from __future__ import annotations

from safe_envs.dynamics.integrators import euler_maruyama_step, rate
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.envs.simulation import LARGEST, readings
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.errors import NotCompilableError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME


def world_source(problem: SafetyProblem, data: Data) -> Source:
    """Return the functions of `safe_envs.engine.slots` that describe a problem's world.

    Args:
        problem: what to simulate.
        data: receives its numbers.

    Raises:
        NotCompilableError: It has a sensor, a delay or a slew limit, or filters believe a delay.
    """
    if problem.measurement is not None:
        raise NotCompilableError(
            f"{problem.name} has a sensor, whose samples the engine 'numpy' alone simulates"
        )
    if not problem.direct:
        raise NotCompilableError(
            f"{problem.name} has {problem.actuators}: inputs under way are kept by the engine"
            " 'numpy' alone"
        )
    return (
        _rest(problem, data)
        + _starts(problem, data)
        + _physics(problem.plant, problem.dt / problem.substeps, problem.substeps, data)
        + _measure(problem, data)
    )


def noise_channels(problem: SafetyProblem) -> int:
    """Return the standard normals that a control period takes."""
    return len(problem.plant.noise_channels) * problem.substeps


def _rest(problem: SafetyProblem, data: Data) -> Source:
    center, _ = center_and_half_width(problem)
    first = data.add(center)
    entries = "".join(f"data[{first + j}], " for j in range(len(center)))
    nothing = "nan, " * problem.plant.n
    return Source(
        f"def resting_input(data):\n    return ({entries})\n"
        f"def no_state(data):\n    return ({nothing})\n"
    )


def _starts(problem: SafetyProblem, data: Data) -> Source:
    start = problem.starts[problem.start]
    states = formulas("start_state", {"uniforms": start.uniforms}, start.state, data)
    condition = 1 if start.condition is None else problem.model.numeric(start.condition)
    margin = formulas("start_margins", {"x": problem.model.states}, [condition], data)
    return (
        states
        + margin
        + Source("def start_margin(x, data):\n    return start_margins(x, data)[0]\n")
    )


def _physics(plant: ControlAffineSDE, h: float, substeps: int, data: Data) -> Source:
    arguments = {"x": plant.states, "u": plant.inputs}
    if not plant.noise_channels:
        return formulas("rate", arguments, tuple(rate(plant)), data) + _runge_kutta(
            plant.n, h, substeps, data
        )
    draws, moved = euler_maruyama_step(plant, h)
    step = formulas("euler_step", {**arguments, "w": draws}, tuple(moved), data)
    lines = ["def advance(x, u, noise, first, data):"]
    for k in range(substeps):
        drawn = "".join(f"noise[first + {k * len(draws) + i}], " for i in range(len(draws)))
        lines.append(f"    x = euler_step(x, u, ({drawn}), data)")
    return step + Source("\n".join([*lines, "    return x\n"]))


def _runge_kutta(n: int, h: float, substeps: int, data: Data) -> Source:
    half, whole, sixth = (f"data[{data.add([value])}]" for value in (0.5 * h, h, h / 6.0))

    def ahead(factor: str, k: str) -> str:
        return "".join(f"x[{i}] + {factor} * {k}[{i}], " for i in range(n))

    total = "".join(
        f"x[{i}] + {sixth} * (k1[{i}] + 2.0 * (k2[{i}] + k3[{i}]) + k4[{i}]), " for i in range(n)
    )
    return Source(
        "def advance(x, u, noise, first, data):\n"
        f"    for _ in range({substeps}):\n"
        "        k1 = rate(x, u, data)\n"
        f"        k2 = rate(({ahead(half, 'k1')}), u, data)\n"
        f"        k3 = rate(({ahead(half, 'k2')}), u, data)\n"
        f"        k4 = rate(({ahead(whole, 'k3')}), u, data)\n"
        f"        x = ({total})\n"
        "    return x\n"
    )


def _measure(problem: SafetyProblem, data: Data) -> Source:
    features, barriers = len(problem.features), len(problem.barriers)
    plant, last = problem.plant, features + barriers
    measure = formulas(
        "measure", {"x": plant.states, "u": plant.inputs, "time": TIME}, readings(problem), data
    )
    seen = [f"single(values[{i}])" for i in range(features)]
    values = [f"values[{features + i}]" for i in range(barriers)]
    heights = [f"{h} if isfinite({h}) else -inf" for h in values]
    observed = {f.expression for f in problem.features}
    unseen = [f"x[{i}]" for i, state in enumerate(plant.states) if state not in observed]
    read = [*unseen, *(f"values[{i}]" for i in (*range(features), last))]
    sizes = [f"abs({entry})" for entry in read]
    smaller = "".join(
        f"    h = h if barriers[{i}] >= h else barriers[{i}]\n" for i in range(1, barriers)
    )
    return measure + Source(
        f"def observation_of(values):\n    return ({', '.join(seen)},)\n"
        f"def barriers_of(values):\n    return ({', '.join(heights)},)\n"
        f"def smallest_barrier(barriers):\n    h = barriers[0]\n{smaller}    return h\n"
        f"def reward_of(values):\n    return values[{last}]\n"
        f"def has_left(values):\n    return values[{last + 1}] > 0.0\n"
        f"def has_ended(values):\n"
        f"    return values[{last + 1}] > 0.0 or values[{last + 2}] >= 0.0\n"
        f"def is_finite(x, values):\n    return {_sum(sizes)} < {LARGEST}\n"
    )


def _sum(terms: list[str]) -> str:
    """Return a sum as a tree, whose additions do not wait for each other."""
    if len(terms) == 1:
        return terms[0]
    half = len(terms) // 2
    return f"({_sum(terms[:half])} + {_sum(terms[half:])})"
