"""Scenes: how each kind of problem is drawn."""

from __future__ import annotations

import importlib

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.scenes.base import Scene

SCENES = {
    "plane": "plane:PlaneScene",
    "bars": "bars:BarsScene",
    "top-view": "top_view:TopView",
    "altitude": "quadrotor:AltitudeScene",
    "side-view": "quadrotor:SideView",
    "road": "road:Road",
    "pendulum": "pendulum:PendulumScene",
    "line": "time_series:LineScene",
}
"""Where the scene of each name is."""


def make_scene(problem: SafetyProblem) -> Scene:
    """Return the scene that a problem names; by default its plane, or else a bar for each state.

    Raises:
        ConfigurationError: there is no such scene, or it shows states that the problem does not
            have.
    """
    name = problem.scene or ("bars" if problem.plane is None else "plane")
    if name not in SCENES:
        raise ConfigurationError(f"{problem.name} has scene {name!r}; {nearest(name, SCENES)}")
    module, class_name = SCENES[name].split(":")
    found = importlib.import_module(f"safe_envs.rendering.scenes.{module}")
    return getattr(found, class_name)(problem)
