"""Where the statistics of a .zip of Stable-Baselines3 lie: the VecNormalize of its training."""

from __future__ import annotations

import re
from pathlib import Path

from safe_envs.errors import ConfigurationError

_CHECKPOINT = re.compile(r"(.+)_(\d+)_steps")
"""Stem of a model of `CheckpointCallback`."""

_OF_CHECKPOINT = re.compile(r"(.+)_vecnormalize_(\d+)_steps")
"""Stem of its statistics."""


def statistics_files(path: Path) -> list[Path]:
    """Return the files next to a .zip that may hold its statistics; nothing is opened.

    They are the pickles with "norm" in their names, and VecNormalize's in a subfolder without a
    model, where the RL Zoo puts it. One that is named after this .zip excludes the others, and one
    that is named after another .zip of the folder is that one's.

    Args:
        path: of the .zip.
    """
    folder = path.parent
    found = [each for each in sorted(folder.glob("*.pkl")) if "norm" in each.stem.lower()]
    named = [each for each in found if _is_named_after(each.stem, path.stem)]
    if named:
        return named
    models = [each.stem for each in folder.glob("*.zip")]
    free = [each for each in found if not any(_is_named_after(each.stem, m) for m in models)]
    free += [p for p in sorted(folder.glob("*/vecnormalize.pkl")) if not [*p.parent.glob("*.zip")]]
    # Those of its training's checkpoints show that this model had some too.
    return free or [each for each in found if _OF_CHECKPOINT.fullmatch(each.stem)]


def statistics_file(path: Path) -> Path | None:
    """Return the file with the statistics of a .zip; None where there is none.

    Args:
        path: of the .zip.

    Raises:
        ConfigurationError: There are several, or only those of another checkpoint.
    """
    files = statistics_files(path)
    if not files:
        return None
    of_another = _OF_CHECKPOINT.fullmatch(files[0].stem)
    if len(files) > 1 or (of_another and not _is_named_after(files[0].stem, path.stem)):
        raise ConfigurationError(
            f"it is not clear which statistics of VecNormalize are those of {path}, if any are:"
            f" {', '.join(map(str, files))}; copy it into a new folder, and its own to"
            " vecnormalize.pkl there, if it has any"
        )
    return files[0]


def _is_named_after(name: str, model: str) -> bool:
    """Return whether the stem of statistics is that of a model, with something added."""
    checkpoint, own = _CHECKPOINT.fullmatch(model), _OF_CHECKPOINT.fullmatch(name)
    if checkpoint or own:
        return bool(checkpoint and own and checkpoint.groups() == own.groups())
    return name.startswith((f"{model}_", f"{model}-")) or name.endswith((f"_{model}", f"-{model}"))
