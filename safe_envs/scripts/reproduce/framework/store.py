"""Results of artefacts on disk: their numbers in a result store, with their pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib as mpl

from safe_envs.agents.jobs.fingerprint import file_checksum, package_versions, source_checksum
from safe_envs.agents.jobs.store import ResultStore, reading
from safe_envs.scripts.figures.saving import save
from safe_envs.scripts.figures.style import STYLE
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Findings, Workload

_SUFFIXES = (".png", ".pdf", ".svg")


def configuration(artefact: Artefact, sample: Workload) -> dict[str, Any]:
    """Return everything that a result depends on, as JSON-able data.

    Args:
        artefact: to compute.
        sample: how much is simulated.
    """
    return {
        "artefact": artefact.name,
        "options": asdict(sample),
        "versions": {**package_versions(), "matplotlib": mpl.__version__},
        "source": source_checksum(),
    }


def require_same_sample(folder: Path, artefacts: Iterable[Artefact], sample: Workload) -> None:
    """Check that a folder holds no results of another sample, which would be overwritten.

    Args:
        folder: of the results.
        artefacts: to look for.
        sample: by which they are to be computed.

    Raises:
        ConfigurationError: it does, or holds a file that is damaged or altered.
    """
    names = [artefact.name for artefact in artefacts]
    ResultStore(folder).require_same_options(names, asdict(sample))


def read(folder: Path, artefact: Artefact, sample: Workload) -> tuple[Findings, float] | None:
    """Return a kept outcome and its seconds, or None without one of the same configuration.

    Args:
        folder: of the results.
        artefact: whose outcome to read.
        sample: by which it is to be computed.

    Raises:
        ConfigurationError: the result is damaged or altered; a ValueError below becomes one.
    """
    store = ResultStore(folder)
    document = store.read(artefact.name, configuration(artefact, sample))
    if document is None:
        return None
    with reading(store.path(artefact.name)):
        outcome, pictures = Findings.from_document(document["outcome"]), document["pictures"]
        seconds = float(document["seconds"])
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"it took {seconds} seconds")
        for suffix in _SUFFIXES if artefact.draw is not None else ():
            picture = folder / f"{artefact.name}{suffix}"
            if not picture.exists():
                return None
            if file_checksum(picture) != pictures[suffix]:
                raise ValueError(f"{picture.name} is another picture")
    return outcome, seconds


def keep(
    folder: Path, artefact: Artefact, sample: Workload, outcome: Findings, seconds: float
) -> None:
    """Draw an outcome, and write it after its pictures, whose checksums it holds.

    Args:
        folder: of the results.
        artefact: that was computed.
        sample: by which.
        outcome: to keep.
        seconds: that the computation took.

    Raises:
        ConfigurationError: it cannot be written, as on a full disk.
    """
    content = {
        "outcome": outcome.document(),
        "seconds": seconds,
        "pictures": _drawn(folder, artefact, outcome),
    }
    ResultStore(folder).keep(artefact.name, configuration(artefact, sample), content)


def _drawn(folder: Path, artefact: Artefact, outcome: Findings) -> dict[str, str]:
    """Draw the pictures of an outcome; return their checksums by suffix."""
    if artefact.draw is None:
        return {}
    pictures = {}
    with mpl.rc_context(STYLE):
        figure = artefact.picture(outcome)
        for suffix in _SUFFIXES:
            picture = folder / f"{artefact.name}{suffix}"
            save(figure, picture)
            pictures[suffix] = file_checksum(picture)
            # Its layout takes as long as writing it, and the next one is to look the same.
            figure.set_layout_engine("none")
    return pictures
