"""Where an episode's h is looked at, as a function of a compiled program."""

from __future__ import annotations

from safe_envs.agents.evaluation.brownian_bridge import bridge_rates, reached_by_noise
from safe_envs.agents.evaluation.episode_kernel import bridge_minimum
from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.problem.problem import SafetyProblem

_HEAD = "def lowest_between(x, before, after, uniforms, first, data):\n"


def bridge_draws(problem: SafetyProblem, continuous: bool) -> int:
    """Return the uniforms that a control period takes for its bridges.

    Args:
        problem: whose barriers they are of.
        continuous: whether h is looked at between control instants too.
    """
    return len(problem.barriers) if continuous and any(reached_by_noise(problem)) else 0


def bridge_source(problem: SafetyProblem, continuous: bool, data: Data) -> Source:
    """Return `lowest_between` and `no_barriers` of `safe_envs.compiled.slots`.

    Args:
        problem: whose barriers are looked at.
        continuous: whether to look between control instants too.
        data: receives its numbers.
    """
    nothing = Source(f"def no_barriers(data):\n    return ({'nan, ' * len(problem.barriers)})\n")
    return nothing + _lowest(problem, continuous, data)


def _lowest(problem: SafetyProblem, continuous: bool, data: Data) -> Source:
    if not continuous:
        return Source(f"{_HEAD}    return smallest_barrier(after)\n")
    if not bridge_draws(problem, continuous):
        return Source(f"{_HEAD}    return min(smallest_barrier(before), smallest_barrier(after))\n")
    rates = formulas("bridge_rates", {"x": problem.plant.states}, bridge_rates(problem), data)
    each = "".join(
        f"bridge_minimum(before[{i}], after[{i}], rates[{i}], uniforms[first + {i}]), "
        for i in range(len(problem.barriers))
    )
    lines = f"    rates = bridge_rates(x, data)\n    return smallest_barrier(({each}))\n"
    return rates + Source(_HEAD + lines, (bridge_minimum,))
