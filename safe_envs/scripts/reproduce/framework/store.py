"""Results of artefacts on disk: by configuration and version, so that a stopped run goes on and a
changed one starts anew.

Each has a checksum of all that is kept, so that a digit that was changed is not taken for a result.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn

import matplotlib as mpl
from matplotlib.figure import Figure

from safe_envs.agents.evaluation.evaluate import package_versions
from safe_envs.atomic_io import write_atomically, write_json
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.figures.evaluation_figure import STYLE
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Outcome, Sample

_SUFFIXES = (".png", ".svg")

_MOST = 30_000_000
"""Bytes of a file, at most: a result with all that its picture shows has less than a million."""

_SHOWN = 200
"""Characters of what a file says, at most, that a message repeats."""


@cache
def source_checksum() -> str:
    """Of all code of the project, so that a developer's change counts as another version."""
    digest = hashlib.sha256()
    root = Path(str(files("safe_envs")))
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def configuration(artefact: Artefact, sample: Sample) -> dict[str, Any]:
    """What a result hangs on."""
    versions = {**package_versions(), "matplotlib": mpl.__version__}
    return {
        "artefact": artefact.name,
        "sample": asdict(sample),
        "versions": versions,
        "source": source_checksum(),
    }


def require_same_sample(folder: Path, artefacts: Iterable[Artefact], sample: Sample) -> None:
    """Check that a folder holds no results of another sample, which would be written over.

    Raises:
        ConfigurationError: it does, or holds a file that is damaged or altered.
    """
    for artefact in artefacts:
        document = _document(folder, artefact)
        if document is not None and (found := document["configuration"].get("sample")) != asdict(
            sample
        ):
            raise ConfigurationError(
                f"{folder} holds {artefact.name} by other options: {json.dumps(found)[:_SHOWN]};"
                " give another --out, or the same options"
            )


def read(folder: Path, artefact: Artefact, sample: Sample) -> tuple[Outcome, float] | None:
    """The outcome and its seconds, if they are in the folder by the same configuration.

    Raises:
        ConfigurationError: they are damaged or altered.
    """
    document = _document(folder, artefact)
    if document is None or document["configuration"] != configuration(artefact, sample):
        return None
    with _reading(_path(folder, artefact)):
        if "sha256" not in document:
            raise ValueError("it has no checksum")
        outcome, pictures = Outcome.from_document(document["outcome"]), document["pictures"]
        seconds = float(document["seconds"])
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"it took {seconds} seconds")
        for suffix in _SUFFIXES if artefact.draw is not None else ():
            picture = folder / f"{artefact.name}{suffix}"
            if not picture.exists():
                return None
            if _checksum(read_bytes(picture, _MOST)) != pictures[suffix]:
                raise ValueError(f"{picture.name} is another picture")
    return outcome, seconds


def keep(
    folder: Path, artefact: Artefact, sample: Sample, outcome: Outcome, seconds: float
) -> None:
    """Draw the outcome, and write it; the JSON comes last, with the checksums of the pictures, so
    that it stands for all.

    Raises:
        ConfigurationError: it cannot be written, as on a full disk.
    """
    pictures = {}
    if artefact.draw is not None:
        with mpl.rc_context({**STYLE, "svg.hashsalt": artefact.name}):
            figure = Figure(figsize=artefact.size)
            artefact.draw(figure, outcome)
            for suffix in _SUFFIXES:
                # Without a date, so that equal results are equal files.
                metadata = {"Date": None} if suffix == ".svg" else {"Software": None}
                picture = folder / f"{artefact.name}{suffix}"
                write_atomically(
                    picture,
                    lambda part, metadata=metadata: figure.savefig(
                        part, dpi=150, metadata=metadata
                    ),
                )
                pictures[suffix] = _checksum(picture.read_bytes())
                # To lay it out takes as long as to write it, and the next one is to look the same.
                figure.set_layout_engine("none")
    document = {
        "configuration": configuration(artefact, sample),
        "outcome": outcome.document(),
        "seconds": seconds,
        "pictures": pictures,
    }
    write_json(_path(folder, artefact), {**document, "sha256": _checksum_of_json(document)})


def _document(folder: Path, artefact: Artefact) -> dict[str, Any] | None:
    """What is in the file of an artefact, if there is one; of any version, with an object under
    "configuration".

    Raises:
        ConfigurationError: it is damaged or altered.
    """
    path = _path(folder, artefact)
    if not path.exists():
        return None
    with _reading(path):
        document = json.loads(read_bytes(path, _MOST), parse_constant=_refuse)
        if not isinstance(document["configuration"], dict):
            raise ValueError("it has no configuration")
        digest = document.get("sha256")
        # Versions before this one wrote none.
        if digest is not None and digest != _checksum_of_json(
            {k: v for k, v in document.items() if k != "sha256"}
        ):
            raise ValueError("its content does not match its checksum")
    return document


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        OSError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        raise ConfigurationError(
            f"{path} cannot be read ({type(error).__name__}: {str(error)[:_SHOWN]}); it is damaged"
            " or altered: remove it, and it is computed again"
        ) from error


def _path(folder: Path, artefact: Artefact) -> Path:
    return folder / f"{artefact.name}.json"


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _checksum_of_json(document: Mapping[str, Any]) -> str:
    return _checksum(json.dumps(document, sort_keys=True).encode())


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
