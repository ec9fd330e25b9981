"""The kernel of the plane above an uncertainty against the batch."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.engine.qp.kernels import second_order as kernel
from safe_envs.engine.qp.second_order import majorant


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_is_the_plane_of_the_batch(m):
    rng = np.random.default_rng(m)
    factor = rng.normal(size=(60, m + 1, m + 1)) * 10.0 ** rng.uniform(-2, 2, (60, 1, 1))
    factor[::3, :, 1:] = 0.0
    low, high = -rng.uniform(0.1, 3.0, m), rng.uniform(0.1, 3.0, m)
    slopes, work = np.empty(m), np.full(kernel.work_of_majorant(m), np.nan)
    for form in factor @ factor.swapaxes(1, 2):
        constant = kernel.majorant_plane(form, low, high, slopes, work)
        expected, above = majorant(form.tolist(), low.tolist(), high.tolist())
        size = np.sqrt(np.abs(form).max())
        np.testing.assert_allclose(slopes, expected, rtol=1e-13, atol=1e-13 * size)
        assert constant == pytest.approx(above, rel=1e-13, abs=1e-13 * size)


def test_a_form_that_is_negative_by_rounding_has_the_root_0():
    slopes, work = np.empty(1), np.empty(2)
    form = np.array([[1.0, -1.0], [-1.0, 1.0 - 1e-16]])
    ends = np.array([-1.0]), np.array([1.0])
    assert kernel.majorant_plane(form, *ends, slopes, work) == pytest.approx(1.0)
    assert slopes == pytest.approx([-1.0])
