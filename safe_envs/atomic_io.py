"""Files that are there whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safe_envs.errors import ConfigurationError, shortened

_STEM = 40


def require_writable(path: Path) -> None:
    """Raise ConfigurationError unless a file can be created at `path`.

    Call it before a long run, not after it.
    """
    folder, name = path.absolute().parent, shortened(path)
    # The functions of os.path take any text for a path, also one that is too long to be one.
    if os.path.isdir(path):
        raise ConfigurationError(f"cannot write {name}: it is a folder; name a file in it")
    if not os.path.isdir(folder):
        there = next(place for place in (folder, *folder.parents) if os.path.exists(place))
        if not there.is_dir():
            raise ConfigurationError(
                f"cannot write {name}: {there} is a file and no folder; choose another folder"
            )
        raise ConfigurationError(
            f"cannot write {name}: the folder {shortened(folder)} does not exist; create it or"
            " choose another"
        )
    if os.path.exists(path) and not os.path.isfile(path):
        raise ConfigurationError(
            f"cannot write {name}: it is a pipe or a device, which a file would replace; name a"
            " file"
        )
    try:
        path.lstat()
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"cannot write {name}: {getattr(error, 'strerror', error)}; choose another name"
        ) from error
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigurationError(
            f"cannot write {name}: no file can be created in {folder} ({error.strerror})"
        ) from error


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file in the same folder, then move it to `path` in one step.

    Args:
        path: where the file is to be.
        write: is given the temporary path, which has the suffix of `path`.

    Raises:
        ConfigurationError: the folder does not exist or is not writable, or the file cannot be
            written, as on a full disk; what was at `path` before is still there.
    """
    with replaced_at_the_end(path) as temporary, writing(path):
        write(temporary)


@contextmanager
def replaced_at_the_end(path: Path) -> Iterator[Path]:
    """Yield a temporary file in the same folder, and move it to `path` in one step at the end.

    For a file that is written bit by bit during a long run; `write_atomically` is for all others.
    After an error what was at `path` before is still there. Errors as for `write_atomically`, but
    those of the writing itself, for which see `writing`.
    """
    require_writable(path)
    with writing(path):
        # With more of its name, the temporary one could be too long.
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem[:_STEM]}.", suffix=path.suffix[-_STEM:], dir=path.absolute().parent
        )
        os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with writing(path):
            temporary.chmod(0o644)
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors of the operating system into a ConfigurationError that names `path`."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot write {path}: {error.strerror or error}; see to it that there is room and that"
            " files may be written there"
        ) from error


def write_json(path: Path, data: Any) -> None:
    """Write strict JSON, whole or not at all; errors as for `write_atomically`.

    Args:
        path: where the file is to be.
        data: JSON-able, without NaN or infinities.
    """
    text = json.dumps(data, indent=2, allow_nan=False)
    write_atomically(path, lambda part: part.write_text(text + "\n"))
