"""The voxel grid: conservation, symmetry, normalisation, and the windows that have too little in them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.errors import CalibrationError
from reconstruction import voxel_grid, voxel_torch
from reconstruction.voxel import RunningAndScale, RunningScale, accumulate, normalise, scaler, window_time

WIDTH, HEIGHT = 7, 5
SIZE = {"width": WIDTH, "height": HEIGHT}


@st.composite
def events(draw: st.DrawFn, min_size: int = 0) -> tuple[np.ndarray, ...]:
    """x, y, t_us, p of some events, in order of time."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(min_size, 60))
    start = draw(st.sampled_from([0, 1_600_000_000_000_000]))
    t = start + np.sort(rng.integers(0, draw(st.sampled_from([1, 40, 50_000])), n))
    return (
        rng.integers(0, WIDTH, n).astype(np.uint16),
        rng.integers(0, HEIGHT, n).astype(np.uint16),
        t.astype(np.int64),
        rng.random(n) < 0.5,
    )


@settings(deadline=None, max_examples=60)
@given(events(), st.integers(1, 6))
def test_sum_per_pixel_is_rises_minus_falls(window: tuple[np.ndarray, ...], bins: int):
    x, y, _, p = window
    expected = np.zeros((HEIGHT, WIDTH))
    np.add.at(expected, (y.astype(int), x.astype(int)), np.where(p, 1.0, -1.0))
    np.testing.assert_allclose(accumulate(*window, **SIZE, num_bins=bins).sum(axis=0), expected, atol=1e-4)


@settings(deadline=None, max_examples=60)
@given(events(), st.integers(0, 2**32 - 1))
def test_order_of_events_does_not_matter(window: tuple[np.ndarray, ...], seed: int):
    order = np.random.default_rng(seed).permutation(len(window[0]))
    shuffled = tuple(values[order] for values in window)
    np.testing.assert_allclose(accumulate(*shuffled, **SIZE), accumulate(*window, **SIZE), atol=1e-5)


@settings(deadline=None, max_examples=60)
@given(events(min_size=1), st.integers(1, 6), st.sampled_from([1, 3]), st.booleans())
def test_cells_are_summed_to_the_bit_as_the_reference_does(
    window: tuple[np.ndarray, ...], bins: int, threads: int, shuffled: bool
):
    """One event after the other in single precision: shares of the bins below first, then of those above."""
    order = np.random.default_rng(0).permutation(len(window[0])) if shuffled else np.arange(len(window[0]))
    x, y, t, p = (values[order] for values in window)
    position = (bins - 1) * (t - t.min()).astype(float) / (float(t.max() - t.min()) or 1.0)
    below = np.minimum(position.astype(int), max(bins - 2, 0))
    expected = np.zeros((bins, HEIGHT, WIDTH), dtype=np.float32)
    for above in range(2 if bins > 1 else 1):
        for i in range(len(t)):
            share = position[i] - below[i] if above else 1.0 - (position[i] - below[i])
            cell = (below[i] + above, y[i], x[i])
            expected[cell] = np.float32(np.float64(expected[cell]) + (share if p[i] else -share))
    np.testing.assert_array_equal(accumulate(x, y, t, p, **SIZE, num_bins=bins, threads=threads), expected)


@settings(deadline=None, max_examples=60)
@given(events(min_size=1), st.integers(1, 59))
def test_grids_of_parts_add_up_when_they_span_the_same_time(window: tuple[np.ndarray, ...], cut: int):
    """Linear before normalisation: each part is completed by the first and last event, which then count twice."""
    x, y, t, p = window
    ends = np.array([0, len(t) - 1])
    inner = np.arange(1, len(t) - 1)
    first, second = inner[inner < cut], inner[inner >= cut]

    def grid(rows: np.ndarray) -> np.ndarray:
        return accumulate(*(values[rows] for values in (x, y, t, p)), **SIZE)

    completed = [grid(np.concatenate([ends[:1], part, ends[1:]])) for part in (first, second)]
    whole = grid(np.concatenate([ends[:1], inner, ends[1:]]))
    np.testing.assert_allclose(completed[0] + completed[1] - grid(ends), whole, atol=1e-5)


@settings(deadline=None, max_examples=60)
@given(events())
def test_opposite_polarity_gives_the_opposite_grid(window: tuple[np.ndarray, ...]):
    x, y, t, p = window
    np.testing.assert_allclose(accumulate(x, y, t, ~p, **SIZE), -accumulate(x, y, t, p, **SIZE), atol=1e-6)


