"""What the table of an evaluation says of learning."""

from __future__ import annotations

import dataclasses
import io
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console

from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.notes import learned_notes
from safe_envs.agents.evaluation.rows import LearningSummary, PosteriorSummary
from safe_envs.registry import make_problem
from safe_envs.scripts.options.evaluation_options import LEARNED_PARAMETERS
from safe_envs.scripts.reports.evaluation import heading, print_evaluation
from safe_envs.wrappers import LEARNED

NO_BOUND = "no bound for learned filters"
LEARNING = LearningSummary([], 1, 20, [], [], [], {}, [], [], rates=[0.9])
OFTEN = replace(LEARNING, repeats=3, rates=[0.9, 0.5, 0.8])
POSTERIOR_BOUND = PosteriorSummary(0.4, "", delta=0.1, shortfall=0.0, bias=0.0, supremum=1.0)


def row(learning=None, bound=None, name="bayesian-scbf"):
    return SimpleNamespace(filter=name, learning=learning, posterior_bound=bound)


@pytest.mark.parametrize(
    ("env_id", "rows", "first"),
    [
        (
            "CubicSDEDisk-v0",
            [row(LEARNING)],
            f"{NO_BOUND}; for bayesian-scbf:simultaneous=P there may be one over the posterior.",
        ),
        ("CubicSDEDisk-v0", [row(LEARNING), row(LEARNING, POSTERIOR_BOUND)], f"{NO_BOUND}."),
        ("CubicSDEDisk-v0", [row(LEARNING, PosteriorSummary(None, "none"))], f"{NO_BOUND}."),
        ("StochasticDubins-v0", [row(LEARNING)], f"{NO_BOUND}."),
        ("DubinsObstacles-v0", [row(LEARNING)], f"{NO_BOUND}."),
    ],
)
def test_a_bound_over_the_posterior_is_proposed_where_there_may_be_one(env_id, rows, first):
    notes = learned_notes(rows, make_problem(env_id))
    assert notes[0] == first
    assert sum(note.startswith(NO_BOUND) for note in notes) == 1


def test_nothing_is_said_where_nothing_was_learned():
    assert not learned_notes([row()], make_problem("CubicSDEDisk-v0"))


def test_repeats_are_means_and_their_intervals_have_a_condition():
    problem = make_problem("CubicSDEDisk-v0")
    rows = [row(), row(LEARNING), row(OFTEN)]
    assert (
        sum(
            "for nearly normal: bad ones that are rarer than about 1 in 3" in note
            for note in learned_notes(rows, problem)
        )
        == 1
    )
    assert not any("nearly normal" in note for note in learned_notes([row(LEARNING)], problem))


def test_texts_of_the_user_are_no_markup_and_the_heading_counts_what_was_learned():
    answer = evaluate(
        "CubicSDEDisk-v0",
        filters=["none", "scbf"],
        options={"horizon": 0.1},
        episodes=2,
        bounds=False,
    )
    rows = [
        answer.rows[0],
        replace(answer.rows[1], filter="scbf:file=[red]x.npz", learning=LEARNING),
    ]
    console = Console(width=200, file=io.StringIO())
    changed = replace(answer, rows=rows, config={**answer.config, "repeats": 2})
    print_evaluation(console, changed)
    assert "\nscbf:file=[red]x.npz" in console.file.getvalue()
    assert "identifications" not in heading(changed).plain
    assert "2 episodes x 3 identifications" in heading(replace(changed, rows=[row(OFTEN)])).plain


def test_the_help_names_the_parameters_of_learned_filters():
    for name, condition in LEARNED.items():
        assert name in LEARNED_PARAMETERS
        for field in dataclasses.fields(condition):
            of_estimates = ("learned", "belief", "measurement_error")  # which they refuse
            assert field.name in of_estimates or f"{field.name}=" in LEARNED_PARAMETERS
    assert "file=" in LEARNED_PARAMETERS
