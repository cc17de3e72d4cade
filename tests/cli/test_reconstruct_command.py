"""`jaxcal reconstruct` and `python -m reconstruction`: folders, bags, e2calib's command lines, repeated runs."""

import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch
from click.testing import CliRunner, Result

import reconstruction
from jaxcal.cli import main
from jaxcal.recording import load_frames
from reconstruction.checkpoints import save_network
from reconstruction.networks import FoldedFireNet

WIDTH, HEIGHT = 32, 24
T0_US = 1_600_000_000_000_000


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def events(tmp_path: Path) -> Path:
    """Events over 0.2 s, of which pixel (5, 7) makes a tenth, and a trigger each 20 ms."""
    rng = np.random.default_rng(0)
    count = 4_000
    t = T0_US + np.sort(rng.integers(0, 200_000, count))
    x, y = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    x[::10], y[::10] = 5, 7
    with h5py.File(tmp_path / "events.h5", "w") as file:
        file["t"], file["x"], file["y"], file["p"] = t, x, y, rng.integers(0, 2, count)
        file["triggers/t"] = T0_US + np.arange(10_000, 200_000, 10_000)
        file["triggers/channel"], file["triggers/rising"] = np.zeros(19, np.int64), np.arange(19) % 2 == 0
    return tmp_path / "events.h5"


@pytest.fixture
def network(tmp_path: Path) -> Path:
    torch.manual_seed(2)
    network = FoldedFireNet(channels=4)
    with torch.no_grad():
        network.body.pred.conv2d.bias.fill_(0.5)  # pyright: ignore
    save_network(network, tmp_path / "small.safetensors")
    return tmp_path / "small.safetensors"


@pytest.fixture
def run(events: Path, network: Path):
    def run(*arguments: str | Path, source: bool = True) -> Result:
        first = [events] if source else []
        size = ["--width", WIDTH, "--height", HEIGHT]
        words = [str(word) for word in ["reconstruct", *first, *size, "-c", network, *arguments]]
        return CliRunner().invoke(main, words, catch_exceptions=False)

    return run


def listing(folder: Path) -> list[int]:
    frames = load_frames(folder)
    for image in frames.images:
        assert image.shape == (HEIGHT, WIDTH)
    assert sorted(path.name for path in (folder / "data").iterdir()) == [f"{t:019d}.png" for t in frames.timestamps_ns]
    return frames.timestamps_ns.tolist()


def test_frames_lie_in_an_euroc_folder_and_show_their_windows(run: Any, events: Path, network: Path, tmp_path: Path):
    result = run("--output", tmp_path / "frames", "--json")
    assert result.exit_code == 0
    summary = json.loads(result.stdout)
    times = listing(tmp_path / "frames")
    assert summary["frames"] == len(times) == 6
    assert (summary["width"], summary["device"], summary["reused"]) == (WIDTH, "cpu", False)
    assert np.all(np.array(times) % 33_000_000 == 0)
    with h5py.File(events) as file:
        t, x, y, p = (np.asarray(file[name]) for name in "txyp")
    reconstructor = reconstruction.Reconstructor(reconstruction.load_network(network), WIDTH, HEIGHT)
    start = 0
    for end, image in zip(times, load_frames(tmp_path / "frames").images, strict=True):
        inside = (1000 * t >= start) & (1000 * t < end)
        assert np.array_equal(image, reconstructor(x[inside], y[inside], t[inside] - T0_US, p[inside]))
        start = end


