"""What is said of a registered env without its problem is what its problem says."""

from __future__ import annotations

import pytest

from safe_envs import ConfigurationError, SafeEnvsError
from safe_envs.registry import make_problem
from safe_envs.systems.summary import summaries, summary_of
from tests.conftest import problem_of

DUBINS = "safe_envs/StochasticDubins-v0"


def test_it_is_what_the_problem_says(env_id):
    advice = "run `python -m safe_envs.systems.summary`, which writes summaries.json"
    assert summaries()[env_id] == summary_of(env_id), advice
    problem = problem_of(env_id)
    assert summary_of(env_id).parameters == tuple(p.name for p in problem.model.parameters)
    assert len(summary_of(env_id).degree) == len(problem.barriers)
    assert summaries()[env_id].sensors == {c.name: c.noise for c in problem.sensors}


REFUSED = (
    {"plant": {"vv": 1.0}},
    {"model": {"v": float("inf")}},
    {"barrier": {"raduis": 2.0}},
    *({"noise": noise} for noise in (-1.0, [1.0, 2.0, 3.0], float("nan"))),
    *({"input_bounds": box} for box in ([2.0, 1.0], [[0.0, 1.0], [0.0, 1.0]])),
    *({"start": start} for start in ("inwrd", [1.0, 2.0])),
    {"dt": 0.0},
    {"nois": 1.0},
)
TAKEN = (
    {},
    {"plant": {"v": 1.5}, "model": {"sigma_1": 0.1}},
    *({"noise": noise} for noise in (0.0, [0.1, 0.2])),
    *({"input_bounds": box} for box in ([[-1.0, 1.0]], [-1.0, 1.0])),
    *({"start": start} for start in ("uniform", [0.0, 0.0, 0.0])),
    {"barrier": {"radius": 2.0}},
    {"rate_limit": [-1.0, 1.0], "start": [0.0, 0.0, 0.0]},
    {"dt": 0.1, "horizon": 1.0, "delay": 2},
)


@pytest.mark.parametrize("options", REFUSED, ids=str)
def test_what_it_refuses_the_problem_refuses_in_the_same_words(options):
    with pytest.raises(SafeEnvsError) as early:
        summaries()[DUBINS].require_options("StochasticDubins", options)
    with pytest.raises(ConfigurationError) as late:
        make_problem(DUBINS, **options)
    assert str(early.value) == str(late.value)


@pytest.mark.parametrize("options", TAKEN, ids=str)
def test_what_the_problem_takes_it_takes(options):
    make_problem(DUBINS, **options)
    summaries()[DUBINS].require_options("StochasticDubins", options)
