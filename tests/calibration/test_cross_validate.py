"""Cross-validation: noise alone is not flagged, each error of the model is, by its right name."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from model_error_examples import RICH_LENS, corners, refocused, rig_for

from jaxcal import Calibration, CalibrationError, calibrate_cameras, cross_validate
from jaxcal.calibration.known import known_problem
from jaxcal.calibration.model_errors import find_model_errors
from jaxcal.cli import main
from jaxcal.results.cross_validation import CrossValidation
from jaxcal.studies.resample import generator, renoised


def calibrated(seed: int, cameras: int = 1, **error: Any) -> Calibration:
    rig = rig_for(seed, cameras)
    return calibrate_cameras(corners(rig, **error), rig.target)


@pytest.fixture(scope="module")
def sound() -> Calibration:
    return calibrated(0)


@pytest.fixture(scope="module")
def checked(sound: Calibration) -> CrossValidation:
    return cross_validate(sound)


def test_noise_alone_is_not_flagged(checked: CrossValidation) -> None:
    assert not checked.flagged
    assert checked.headline.startswith("Nothing but noise")
    assert {half.split for half in checked.halves} == {"in turns", "in time", "near and far"}
    for half in checked.halves:
        (camera,) = half.difference.cameras
        assert camera.agreement == "agree"
        assert half.freedom == 8


def test_with_other_noise_the_p_values_are_spread_evenly(sound: Calibration) -> None:
    p_values, found = [], 0
    for run in range(24):
        (detections,), _ = renoised(sound, generator(5, run), None)
        known = known_problem(sound)
        # The optimum of the new corners, from the old one.
        pixels = np.zeros((len(known.cameras[0].detections.timestamps_ns), known.kept[0].shape[1], 2))
        pixels[detections.frame, detections.point] = detections.pixels
        moved = known.with_pixels([pixels[known.cameras[0].frames]])
        tested = find_model_errors(moved)
        p_values += [evidence.p_value for evidence in tested]
        found += any(evidence.found for evidence in tested)
    assert np.mean(np.array(p_values) < 0.5) == pytest.approx(0.5, abs=0.15)
    assert found <= 1


def test_cameras_that_see_at_the_same_instants_are_each_halved() -> None:
    made = calibrated(0, cameras=2)
    # As with an IMU or time offsets: frames are views by themselves, two at each instant.
    untied = dataclasses.replace(made, settings={**made.settings, "time_offsets": True})
    known = known_problem(untied)
    assert not known.tied
    first = known.in_turns()
    for view in known.views:
        assert 0.4 < first[view].mean() < 0.6
    found = cross_validate(untied)
    assert not found.flagged
    for half in found.halves:
        assert np.isfinite(half.gain)
        assert half.freedom == 16
    assert all(np.isfinite(evidence.held_back) for evidence in found.evidence)


@pytest.mark.slow
def test_frames_that_may_lag_have_no_shutter_that_could_roll(sound: Calibration) -> None:
    lagging = dataclasses.replace(sound, settings={**sound.settings, "stamp_sigma_s": [5e-4]})
    for calibration, looked_for in ((sound, True), (lagging, False)):
        causes = {evidence.cause for evidence in find_model_errors(known_problem(calibration))}
        assert ("rolling shutter" in causes) == looked_for
        assert "lens" in causes


@pytest.mark.parametrize(
    ("error", "cause", "cameras"),
    [
        ({"lens": RICH_LENS}, "lens", 1),
        ({"bend_m": 0.002}, "bent board", 1),
        ({"line_delay_s": 10e-6}, "rolling shutter", 1),
        ({"late_lens": refocused(rig_for(0).cameras[0].model, 0.005)}, "changed lens", 1),  # pyright: ignore[reportArgumentType]
        ({"late_shift_m": 0.001}, "moved camera", 2),
    ],
)
def test_every_error_is_flagged_by_its_name(error: dict[str, Any], cause: str, cameras: int) -> None:
    found = cross_validate(calibrated(0, cameras, **error))
    assert found.flagged
    assert found.causes[0].cause == cause
    assert found.causes[0].p_value < 1e-4
    if cause == "rolling shutter":
        assert found.causes[0].value == pytest.approx(10e-6, rel=0.15)


def test_the_command_says_so_and_tells_by_its_exit_status(sound: Calibration, tmp_path: Path) -> None:
    sound.save(tmp_path / "sound")
    done = CliRunner().invoke(main, ["cross-validate", str(tmp_path / "sound"), "--plot", str(tmp_path / "map.png")])
    assert done.exit_code == 0, done.output
    assert "Nothing but noise" in done.output
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads(CliRunner().invoke(main, ["cross-validate", str(tmp_path / "sound"), "--json"]).output)
    assert told["flagged"] is False
    assert len(told["evidence"]) == 6


def test_too_few_views_are_refused(sound: Calibration) -> None:
    rig = rig_for(0)
    few = corners(rig)[0]
    rows = np.isin(few.frame, few.seen_frames[:12])
    short = type(few)(few.timestamps_ns, few.frame[rows], few.point[rows], few.pixels[rows], few.image_size)
    with pytest.raises(CalibrationError, match="12 views; 16 are the least"):
        cross_validate(calibrate_cameras([short], rig.target))
