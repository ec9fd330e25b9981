"""Pictures of results: figures that a notebook shows, and files."""

from __future__ import annotations

import subprocess
import sys

import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_problem
from safe_envs.agents.evaluation.attainable import attainable_safety
from safe_envs.proofs.feasibility import verify
from safe_envs.scripts.figures.best import plot_attainable
from safe_envs.scripts.figures.evaluation import plot_evaluation
from safe_envs.scripts.figures.verify import plot_verification
from safe_envs.values.tables import ValueSettings
from safe_envs.wrappers import parse_conditions
from tests.readable import figure_texts, unreadable

SCALAR = "safe_envs/Scalar-v0"


@pytest.fixture(scope="module")
def evaluation():
    return evaluate(
        SCALAR, filters=["none", "scbf"], episodes=20, bounds=False, record=True, best=False
    )


def test_matplotlib_is_imported_when_something_is_drawn():
    code = "import sys, safe_envs.agents; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_evaluation_is_a_figure_that_a_notebook_shows(evaluation):
    figure = plot_evaluation(evaluation)
    assert figure.get_suptitle().startswith(f"{SCALAR}, nominal policy")
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.parametrize(("name", "start"), [("p.png", b"\x89PNG"), ("p.pdf", b"%PDF")])
def test_a_figure_is_written_in_the_format_of_the_suffix(evaluation, tmp_path, name, start):
    plot_evaluation(evaluation, tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(start)


@pytest.mark.slow
@pytest.mark.parametrize("size", ["single", "double"])
def test_eight_filters_of_long_names_can_be_read(size):
    names = [f"hocbf:alpha=1.2345*s**3+0.5*tanh(s)+0.25*s**5+{k}*s" for k in range(1, 8)]
    found = evaluate(
        SCALAR, filters=["none", *names], episodes=4, bounds=False, record=True, best=False
    )
    assert unreadable(*figure_texts(plot_evaluation(found, size=size))) == []


def test_text_of_a_figure_that_is_saved_later_is_embedded_as_truetype(evaluation, tmp_path):
    plot_evaluation(evaluation).savefig(tmp_path / "later.pdf")
    content = (tmp_path / "later.pdf").read_bytes()
    assert b"/FontFile2" in content
    assert b"/Type3" not in content


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


def test_the_best_attainable_safety_is_drawn_over_its_coordinates(tmp_path):
    problem = make_problem(SCALAR, noise=1.0, horizon=0.2)
    settings = ValueSettings(knowledge="plant", cells=(50,))
    found, policy = attainable_safety(problem, settings, episodes=0, file=tmp_path / "table")
    (panel,) = plot_attainable(found, policy, title="Scalar").axes
    assert "best attainable safety" in panel.get_ylabel()


def test_a_verification_is_drawn_with_the_starts_of_the_problem():
    problem = make_problem(SCALAR)
    found = verify(problem, parse_conditions("scbf", problem), samples=100)
    figure = plot_verification(found)
    assert figure.get_suptitle().startswith(f"{problem.name}, scbf")
