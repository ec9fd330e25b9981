"""The functions of a compiled batch of envs that take arrays apart and keep numbers in bounds."""

from __future__ import annotations

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.envs.action_kernel import scaled_action, within
from safe_envs.envs.spaces import center_and_half_width, observation_box
from safe_envs.problem.problem import SafetyProblem


def batch_source(problem: SafetyProblem, data: Data) -> Source:
    """Return the functions of `safe_envs.compiled.slots` about tables, actions and observations.

    Args:
        problem: what to simulate.
        data: receives its numbers.
    """
    space = observation_box(problem)
    bounds = list(zip(space.low.tolist(), space.high.tolist(), strict=True))
    scales = list(zip(*center_and_half_width(problem), strict=True))
    return Source(
        f"def state_at(table, i):\n    return ({_entries(problem.plant.n)})\n"
        f"def input_at(table, i):\n    return ({_entries(len(scales))})\n"
        "def scaled_input(action, data):\n"
        f"    return ({_calls('scaled_action', 'action', scales, data)})\n"
        "def observation_within(observation, data):\n"
        f"    return ({_calls('within', 'observation', bounds, data)})\n",
        (scaled_action, within),
    )


def _entries(count: int) -> str:
    return "".join(f"table[i, {j}], " for j in range(count))


def _calls(function: str, array: str, numbers: list[tuple[float, float]], data: Data) -> str:
    """Return calls of a function with an entry of an array and two numbers each."""
    first = data.add([number for pair in numbers for number in pair])
    return "".join(
        f"{function}({array}[{i}], data[{first + 2 * i}], data[{first + 2 * i + 1}]), "
        for i in range(len(numbers))
    )