@settings(deadline=None, max_examples=60)
@given(events(), st.sampled_from([1e-3, 1.0, 60.0]), st.integers(-(10**6), 10**6))
def test_time_counts_only_relative_to_first_and_last_event(window: tuple[np.ndarray, ...], scale: float, shift: int):
    x, y, t, p = window
    moved = (t - (t[0] if len(t) else 0)) * scale + shift
    np.testing.assert_allclose(accumulate(x, y, moved, p, **SIZE), accumulate(x, y, t, p, **SIZE), atol=1e-4)


@settings(deadline=None, max_examples=60)
@given(events(min_size=2))
def test_non_zero_cells_are_normalised(window: tuple[np.ndarray, ...]):
    raw, grid = accumulate(*window, **SIZE), voxel_grid(*window, **SIZE)
    assert grid.dtype == np.float32
    assert grid.shape == (5, HEIGHT, WIDTH)
    assert np.isfinite(grid).all()
    assert (grid[raw == 0] == 0).all()
    filled = raw[raw != 0].astype(np.float64)
    if len(filled) and filled.std() > 1e-3:
        values = grid[raw != 0].astype(np.float64)
        np.testing.assert_allclose([values.mean(), values.std()], [0.0, 1.0], atol=1e-5)
        np.testing.assert_allclose(values, (filled - filled.mean()) / filled.std(), atol=1e-4)


def test_an_event_is_shared_by_the_two_bins_around_it():
    grid = accumulate(
        np.array([0, 3, 6]), np.array([0, 2, 4]), np.array([100, 130, 200]), np.array([1, 1, 0]), **SIZE, num_bins=5
    )
    expected = np.zeros((5, HEIGHT, WIDTH))
    expected[0, 0, 0] = 1.0
    expected[1, 2, 3], expected[2, 2, 3] = 0.8, 0.2  # 30 of 100 us lie at bin 1.2 of 0..4
    expected[4, 4, 6] = -1.0
    np.testing.assert_allclose(grid, expected, atol=1e-6)


@pytest.mark.parametrize("polarity", [[True, False], [1, 0], [1, -1]])
def test_polarity_may_be_written_in_any_of_the_usual_ways(polarity: list[int]):
    grid = accumulate(np.array([1, 2]), np.array([0, 0]), np.array([0, 9]), np.array(polarity), **SIZE)
    assert grid[0, 0, 1] == 1.0
    assert grid[4, 0, 2] == -1.0


def test_no_events_give_zeros():
    nothing = np.zeros(0, dtype=np.int64)
    grid = voxel_grid(nothing, nothing, nothing, nothing, **SIZE)
    assert grid.shape == (5, HEIGHT, WIDTH)
    assert (grid == 0).all()


@pytest.mark.parametrize("count", [1, 3])
def test_events_at_one_time_lie_in_the_first_bin(count: int):
    same = np.full(count, 4)
    grid = voxel_grid(same, same, np.full(count, 5_000), np.ones(count), **SIZE)
    assert np.isfinite(grid).all()
    assert np.argwhere(grid).tolist() == [[0, 4, 4]]


def test_normalisation_of_equal_cells_leaves_them():
    grid = np.zeros((5, HEIGHT, WIDTH), dtype=np.float32)
    grid[2, 1, 1:4] = 2.0
    np.testing.assert_array_equal(normalise(grid), grid)


@pytest.mark.parametrize(("x", "y"), [(WIDTH, 0), (0, HEIGHT), (-1, 0)])
def test_event_outside_the_sensor_is_refused(x: int, y: int):
    with pytest.raises(CalibrationError, match=rf"event 1 at \(x, y\) = \({x}, {y}\).*7x5"):
        voxel_grid(np.array([0, x]), np.array([0, y]), np.array([0, 1]), np.array([1, 1]), **SIZE)


def test_arrays_of_different_lengths_are_refused():
    with pytest.raises(CalibrationError, match="2, 2, 2, 1 entries"):
        voxel_grid(np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(1), **SIZE)


@settings(deadline=None, max_examples=60)
@given(events(), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_scatter_add_gives_the_same_grid_in_any_order(window: tuple[np.ndarray, ...], bins: int, seed: int):
    """The path for GPUs, run on the CPU: exact sums, so that the order leaves no trace."""
    size = {**SIZE, "num_bins": bins, "device": "cpu"}
    grid = voxel_torch.accumulate(*window, **size)
    np.testing.assert_allclose(grid, accumulate(*window, **SIZE, num_bins=bins), atol=2e-6)
    order = np.random.default_rng(seed).permutation(len(window[0]))
    assert torch.equal(voxel_torch.accumulate(*(values[order] for values in window), **size), grid)
    np.testing.assert_allclose(voxel_torch.normalise(grid), normalise(grid.numpy()), atol=1e-5)


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 40), st.integers(0, 30), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_running_scale_is_the_events_of_a_passing_edge(edge: int, noise: int, hot: int, seed: int):
    """Whatever single noise events and a few hot pixels there are beside."""
    rng = np.random.default_rng(seed)
    net = np.zeros(4000)
    net[:200] = edge * rng.choice([-1, 1], 200)
    net[200 : 200 + noise] = 1
    net[300 : 300 + hot] = 20 * edge
    scale = RunningScale()
    grid = scale(rng.permutation(net).reshape(1, 50, 80).astype(np.float32))
    assert scale.events == edge
    assert np.abs(grid).max() == pytest.approx(2.0 * (20 if hot else 1))


