"""Standard normal and exponential numbers of uniforms."""

import math

import mpmath
import numpy as np
import pytest

from safe_envs.dynamics import noise
from safe_envs.dynamics.noise import standard_exponentials, standard_normals
from safe_envs.dynamics.normal_kernel import standard_exponential, standard_normal

STEP = 2.0**-53


def uniforms(count=3000):
    """Multiples of 2**-53, in all parts of [0, 1): both ends, the joints and the middle."""
    rng = np.random.default_rng(0)
    near = 2.0 ** -rng.uniform(1.0, 53.0, count // 3)
    places = np.concatenate(
        [
            [0.0, 0.075, 0.925, 0.5, math.exp(-25.0)],
            rng.random(count // 3),
            near,
            1.0 - near,
            0.5 + rng.choice([-1, 1], count // 3) * near / 2,
        ]
    )
    steps = np.floor(places / STEP)
    return np.unique(np.clip(np.concatenate([steps - 1, steps, steps + 1]), 0, 2**53 - 1)) * STEP


def test_the_inverse_distribution_function():
    u = uniforms()[::40]
    with mpmath.workdps(40):
        half = mpmath.mpf(1) / 2
        expected = [
            mpmath.sqrt(2) * mpmath.erfinv(2 * (mpmath.mpf(x) - half + mpmath.mpf(2) ** -54))
            for x in u.tolist()
        ]
        errors = [
            float(abs(mpmath.mpf(z) / exact - 1))
            for z, exact in zip(standard_normals(u).tolist(), expected, strict=True)
        ]
    assert len(errors) > 200
    assert max(errors) < 1e-15


def test_arrays_and_floats_agree():
    u = uniforms()
    scalar = np.array([standard_normal(x) for x in u.tolist()])
    central = abs(u - 0.5) < 0.425
    assert 0.3 < central.mean() < 0.9
    np.testing.assert_array_equal(standard_normals(u)[central], scalar[central])
    # The logarithms of NumPy and of Python may differ in their last bit.
    np.testing.assert_allclose(standard_normals(u), scalar, rtol=4e-16)
    np.testing.assert_allclose(
        standard_exponentials(u), [standard_exponential(x) for x in u.tolist()], rtol=4e-16
    )


def test_a_number_does_not_depend_on_its_neighbours(monkeypatch):
    u = uniforms()
    together = standard_normals(u)
    monkeypatch.setattr(noise, "_PIECE", 7)
    np.testing.assert_array_equal(standard_normals(u), together)
    np.testing.assert_array_equal(standard_normals(u[::-2]), together[::-2])
    square = u[:1000].reshape(10, 100).T
    np.testing.assert_array_equal(standard_normals(square), together[:1000].reshape(10, 100).T)
    given = u.copy()
    assert standard_normals(given, out=given) is given
    np.testing.assert_array_equal(given, together)
    assert standard_normals(np.empty((0, 2))).shape == (0, 2)


def test_symmetry_order_and_ends():
    u = uniforms()
    z = standard_normals(u)
    np.testing.assert_array_equal(standard_normals((1.0 - STEP) - u), -z)
    assert [standard_normal(x) for x in ((1.0 - STEP) - u[:99]).tolist()] == [
        -standard_normal(x) for x in u[:99].tolist()
    ]
    assert (np.diff(z) >= 0).all()
    assert z[0] == pytest.approx(-8.292361075813595)
    assert z.max() == -z[0]
    assert (z != 0).all()


def test_exponentials():
    assert standard_exponential(0.0) == pytest.approx(54 * math.log(2))
    assert standard_exponential(1.0 - STEP) == 0.0
    u = uniforms()
    np.testing.assert_allclose(np.exp(-standard_exponentials(u)), u + STEP / 2, rtol=1e-14)
