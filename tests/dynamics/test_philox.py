"""Streams of counter-based random numbers."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from safe_envs import ConfigurationError
from safe_envs.dynamics.noise import (
    BRIDGE,
    EPISODE,
    NOISE,
    POLICY,
    START,
    StreamReader,
    key_of,
    standard_normals,
)

PURPOSES = (NOISE, START, BRIDGE, POLICY, EPISODE)
FULL = 2**64 - 1


def philox(counter, key):
    """Philox 4x64-10 in whole numbers, by the definition of Salmon et al., section 3.3."""
    x, k = list(counter), list(key)
    for _ in range(10):
        first, second = 0xD2E7470EE14C6C93 * x[0], 0xCA5A826395121157 * x[2]
        x = [(second >> 64) ^ x[1] ^ k[0], second & FULL, (first >> 64) ^ x[3] ^ k[1], first & FULL]
        k = [(k[0] + 0x9E3779B97F4A7C15) & FULL, (k[1] + 0xBB67AE8584CAA73B) & FULL]
    return x


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ([0] * 4, [0] * 2, "16554d9eca36314c db20fe9d672d0fdc d7e772cee186176b 7e68b68aec7ba23b"),
        (
            [FULL] * 4,
            [FULL] * 2,
            "87b092c3013fe90b 438c3c67be8d0224 9cc7d7c69cd777b6 a09caebf594f0ba0",
        ),
        # The digits of pi.
        (
            [0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89],
            [0x452821E638D01377, 0xBE5466CF34E90C6C],
            "a528f45403e61d95 38c72dbd566e9788 a5a1610e72fd18b5 57bd43b5e52b7fe6",
        ),
    ],
)
def test_the_reference_has_the_published_answers(counter, key, words):
    """Known answers of Random123, the library of the authors of Philox."""
    assert philox(counter, key) == [int(word, 16) for word in words.split()]


@pytest.mark.parametrize("seed", [0, 7, 2**64 + 3, FULL])
@pytest.mark.parametrize(("episode", "purpose"), [(0, NOISE), (5, POLICY), (2**40, EPISODE)])
@pytest.mark.parametrize("first", [0, 1, 3, 4, 1002, 4 * 2**50 + 2])
def test_words_are_those_of_the_definition(seed, episode, purpose, first):
    key = (seed % 2**64, seed // 2**64)
    assert key_of(seed) == key
    expected = [
        philox([j // 4 + 1, episode, purpose, 0], key)[j % 4] for j in range(first, first + 9)
    ]
    reader = StreamReader()
    reader.seek((1, 2), 3, 4).uniforms(5)
    assert reader.seek(key, episode, purpose, first).words(9).tolist() == expected
    uniforms = [(w >> 11) / 2**53 for w in expected]
    assert reader.seek(key, episode, purpose, first).uniforms((3, 3)).ravel().tolist() == uniforms
    filled = np.empty(9)
    reader.seek(key, episode, purpose, first).fill(filled[:5])
    reader.fill(filled[5:])
    assert filled.tolist() == uniforms


def test_keys():
    assert key_of(3) == (3, 0)
    assert key_of(2**128 - 1) == (FULL, FULL)
    assert key_of(2**128) == tuple(np.random.SeedSequence(2**128).generate_state(2, np.uint64))
    for seed in (-1, 0.5, True):
        with pytest.raises(ConfigurationError, match="seed"):
            key_of(seed)  # pyright: ignore[reportArgumentType]


def test_neighbouring_streams_have_no_word_in_common():
    reader, seeds = StreamReader(), (0, 1, 2, 2**32, 2**64, 2**64 + 1)
    drawn = [
        reader.seek(key_of(seed), episode, purpose).words(64)
        for seed, episode, purpose in itertools.product(seeds, range(5), PURPOSES)
    ]
    words = np.concatenate(drawn)
    assert len(words) == 6 * 5 * 5 * 64
    # Of so many fair words, two agree with a probability of 3e-12.
    assert len(np.unique(words)) == len(words)


def normals(count, neighbour):
    """Pairs of normal numbers from neighbouring places of streams, shape (2, count)."""
    reader, found = StreamReader(), np.empty((2, count // 64, 64))
    for n in range(count // 64):
        for side in (0, 1):
            seed, episode, purpose, step = neighbour(n, side)
            reader.seek(key_of(seed), episode, purpose, step).fill(found[side, n])
    return standard_normals(found).reshape(2, -1)


@pytest.mark.parametrize(
    "neighbour",
    [
        pytest.param(lambda n, side: (2 * n + side, 0, NOISE, 0), id="seeds"),
        pytest.param(lambda n, side: (0, 2 * n + side, NOISE, 0), id="episodes"),
        pytest.param(lambda n, side: (0, n, (NOISE, POLICY)[side], 0), id="purposes"),
        pytest.param(lambda n, side: (0, n, NOISE, side), id="channels"),
        pytest.param(lambda n, side: (0, 0, NOISE, 128 * n + 64 * side), id="steps"),
    ],
)
def test_numbers_are_independent_and_normal(neighbour):
    count, level = 64 * 512, 1e-4
    pair = normals(count, neighbour)
    for x in pair:
        assert abs(x.sum()) / math.sqrt(count) < stats.norm.isf(level / 2)
        assert level / 2 < stats.chi2(count).sf((x**2).sum()) < 1 - level / 2
        assert stats.kstest(x, "norm").pvalue > level
    for a, b in (pair, pair**2):
        assert stats.pearsonr(a, b)[1] > level
