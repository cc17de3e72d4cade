"""The reconstructor: state, reset, sizes, silence, options; with a small network of random weights."""

import logging

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import reconstruction
from jaxcal.errors import CalibrationError
from jaxcal.observations import Events
from reconstruction.colour import bayer_places, merged
from reconstruction.networks import E2VIDRecurrent, FireNet, FoldedFireNet, ReconstructionNetwork, TwoScaleNet
from reconstruction.reconstructor import unsharp_kernel
from reconstruction.voxel import RunningAndScale, accumulate

Window = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
NOTHING: Window = tuple(np.zeros(0, dtype=np.int64) for _ in range(4))  # pyright: ignore[reportAssignmentType]


def make_network(kind: str = "folded") -> ReconstructionNetwork:
    torch.manual_seed(5)
    network = {
        "folded": lambda: FoldedFireNet(channels=8),
        "e2vid": lambda: E2VIDRecurrent(base_num_channels=4, num_encoders=3, num_residual_blocks=1),
        "firenet": lambda: FireNet(base_num_channels=4),
    }[kind]()
    if kind != "e2vid":
        with torch.no_grad():  # an output in the middle of the grey scale
            (network.body if kind == "folded" else network.net).pred.conv2d.bias.fill_(0.5)  # pyright: ignore
    return network.eval().requires_grad_(False)


def make_window(width: int, height: int, seed: int, start_us: int = 0, count: int = 300) -> Window:
    rng = np.random.default_rng(seed)
    t = start_us + np.sort(rng.integers(0, 20_000, count))
    return rng.integers(0, width, count), rng.integers(0, height, count), t, rng.integers(0, 2, count)


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 45), st.integers(1, 45), st.sampled_from(["folded", "e2vid", "firenet"]))
def test_any_sensor_size_gives_an_image_of_that_size(width: int, height: int, kind: str):
    reconstructor = reconstruction.Reconstructor(make_network(kind), width, height)
    for index in range(2):
        image = reconstructor(*make_window(width, height, index, 20_000 * index))
        assert image.shape == (height, width)
        assert image.dtype == np.uint8


class _MeanOfBins(ReconstructionNetwork):
    """No learning: shows where the reconstructor puts each pixel."""

    def __init__(self, multiple: int):
        super().__init__()
        self.num_bins, self.multiple, self.settings = 5, multiple, {}

    def forward(self, voxels: torch.Tensor, state: list | None) -> tuple[torch.Tensor, list]:
        assert voxels.shape[-1] % self.multiple == voxels.shape[-2] % self.multiple == 0
        return voxels.mean(dim=1, keepdim=True), []


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from([1, 2, 8, 16]))
def test_padding_does_not_shift_the_image(width: int, height: int, multiple: int):
    window = make_window(width, height, 1)
    image = reconstruction.Reconstructor(
        _MeanOfBins(multiple), width, height, unsharp_mask_amount=0.0, Imin=-1.0, Imax=1.0
    )(*window)
    expected = 255 * (reconstruction.voxel_grid(*window, width=width, height=height).mean(axis=0) + 1) / 2
    assert np.abs(image - expected.clip(0, 255)).max() <= 1.0


def test_state_carries_over_and_reset_clears_it():
    reconstructor = reconstruction.Reconstructor(make_network(), 32, 24)
    first, second = make_window(32, 24, 1), make_window(32, 24, 2, 20_000)
    one, two = reconstructor(*first), reconstructor(*second)
    reconstructor.reset()
    np.testing.assert_array_equal(reconstructor(*first), one)
    np.testing.assert_array_equal(reconstructor(*second), two)
    reconstructor.reset()
    assert (reconstructor(*second) != two).any()


def test_two_reconstructors_share_a_network_without_disturbing_each_other():
    network = make_network()
    alone = reconstruction.Reconstructor(network, 32, 24)
    expected = [alone(*make_window(32, 24, seed, 20_000 * seed)) for seed in range(3)]
    left, right = (reconstruction.Reconstructor(network, 32, 24) for _ in range(2))
    for seed in range(3):
        window = make_window(32, 24, seed, 20_000 * seed)
        np.testing.assert_array_equal(left(*window), expected[seed])
        right(*make_window(32, 24, 50 + seed, 20_000 * seed))


