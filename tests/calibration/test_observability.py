"""Recordings that leave something open are called so, in words that name the parameters and the remedy."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from degenerate_views import BOARD, LENS, SIZE, VIEWS, views_of_board
from simulated_truth import seen_by, still_rig

from jaxcal import Calibration, CalibrationError, calibrate_cameras
from jaxcal.calibration import observability
from jaxcal.calibration.assemble import camera_frames
from jaxcal.calibration.state import layout_of
from jaxcal.calibration.uncertainty import labels_of
from jaxcal.cameras import camera_model
from jaxcal.results import judge


def calibrated(**how: Any) -> Calibration:
    return calibrate_cameras([views_of_board(**how)], BOARD)


@pytest.fixture(scope="module")
def good() -> Calibration:
    return calibrated()


def test_a_good_recording_gives_no_sentence(good: Calibration) -> None:
    assert good.warnings == ()
    assert judge(good).level == "good"


@pytest.mark.parametrize("distances_m", [(0.45, 0.8), (0.6, 0.6001)], ids=["near and far", "one distance"])
@pytest.mark.parametrize("tilt_deg", [0.0, 3.0])
def test_frontal_views_leave_focal_length_and_distance_undivided(
    tilt_deg: float, distances_m: tuple[float, float]
) -> None:
    try:
        calibration = calibrated(largest_tilt_deg=tilt_deg, distances_m=distances_m)
    except CalibrationError as refusal:
        said = str(refusal)
        assert said.startswith("failed, because the recording does not determine the lens")
    else:
        assert calibration.converged
        assert judge(calibration).level == "bad"
        error = np.asarray(calibration.cameras[0].model.intrinsics - LENS.intrinsics)
        assert np.all(np.abs(error) < 3.5 * calibration.std("cam0.intrinsics"))
        (said,) = [w for w in calibration.warnings if "known only together" in w]
    assert "cam0: focal length and distance to the board are known only together" in said
    assert "cam0 fx" in said
    assert "cam0 fy" in said
    assert "Record the board tilted by 30 degrees and more about both of its axes" in said
    assert ("from one distance" in said) == (distances_m[1] < 0.7)


def test_little_tilt_is_said_with_what_more_would_bring(good: Calibration) -> None:
    calibration = calibrated(largest_tilt_deg=10.0)
    assert calibration.converged
    assert judge(calibration).level == "usable"
    (said,) = calibration.warnings
    assert "hardly a view tilts the board by more than 9 degrees" in said
    relative = 100.0 * calibration.std("cam0.intrinsics")[0] / float(calibration.cameras[0].model.intrinsics[0])
    assert f"cam0 fx +-{relative:.2g} %" in said
    # A recording with tilts up to 40 degrees is about as much better as is claimed.
    gain = float(calibration.std("cam0.intrinsics")[0] / good.std("cam0.intrinsics")[0])
    claimed = float(said.split("would make these sigmas ")[1].split(" ")[0])
    assert 0.5 * gain < claimed < 2.0 * gain


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_views_are_refused_with_what_they_cannot_tell(count: int) -> None:
    with pytest.raises(
        CalibrationError, match=r"cam0: .*3 are the least.*two numbers of the lens.*focal length, princ"
    ):
        calibrated(count=count)


def test_three_views_are_called_few() -> None:
    calibration = calibrated(count=3)
    assert judge(calibration).level != "good"
    (said,) = [w for w in calibration.warnings if "only 3 views" in w]
    for name, sigma in zip(("fx", "fy"), calibration.std("cam0.intrinsics")[:2], strict=True):
        assert sigma > 1.0
        assert f"cam0 {name} +-" in said
    assert "Record 20 views or more" in said
    error = np.asarray(calibration.cameras[0].model.intrinsics - LENS.intrinsics)
    assert np.all(np.abs(error) < 4.0 * calibration.std("cam0.intrinsics"))


def test_corners_along_one_line_are_refused() -> None:
    with pytest.raises(CalibrationError, match=f"0 frames .* and {VIEWS} whose corners do.*several rows and columns"):
        calibrated(points=np.arange(9))
    diagonal = np.arange(6) * 10  # (0, 0), (1, 1), ...: 6 corners, of which 8 are needed on this board
    with pytest.raises(CalibrationError, match="0 frames with at least 8 corners"):
        calibrated(points=diagonal)


def test_frames_whose_corners_are_in_line_take_no_part() -> None:
    detections = views_of_board(6)
    cut = np.isin(detections.frame, [1, 4]) & (detections.point >= 9)
    part = dataclasses.replace(
        detections, frame=detections.frame[~cut], point=detections.point[~cut], pixels=detections.pixels[~cut]
    )
    np.testing.assert_array_equal(camera_frames(part, BOARD, "cam0").frames, [0, 2, 3, 5])


@pytest.mark.parametrize(
    ("region", "empty"),
    [
        ((0.0, 0.0, 0.5, 0.5), "the right and the lower thirds"),
        ((0.4, 0.0, 1.0, 1.0), "the left third"),
        ((0.0, 0.4, 1.0, 1.0), "the upper third"),
    ],
    ids=["corner", "right side", "lower side"],
)
def test_parts_of_the_image_without_the_board_are_named(region: tuple[float, float, float, float], empty: str) -> None:
    small = (1.0, 1.5) if region[2] - region[0] < 0.6 else (0.7, 1.1)
    calibration = calibrated(region=region, distances_m=small)
    assert judge(calibration).level == "usable"
    (said,) = calibration.warnings
    assert f"no corner was ever in {empty} of the image" in said
    assert "Distortion there is extrapolated" in said
    assert "Move the board there" in said


def test_few_shared_views_are_named() -> None:
    rig = still_rig((1, 2))
    left, right = seen_by(rig)
    late = right.timestamps_ns.copy()
    late[right.seen_frames[3] :] += 3_600_000_000_000
    calibration = calibrate_cameras(
        [left, dataclasses.replace(right, timestamps_ns=late)], rig.target, names=["left", "right"]
    )
    (said,) = calibration.warnings
    shared = int(np.sum(np.isin(right.seen_frames[:3], left.seen_frames)))
    assert f"right saw the board together with another camera in {shared} view" in said
    assert "ten moments or more" in said


# --- the parts -------------------------------------------------------------------------------------------------------


def test_the_sigma_of_the_focal_length_is_that_of_the_calibration(good: Calibration) -> None:
    """Computed from the views alone, without the solver."""
    (camera,) = good.cameras
    assert camera.T_cam_target is not None
    T = camera.T_cam_target
    places = jnp.asarray(np.einsum("fij,nj->fni", T[:, :3, :3], BOARD.points) + T[:, None, :3, 3])
    kept = np.zeros((len(T), len(BOARD.points)))
    kept[camera.detections.frame[camera.used], camera.detections.point[camera.used]] = 1.0
    sigma = camera.corner_sigma_px * float(
        observability._focal_sigma(camera.model, places, jnp.asarray(kept), jnp.asarray(SIZE, dtype=float))
    )
    focal = 0.5 / np.asarray(camera.model.intrinsics[:2])
    covariance = good.covariance_of("cam0.intrinsics")[:2, :2]
    assert sigma == pytest.approx(np.sqrt(focal @ covariance @ focal), rel=0.01)


@pytest.mark.parametrize("angle", [0.0, 7.0, 40.0])
def test_the_tilt_of_a_board(angle: float) -> None:
    turn = np.deg2rad(angle)
    tilted = BOARD.points @ np.array([[1.0, 0.0, 0.0], [0.0, np.cos(turn), 0.0], [0.0, np.sin(turn), 0.0]]).T
    seen = np.ones((2, len(tilted)), dtype=bool)
    seen[1, ::3] = False  # of the second view a part is hidden, and lies anywhere
    views = np.stack([tilted, np.where(seen[1][:, None], tilted, 7.0)]) + np.array([0.1, 0.2, 1.0])
    np.testing.assert_allclose(observability._tilt_deg(views, seen), angle, atol=1e-6)


def test_boards_at_an_angle_to_each_other_count_as_tilted() -> None:
    walls = np.concatenate([BOARD.points, BOARD.points[:, [2, 1, 0]]])
    seen = np.ones((1, len(walls)), dtype=bool)
    assert observability._tilt_deg(walls[None] + np.array([0.0, 0.0, 1.0]), seen)[0] > 30.0


def test_weak_directions_are_named_once_and_strong_ones_not() -> None:
    """Of two cameras the pose of the second and its time shift are made weak by hand."""
    lenses = [LENS, LENS]
    layout = layout_of(lenses)
    labels = labels_of(["left", "right"], lenses, layout)
    free = np.ones(layout.size, dtype=bool)
    frames = [camera_frames(views_of_board(4), BOARD, name) for name in ("left", "right")]
    covariance = 1e-12 * np.eye(layout.size)
    quantities = observability._quantities(["left", "right"], lenses, layout, free, covariance, frames)
    assert observability._weak_directions(quantities, covariance) == []
    direction = np.zeros(layout.size)
    direction[labels.index("right translation z")] = 0.05
    direction[labels.index("right rotation x")] = 0.02
    shift = np.zeros(layout.size)
    shift[labels.index("right time shift")] = 0.004
    covariance = covariance + np.outer(direction, direction) + np.outer(shift, shift)
    first, second = observability._weak_directions(quantities, covariance)
    assert "Known only together" in first
    assert "right translation z +-50 mm" in first
    assert "right rotation x +-1.1 deg" in first
    assert "Record more moments" in first
    assert "Badly known: right time shift +-4 ms. Rotate the rig" in second


def test_a_focal_length_that_a_shape_parameter_stands_for_is_not_weak() -> None:
    """Omni: scaling fx, fy and 1 + xi alike hardly changes the image near the axis."""
    lens = camera_model("omni-none").from_focal(300.0, SIZE)
    names = [*lens.parameter_names[0], *lens.parameter_names[1]]
    layout = layout_of([lens])
    frames = [camera_frames(views_of_board(4), BOARD, "cam0")]
    together = np.zeros(layout.size)
    xi = float(lens.parameters[names.index("xi")])
    together[names.index("xi")] = 0.05 * (1.0 + xi)
    for name in ("fx", "fy"):
        together[names.index(name)] = 0.05 * float(lens.parameters[names.index(name)])
    alone = np.zeros(layout.size)
    alone[names.index("fx")] = together[names.index("fx")]
    free = np.ones(layout.size, dtype=bool)
    for change, weak in ((together, False), (alone, True)):
        covariance = np.outer(change, change)
        found = observability._lens_quantities("cam0", lens, layout.lens(0), covariance, SIZE)
        assert (observability._sigma(found[0], covariance) > found[0].weak) == weak
    assert len(observability._quantities(["cam0"], [lens], layout, free, covariance, frames)) > 4
