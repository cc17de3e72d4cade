"""A delay that all stamps of a camera share makes its time offset less certain, and nothing else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from jaxcal import CalibrationError
from jaxcal.calibration.state import layout_of
from jaxcal.calibration.uncertainty import stamp_sigmas_of, with_common_delay
from jaxcal.cameras import PinholeRadtan

LENS = PinholeRadtan.create([400.0, 400.0, 320.0, 240.0], [0.0, 0.0, 0.0, 0.0])
sigmas = st.floats(0.0, 1e-2)


@given(st.lists(sigmas, min_size=2, max_size=4), st.booleans(), st.integers(0, 99))
def test_only_offsets_become_less_certain(delays: list[float], to_first_camera: bool, seed: int) -> None:
    layout = layout_of([LENS] * len(delays))
    root = np.random.default_rng(seed).normal(size=(layout.size, layout.size))
    before = root @ root.T
    after = with_common_delay(before, layout, delays, to_first_camera=to_first_camera)
    offsets = [layout.shift(c) for c in range(len(delays))]
    others = np.setdiff1d(np.arange(layout.size), offsets)
    assert_allclose(after[others], before[others])
    added = (after - before)[np.ix_(offsets, offsets)]
    relative = np.array(delays) - (delays[0] if to_first_camera else 0.0)
    assert_allclose(np.diag(added), relative**2, atol=1e-12)
    # What two cameras have in common cancels between them.
    between = np.array([1.0, -1.0] + [0.0] * (len(delays) - 2))
    assert_allclose(between @ added @ between, (delays[0] - delays[1]) ** 2, atol=1e-12)


def test_one_number_for_all_or_one_each() -> None:
    assert stamp_sigmas_of(1e-3, 3) == [1e-3] * 3
    assert stamp_sigmas_of([0.0, 1e-3], 2) == [0.0, 1e-3]
    for wrong in ([1e-3], -1.0, [0.0, float("nan")], [0.0, float("inf")]):
        with pytest.raises(CalibrationError, match="expected seconds, zero or more: one number for all 2 cameras or"):
            stamp_sigmas_of(wrong, 2)
