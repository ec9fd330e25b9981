"""Figure 6.3: the drift of the car behind another one, identified from trajectories."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs.agents import make_problem
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import COLORS, add_legend
from safe_envs.scripts.reproduce.chapter_6 import identifications as bayes
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.paired import is_above
from safe_envs.wrappers.learning.data.collection import draw_states

_SETTINGS = bayes.CHAPTER.settings["car"]
ENV, PRIOR, FRESH = (_SETTINGS[name] for name in ("env", "prior", "fresh"))
_IDENTIFICATIONS = 10
_NEAR = 0.1  # relative error up to which we should call an estimate near; the thesis gives none


def compute(sample: Workload) -> Findings:
    """Compute Figure 6.3."""
    problem = make_problem(ENV)
    x = draw_states(problem, FRESH, np.random.default_rng([sample.seed, 64]))
    truth, chosen = bayes.true_drift(problem, x), bayes.seeds(sample, _IDENTIFICATIONS)
    learned = [bayes.identified(problem, bayes.REPETITIONS[-1], seed, PRIOR) for seed in chosen]
    means, deviations = (
        np.array(part)
        for part in zip(*[bayes.estimated_drift(each, x) for each in learned], strict=True)
    )
    errors, size = np.sqrt(((means - truth) ** 2).mean(axis=1)), np.sqrt((truth**2).mean(axis=0))
    errors_in_deviations = np.sqrt((((means - truth) / deviations) ** 2).mean(axis=(1, 2)))
    sigma, time = (
        problem.plant.parameter_values["sigma_1"],
        bayes.REPETITIONS[-1] * 2 * bayes.STARTS * bayes.STEPS * problem.dt,
    )
    law = float(np.sqrt(learned[0].features.count * sigma**2 / time))
    most = problem.box[0][1] / problem.plant.parameter_values["M"]
    needed = bayes.REPETITIONS[-1] * (law / (_NEAR * size[0])) ** 2
    note = partial(bayes.CHAPTER.note, "figure-6.3")
    by_data = Number.mean(
        "rms error in standard deviations of the posterior", errors_in_deviations, least=0.0
    )
    order = x[:, 0].argsort()
    shown: dict[str, Any] = {"v": x[order, 0].tolist()}
    for i in (0, 1):
        parts = {"truth": truth, "estimate": means[0], "deviation": deviations[0]}
        shown |= {f"{name} {i + 1}": values[order, i].tolist() for name, values in parts.items()}
    return Findings(
        numbers=[
            *(
                bayes.predicted(f"rms error of f_{i + 1}", errors[:, i], unit=unit)
                for i, unit in enumerate(("m/s^2", "m/s"))
            ),
            *(
                bayes.predicted(
                    f"relative rms error of f_{i + 1}", 100 * errors[:, i] / size[i], unit="%"
                )
                for i in (0, 1)
            ),
            by_data,
        ],
        claims=[validated(by_data), *(near(f"f_{i + 1}", errors[:, i] / size[i]) for i in (0, 1))],
        data=shown,
        notes=[
            note("none"),
            note("law", law=law, size=size[0], near=100 * _NEAR, needed=needed),
            note("input", most=most, ratio=most / np.exp(np.log(errors[:, 0]).mean())),
        ],
    )


def validated(doubt: Number) -> Claim:
    """Return the claim that the mean error is one that the data leave open."""
    return bayes.CHAPTER.claim("figure-6.3", "validated", not is_above(doubt, 1.0), doubt=doubt)


def near(name: str, relative: np.ndarray) -> Claim:
    """Return the claim that one more identification is near the truth.

    Args:
        name: of the component.
        relative: errors of some identifications, shape (R,).
    """
    low, high = np.exp(bayes.one_more(np.log(relative)))
    values = {"component": name, "near": 100 * _NEAR, "low": 100 * low, "high": 100 * high}
    return bayes.CHAPTER.claim("figure-6.3", "near", high <= _NEAR, **values)


def _draw_drift(figure: Figure, outcome: Findings) -> None:
    data = outcome.data
    panels = figure.subplots(1, 2)
    for i, (letter, unit, axes) in enumerate(
        zip("ab", ("m/s^2", "m/s"), panels, strict=True), start=1
    ):
        estimate = data[f"estimate {i}"], data[f"deviation {i}"]
        bayes.draw_estimate(axes, (data["v"], data[f"truth {i}"]), data["v"], *estimate, COLORS[0])
        label = labelled(f"$f_{i}$", unit)
        axes.set(xlabel=labelled("speed $v$", "m/s"), ylabel=label, title=f"({letter}) $f_{i}$")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


def _values(sample: Workload) -> dict[str, Any]:
    return {"identifications": len(bayes.seeds(sample, _IDENTIFICATIONS))}


ARTEFACTS = (bayes.CHAPTER.artefact("figure-6.3", compute, _values, _draw_drift),)