def test_no_recurrent_forgets():
    reconstructor = reconstruction.Reconstructor(make_network(), 32, 24, no_recurrent=True)
    window = make_window(32, 24, 1)
    np.testing.assert_array_equal(reconstructor(*window), reconstructor(*window))


def test_a_window_without_events_repeats_the_last_image_and_keeps_the_state():
    quiet, steady = (reconstruction.Reconstructor(make_network(), 32, 24) for _ in range(2))
    assert (quiet(*NOTHING) == 127).all()
    first, second = make_window(32, 24, 1), make_window(32, 24, 2, 20_000)
    image = quiet(*first)
    np.testing.assert_array_equal(image, steady(*first))
    repeated = quiet(*NOTHING)
    np.testing.assert_array_equal(repeated, image)
    repeated[:] = 0  # the caller may do as it likes with its image
    np.testing.assert_array_equal(quiet(*NOTHING), image)
    np.testing.assert_array_equal(quiet(*second), steady(*second))


@pytest.mark.parametrize("start_us", [-1_000_000, 6_000_000])
def test_a_jump_in_time_starts_anew(start_us: int, caplog: pytest.LogCaptureFixture):
    reconstructor, fresh = (reconstruction.Reconstructor(make_network(), 32, 24) for _ in range(2))
    reconstructor(*make_window(32, 24, 1))
    later = make_window(32, 24, 2, start_us)
    with caplog.at_level(logging.INFO, logger="reconstruction"):
        image = reconstructor(*later)
    np.testing.assert_array_equal(image, fresh(*later))
    assert "starts anew" in caplog.text


def test_hot_pixels_have_no_influence(tmp_path):
    window = make_window(32, 24, 1)
    rest = np.ones(len(window[0]), dtype=bool)
    rest[1:-1] = (window[0][1:-1] != 5) | (window[1][1:-1] != 6)
    fires = ([5] * 90, [6] * 90, [19_000] * 90, [1] * 90)
    hot = [np.concatenate([values, extra]) for values, extra in zip(window, fires, strict=True)]
    order = np.argsort(hot[2], kind="stable")
    clean = reconstruction.Reconstructor(make_network(), 32, 24, hot_pixels=np.array([[5, 6]]))
    expected = clean(*(values[rest] for values in window))
    (tmp_path / "hot.txt").write_text("5,6\n")
    for place in ([[5, 6]], tmp_path / "hot.txt"):
        masked = reconstruction.Reconstructor(make_network(), 32, 24, hot_pixels=place)
        np.testing.assert_array_equal(masked(*(values[order] for values in hot)), expected)
    assert (reconstruction.Reconstructor(make_network(), 32, 24)(*(values[order] for values in hot)) != expected).any()


def test_flip_turns_image_and_events_by_half_a_turn():
    x, y, t, p = make_window(32, 24, 1)
    straight = reconstruction.Reconstructor(make_network(), 32, 24)(31 - x, 23 - y, t, p)
    np.testing.assert_array_equal(reconstruction.Reconstructor(make_network(), 32, 24, flip=True)(x, y, t, p), straight)


def test_fixed_bounds_scale_the_grey_levels():
    options = {"unsharp_mask_amount": 0.0, "precision": "float32"}
    window = make_window(32, 24, 1)
    plain = reconstruction.Reconstructor(make_network(), 32, 24, **options)(*window).astype(float)
    scaled = reconstruction.Reconstructor(make_network(), 32, 24, Imin=0.25, Imax=0.75, **options)(*window)
    expected = (255 * (plain / 255 - 0.25) / 0.5).clip(0, 255)
    assert np.abs(scaled - expected).max() <= 2.0  # two images cut to whole grey levels


