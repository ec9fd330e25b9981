"""Figure 6.3: the drift of the car behind another one, identified from trajectories."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs.agents import make_problem
from safe_envs.filters.learning.collection import draw_states
from safe_envs.scripts.figures.style import add_legend, labelled
from thesis.artefact import Claim, Number, Outcome, Sample, settings
from thesis.chapter_6 import bayes
from thesis.chapter_6.bayes import MOST

CAR = settings(6, "car")
_UNITS = ("m/s^2", "m/s")


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute Figure 6.3."""
    problem = make_problem(CAR.env)
    x = draw_states(problem, CAR.fresh, np.random.default_rng([sample.seed, 64]))
    truth, seeds = bayes.true_drift(problem, x), bayes.seeds(sample, CAR.identifications)
    learned = [bayes.identified(problem, MOST, seed, CAR.prior) for seed in seeds]
    means, deviations = map(
        np.array, zip(*[bayes.estimated_drift(each, x) for each in learned], strict=True)
    )
    errors, size = np.sqrt(((means - truth) ** 2).mean(axis=1)), np.sqrt((truth**2).mean(axis=0))
    in_deviations = np.sqrt((((means - truth) / deviations) ** 2).mean(axis=(1, 2)))
    doubt = Number.mean(
        "rms error in standard deviations of the posterior", in_deviations, least=0.0
    )
    components = [(f"f_{i + 1}", errors[:, i], size[i], _UNITS[i]) for i in (0, 1)]
    outcome = Outcome(
        numbers=[
            *(bayes.predicted(f"rms error of {f}", e, unit=unit) for f, e, _, unit in components),
            *(
                bayes.predicted(f"relative rms error of {f}", 100 * e / s, unit="%")
                for f, e, s, _ in components
            ),
            doubt,
        ],
        claims=[validated(doubt), *(near(f, e / s) for f, e, s, _ in components)],
    )
    order = x[:, 0].argsort()
    shown = [each[order] for each in (x[:, 0], truth, means[0], deviations[0])]
    return outcome, partial(_draw, *shown)


def validated(doubt: Number) -> Claim:
    """Return the claim that the mean error, in standard deviations, is one that the data leave."""
    return Claim(
        f"The identified f is validated at {CAR.fresh} random states: its errors are no larger than"
        " its posterior leaves open.",
        not doubt.is_above(1.0),
        f"rms error {doubt.text} standard deviations of the posterior",
    )


def near(component: str, relative: np.ndarray) -> Claim:
    """Return the claim that one more identification is near, from relative errors (R,) of some."""
    low, high = np.exp(bayes.one_more(np.log(relative)))
    return Claim(
        f"The identified {component} is that of the car, to {100 * CAR.near:g} % of its size.",
        high <= CAR.near,
        f"relative rms error of one more identification {100 * low:.2g} to {100 * high:.2g} %",
        printed=False,
    )


def _draw(
    v: np.ndarray, truth: np.ndarray, mean: np.ndarray, deviation: np.ndarray, figure: Figure
) -> None:
    panels = figure.subplots(1, 2)
    for i, (axes, unit) in enumerate(zip(panels, _UNITS, strict=True)):
        bayes.draw_estimate(axes, (v, truth[:, i]), v, mean[:, i], deviation[:, i])
        axes.set(xlabel=labelled("speed $v$", "m/s"), ylabel=labelled(f"$f_{i + 1}$", unit))
        axes.set_title(f"({'ab'[i]}) $f_{i + 1}$")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


ARTEFACTS = {"figure-6.3": compute}
