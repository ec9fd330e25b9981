"""What was evaluated, and what has to be known to read its rates: lines below a title."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_envs.agents.evaluation.best_text import best_line
from safe_envs.agents.evaluation.evaluation_data import EvaluationData
from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.problem.problem import SafetyProblem

NOTHING_RANDOM = (
    "nothing is random here (no noise, a fixed start, a deterministic policy), so that all"
    " episodes are one and the same: the interval has no meaning."
)


def setting_lines(evaluation: EvaluationData) -> list[str]:
    """Return the setting of an evaluation, and what its rates do not tell by themselves."""
    lines, best = [setting_text(evaluation.config, evaluation.problem)], evaluation.best
    notes = unsafe_starts(1.0 - evaluation.rows[0].curve.rate[0])
    notes += [best_line(best)] if best and best.contradiction else []
    notes += [NOTHING_RANDOM] if evaluation.is_deterministic else []
    sensor = sensor_text(evaluation.config)
    lines += [sensor] if sensor else []
    return lines + [note[:1].upper() + note[1:].rstrip(".") for note in notes]


def setting_text(config: Mapping[str, Any], problem: SafetyProblem) -> str:
    """Return system, timing, monitoring and what filters know.

    Args:
        config: of the evaluation.
        problem: that was evaluated.
    """
    seen = config["filter_spec"]
    system = f"seen through {seen}, {_timing(problem)}" if seen else describe_system(problem)
    goal = ", joint QP with the goal" if config["objective"] == "clf" else ""
    watched = ", monitored continuously" if config["monitoring"] == "continuous" else ""
    return f"{system}{watched}; filters know the {config['knowledge']}{goal}"


def sensor_text(config: Mapping[str, Any]) -> str:
    """Return the sensor and the estimator of an evaluation; "" without a sensor.

    Args:
        config: of the evaluation.
    """
    measured = config.get("measurement")
    if measured is None:
        return ""
    channels = []
    for c in measured["channels"]:
        errors = {"sd": c["noise"], "bias": c["bias"], "dropout": c["dropout"]}
        told = [f"{key} {value:g}" for key, value in errors.items() if value or key == "sd"]
        channels.append(f"{c['name']} ({', '.join(told)})")
    late = f", {measured['delay']} control periods late" if measured["delay"] else ""
    seen = config["estimator"]
    known = f"; estimator {seen}, policies see the {config['observe']}" if seen else ""
    return f"sensor: {', '.join(channels)}{late}{known}"


def unsafe_starts(share: float) -> list[str]:
    """Return a note on episodes that start where h <= 0, if there are some."""
    if share == 0.0:
        return []
    some = "all episodes start" if share == 1.0 else f"{percent(share)} of the episodes start"
    return [f"{some} where h <= 0: they count as violated whatever a filter does"]


def describe_system(problem: SafetyProblem) -> str:
    """Return noise, mismatch and timing of a problem."""
    return f"{describe_plant(problem)}, {_timing(problem)}"


def _timing(problem: SafetyProblem) -> str:
    return f"dt = {problem.dt:g} s, horizon {problem.duration:g} s"


def describe_plant(problem: SafetyProblem) -> str:
    """Return noise and mismatch of a problem."""
    plant = {p.name: value for p, value in problem.plant.parameters.items()}
    model = {p.name: value for p, value in problem.model.parameters.items()}
    noise = ", ".join(f"{name} = {plant[name]:g}" for name in problem.noise)
    differing = [
        f"{name} = {plant[name]:g} (model {model[name]:g})"
        for name in plant
        if plant[name] != model[name]
    ]
    told = (
        f"noise {noise}"
        if any(plant[name] for name in problem.noise)
        else "fixed noise"
        if problem.plant.noisy
        else "no noise"
    )
    mismatch = f"plant {', '.join(differing)}" if differing else "model = plant"
    return f"{told}, {mismatch}"
