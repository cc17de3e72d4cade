"""`compare`: how far two calibrations of the same rig are apart, in pixels and in sigmas."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.calibration import Calibration, CameraCalibration
from jaxcal.results.difference import CameraDifference, ParameterDifference, RigDifference
from jaxcal.results.implied_pose import implied_difference
from jaxcal.results.interchange import CalibratedRig, rig_of
from jaxcal.results.kalibr import CamchainCamera
from jaxcal.results.parameters import parameter_names, sigma_of
from jaxcal.results.projection_uncertainty import can_be_told, observed_region, projection_covariance, worst_sigma

DEFAULT_GRID = (40, 30)
# Where nothing says how far away the board was, m.
_RANGES_UNKNOWN = (1.0, 5.0)


def compare(
    first: Calibration | CalibratedRig,
    second: Calibration | CalibratedRig,
    *,
    ranges_m: Sequence[float] | None = None,
    grid: tuple[int, int] = DEFAULT_GRID,
) -> RigDifference:
    """Compare two calibrations of a rig, or what files of other tools say of it, camera by camera.

    Cameras are matched by name, or by order where no name is in both. `ranges_m` are the distances of the points that
    are projected (inf: directions); by default the nearest, middle and furthest at which corners were seen, and
    infinity. `grid` is (nx, ny). Differences are weighted by the uncertainties where at least one is known, and told
    where both saw corners. Raises CalibrationError when no camera is in both or the image sizes differ.
    """
    rigs = [item if isinstance(item, CalibratedRig) else rig_of(item) for item in (first, second)]
    full = [item if isinstance(item, Calibration) else None for item in (first, second)]
    pairs, notes = _matched(rigs[0], rigs[1])
    cameras, parameters = [], []
    for pair in pairs:
        sides = tuple(_Side(rig.cameras[k], item, k) for rig, item, k in zip(rigs, full, pair, strict=True))
        cameras.append(_camera_difference(sides[0], sides[1], ranges_m, grid))
        parameters += list(_parameter_differences(sides[0], sides[1]))
    if (full[0] is None) != (full[1] is None):
        notes.append(
            f"nothing is known of the {'first' if full[0] is None else 'second'}'s uncertainty: sigmas are the other's"
        )
    if full[0] is not None and full[1] is not None and _share_frames(full[0], full[1]):
        notes.append(
            "both were made from the same frames, so their errors go together: sigmas that combine as if they were "
            "independent are too large"
        )
    return RigDifference(tuple(cameras), tuple(parameters), tuple(notes))


# --- one camera ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Side:
    """A camera of one of the two, and the calibration that it is from where that is ours."""

    camera: CamchainCamera
    calibration: Calibration | None
    index: int

    @property
    def measured(self) -> CameraCalibration | None:
        return None if self.calibration is None else self.calibration.cameras[self.index]

    def covariance(self, pixels: np.ndarray, range_m: float) -> np.ndarray | None:
        """(K, 2, 2) of the projection, px^2, or None where it cannot be told."""
        if self.calibration is None or not can_be_told(self.calibration, self.calibration.cameras[self.index]):
            return None
        return projection_covariance(self.calibration, self.index, pixels, None if np.isinf(range_m) else range_m)

    def sigma(self, block: str) -> np.ndarray | None:
        return None if self.calibration is None else sigma_of(self.calibration, f"{self.camera.name}.{block}")


def _camera_difference(
    first: _Side, second: _Side, ranges_m: Sequence[float] | None, grid: tuple[int, int]
) -> CameraDifference:
    name, size = first.camera.name, first.camera.image_size
    if size != second.camera.image_size:
        raise CalibrationError(
            f"{name}: images of {size[0]} x {size[1]} and {second.camera.image_size[0]} x "
            f"{second.camera.image_size[1]} pixels cannot be compared. Calibrate both at one resolution."
        )
    seen = _seen_ranges(first, second)
    ranges = tuple(float(r) for r in ranges_m) if ranges_m is not None else (*(seen or _RANGES_UNKNOWN), np.inf)
    if not ranges or not all(r > 0 for r in ranges):
        raise CalibrationError(f"compare: ranges {ranges}; expected metres above 0, or inf.")
    nx, ny = grid
    across, down = np.meshgrid(np.linspace(0.0, size[0] - 1.0, nx), np.linspace(0.0, size[1] - 1.0, ny))
    pixels = np.stack([across, down], axis=-1)
    flat = pixels.reshape(-1, 2)
    covariance = _covariance(first, second, flat, ranges)
    observed = _observed_by_both(first, second, grid)
    # Infinity is told, not fitted, where nearer ranges are there: nobody saw corners so far away.
    fitted = np.isfinite(ranges) if np.isfinite(ranges).any() else np.ones(len(ranges), dtype=bool)
    weight = np.tile(observed.ravel().astype(float), (len(ranges), 1))
    if covariance is not None:
        weight = 1.0 / np.stack([worst_sigma(of_range) for of_range in covariance])
    found = implied_difference(first.camera.model, second.camera.model, flat, ranges, weight * fitted[:, None])
    return CameraDifference(
        name=name,
        models=(model_name(first.camera.model), model_name(second.camera.model)),
        pixels=pixels,
        ranges_m=ranges,
        difference_px=found.difference_px.reshape(len(ranges), ny, nx, 2),
        covariance=None if covariance is None else covariance.reshape(len(ranges), ny, nx, 2, 2),
        observed=observed,
        at_ranges=fitted,
        T_second_first=found.pose,
    )


def _covariance(first: _Side, second: _Side, pixels: np.ndarray, ranges: tuple[float, ...]) -> np.ndarray | None:
    """(R, K, 2, 2) of the difference: the sum of what is known of either."""
    total = None
    for side in (first, second):
        parts = [side.covariance(pixels, r) for r in ranges]
        known = [part for part in parts if part is not None]
        if len(known) == len(ranges):
            total = np.stack(known) if total is None else total + np.stack(known)
    return total


def _observed_by_both(first: _Side, second: _Side, grid: tuple[int, int]) -> np.ndarray:
    masks = [observed_region(side.measured, grid) for side in (first, second) if side.measured is not None]
    both = np.logical_and.reduce(masks) if masks else np.ones((grid[1], grid[0]), dtype=bool)
    return both if both.any() else np.ones_like(both)


def _seen_ranges(first: _Side, second: _Side) -> tuple[float, ...]:
    """The nearest, middle and furthest distance of used corners, m; none where no calibration has poses."""
    distances = []
    for side in (first, second):
        camera, calibration = side.measured, side.calibration
        if camera is None or calibration is None or camera.T_cam_target is None:
            continue
        T = camera.T_cam_target[camera.detections.frame[camera.used]]
        points = calibration.target_points[camera.detections.point[camera.used]]
        distances.append(np.linalg.norm(np.einsum("mij,mj->mi", T[:, :3, :3], points) + T[:, :3, 3], axis=1))
    known = np.concatenate(distances) if distances else np.zeros(0)
    known = known[np.isfinite(known)]
    # Two digits: distances for a person, and the same for two calibrations of one recording.
    return tuple(float(f"{value:.2g}") for value in np.quantile(known, [0.05, 0.5, 0.95])) if len(known) else ()


# --- parameters ------------------------------------------------------------------------------------------------------


def _parameter_differences(first: _Side, second: _Side) -> Iterator[ParameterDifference]:
    name = first.camera.name
    if model_name(first.camera.model) == model_name(second.camera.model):
        names = parameter_names(first.camera.model)
        for labels, block in zip(names, ("intrinsics", "distortion"), strict=True):
            values = [np.asarray(getattr(side.camera.model, block)) for side in (first, second)]
            sigma = _combined(first.sigma(block), second.sigma(block))
            unit = ["px" if label in ("fx", "fy", "cx", "cy") else "" for label in labels]
            yield from _rows(f"{name}.{block}", labels, values[0], values[1], values[1] - values[0], sigma, unit)
    for block in ("T_cn_cnm1", "T_cam_imu"):
        poses = [getattr(side.camera, block) for side in (first, second)]
        if poses[0] is not None and poses[1] is not None:
            sigma = _combined(first.sigma(block), second.sigma(block))
            yield from _pose_rows(f"{name}.{block}", poses[0], poses[1], sigma)
    before, after = first.camera.timeshift_cam_imu, second.camera.timeshift_cam_imu
    if before is not None and after is not None:
        block = "timeshift_cam_imu"
        sigma = _combined(first.sigma(block), second.sigma(block))
        a, b = np.array([1e3 * before]), np.array([1e3 * after])
        yield from _rows(
            f"{name}.{block}", ("time offset",), a, b, b - a, None if sigma is None else 1e3 * sigma, ["ms"]
        )


def _pose_rows(group: str, a: np.ndarray, b: np.ndarray, sigma: np.ndarray | None) -> Iterator[ParameterDifference]:
    turns = [Rotation.from_matrix(pose[:3, :3]) for pose in (a, b)]
    vectors = [np.degrees(turn.as_rotvec()) for turn in turns]
    # A perturbation on the left, as the covariance has it.
    apart = np.degrees((turns[1] * turns[0].inv()).as_rotvec())
    labels = [f"rotation {axis}" for axis in "xyz"]
    known = None if sigma is None else np.degrees(sigma[:3])
    yield from _rows(group, labels, vectors[0], vectors[1], apart, known, ["deg"] * 3)
    labels = [f"translation {axis}" for axis in "xyz"]
    shifts = [1e3 * pose[:3, 3] for pose in (a, b)]
    known = None if sigma is None else 1e3 * sigma[3:]
    yield from _rows(group, labels, shifts[0], shifts[1], shifts[1] - shifts[0], known, ["mm"] * 3)


def _rows(
    group: str,
    labels: Sequence[str],
    first: np.ndarray,
    second: np.ndarray,
    difference: np.ndarray,
    sigma: np.ndarray | None,
    unit: Sequence[str],
) -> Iterator[ParameterDifference]:
    for k, label in enumerate(labels):
        known = None if sigma is None else float(sigma[k])
        yield ParameterDifference(group, label, float(first[k]), float(second[k]), float(difference[k]), known, unit[k])


def _combined(first: np.ndarray | None, second: np.ndarray | None) -> np.ndarray | None:
    """Root sum of squares of what is known; None where neither is."""
    known = [sigma for sigma in (first, second) if sigma is not None]
    return np.sqrt(np.sum(np.square(known), axis=0)) if known else None


# --- the two rigs ----------------------------------------------------------------------------------------------------


def _matched(first: CalibratedRig, second: CalibratedRig) -> tuple[list[tuple[int, int]], list[str]]:
    """Places of cameras that are the same in both, and what to say of the others."""
    names = [[camera.name for camera in rig.cameras] for rig in (first, second)]
    common = [name for name in names[0] if name in names[1]]
    if common:
        left = sorted({*names[0], *names[1]} - set(common))
        notes = [f"{', '.join(left)}: in one of the two only, left out"] if left else []
        return [(names[0].index(name), names[1].index(name)) for name in common], notes
    if len(names[0]) == len(names[1]) and names[0]:
        matched = ", ".join(f"{a} with {b}" for a, b in zip(*names, strict=True))
        return [(k, k) for k in range(len(names[0]))], [
            f"no camera has the same name in both; matched by order: {matched}"
        ]
    raise CalibrationError(
        f"compare: no camera is in both; the first has {', '.join(names[0]) or 'none'}, the second "
        f"{', '.join(names[1]) or 'none'}. Compare calibrations of the same rig."
    )


def _share_frames(first: Calibration, second: Calibration) -> bool:
    """Whether most of the frames that one of them saw corners in are the other's too."""
    times = [
        {int(t) for camera in item.cameras for t in camera.detections.timestamps_ns[camera.detections.seen_frames]}
        for item in (first, second)
    ]
    return len(times[0] & times[1]) > 0.5 * min(len(times[0]), len(times[1]))
