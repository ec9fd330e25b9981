"""Noise of paths that begin in different control periods."""

from __future__ import annotations

import numpy as np

from safe_envs.agents.rare_events.numpy_paths import PathNoise
from safe_envs.dynamics.noise import NOISE, StreamReader, standard_normals
from safe_envs.envs.starts import EpisodeStreams

SEEDS = (5, 6, 7)
CHANNELS, PERIODS = 3, 200


def stream_of(seed):
    uniforms = StreamReader().seek((seed, 0), 0, NOISE).uniforms((PERIODS, CHANNELS))
    return standard_normals(uniforms)


def test_each_env_has_the_rest_of_its_stream_and_nothing_after_it():
    streams = EpisodeStreams(len(SEEDS))
    noise = PathNoise(streams, CHANNELS, PERIODS)
    streams.seed(SEEDS)
    streams.begin_episodes(range(len(SEEDS)))
    noise.begin(np.arange(len(SEEDS)))
    first = noise.next(None)
    wanted = [stream_of(seed) for seed in SEEDS]
    assert first.T.tolist() == [rows[0].tolist() for rows in wanted]

    begun = np.array([0, 11, PERIODS - 2])
    noise.seek(np.arange(len(SEEDS)), begun)
    drawn = np.array([noise.next(None) for _ in range(PERIODS)])
    for i, (rows, begin) in enumerate(zip(wanted, begun, strict=True)):
        left = PERIODS - begin
        assert drawn[:left, :, i].tolist() == rows[begin:].tolist()
        # Beyond the episode the noise is next to nothing.
        assert np.abs(drawn[left:, :, i]).max(initial=0.0) < 1e-12


def test_later_episodes_have_no_noise():
    streams = EpisodeStreams(len(SEEDS))
    noise = PathNoise(streams, CHANNELS, 20)
    streams.seed(SEEDS)
    for envs in (np.arange(len(SEEDS)), np.array([1])):
        streams.begin_episodes(envs)
        noise.begin(envs)
    drawn = noise.next(None)
    assert drawn[:, 1].tolist() == [0.0] * CHANNELS
    assert np.all(drawn[:, [0, 2]])


def test_nothing_is_drawn_without_channels():
    assert PathNoise(EpisodeStreams(4), 0, 20).next(None).shape == (0, 4)
