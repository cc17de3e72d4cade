"""Parts of recordings: what is kept is what lies in the span, and simultaneous cameras stay simultaneous."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from jaxcal import CalibrationError, Detections
from jaxcal.observations import Frames
from jaxcal.recording.cut import SomeImages, cut_detections, cut_frames

MS = 1_000_000


class Numbers:
    """Images that are their own numbers, with a fingerprint, as files have."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> np.ndarray:
        return np.full((2, 3), index, np.uint8)

    def fingerprint(self) -> str:
        return "numbers"


def frames_at(times: list[int]) -> Frames:
    return Frames(np.array(times, np.int64), Numbers(len(times)), (3, 2))


spans = st.tuples(st.integers(0, 900), st.integers(1, 900)).map(lambda s: (s[0] * MS, (s[0] + s[1]) * MS))


@given(st.lists(st.integers(0, 2000), min_size=1, max_size=50, unique=True).map(sorted), spans)
def test_exactly_the_frames_of_the_span_are_kept(times_ms: list[int], span: tuple[int, int]) -> None:
    times = [t * MS for t in times_ms]
    wanted = [k for k, t in enumerate(times) if span[0] <= t <= span[1]]
    if not wanted:
        with pytest.raises(CalibrationError, match="no frame lies between"):
            cut_frames(frames_at(times), span)
        return
    kept = cut_frames(frames_at(times), span)
    assert kept.timestamps_ns.tolist() == [times[k] for k in wanted]
    assert [int(kept.images[k][0, 0]) for k in range(len(kept))] == wanted


@given(st.integers(5, 60), st.integers(1, 70), st.integers(0, 10**12))
@example(6, 6, 0)
def test_thinned_frames_are_as_many_as_asked_for(rate: int, wanted: int, start: int) -> None:
    times = start + np.arange(10 * rate) * 10**9 // rate
    kept = cut_frames(frames_at(times.tolist()), rate_hz=float(wanted)).timestamps_ns
    assert abs(len(kept) - 10 * min(rate, wanted)) <= max(1, 10 * rate // 10) * (wanted > 0.5 * rate) + 1
    assert set(kept.tolist()) <= set(times.tolist())


def test_simultaneous_cameras_keep_simultaneous_frames() -> None:
    rng = np.random.default_rng(0)
    times = 10**18 + np.arange(400) * 50 * MS
    jitter = rng.integers(-MS // 2, MS // 2, 400)
    one, other = (cut_frames(frames_at(t.tolist()), rate_hz=4.0).timestamps_ns for t in (times, times + jitter))
    assert len(one) == len(other) == 80
    assert np.abs(one - other).max() <= MS // 2


def test_the_fingerprint_says_which_images_were_chosen() -> None:
    whole = frames_at([0, MS, 2 * MS])
    first, last = (cut_frames(whole, span).images for span in ((0, MS), (MS, 2 * MS)))
    assert isinstance(first, SomeImages)
    assert isinstance(last, SomeImages)
    assert first.fingerprint() != last.fingerprint()
    assert cut_frames(whole, (0, 2 * MS)) is whole


@given(spans, st.integers(0, 2**32 - 1))
def test_corners_of_the_span_keep_their_frames(span: tuple[int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.arange(20) * 100 * MS
    frame = np.sort(rng.integers(0, 20, 30))
    point, pixels, precision = np.arange(30), rng.uniform(0, 9, (30, 2)), rng.uniform(1, 2, 30)
    seen = Detections(times, frame, point, pixels, (10, 10), precision)
    inside = (times[frame] >= span[0]) & (times[frame] <= span[1])
    if not ((times >= span[0]) & (times <= span[1])).any():
        with pytest.raises(CalibrationError, match="no frame with corners"):
            cut_detections(seen, span)
        return
    cut = cut_detections(seen, span)
    assert cut.precision is not None
    np.testing.assert_array_equal(cut.timestamps_ns[cut.frame], times[frame][inside])
    np.testing.assert_array_equal(cut.point, point[inside])
    np.testing.assert_array_equal(cut.pixels, pixels[inside])
    np.testing.assert_array_equal(cut.precision, precision[inside])
