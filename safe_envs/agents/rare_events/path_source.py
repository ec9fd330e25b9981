"""The functions of `safe_envs.agents.rare_events.path_slots` for a problem."""

from __future__ import annotations

from safe_envs.agents.evaluation.brownian_bridge import bridge_rates
from safe_envs.agents.evaluation.episode_kernel import bridge_minimum
from safe_envs.agents.rare_events.tilted_env import barrier_slopes
from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.problem.problem import SafetyProblem


def path_source(problem: SafetyProblem, bridged: bool, data: Data) -> Source:
    """Return the functions that playing paths takes next to those of the world.

    Args:
        problem: what is simulated.
        bridged: whether to draw h between control instants.
        data: receives its numbers.
    """
    entries = "".join(f"row[{i}], " for i in range(problem.plant.n))
    state = Source(f"def state_in(row):\n    return ({entries})\n")
    return state + _tilt(problem, data) + _lowest(problem, bridged, data)


def _tilt(problem: SafetyProblem, data: Data) -> Source:
    channels, head = len(problem.plant.noise_channels), "def tilt_direction(x, barriers, data):\n"
    if not channels:
        return Source(f"{head}    return (0.0,)\n")
    slopes = barrier_slopes(problem)
    lines = ["slopes = barrier_slopes(x, data)", "h = barriers[0]"]
    rows = [
        "".join(f"slopes[{i}], " for i in range(first, first + channels))
        for first in range(0, len(slopes), channels)
    ]
    lines.append(f"steepest = ({rows[0]})")
    for i, row in enumerate(rows[1:], 1):
        lines += [f"if barriers[{i}] < h:", f"    h = barriers[{i}]", f"    steepest = ({row})"]
    squares = " + ".join(f"steepest[{i}] * steepest[{i}]" for i in range(channels))
    lines += [
        f"steepness = sqrt({squares})",
        "if not steepness > 0.0:",
        f"    return ({'0.0, ' * channels})",
        f"return ({''.join(f'steepest[{i}] / steepness, ' for i in range(channels))})",
    ]
    text = head + "".join(f"    {line}\n" for line in lines)
    return formulas("barrier_slopes", {"x": problem.plant.states}, slopes, data) + Source(text)


def _lowest(problem: SafetyProblem, bridged: bool, data: Data) -> Source:
    count = len(problem.barriers)
    lines = ["def lowest_relative(x, before, after, units, uniforms, first, data):"]
    if bridged:
        lines += [
            "    rates = bridge_rates(x, data)",
            *(
                f"    h{i} = bridge_minimum("
                f"before[{i}], after[{i}], rates[{i}], uniforms[first + {i}])"
                for i in range(count)
            ),
        ]
    else:
        lines += [f"    h{i} = after[{i}]" for i in range(count)]
    lines.append("    lowest = h0 / units[0]")
    lines += [f"    lowest = min(lowest, h{i} / units[{i}])" for i in range(1, count)]
    text = "\n".join([*lines, "    return lowest\n"])
    if not bridged:
        return Source(text)
    rates = formulas("bridge_rates", {"x": problem.plant.states}, bridge_rates(problem), data)
    return rates + Source(text, (bridge_minimum,))
