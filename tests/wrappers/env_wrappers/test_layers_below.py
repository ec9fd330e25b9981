"""What is known of each wrapper of Gymnasium between a filter and a third-party env."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor

from safe_envs.errors import ConfigurationError, SystemDefinitionWarning
from safe_envs.wrappers.layers import doubt_layers

NOTHING = ""
SIGHT = "and changes observations: unless state_fn undoes that, the filter"
ACTIONS = "and changes actions: unless action_map undoes that, the filter"
REPEATS = "and repeats actions: unless dt is the time of all repetitions, the filter"
BOTH = (
    "and changes observations and repeats actions: unless state_fn undoes that and dt is the time"
    " of all repetitions, the filter"
)
OWN_STEP = "and has a step of its own: if that repeats or changes actions, or changes observations"

SINGLE = {
    **dict.fromkeys(
        (
            *("ClipReward", "TransformReward", "NormalizeReward", "TimeLimit", "OrderEnforcing"),
            *("PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering"),
            *("RenderCollection", "AddWhiteNoise", "ObstructView"),
        ),
        NOTHING,
    ),
    **dict.fromkeys(
        (
            *("DelayObservation", "DtypeObservation", "DiscretizeObservation"),
            *("FilterObservation", "FlattenObservation", "FrameStackObservation"),
            *("GrayscaleObservation", "TransformObservation", "NormalizeObservation"),
            *("AddRenderObservation", "ResizeObservation", "ReshapeObservation"),
            *("RescaleObservation", "TimeAwareObservation"),
        ),
        SIGHT,
    ),
    **dict.fromkeys(
        ("ClipAction", "DiscretizeAction", "TransformAction", "RescaleAction", "StickyAction"),
        ACTIONS,
    ),
    "MaxAndSkipObservation": BOTH,
    "RepeatAction": REPEATS,
    # With a screen for its observations, which no filter reads a state from.
    "AtariPreprocessing": REPEATS,
    **dict.fromkeys(("ArrayConversion", "JaxToNumpy", "JaxToTorch", "NumpyToTorch"), OWN_STEP),
}
"""What the class alone tells; most change a space, too, which is seen as well."""

REFUSED = "Autoreset"

VECTOR = {
    **dict.fromkeys(
        (
            *("VectorizeTransformReward", "TransformReward", "ClipReward", "NormalizeReward"),
            *("RecordEpisodeStatistics", "RecordVideo", "HumanRendering"),
        ),
        NOTHING,
    ),
    **dict.fromkeys(
        (
            *("VectorizeTransformObservation", "TransformObservation", "FilterObservation"),
            *("FlattenObservation", "GrayscaleObservation", "ResizeObservation"),
            *("ReshapeObservation", "RescaleObservation", "DtypeObservation"),
            "NormalizeObservation",
        ),
        SIGHT,
    ),
    **dict.fromkeys(
        ("VectorizeTransformAction", "TransformAction", "ClipAction", "RescaleAction"), ACTIONS
    ),
    **dict.fromkeys(
        ("DictInfoToList", "ArrayConversion", "JaxToNumpy", "JaxToTorch", "NumpyToTorch"), OWN_STEP
    ),
}


class Tampers(gym.Wrapper):
    def step(self, action: Any) -> Any:
        return self.env.step(-action)


def doubts(env: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        doubt_layers(env)
    assert {each.category for each in found} <= {SystemDefinitionWarning}
    return [str(each.message) for each in found]


def bare(module: Any, name: str, base: Any, env: Any) -> Any:
    """Return a wrapper of a class over an env, whose own arguments do not matter here."""
    try:
        kind = getattr(module, name)
    except (ImportError, gym.error.DependencyNotInstalled) as error:
        pytest.skip(str(error))
    layer = kind.__new__(kind)
    base.__init__(layer, env)
    return layer


def test_every_wrapper_of_gymnasium_is_decided_on():
    assert {*wrappers.__all__} <= {*SINGLE, REFUSED, "vector"}
    assert {*wrappers.vector.__all__} <= {*VECTOR}


@pytest.mark.parametrize("name", [each for each in SINGLE if each in wrappers.__all__])
def test_wrappers_of_one_env(name: str):
    env = gym.make("Pendulum-v1")
    found = doubts(bare(wrappers, name, gym.Wrapper, env))
    start = f"{name} lies between the filter and the env {SINGLE[name]}"
    assert [text[: len(start)] for text in found] == ([start] if SINGLE[name] else [])


@pytest.mark.parametrize("name", [each for each in VECTOR if each in wrappers.vector.__all__])
def test_wrappers_of_vector_envs(name: str):
    envs = gym.make_vec("Pendulum-v1", 2)
    found = doubts(bare(wrappers.vector, name, gym.vector.VectorWrapper, envs))
    start = f"{name} lies between the filter and the env {VECTOR[name]}"
    assert [text[: len(start)] for text in found] == ([start] if VECTOR[name] else [])


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_wrappers_of_the_envs_of_a_batch_are_named_once(mode: Any):
    def wrap(env: Any) -> Any:
        return wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))

    envs = gym.make_vec("Pendulum-v1", 2, vectorization_mode=mode, wrappers=[wrap])
    (text,) = doubts(envs)
    envs.close()
    assert "RescaleAction" in text
    assert ACTIONS in text


def test_an_unknown_wrapper_with_a_step_is_doubted():
    (text,) = doubts(Tampers(gym.make("Pendulum-v1")))
    assert text.startswith("Tampers lies")
    assert OWN_STEP in text


def test_a_wrapper_without_a_step_and_the_monitor_of_stable_baselines3_are_not():
    assert doubts(gym.Wrapper(Monitor(gym.make("Pendulum-v1")))) == []


def test_a_wrapper_that_starts_episodes_is_refused():
    with pytest.raises(ConfigurationError, match="starts episodes of which the filter"):
        doubt_layers(wrappers.Autoreset(gym.make("Pendulum-v1")))
