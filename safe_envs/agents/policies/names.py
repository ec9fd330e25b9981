"""Names, places and files of policies, known before what is behind them is imported."""

from __future__ import annotations

import os
import re
from pathlib import Path

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.plugins import POLICIES as POLICY_PLUGINS
from safe_envs.plugins import module_of, plugin_names, resolved

POLICIES = ("nominal", "clf", "zero", "random", "best")
"""Names that `make_policy` knows without any other package."""

POLICY_FILE = "policy.npz"
"""Name of the file of a policy that was saved as data; see `safe_envs.agents.policies.network`."""

_PLACE = re.compile(r".+\.py:\w+|[^\W\d]\w*(\.\w+)*:\w+")

_ALLOWED = (
    "a policy of your own as FILE.py:NAME, a folder of `safe-envs train`, or the path of a"
    " Stable-Baselines3 .zip"
)


def require_policy(name: str) -> None:
    """Raise ConfigurationError if there is no policy of a name and no file; nothing is opened.

    Args:
        name: as for `safe_envs.agents.policies.registry.make_policy`.
    """
    if name in POLICIES or name in plugin_names(POLICY_PLUGINS):
        return
    if os.path.exists(name):
        saved = saved_policy_file(Path(name))
        if saved is not None and not os.path.exists(saved):
            raise ConfigurationError(f"{saved} does not exist; `safe-envs train` writes such files")
        if name.endswith(".py"):
            raise ConfigurationError(f"policy {shown(name)} is a file of Python; give {_ALLOWED}")
        return
    if is_place(name):
        file = policy_file(name)
        if file is not None and not os.path.isfile(file):
            raise ConfigurationError(
                f"policy {shown(name)}: there is no such file; give FILE.py:NAME of what a file"
                " defines"
            )
        return
    if "." in os.path.basename(name) or os.sep in name:
        raise ConfigurationError(
            f"policy {shown(name)}: there is no such file or folder; give {_ALLOWED}, or one of"
            f" {', '.join(POLICIES)}"
        )
    known = (*POLICIES, *plugin_names(POLICY_PLUGINS))
    raise ConfigurationError(
        f"unknown policy {shown(name)}; {nearest(name, known, f'or {_ALLOWED}')}"
    )


def is_place(name: str) -> bool:
    """Return whether the name of a policy is FILE.py:NAME or MODULE:NAME, and no file."""
    return _PLACE.fullmatch(name) is not None and not os.path.exists(name)


def saved_policy_file(path: Path) -> Path | None:
    """Return the file of a policy that was saved as data; None where the path names no such one.

    Args:
        path: of its folder, or of the file itself.
    """
    # Unlike a path, os.path takes any text for the name of a file.
    if os.path.isdir(path):
        return path / POLICY_FILE
    return path if path.suffix == ".npz" else None


def policy_file(name: str) -> Path | None:
    """Return the file that `make_policy` reads; None for the name of a policy and MODULE:NAME."""
    if name in POLICIES or name in plugin_names(POLICY_PLUGINS):
        return None
    if is_place(name):
        source = name.rpartition(":")[0]
        return Path(source) if source.endswith(".py") else None
    return saved_policy_file(Path(name)) or Path(name)


def policy_files(name: str) -> list[Path]:
    """Return the files that decide what the policy of a name is: its own, and its statistics."""
    file = policy_file(name)
    if file is None:
        return []
    return [file, *(statistics_files(file) if file.suffix == ".zip" else [])]


def policy_module(name: str) -> str | None:
    """Return the module of a policy that is MODULE:NAME or of a package; None for others."""
    if name in POLICIES:
        return None
    if name in plugin_names(POLICY_PLUGINS):
        return module_of(POLICY_PLUGINS, name)
    source = name.rpartition(":")[0]
    return source if is_place(name) and not source.endswith(".py") else None


def absolute_policy(name: str) -> str:
    """Return the name of a policy with the whole path of its file, valid in any folder."""
    if is_place(name):
        return resolved(name)
    return os.path.realpath(name) if policy_file(name) and os.path.exists(name) else name


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
