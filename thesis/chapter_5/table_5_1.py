"""Table 5.1: safety rates of SCBF, DDSCBF and CBF, pendulum (Sec. 5.4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from safe_envs import SafetyFilter
from safe_envs.agents import make_problem
from safe_envs.wrappers import DDSCBF
from thesis.artefact import Claim, Outcome, Sample, settings, texts
from thesis.chapter_5 import noise
from thesis.chapter_5.noise import WITHOUT_RATE, Identification, Runs, rates_of
from thesis.rates import MeasuredFilter, safer

PENDULUM = settings(5, "pendulum")
PRINTED = texts()["table-5.1"].printed
A, B = (SimpleNamespace(**each) for each in vars(settings(5, "pendulum_settings")).values())


def cbf_of(setting: SimpleNamespace) -> str:
    """Return the text of the CBF in a setting."""
    return f"cbf:alpha={setting.alpha}"


def options_of(setting: SimpleNamespace, sample: Sample) -> dict[str, Any]:
    """Return the environment's arguments: a quick sample ends after 5 s at the latest."""
    return {"start": setting.start, "horizon": sample.work(round(2 * setting.horizon)) / 2}


def describe(setting: SimpleNamespace, sample: Sample) -> str:
    """Return a setting in words."""
    return (
        f"{setting.where}, {options_of(setting, sample)['horizon']:g} s, CBF with alpha(h) ="
        f" {setting.alpha:g} h 1/s"
    )


def compute(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 5.1 in both settings."""
    learned = noise.identifications(PENDULUM.env, PENDULUM.noise, sample)
    (runs, main), (others, other) = (_outcome(each, learned, sample) for each in (B, A))
    printed = noise.models(learned, "printed")
    literal = rates_of(PENDULUM.env, options_of(B, sample), sample, [], printed)["ddscbf"]
    return Outcome(
        main.numbers,
        main.claims,
        {f"A: {describe(A, sample)}": other},
        [literal.number("DDSCBF", PRINTED["DDSCBF"])],
        notes=[
            noise.explain_gap(runs, cbf_of(B), "in B"),
            noise.explain_gap(others, cbf_of(A), "in A"),
            _margin(learned[0], sample),
        ],
    ), None


def _outcome(
    setting: SimpleNamespace, learned: Sequence[Identification], sample: Sample
) -> tuple[Runs, Outcome]:
    options, cbf = options_of(setting, sample), cbf_of(setting)
    filters = [cbf, WITHOUT_RATE, "scbf"]
    runs = rates_of(PENDULUM.env, options, sample, filters, noise.models(learned))
    quiet = rates_of(PENDULUM.env, {**options, "noise": 0.0}, sample, [cbf])[cbf]
    return runs, outcome_of(cbf, runs, quiet)


def outcome_of(cbf: str, runs: Runs, quiet: MeasuredFilter) -> Outcome:
    """Return numbers and claims in a setting; `quiet` is of its CBF without noise."""
    named = {"SCBF": runs["scbf"], "DDSCBF": runs["ddscbf"], "CBF": runs[cbf]}
    ddscbf = runs["ddscbf"].number("")
    return Outcome(
        [
            *(each.number(name, PRINTED[name]) for name, each in named.items()),
            runs[WITHOUT_RATE].number("CBF with alpha = 0"),
        ],
        [
            Claim(
                "every trajectory is unsafe with the CBF",
                runs[cbf].row.safe == 0,
                f"{runs[cbf].row.safe} of {runs[cbf].row.episodes} are safe",
            ),
            safer(
                "the noise makes trajectories unsafe with the CBF that are safe without it",
                quiet,
                runs[cbf],
            ),
            Claim(
                f"DDSCBF is safe in more than {PENDULUM.threshold:g} % of the episodes, as counted,"
                " whatever its interval",
                ddscbf.ours > PENDULUM.threshold,
                ddscbf.text,
            ),
            noise.close(runs, PRINTED["SCBF"], PRINTED["DDSCBF"]),
        ],
    )


def _margin(first: Identification, sample: Sample) -> str:
    """Return what Prop. 5.2.2 asks for at the origin, in words."""
    problem, model = (
        make_problem(PENDULUM.env, **options_of(B, sample)),
        first.learned["martingale"],
    )
    margin = next(iter(model.record.errors.values()))
    safety_filter = SafetyFilter.for_problem(problem, DDSCBF(model, margin=margin))
    slack = float(np.max(safety_filter.filter([0.0, 0.0], [0.0]).slack))
    met = f"violates the condition by {slack:.2g} 1/s" if slack > 0.0 else "meets the condition"
    return (
        "Prop. 5.2.2 asks for a positive margin on all of C: at the origin, where h is largest,"
        f" with the median error of the network, {margin:.2g} 1/s, for it the best torque {met}"
    )


ARTEFACTS = {"table-5.1": compute}