def test_auto_hdr_follows_the_median_of_the_extremes():
    """Written out from the reference: bounds limited to 0..0.45 and 0.55..1, median over the last eleven images."""
    network, windows = make_network("e2vid"), [make_window(32, 24, seed, 20_000 * seed) for seed in range(14)]
    options = {"unsharp_mask_amount": 0.0}
    raw = reconstruction.Reconstructor(network, 32, 24, **options)
    raw_images, bounds = [], []
    auto = reconstruction.Reconstructor(network, 32, 24, auto_hdr=True, **options)
    for window in windows:
        raw_images.append(raw(*window) / 255.0)
        image = auto(*window)
        bounds.append((min(raw_images[-1].min(), 0.45), max(raw_images[-1].max(), 0.55)))
        low, high = np.median(bounds[-11:], axis=0)
        expected = (255 * (raw_images[-1] - low) / (high - low)).clip(0, 255)
        assert np.abs(image - expected).max() <= 2 + 1 / (high - low)


def test_unsharp_kernel_is_the_references():
    """Values of the reference's gkern(5, 1.0): the square root makes it a one-dimensional product of its own."""
    kernel = unsharp_kernel(1.0)[0, 0].numpy()
    assert kernel.sum() == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(kernel, kernel.T)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-7)
    row = kernel[2] / kernel[2, 2]
    # Five cells from -1.3 to 1.3, with these shares of a standard normal distribution.
    np.testing.assert_allclose(row**2, np.array([0.12090, 0.17974, 0.20514, 0.17974, 0.12090]) / 0.20514, atol=1e-4)


def test_unsharp_mask_sharpens():
    window = make_window(32, 24, 1)
    soft = reconstruction.Reconstructor(make_network(), 32, 24, unsharp_mask_amount=0.0)(*window)
    sharp = reconstruction.Reconstructor(make_network(), 32, 24, unsharp_mask_amount=2.0)(*window)
    assert (
        np.abs(np.diff(sharp[4:-4].astype(int), axis=1)).mean() > np.abs(np.diff(soft[4:-4].astype(int), axis=1)).mean()
    )


def test_bilateral_filter_smooths():
    window = make_window(32, 24, 1)
    plain = reconstruction.Reconstructor(make_network(), 32, 24)(*window)
    smooth = reconstruction.Reconstructor(make_network(), 32, 24, bilateral_filter_sigma=2.0)(*window)
    assert smooth.dtype == np.uint8
    assert np.abs(np.diff(smooth.astype(int))).mean() < np.abs(np.diff(plain.astype(int))).mean()


def test_bfloat16_stays_close_to_float32():
    images = [
        reconstruction.Reconstructor(make_network(), 32, 24, precision=precision)(*make_window(32, 24, 1))
        for precision in ("float32", "bfloat16")
    ]
    assert np.abs(images[0].astype(int) - images[1]).max() <= 4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"width": 0}, "0x24"),
        ({"Imin": 0.5, "Imax": 0.5}, "Imax"),
        ({"unsharp_mask_amount": -1.0}, "must not be negative"),
        ({"precision": "float8"}, "float8"),
        ({"hot_pixels": np.array([[32, 0]])}, r"\(32, 0\) lies outside"),
        ({"hot_pixels": "/nowhere/hot.txt"}, "/nowhere/hot.txt: hot pixels unreadable"),
    ],
)
def test_options_out_of_range_are_refused(options: dict, words: str):
    with pytest.raises(CalibrationError, match=words):
        reconstruction.Reconstructor(make_network(), **({"width": 32, "height": 24} | options))


def _events(window: Window, origin_ns: int) -> Events:
    x, y, t, p = window
    return Events(origin_ns + 1000 * t, x.astype(np.uint16), y.astype(np.uint16), p.astype(bool), 32, 24)


def test_stream_gives_the_reconstructors_images_at_the_windows_ends():
    origin = 1_600_000_000_000_000_000
    windows = [make_window(32, 24, seed, 20_000 * seed) for seed in range(4)]
    ends = [origin + 20_000_000 * (seed + 1) for seed in range(4)]
    stream = reconstruction.reconstruct(
        ((end, _events(window, origin)) for end, window in zip(ends, windows, strict=True)),
        make_network(),
        width=32,
        height=24,
        unsharp_mask_amount=0.1,
    )
    reconstructor = reconstruction.Reconstructor(make_network(), 32, 24, unsharp_mask_amount=0.1)
    for end, window, (t_ns, image) in zip(ends, windows, stream, strict=True):
        assert t_ns == end
        np.testing.assert_array_equal(image, reconstructor(*window))