def test_running_scale_outlasts_slow_windows_and_fades():
    scale, fast, slow = RunningScale(), np.full((1, 4, 4), 20.0, np.float32), np.full((1, 4, 4), 3.0, np.float32)
    scale(fast)
    first = scale(slow)
    assert np.allclose(first, 2.0 * 3.0 / (0.99 * 20.0))
    for _ in range(1000):
        last = scale(np.zeros((1, 4, 4), np.float32))
    assert scale.events == 1.0
    assert np.isfinite(last).all()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30), st.floats(0.1, 0.9), st.floats(0.1, 0.9))
def test_window_time_puts_the_shown_moment_where_the_network_expects_it(places: list[float], moment: float, at: float):
    start, end = 1e15, 1e15 + 50_000.0
    shown = start + moment * (end - start)
    t_us = np.sort(start + (end - start) * np.array(places))
    time, span = window_time(np.concatenate([[start, shown, end], t_us]), (start, shown, end), at)
    assert span == (0.0, 1.0)
    assert time[:3] == pytest.approx([0.0, at, 1.0], abs=1e-9)
    assert np.all(np.diff(time[3:]) >= 0)
    assert np.all((time >= 0) & (time <= 1))


@pytest.mark.parametrize("span", [(5.0, 5.0, 5.0), (5.0, 5.0, 9.0), (5.0, 9.0, 9.0), (0.0, 5.0, 9.0)])
def test_window_time_of_parts_without_length_is_that_of_linear_interpolation(span: tuple[float, float, float]):
    t_us = np.array([3, 5, 6, 8, 9, 12])
    np.testing.assert_array_equal(window_time(t_us, span, 0.5)[0], np.interp(t_us, span, [0.0, 0.5, 1.0]))


def test_networks_that_show_the_end_get_times_as_they_are():
    t_us = np.array([3, 5, 9])
    time, span = window_time(t_us, (0.0, 10.0, 10.0), 1.0)
    assert time is t_us
    assert span is None


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_a_given_span_places_the_bins(seed: int):
    """Bins of the window, not of its events: the same events in a span that begins earlier lie in later bins."""
    rng = np.random.default_rng(seed)
    x, y, p = rng.integers(0, 8, 40), rng.integers(0, 6, 40), rng.integers(0, 2, 40)
    t = np.sort(rng.uniform(0.5, 1.0, 40))
    size = {"width": 8, "height": 6, "num_bins": 5}
    grid = accumulate(x, y, t, p, **size, span=(0.0, 1.0))
    assert not grid[:2].any()
    assert grid.sum() == pytest.approx(np.where(p > 0, 1, -1).sum(), abs=1e-4)
    own = accumulate(x, y, t, p, **size, span=(float(t.min()), float(t.max())))
    np.testing.assert_array_equal(own, accumulate(x, y, t, p, **size))
    on_torch = voxel_torch.accumulate(x, y, t, p, **size, device="cpu", span=(0.0, 1.0))
    np.testing.assert_allclose(on_torch.numpy(), grid, atol=1e-5)


@settings(deadline=None, max_examples=30)
@given(st.integers(2, 12), st.integers(0, 2**32 - 1))
def test_the_scale_beside_a_grid_tells_the_events_of_an_edge(count: int, seed: int):
    """Edges that make more events give equal grids; the plane tells how many they were."""
    shape = np.zeros((5, 6, 7), dtype=np.float32)
    shape[0] = np.random.default_rng(seed).choice([-1.0, 0.0, 1.0], (6, 7))
    shape[0, 0, 0] = 1.0
    together = RunningAndScale()
    made = together(count * shape)
    assert made.shape == (6, 6, 7)
    np.testing.assert_allclose(made[:5], 2.0 * shape, rtol=1e-6)
    assert np.all(made[5] == np.float32(0.5 * np.log(count)))
    slower = together(shape)  # of a window in which edges move little
    np.testing.assert_allclose(slower[:5], 2.0 * shape / max(0.99 * count, 1.0), rtol=1e-6)
    assert slower[5, 0, 0] == pytest.approx(0.5 * np.log(0.99 * count), abs=1e-6)


def test_each_recording_has_a_scale_of_its_own():
    assert scaler("window") is scaler("none") is normalise
    assert scaler("running+scale") is not scaler("running+scale")
    assert isinstance(scaler("running"), RunningScale)
