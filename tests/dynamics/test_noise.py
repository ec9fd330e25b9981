"""Streams of counter-based random numbers, and the normal numbers of their uniforms."""

from __future__ import annotations

import itertools
import math

import mpmath
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
    standard_exponentials,
    standard_normals,
)
from safe_envs.dynamics.normal_kernel import standard_exponential, standard_normal

PURPOSES = (NOISE, START, BRIDGE, POLICY, EPISODE)
FULL = 2**64 - 1
STEP = 2.0**-53


def philox(counter, key):
    """Philox 4x64-10 in whole numbers, by the definition of Salmon et al., section 3.3."""
    x, k = list(counter), list(key)
    for _ in range(10):
        first, second = 0xD2E7470EE14C6C93 * x[0], 0xCA5A826395121157 * x[2]
        x = [(second >> 64) ^ x[1] ^ k[0], second & FULL, (first >> 64) ^ x[3] ^ k[1], first & FULL]
        k = [(k[0] + 0x9E3779B97F4A7C15) & FULL, (k[1] + 0xBB67AE8584CAA73B) & FULL]
    return x


DIGITS_OF_PI = [
    *(0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89),
    *(0x452821E638D01377, 0xBE5466CF34E90C6C),
]


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([0] * 6, "16554d9eca36314c db20fe9d672d0fdc d7e772cee186176b 7e68b68aec7ba23b"),
        ([FULL] * 6, "87b092c3013fe90b 438c3c67be8d0224 9cc7d7c69cd777b6 a09caebf594f0ba0"),
        (DIGITS_OF_PI, "a528f45403e61d95 38c72dbd566e9788 a5a1610e72fd18b5 57bd43b5e52b7fe6"),
    ],
)
def test_the_reference_has_the_published_answers(numbers, words):
    """Known answers of Random123, the library of the authors of Philox."""
    assert philox(numbers[:4], numbers[4:]) == [int(word, 16) for word in words.split()]


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
    streams = itertools.product(seeds, range(5), PURPOSES)
    words = [reader.seek(key_of(s), episode, purpose).words(64) for s, episode, purpose in streams]
    # Of 9600 fair words, two agree with a probability of 3e-12.
    assert len(np.unique(words)) == np.size(words) == 6 * 5 * 5 * 64


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
def test_numbers_of_neighbouring_places_are_independent_and_normal(neighbour):
    reader, uniforms, level = StreamReader(), np.empty((2, 512, 64)), 1e-4
    for side, n in np.ndindex(2, 512):
        seed, episode, purpose, step = neighbour(n, side)
        reader.seek(key_of(seed), episode, purpose, step).fill(uniforms[side, n])
    pair = standard_normals(uniforms).reshape(2, -1)
    for x in pair:
        assert abs(x.sum()) / math.sqrt(x.size) < stats.norm.isf(level / 2)
        assert level / 2 < stats.chi2(x.size).sf((x**2).sum()) < 1 - level / 2
        assert stats.kstest(x, "norm").pvalue > level
    for a, b in (pair, pair**2):
        assert stats.pearsonr(a, b)[1] > level


def uniforms(count=3000):
    """Multiples of 2**-53, in all parts of [0, 1): both ends, the joints and the middle."""
    rng = np.random.default_rng(0)
    near = 2.0 ** -rng.uniform(1.0, 53.0, count // 3)
    middle = 0.5 + rng.choice([-1, 1], count // 3) * near / 2
    joints = [0.0, 0.075, 0.925, 0.5, math.exp(-25.0)]
    steps = np.concatenate([joints, rng.random(count // 3), near, 1.0 - near, middle]) // STEP
    return np.unique(np.clip(np.concatenate([steps - 1, steps, steps + 1]), 0, 2**53 - 1)) * STEP


def test_normal_numbers_are_the_inverse_distribution_function_to_the_last_place():
    u = uniforms()[::40]
    assert len(u) > 200
    with mpmath.workdps(40):
        for x, z in zip(u.tolist(), standard_normals(u).tolist(), strict=True):
            exact = mpmath.sqrt(2) * mpmath.erfinv(2 * mpmath.mpf(x) - 1 + mpmath.mpf(2) ** -53)
            assert abs(mpmath.mpf(z) / exact - 1) < 1e-15


def test_arrays_and_floats_agree():
    u = uniforms()
    scalar = np.array([standard_normal(x) for x in u.tolist()])
    central = abs(u - 0.5) < 0.425
    assert 0.3 < central.mean() < 0.9
    np.testing.assert_array_equal(standard_normals(u)[central], scalar[central])
    # The logarithms of NumPy and of Python may differ in their last bit.
    np.testing.assert_allclose(standard_normals(u), scalar, rtol=4e-16)
    exponentials = [standard_exponential(x) for x in u.tolist()]
    np.testing.assert_allclose(standard_exponentials(u), exponentials, rtol=4e-16)


def test_a_number_does_not_depend_on_its_neighbours():
    u = np.tile(uniforms(), 4)  # longer than the pieces that are computed at once
    together = standard_normals(u)
    np.testing.assert_array_equal([standard_normals(x) for x in u[:200]], together[:200])
    np.testing.assert_array_equal(standard_normals(u[::-2]), together[::-2])
    square = u[:1000].reshape(10, 100).T
    np.testing.assert_array_equal(standard_normals(square), together[:1000].reshape(10, 100).T)
    given = u.copy()
    assert standard_normals(given, out=given) is given
    np.testing.assert_array_equal(given, together)
    assert standard_normals(np.empty((0, 2))).shape == (0, 2)


def test_normal_numbers_are_symmetric_monotone_and_bounded():
    u = uniforms()
    z = standard_normals(u)
    np.testing.assert_array_equal(standard_normals((1.0 - STEP) - u), -z)
    assert all(standard_normal((1.0 - STEP) - x) == -standard_normal(x) for x in u[:99].tolist())
    assert (np.diff(z) >= 0).all()
    assert z[0] == pytest.approx(-8.292361075813595)
    assert z.max() == -z[0]
    assert (z != 0).all()


def test_exponential_numbers_are_minus_the_logarithm():
    assert standard_exponential(0.0) == pytest.approx(54 * math.log(2))
    assert standard_exponential(1.0 - STEP) == 0.0
    u = uniforms()
    np.testing.assert_allclose(np.exp(-standard_exponentials(u)), u + STEP / 2, rtol=1e-14)
