"""The scripts of the paper's tables: what they measure, and that the scenes are the paper's."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.observations import Events
from jaxcal.recording.windows import Window

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"


def module(name: str) -> ModuleType:
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(EXPERIMENTS))


@settings(deadline=None, max_examples=30)
@given(st.floats(-3.0, 3.0), st.integers(0, 2**32 - 1))
def test_latency_and_bias_are_those_of_corners_that_trail(latency_ms: float, seed: int):
    scenes = module("paper_scenes")
    velocity = np.random.default_rng(seed).normal(0.0, 150.0, (200, 2))
    found = scenes.CornerErrors(-1e-3 * latency_ms * velocity, velocity)
    assert found.latency_ms == pytest.approx(latency_ms, abs=1e-9)
    chosen = found.speed[(found.speed >= 100.0) & (found.speed < 200.0)]
    assert found.bias_px(100.0, 200.0) == pytest.approx(-1e-3 * latency_ms * chosen.mean(), abs=1e-9)


@pytest.mark.parametrize("lens", ["none", "equidistant", "radtan"])
@pytest.mark.parametrize("board", ["checkerboard", "AprilGrid"])
def test_scenes_are_those_of_the_paper_and_their_frames_end_the_windows(board: str, lens: str):
    scenes = module("paper_scenes")
    rig = scenes.scene(scenes.LENSES[lens], scenes.SIZE, scenes.BOARDS[board], 0, 1.0)
    events, ideal = rig.cameras
    assert list(np.asarray(events.model.intrinsics)) == [200.0, 200.0, 250.0, 250.0]
    assert (events.kind, ideal.kind) == ("events", "frames")
    times = rig.frame_times_ns(ideal) - rig.t0_ns
    np.testing.assert_array_equal(times, 50_000_000 * np.arange(1, len(times) + 1))
    assert len(times) in (19, 20)


def test_images_without_a_network_show_rises_and_counts():
    baselines = module("paper_baselines")
    x, y, p = np.array([1, 1, 2]), np.array([0, 0, 1]), np.array([True, True, False])
    window = Events(np.array([10, 20, 30]), x.astype(np.uint16), y.astype(np.uint16), p, 4, 3)
    ((end, leaky),) = baselines.leaky_integration([Window(40, window, True, 40)], 4, 3)
    ((_, count),) = baselines.event_count([Window(40, window, True, 40)], 4, 3)
    assert end == 40
    assert leaky[0, 1] == 255
    assert leaky[1, 2] < leaky[2, 3] == 128
    assert count[0, 1] > count[1, 2] > count[2, 3] == 0
