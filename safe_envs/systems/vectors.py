"""The systems in batches: a class `XVector` for each env class `X`.

Each is made when it is first named.
"""

from __future__ import annotations

from importlib import import_module

from safe_envs.envs.registered import SystemVectorEnv
from safe_envs.systems import MODULES


def __getattr__(name: str) -> type[SystemVectorEnv]:
    system = name.removesuffix("Vector")
    if system == name or system not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    members = {
        "__doc__": f"`{system}` in a batch.",
        "__module__": __name__,
        "env_class": getattr(import_module(f"safe_envs.systems.{MODULES[system]}"), system),
    }
    made = globals()[name] = type(name, (SystemVectorEnv,), members)
    return made
