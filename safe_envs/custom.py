"""Systems of your own behind `gym.make`: from the place of their statement, FILE.py:NAME or MODULE:NAME, to an env."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
import zlib
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym

from safe_envs.env import SafeEnv, make_problem
from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest
from safe_envs.mistakes import require_sound
from safe_envs.problem import SafetyProblem
from safe_envs.vector import AutoresetMode, SafeVectorEnv

Factory = Callable[..., SafetyProblem]


def load_system(place: str) -> Factory:
    """Import the statement of a system.

    Args:
        place: FILE.py:NAME or MODULE:NAME of a `SafetyProblem`, or of a function that returns one. Importing runs the code there.

    Returns:
        The function, whose keyword arguments are those of `--barrier`; one without any for a problem.

    Raises:
        ConfigurationError: there is no such place, or the code there ends with an error.
    """
    found = load_object(place)
    if isinstance(found, SafetyProblem):
        require_sound(found)
        return lambda: found
    if not inspect.isfunction(found):
        raise ConfigurationError(f"{place} is {type(found).__name__}; give a SafetyProblem, or a function that returns one")

    def factory(**arguments: Any) -> SafetyProblem:
        problem = found(**arguments)
        if not isinstance(problem, SafetyProblem):
            raise ConfigurationError(f"{place} returned {type(problem).__name__}; it is to return a SafetyProblem")
        require_sound(problem)
        return problem

    factory.__signature__ = inspect.signature(found)  # pyright: ignore[reportFunctionMemberAccess]
    return factory


def load_object(place: str) -> Any:
    """Import what stands at FILE.py:NAME or MODULE:NAME.

    Raises:
        ConfigurationError: there is no such place, or the code there ends with an error.
    """
    source, colon, name = place.rpartition(":")
    if not (colon and source and name):
        raise ConfigurationError(f"{place!r} is no place of a statement; give FILE.py:NAME or MODULE:NAME, like my_system.py:problem")
    module = _of_file(Path(source)) if source.endswith(".py") else _of_module(source)
    if not hasattr(module, name):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise ConfigurationError(f"{source} has no {name!r}; {nearest(name, public)}")
    return getattr(module, name)


def _of_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise ConfigurationError(f"there is no file {path}; give the path of a Python file, as in my_system.py:problem")
    return _loaded(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=32)
def _loaded(path: Path, _changed: int) -> ModuleType:
    """Remembered until the file changes, so that the symbols of all envs of a file are compiled once."""
    name = f"_{path.stem}_{zlib.crc32(bytes(path)):08x}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"{path} cannot be read as Python")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.parent))  # As when Python runs the file: modules beside it can be imported.
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        if isinstance(error, SafeEnvsError):
            raise
        raise ConfigurationError(f"{path} ended with an error: {_described(error, path)}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module


def _of_module(name: str) -> ModuleType:
    try:
        return sys.modules.get(name) or importlib.import_module(name)
    except SafeEnvsError:
        raise
    except Exception as error:
        raise ConfigurationError(f"module {name} cannot be imported: {_described(error, None)}; a file is named with .py") from error


def _described(error: Exception, path: Path | None) -> str:
    """The error, and the last line of the file that led to it."""
    lines, trace = [], error.__traceback__
    while trace is not None:
        if path is not None and trace.tb_frame.f_code.co_filename == str(path):
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    where = f" in line {lines[-1]}" if lines else ""
    return f"{type(error).__name__}{where}: {error}"


def register(env_id: str, system: str | Factory) -> None:
    """Register an id with Gymnasium for a system of your own: `gym.make`, `gym.make_vec` and all commands know it then.

    Args:
        env_id: like "my_lab/CartPole-v0".
        system: where it is stated, see `load_system`; or the function itself, if it is at the top of a module. An env's spec
            holds the place as text, so that it can be made again elsewhere.

    Raises:
        ConfigurationError: there is no such place, or what is there is no problem. A mistake in the problem is an error of its own.
    """
    if isinstance(system, SafetyProblem):
        raise ConfigurationError(
            "register takes FILE.py:NAME or a function that returns a problem; a problem itself goes into SafeEnv(problem)"
        )
    if not isinstance(system, str):
        name = getattr(system, "__qualname__", "")
        if not name.isidentifier():
            raise ConfigurationError(f"{system!r} is no function at the top of a module, so that others could find it; define it there")
        system = f"{system.__module__}:{name}"
    load_system(system)()
    gym.register(
        env_id,
        entry_point="safe_envs.custom:Custom",
        vector_entry_point="safe_envs.custom:CustomVector",
        kwargs={"system": system},
    )


class Custom(SafeEnv):
    """A system of your own.

    Args:
        system: where it is stated: see `load_system`.
        barrier: arguments of the function that states it, by name; each may also be given by itself.
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: see `SafeEnv`.
        **options: `noise`, `plant`, `model`, `dt`, `substeps`, `horizon`, `box` and `start` as for `SystemEnv`.

    Raises:
        ConfigurationError: the place or an argument is unknown or out of range.
    """

    def __init__(
        self,
        system: str,
        *,
        barrier: Mapping[str, Any] | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(make_problem(system, load_system(system), barrier, options), max_episode_steps, render_mode)


class CustomVector(SafeVectorEnv):
    """The same, batched; further arguments as for `SafeVectorEnv`."""

    def __init__(
        self,
        system: str,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        barrier: Mapping[str, Any] | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        problem = make_problem(system, load_system(system), barrier, options)
        super().__init__(problem, num_envs, autoreset_mode, max_episode_steps, render_mode)