@pytest.mark.parametrize("no_normalize", [False, True])
def test_a_network_gets_the_plane_that_it_asks_for_with_scaled_and_with_raw_counts(no_normalize: bool):
    torch.manual_seed(5)
    network = TwoScaleNet(channels=8, detail=4, scaling="running+scale").eval().requires_grad_(False)
    seen: list[torch.Tensor] = []
    network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    window = make_window(32, 24, 1)
    reconstruction.Reconstructor(network, 32, 24, no_normalize=no_normalize)(*window)
    grid = accumulate(*window, width=32, height=24, num_bins=8)
    scaled = RunningAndScale()(grid)
    np.testing.assert_allclose(seen[0][0, -1], scaled[-1])
    np.testing.assert_allclose(seen[0][0, :8], grid if no_normalize else scaled[:8], atol=1e-4)


class _Clock(ReconstructionNetwork):
    """Shows where in the bins the events lie: their mean bin, over the last one."""

    num_bins, multiple, settings = 5, 1, {}
    scaling = "none"

    def __init__(self, shown_at: float):
        super().__init__()
        self.shown_at = shown_at

    def forward(self, voxels: torch.Tensor, state: list | None) -> tuple[torch.Tensor, list]:
        weight = torch.arange(5.0)[None, :, None, None] / 4
        return (weight * voxels).sum(dim=1, keepdim=True) / voxels.sum(), []


@settings(deadline=None, max_examples=30)
@given(st.integers(1_000, 99_000), st.integers(0, 10**18))
def test_stream_shows_the_moment_that_is_asked_for_wherever_it_is_in_the_window(shown_us: int, start_ns: int):
    """Events at that moment lie in the middle bin of a network that shows the middle."""
    cell = np.zeros(1, np.uint16)
    first, then = (Events(start_ns + 1000 * np.array([t]), cell, cell, cell == 0, 1, 1) for t in (0, 10_000 + shown_us))
    ends = [start_ns + 10_000_000, start_ns + 110_000_000]
    windows = [(ends[0], first, True, start_ns + 5_000_000), (ends[1], then, True, ends[0] + 1000 * shown_us)]
    images = list(reconstruction.reconstruct(windows, _Clock(0.5), width=1, height=1, unsharp_mask_amount=0.0))
    assert [t_ns for t_ns, _ in images] == [windows[0][3], windows[1][3]]
    assert images[1][1][0, 0] == pytest.approx(127.5, abs=1.0)


def test_stream_tells_by_itself_when_its_images_are_of():
    events = [
        Events(np.array([t]), *(np.zeros(1, np.uint16),) * 2, np.ones(1, bool), 4, 4) for t in (100, 1_000, 2_500)
    ]
    windows = list(zip((1_000, 2_000, 3_000), events[:1] + events[1:], strict=True))
    for shown_at, expected in ((0.5, [550, 1_500, 2_500]), (1.0, [1_000, 2_000, 3_000])):
        stream = reconstruction.reconstruct(windows, _Clock(shown_at), width=4, height=4)
        assert [t_ns for t_ns, _ in stream] == expected


@pytest.mark.parametrize(("shown_at", "moment", "words"), [(1.0, 500, "shows the end"), (0.5, 1_500, "outside")])
def test_stream_refuses_moments_that_its_network_cannot_show(shown_at: float, moment: int, words: str):
    events = Events(np.array([100]), *(np.zeros(1, np.uint16),) * 2, np.ones(1, bool), 4, 4)
    with pytest.raises(CalibrationError, match=words):
        list(reconstruction.reconstruct([(1_000, events, True, moment)], _Clock(shown_at), width=4, height=4))


def test_stream_is_lazy():
    drawn = []

    def windows():
        for seed in range(100):
            drawn.append(seed)
            yield 20_000_000 * (seed + 1), _events(make_window(32, 24, seed, 20_000 * seed), 0)

    stream = reconstruction.reconstruct(windows(), make_network(), width=32, height=24)
    next(stream)
    next(stream)
    assert drawn == [0, 1]


