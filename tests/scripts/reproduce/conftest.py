"""An artefact that costs nothing."""

from __future__ import annotations

import pytest

from safe_envs.scripts.reproduce.framework.artefact import (
    Artefact,
    Claim,
    Findings,
    Number,
    Workload,
)


@pytest.fixture
def computed():
    """Names that were computed, in order."""
    return []


@pytest.fixture
def coin(computed):
    """A table of a fair coin, with a picture."""

    def compute(sample: Workload) -> Findings:
        computed.append("table-0.1")
        trials = sample.size(1000)
        return Findings(
            [
                Number.rate("heads", trials // 2, trials, 48.0, 50),
                Number("edge", 0.25, 0.2, 0.3, unit="s"),
            ],
            [Claim("it lands", True, "1 of 1"), Claim("it rolls", False, "|v| = 0", printed=False)],
            data={"x": [0.0, 1.0]},
            notes=["a < b"],
        )

    def draw(figure, outcome):
        figure.subplots().plot(outcome.data["x"])

    return Artefact(
        "table-0.1",
        "A coin",
        compute,
        lambda sample: (f"thrown {sample.size(1000)} times",),
        ("the coin",),
        ("Eq 0.1: a sign",),
        draw=draw,
    )


@pytest.fixture
def catalogue(coin, monkeypatch):
    """A catalogue of that alone."""
    monkeypatch.setattr("safe_envs.scripts.reproduce.catalogue.ARTEFACTS", (coin,))
    return (coin,)


@pytest.fixture
def pictures(monkeypatch):
    """Has real figures saved as PNG only, which takes half as long; those of the coin are saved as
    SVG, too."""
    monkeypatch.setattr("safe_envs.scripts.reproduce.framework.store._SUFFIXES", (".png",))
