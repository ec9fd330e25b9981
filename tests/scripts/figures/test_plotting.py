"""Pictures of results: figures that a notebook shows, and files."""

from __future__ import annotations

import subprocess
import sys

import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.proofs.feasibility import verify
from safe_envs.scripts.figures.evaluation import plot_evaluation
from safe_envs.scripts.figures.verify import plot_verification
from safe_envs.wrappers import parse_conditions
from tests.readable import figure_texts, unreadable

SCALAR = "safe_envs/Scalar-v0"


@pytest.fixture(scope="module")
def evaluation():
    return evaluate(
        SCALAR, filters=["none", "scbf"], episodes=4, bounds=False, record=True, best=False
    )


def test_matplotlib_is_imported_when_something_is_drawn():
    code = "import sys, safe_envs.agents; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_evaluation_is_a_figure_that_a_notebook_shows(evaluation):
    figure = plot_evaluation(evaluation)
    assert figure.get_suptitle().startswith(f"{SCALAR}, nominal policy")
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.slow
def test_eight_filters_of_long_names_can_be_read():
    names = [f"hocbf:alpha=1.2345*s**3+0.5*tanh(s)+0.25*s**5+{k}*s" for k in range(1, 8)]
    found = evaluate(
        SCALAR, filters=["none", *names], episodes=4, bounds=False, record=True, best=False
    )
    assert unreadable(*figure_texts(plot_evaluation(found, size="single"))) == []


@pytest.mark.parametrize("out", ["picture.doc", "picture", 3])
def test_what_is_no_file_of_a_picture_is_refused(evaluation, tmp_path, monkeypatch, out):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=r"give FILE\.png, FILE\.pdf or FILE\.svg"):
        plot_evaluation(evaluation, out)
    assert not list(tmp_path.iterdir())


def test_an_evaluation_without_trajectories_cannot_be_drawn():
    found = evaluate(SCALAR, filters=["none"], episodes=2, bounds=False)
    with pytest.raises(ConfigurationError, match="record=True"):
        plot_evaluation(found)


def test_a_verification_is_drawn_with_the_starts_of_the_problem():
    problem = make_problem(SCALAR)
    found = verify(problem, parse_conditions("scbf", problem), samples=100)
    figure = plot_verification(found)
    assert figure.get_suptitle().startswith(f"{problem.name}, scbf")
