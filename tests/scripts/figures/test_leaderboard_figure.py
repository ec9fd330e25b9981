"""The picture of an env of the leaderboard shows everything that the table has."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

from safe_envs.agents.training.leaderboard import entry_of
from safe_envs.scripts.figures import leaderboard
from safe_envs.scripts.figures.leaderboard import draw
from tests.agents.training.test_leaderboard import SCALAR, result
from tests.readable import figure_texts, unreadable

pytestmark = pytest.mark.slow

NAMES = ["nominal", "ppo", "ppo-lag", "ppo + filter", "ppo behind filter", "ppo + promise filter"]
NAMES += ["ppo behind backup"]


def test_agents_are_inside_the_axes_and_look_different(tmp_path, monkeypatch):
    safe = {(SCALAR, name): [50 - 8 * i, 49 - 8 * i, 48 - 8 * i] for i, name in enumerate(NAMES)}
    safe[SCALAR, "ppo"] = [0, 0, 0]
    found = result(safe, 3)
    entries = [entry_of(found, SCALAR, name) for name in NAMES]
    figures = []
    save = Figure.savefig

    def kept(figure, *given, **how):
        figures.append(figure)
        return save(figure, *given, **how)

    monkeypatch.setattr(Figure, "savefig", kept)
    path = tmp_path / "Scalar.png"
    draw("Scalar", [e for e in entries if e], found.rows, NAMES, path)
    assert path.stat().st_size > 10_000
    (figure,) = figures
    (axes,) = figure.axes
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    for row in found.rows:
        assert left < 1 - row.safety_rate < right
        assert bottom < row.return_mean < top
    labels = axes.get_legend_handles_labels()[1]
    assert labels == NAMES
    assert len(set(leaderboard._LOOKS)) == len({m for _, m in leaderboard._LOOKS})
    assert unreadable(*figure_texts(figure)) == []
