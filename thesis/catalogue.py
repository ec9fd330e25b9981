"""The artefacts by name, and their computation, in whatever process."""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict, dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from safe_envs.agents.jobs.store import ResultStore, package_versions, reading, source_checksum
from safe_envs.errors import ConfigurationError
from thesis.artefact import Compute, Outcome, Sample, chapter_of, texts

_SUFFIXES = (".png", ".pdf", ".svg")


def compute_of(name: str) -> Compute:
    """Return what computes an artefact."""
    place = f"thesis.chapter_{chapter_of(name)}.{texts()[name].file}"
    return import_module(place).ARTEFACTS[name]


@cache
def code_checksum() -> str:
    """Return the SHA-256 of the code and data that results depend on: safe_envs and thesis."""
    digest, root = hashlib.sha256(source_checksum().encode()), Path(__file__).parent
    for path in sorted([*root.rglob("*.py"), *root.rglob("*.yaml")]):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def configuration(name: str, sample: Sample) -> dict[str, Any]:
    """Return everything that a result depends on, as JSON-able data."""
    return {
        "artefact": name,
        "options": asdict(sample),
        "versions": package_versions(),
        "source": code_checksum(),
    }


def read(folder: Path, name: str, sample: Sample) -> tuple[Outcome, float] | None:
    """Return a kept outcome and its seconds; None without one of the same configuration.

    Raises:
        ConfigurationError: the file is damaged or altered.
    """
    store = ResultStore(folder)
    document = store.read(name, configuration(name, sample))
    if document is None:
        return None
    with reading(store.path(name)):
        outcome, seconds = Outcome.from_document(document["outcome"]), float(document["seconds"])
        pictures = [folder / f"{name}{suffix}" for suffix in _SUFFIXES if document["drawn"]]
    return (outcome, seconds) if all(path.exists() for path in pictures) else None


@dataclass(frozen=True)
class ArtefactJob:
    """The computation of an artefact, which keeps its result itself.

    Attributes:
        key: name of the artefact.
        sample: how much is simulated.
        out: folder of the results.
        source: checksum of the code of the process that asks for it.
    """

    key: str
    sample: Sample
    out: Path
    source: str

    def compute(self) -> None:
        """Compute the artefact, draw it, and write its numbers after its pictures.

        Raises:
            ConfigurationError: the code has changed since the command began.
        """
        import torch

        # Before the code that computes is imported, since results are kept by this checksum.
        if self.source != code_checksum():
            raise ConfigurationError("the code changed during the run; start it again")
        torch.set_num_threads(1)
        began = time.perf_counter()
        outcome, draw = compute_of(self.key)(self.sample)
        seconds = time.perf_counter() - began
        if draw is not None:
            self._draw(draw)
        content = {"outcome": outcome.document(), "seconds": seconds, "drawn": draw is not None}
        ResultStore(self.out).keep(self.key, configuration(self.key, self.sample), content)

    def _draw(self, draw: Any) -> None:
        """Write the pictures, two columns of a paper wide."""
        import matplotlib as mpl
        from matplotlib.figure import Figure

        from safe_envs.scripts.figures.style import STYLE, save
        from safe_envs.scripts.options.evaluation_options import WIDTHS

        width, height = texts()[self.key].size
        wide = WIDTHS["double"]
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(wide, wide * height / width))
            draw(figure)
            for suffix in _SUFFIXES:
                save(figure, self.out / f"{self.key}{suffix}")
                # Its layout takes as long as writing it, and the next one is to look the same.
                figure.set_layout_engine("none")
