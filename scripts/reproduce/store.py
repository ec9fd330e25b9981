"""Results of artefacts on disk: by configuration and version, so that a stopped run goes on and a changed one starts anew."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from agents.evaluation import package_versions
from safe_envs.errors import ConfigurationError
from safe_envs.files import write_atomically, write_json
from scripts.figure import STYLE
from scripts.reproduce.artefact import Artefact, Outcome, Sample

_PACKAGES = ("safe_envs", "wrappers", "agents", "scripts")
_SUFFIXES = (".png", ".svg")


@cache
def source_checksum() -> str:
    """Of all code of the project, so that a developer's change counts as another version."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        root = Path(str(files(package)))
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def configuration(artefact: Artefact, sample: Sample) -> dict[str, Any]:
    """What a result hangs on."""
    versions = {**package_versions(), "matplotlib": mpl.__version__}
    return {"artefact": artefact.name, "sample": asdict(sample), "versions": versions, "source": source_checksum()}


def require_same_sample(folder: Path, artefacts: Iterable[Artefact], sample: Sample) -> None:
    """Check that a folder holds no results of another sample, which would be written over.

    Raises:
        ConfigurationError: it does.
    """
    for artefact in artefacts:
        try:
            found = json.loads((folder / f"{artefact.name}.json").read_text())["configuration"]["sample"]
        except (OSError, LookupError, TypeError, ValueError):
            continue
        if found != asdict(sample):
            raise ConfigurationError(
                f"{folder} holds {artefact.name} by other options: {json.dumps(found)}; give another --out, or the same options"
            )


def read(folder: Path, artefact: Artefact, sample: Sample) -> tuple[Outcome, float] | None:
    """The outcome and its seconds, if they are in the folder by the same configuration."""
    path = folder / f"{artefact.name}.json"
    try:
        document = json.loads(path.read_text())
        if document["configuration"] != configuration(artefact, sample):
            return None
        found = Outcome.from_document(document["outcome"]), float(document["seconds"])
    except (OSError, LookupError, TypeError, ValueError):
        return None
    return found if artefact.draw is None or all((folder / f"{artefact.name}{s}").exists() for s in _SUFFIXES) else None


def keep(folder: Path, artefact: Artefact, sample: Sample, outcome: Outcome, seconds: float) -> None:
    """Draw the outcome, and write it; the JSON goes first and comes last, so that it stands for all."""
    (folder / f"{artefact.name}.json").unlink(missing_ok=True)
    if artefact.draw is not None:
        with mpl.rc_context({**STYLE, "svg.hashsalt": artefact.name}):
            figure = Figure(figsize=artefact.size)
            artefact.draw(figure, outcome)
            for suffix in _SUFFIXES:
                # Without a date, so that equal results are equal files.
                metadata = {"Date": None} if suffix == ".svg" else {"Software": None}
                write_atomically(
                    folder / f"{artefact.name}{suffix}", lambda part, metadata=metadata: figure.savefig(part, dpi=150, metadata=metadata)
                )
    document = {"configuration": configuration(artefact, sample), "outcome": outcome.document(), "seconds": seconds}
    write_json(folder / f"{artefact.name}.json", document)