def test_e2calibs_command_line_goes_on_working(run: Any, events: Path, tmp_path: Path, monkeypatch: Any):
    """Every option of its offline_reconstruction.py, in its spelling; and where it puts its frames by default."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hot.txt").write_text("5,7\n")
    text = (
        "--freq_hz 20 --upsample_rate 4 --gpu_id 0 --hot_pixels_file hot.txt --unsharp_mask_amount 0.2 -v "
        "--unsharp_mask_sigma 1.5 --bilateral_filter_sigma 0.5 --flip --Imin 0.1 --Imax 0.9 --auto_hdr "
        "--auto_hdr_median_filter_size 5 --no-normalize --no-recurrent --display --no-display_trackbars "
        "--no-show_reconstruction --show_events --event_display_mode red-blue --num_bins_to_show -1 "
        "--display_border_crop 0 --display_wait_time 1 --gamma 1.5 --contrast 1.0 --brightness 0.0 --saturation 1.0"
    )
    words = text.split()
    result = run("--h5file", events, *words, source=False)
    assert result.exit_code == 0, result.output
    with h5py.File(events) as file:
        first = 1000 * int(file["t"][0])  # pyright: ignore[reportIndexIssue, reportArgumentType]
    assert listing(tmp_path / "frames" / "e2calib") == [first + 50_000_000 * number for number in (1, 2, 3)]
    (tmp_path / "times.txt").write_text(f"{T0_US + 60_000}\n{T0_US + 120_000}\n")
    result = run("--h5file", events, "-tsf", "times.txt", "-u", 2, "-o", "out", "--dataset_name", "mine", source=False)
    assert result.exit_code == 0, result.output
    assert listing(tmp_path / "out" / "mine") == [1000 * (T0_US + 60_000), 1000 * (T0_US + 120_000)]


def test_e2vids_windows(run: Any, tmp_path: Path):
    assert run("-T", "50", "--output", tmp_path / "duration").exit_code == 0
    assert np.all(np.diff(listing(tmp_path / "duration")) == 50_000_000)
    assert run("-N", "1000", "--output", tmp_path / "number").exit_code == 0
    assert len(listing(tmp_path / "number")) == 4
    assert run("--num_events_per_pixel", "0.5", "--output", tmp_path / "pixels").exit_code == 0
    assert len(listing(tmp_path / "pixels")) == 11  # of 384 events, the last with 160
    assert run("--fixed_duration", "--output", tmp_path / "default").exit_code == 0
    assert np.all(np.diff(listing(tmp_path / "default")) == 33_330_000)


def test_frames_at_triggers_and_at_the_stamps_of_images(run: Any, tmp_path: Path):
    assert run("--triggers", "middle", "--output", tmp_path / "triggers").exit_code == 0
    times = listing(tmp_path / "triggers")
    assert times == [1000 * (T0_US + 15_000 + 20_000 * number) for number in range(9)]
    result = run("--stamps-of", tmp_path / "triggers", "--time_offset_us", "500", "--output", tmp_path / "stamps")
    assert result.exit_code == 0, result.output
    assert listing(tmp_path / "stamps") == [t + 500_000 for t in times]


@pytest.mark.parametrize("name", ["frames.bag", "frames_ros2"])
def test_a_bag_holds_the_same_images(run: Any, tmp_path: Path, name: str):
    result = run("--output", tmp_path / "frames", "--bag", tmp_path / name, "--topic", "/dvs/image")
    assert result.exit_code == 0, result.output
    images, bag = load_frames(tmp_path / "frames"), load_frames(f"{tmp_path / name}:/dvs/image")
    assert np.array_equal(bag.timestamps_ns, images.timestamps_ns)
    for one, other in zip(bag.images, images.images, strict=True):
        assert np.array_equal(one, other)


def test_a_finished_run_is_not_repeated_and_other_frames_are_not_overwritten(run: Any, tmp_path: Path):
    folder = tmp_path / "frames"
    assert run("--output", folder).exit_code == 0
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    again = run("--output", folder)
    assert "complete already" in again.output
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    other = run("--output", folder, "--flip")
    assert other.exit_code == 1
    assert "frames: exists already" in other.output
    assert run("--output", folder, "--flip", "--overwrite").exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events.h5", "frames", "small.safetensors"]
    assert "complete already" not in run("--output", folder, "--overwrite").output


def test_automatic_hot_pixels_are_those_of_a_file(run: Any, tmp_path: Path):
    (tmp_path / "hot.txt").write_text("5,7\n")
    for name, words in (("auto", ["--hot_pixels", "auto"]), ("file", ["--hot_pixels_file", tmp_path / "hot.txt"])):
        assert run("--output", tmp_path / name, *words).exit_code == 0
    assert run("--output", tmp_path / "none").exit_code == 0
    auto, given, none = (list(load_frames(tmp_path / name).images) for name in ("auto", "file", "none"))
    assert np.array_equal(auto, given)
    assert not np.array_equal(auto, none)


def test_colour_images(run: Any, tmp_path: Path):
    result = run("--output", tmp_path / "frames", "--color", "--bag", tmp_path / "frames.bag")
    assert result.exit_code == 0, result.output
    image = cv2.imread(str(sorted((tmp_path / "frames" / "data").iterdir())[-1]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert len(load_frames(tmp_path / "frames.bag")) == len(listing(tmp_path / "frames"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-T", "33", "-N", "5"], "window_ms and events_per_window each say when frames are wanted"),
        (["--use_fp16"], "float16 is for GPUs"),
        (["--use_gpu", "--gpu_id", "77"], "device 'cuda:77' cannot be used"),
        (["--timestamps_file", "absent.txt"], "absent.txt: time stamps unreadable"),
        (["--output_folder", "elsewhere"], "not both"),
        (["--h5file", "other.h5"], "Name one event recording"),
    ],
)
def test_mistakes_are_named_before_any_work(run: Any, tmp_path: Path, words: list[str], message: str):
    result = run("--output", tmp_path / "frames", *words)
    assert result.exit_code != 0
    assert message in result.output
    assert not (tmp_path / "frames").exists()


def test_help_teaches_by_example():
    result = CliRunner().invoke(main, ["reconstruct", "--help"])
    assert "jaxcal reconstruct recording.raw --output frames/" in result.output
    assert "--unsharp_mask_amount" in result.output
    assert "--gamma" not in result.output


@pytest.mark.parametrize(("wiggle_hz", "expected_ms"), [(0.5, 100.0), (12.0, 20.0)])
def test_frames_as_often_as_a_spline_wants_them(run: Any, tmp_path: Path, wiggle_hz: float, expected_ms: float):
    """Slow motion: the sparsest spline, 10 knots a second; fast motion: a frame per 20 ms, and no more."""
    time = np.arange(0.0, 4.0, 0.005)
    wave = np.sin(2.0 * np.pi * wiggle_hz * time)[:, None]
    noise = 1e-3 * np.random.default_rng(0).standard_normal((len(time), 6))
    readings = np.concatenate([wave * [1.0, 0.5, 0.2], wave * [3.0, 2.0, 1.0] + [0.0, 0.0, 9.81]], axis=1) + noise
    stamps = 1000 * T0_US + np.round(1e9 * time).astype(np.int64)
    rows = [f"{t},{','.join(f'{value:.9f}' for value in row)}" for t, row in zip(stamps, readings, strict=True)]
    (tmp_path / "imu.csv").write_text("\n".join(["#timestamp [ns],w,w,w,a,a,a", *rows]) + "\n")
    result = run("--imu", tmp_path / "imu.csv", "--output", tmp_path / "frames")
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(np.diff(listing(tmp_path / "frames")), 1e6 * expected_ms)
    result = run("--imu", tmp_path / "imu.csv", "-T", "20", "--output", tmp_path / "other")
    assert "imu each say when frames are wanted" in result.output