def test_stream_refuses_windows_out_of_order_and_late_events():
    events = _events(make_window(32, 24, 0), 0)
    with pytest.raises(CalibrationError, match="must come in order of time"):
        list(reconstruction.reconstruct([(10**9, events), (10**9, events)], make_network(), width=32, height=24))
    with pytest.raises(CalibrationError, match="ends at 5 ns holds an event"):
        list(reconstruction.reconstruct([(5, events)], make_network(), width=32, height=24))


# --- colour, devices ---


@settings(deadline=None, max_examples=10)
@given(st.sampled_from(["rggb", "bggr", "grbg", "gbrg"]), st.integers(0, 1000))
def test_the_colour_image_has_the_brightness_of_the_grey_one(pattern: str, seed: int):
    width, height = 24, 16
    windows = [make_window(width, height, seed + index, 20_000 * index, 400) for index in range(2)]
    options = {"unsharp_mask_amount": 0.0, "no_normalize": True, "precision": "float32"}
    whole = reconstruction.Reconstructor(make_network(), width, height, bayer=pattern, **options)
    grey = reconstruction.Reconstructor(make_network(), width, height, **options)
    places = bayer_places(pattern, width, height)
    assert sorted(places) == ["b", "g", "r", "w"]
    assert [pattern[2 * row + column] for row, column in (places["r"], places["b"])] == ["r", "b"]
    for window in windows:
        image, lightness = whole(*window), grey(*window)
        assert image.shape == (height, width, 3)
        back = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        inside = (image > 0).all(axis=2) & (image < 255).all(axis=2)  # colours out of gamut lose some brightness
        assert np.abs(back.astype(int) - lightness)[inside].max(initial=0) <= 3


def test_colours_lie_where_their_pixels_are():
    """A ramp over the image, sampled by each colour at its own pixels, comes back as the same ramp: no shift."""
    ramp = np.add.outer(2.0 * np.arange(32), 3.0 * np.arange(40)).astype(np.uint8)
    for pattern in ("rggb", "gbrg"):
        places = bayer_places(pattern, 40, 32)
        planes = {name: (ramp[row::2, column::2], row, column) for name, (row, column) in places.items()}
        image = merged(ramp, planes)
        assert np.abs(image[2:-2, 2:-2].astype(int) - ramp[2:-2, 2:-2, None]).max() <= 3


def test_colour_needs_whole_blocks_and_a_known_pattern(caplog: pytest.LogCaptureFixture):
    with pytest.raises(CalibrationError, match="no whole Bayer blocks"):
        reconstruction.Reconstructor(make_network(), 31, 24, bayer="rggb")
    with pytest.raises(CalibrationError, match="bayer is 'rgb'"):
        reconstruction.Reconstructor(make_network(), 32, 24, bayer="rgb")
    colour = reconstruction.Reconstructor(make_network(), 32, 24, bayer="rggb", auto_hdr=True)
    assert "auto_hdr is left out" in caplog.text
    assert colour(*NOTHING).shape == (24, 32, 3)


def test_devices_that_are_not_there_are_named():
    with pytest.raises(CalibrationError, match="device 'cuda:99' cannot be used"):
        reconstruction.Reconstructor(make_network(), 32, 24, device="cuda:99")
    with pytest.raises(CalibrationError, match="device 'abacus' cannot be used"):
        reconstruction.Reconstructor(make_network(), 32, 24, device="abacus")
    with pytest.raises(CalibrationError, match="float16 is for GPUs"):
        reconstruction.Reconstructor(make_network(), 32, 24, precision="float16", device="cpu")
    assert reconstruction.Reconstructor(make_network(), 32, 24, device="auto").device.type in ("cpu", "cuda")


def test_networks_trained_on_raw_grids_get_them_padded_with_zeros():
    window = make_window(30, 21, 1)
    network = FireNet(base_num_channels=4, normalise=False, padding="zeros").eval()
    seen = []
    network.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0].clone()))
    reconstruction.Reconstructor(network, 30, 21)(*window)
    grid = accumulate(*window, width=30, height=21)
    assert seen[0].shape == (1, 5, 32, 32)
    np.testing.assert_array_equal(seen[0][0, :, 6:27, 1:31], grid)
    assert float(seen[0].abs().sum()) == pytest.approx(np.abs(grid).sum(), rel=1e-6)
