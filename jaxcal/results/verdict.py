"""The verdict: whether a calibration can be used, from checks that each state what was measured and what is wanted."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration
from jaxcal.results.coverage import coverage, least_kept
from jaxcal.results.parameters import camera_estimates, sigma_of, timeshift_estimate
from jaxcal.results.projection_uncertainty import ProjectionUncertainty, can_be_told, projection_uncertainty
from jaxcal.results.target_bias import target_bias
from jaxcal.targets import Target

Level = Literal["good", "usable", "bad"]

# Limits beyond which a figure makes a result (usable with care, bad). They are rules of thumb, in one place.
_RMS_PX = (1.0, 3.0)  # for images up to 2000 px wide; in proportion beyond
_RMS_OVER_NOISE = (1.5, 4.0)  # 1 when the residuals are Gaussian
_TARGET_BIAS = 0.4  # share of the corner noise that is the same in every frame
_FOCAL_SIGMA = (0.005, 0.03)  # relative
_PROJECTION_PX = (1.0, 5.0)  # for images up to 2000 px wide; in proportion beyond
_COVERAGE = (0.5, 0.15)
_INLIERS = (0.9, 0.5)
_INLIERS_OF_CELL = 0.6
_FRAMES = (10.0, 3.0)
_ROTATION_SIGMA_DEG = (0.2, 2.0)
_TRANSLATION_SIGMA_M = (0.01, 0.1)
_TIMESHIFT_SIGMA_MS = (1.0, 10.0)
_IMU_RMS = (2.0, 10.0)  # residual over assumed noise, per axis
_GRAVITY_M_S2 = (0.1, 0.5)  # |g| away from 9.81
_GYRO_BIAS_RAD_S = (0.2, 1.0)
_ACCEL_BIAS_M_S2 = (1.5, 5.0)


@dataclass(frozen=True)
class Check:
    """One thing looked at: `measured` and `wanted` as short texts; `problem` and `remedy` say what a failure means."""

    subject: str
    title: str
    measured: str
    wanted: str
    level: Level
    problem: str
    remedy: str

    @property
    def sentence(self) -> str:
        """The problem as a sentence; names of cameras keep their spelling."""
        text = self.problem if self.problem.startswith(self.subject) else self.problem[:1].upper() + self.problem[1:]
        return f"{text}."


@dataclass(frozen=True)
class Verdict:
    """The worst level of all checks and warnings, a headline in plain words, and the checks behind it."""

    level: Level
    headline: str
    checks: tuple[Check, ...]

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that were not good, worst first."""
        return tuple(sorted((c for c in self.checks if c.level != "good"), key=lambda c: _severity(c.level)))


def judge(calibration: Calibration, projections: Mapping[str, ProjectionUncertainty] | None = None) -> Verdict:
    """Check a calibration for what makes results unusable or weak. Warnings alone make it usable with care.

    `projections`: the cameras' projection uncertainties, by name, where they are known already (at infinity).
    """
    checks = tuple(_checks(calibration, projections or {}))
    failed = sorted((check for check in checks if check.level != "good"), key=lambda check: _severity(check.level))
    problems = [check.problem for check in failed] + [_clause(warning) for warning in calibration.warnings]
    if not problems:
        return Verdict("good", _praise(calibration, len(checks)), checks)
    level: Level = failed[0].level if failed else "usable"
    opening = "Do not use, because" if level == "bad" else "Usable, but"
    others = len(problems) - 1
    rest = f", and {others} more finding{'s' if others > 1 else ''} below" if others else ""
    return Verdict(level, f"{opening} {problems[0]}{rest}.", checks)


def _clause(warning: str) -> str:
    """The start of a warning as a part of a longer sentence: its first statement, without the capital."""
    statement = re.split(r"[.;] ", warning, maxsplit=1)[0].rstrip(".")
    if statement[1:2].islower():  # not IMU, and not a name such as T_cam_imu
        return statement[:1].lower() + statement[1:]
    return statement


def _severity(level: Level) -> int:
    return {"bad": 0, "usable": 1, "good": 2}[level]


def _praise(calibration: Calibration, count: int) -> str:
    worst = max(camera.reprojection_rms_px for camera in calibration.cameras)
    cameras = "The camera fits" if len(calibration.cameras) == 1 else "All cameras fit"
    imu = " and the IMU agrees with the motion" if calibration.imu is not None else ""
    return f"Good. {cameras} the corners to {worst:.2f} px{imu}; all {count} checks passed."


def _above(value: float, limits: tuple[float, float]) -> Level:
    """The level of a figure that should be small; what is not finite is bad."""
    if not np.isfinite(value) or value > limits[1]:
        return "bad"
    return "usable" if value > limits[0] else "good"


def _below(value: float, limits: tuple[float, float]) -> Level:
    """The level of a figure that should be large."""
    if not np.isfinite(value) or value < limits[1]:
        return "bad"
    return "usable" if value < limits[0] else "good"


def _checks(calibration: Calibration, projections: Mapping[str, ProjectionUncertainty]) -> Iterator[Check]:
    yield from _solution_checks(calibration)
    for index, camera in enumerate(calibration.cameras):
        yield from _residual_checks(camera)
        yield from _target_checks(camera, calibration.target)
        yield from _view_checks(camera)
        yield from _lens_checks(calibration, index)
        yield from _projection_checks(calibration, camera, projections.get(camera.name))
        yield from _pose_checks(calibration, camera)
        yield from _time_checks(calibration, index)
    for number, imu in enumerate(calibration.imus):
        yield from _imu_checks(imu, f"imu{number}")
    yield from _gravity_checks(calibration)


def _solution_checks(calibration: Calibration) -> Iterator[Check]:
    yield Check(
        "solution",
        "convergence",
        "converged" if calibration.converged else "stopped early",
        "converged",
        "good" if calibration.converged else "bad",
        "the optimisation stopped before it converged",
        "Allow more steps; if it still does not settle, the recording leaves parameters undetermined.",
    )
    parameters = np.concatenate([np.asarray(camera.model.parameters) for camera in calibration.cameras])
    finite = bool(np.isfinite(parameters).all() and np.isfinite(calibration.covariance).all())
    yield Check(
        "solution",
        "numbers",
        "finite" if finite else "not finite",
        "finite",
        "good" if finite else "bad",
        "the solution or its covariance is not finite",
        "The problem had no unique solution: record more varied views of the target.",
    )


def _residual_checks(camera: CameraCalibration) -> Iterator[Check]:
    rms = camera.reprojection_rms_px
    scale = max(1.0, camera.image_size[0] / 2000.0)
    yield Check(
        camera.name,
        "reprojection error",
        f"{rms:.3f} px rms",
        f"under {_RMS_PX[0] * scale:.2g} px",
        _above(rms / scale, _RMS_PX),
        f"{camera.name} misses the corners by {rms:.2f} px",
        "Look for blurred frames, a board that is not flat, a wrong target size or a lens model too simple.",
    )
    ratio = rms / (np.sqrt(2.0) * camera.corner_sigma_px) if camera.corner_sigma_px > 0 else 1.0
    yield Check(
        camera.name,
        "error over corner noise",
        f"{ratio:.2f}",
        f"under {_RMS_OVER_NOISE[0]}",
        _above(ratio, _RMS_OVER_NOISE),
        f"{camera.name}'s residuals are {ratio:.1f} times what its corner noise explains",
        "Some frames fit far worse than the rest: find them in the error over time, and look at their pictures.",
    )
    total = int(np.isfinite(camera.residuals_px).all(axis=1).sum())
    share = int(camera.used.sum()) / total if total else float("nan")
    yield Check(
        camera.name,
        "corners kept",
        f"{100.0 * share:.1f} %" if total else "none",
        f"over {100.0 * _INLIERS[0]:.0f} %",
        _below(share, _INLIERS),
        f"{camera.name} had many corners rejected as outliers" if total else f"{camera.name} contributed no corner",
        "Check that target.yaml describes the board in the pictures, and that the detections sit on the corners.",
    )
    worst = least_kept(camera)
    if np.isfinite(worst):
        yield Check(
            camera.name,
            "corners kept, worst place",
            f"{100.0 * worst:.0f} %",
            f"over {100.0 * _INLIERS_OF_CELL:.0f} %",
            "usable" if worst < _INLIERS_OF_CELL else "good",
            f"{camera.name} lost {100.0 * (1.0 - worst):.0f} % of the corners in one part of its image as outliers",
            "Corners rejected in one place (red in the coverage) mean a lens model too simple: choose a richer one.",
        )


def _target_checks(camera: CameraCalibration, target: Target) -> Iterator[Check]:
    bias = target_bias(camera, target).rms_px
    if not np.isfinite(bias) or not camera.corner_sigma_px > 0:
        return
    share = bias / (np.sqrt(2.0) * camera.corner_sigma_px)
    yield Check(
        camera.name,
        "target points' own error",
        f"{bias:.3f} px, {100.0 * share:.0f} % of the noise",
        f"under {100.0 * _TARGET_BIAS:.0f} % of the noise",
        "usable" if share > _TARGET_BIAS else "good",
        f"{camera.name} sees the target's points {bias:.2f} px off where target.yaml has them, always the same way",
        "Measure the board's size, spacing and flatness; if they are right, the detector shifts the corners.",
    )


def _view_checks(camera: CameraCalibration) -> Iterator[Check]:
    frames = len(np.unique(camera.detections.frame[camera.used]))
    yield Check(
        camera.name,
        "frames used",
        f"{frames}",
        f"at least {_FRAMES[0]:g}",
        _below(float(frames), _FRAMES),
        f"{camera.name} has only {frames} frames with the target",
        "Record longer, with the whole target in view.",
    )
    covered = coverage(camera)
    yield Check(
        camera.name,
        "image covered",
        f"{100.0 * covered:.0f} % of cells",
        f"at least {100.0 * _COVERAGE[0]:.0f} %",
        _below(covered, _COVERAGE),
        f"the target visited only {100.0 * covered:.0f} % of {camera.name}'s image",
        "Distortion is a guess where no corner was seen: move the target into the edges and corners of the image.",
    )


def _lens_checks(calibration: Calibration, index: int) -> Iterator[Check]:
    camera = calibration.cameras[index]
    estimates = {estimate.name: estimate for estimate in camera_estimates(calibration, index)}
    focal = [estimates[name] for name in ("fx", "fy") if name in estimates]
    known = [abs(e.sigma / e.value) for e in focal if e.sigma is not None and e.value]
    if known:
        worst = max(known)
        yield Check(
            camera.name,
            "focal length 1-sigma",
            f"{100.0 * worst:.3f} %",
            f"under {100.0 * _FOCAL_SIGMA[0]:.1f} %",
            _above(worst, _FOCAL_SIGMA),
            f"{camera.name}'s focal length is known to {100.0 * worst:.1f} % only",
            "Tilt the target by 30 degrees and more about both axes: head-on views do not show the focal length.",
        )
    if "cx" in estimates and "cy" in estimates:
        width, height = camera.image_size
        cx, cy = estimates["cx"].value, estimates["cy"].value
        inside = 0.0 <= cx <= width - 1 and 0.0 <= cy <= height - 1
        yield Check(
            camera.name,
            "principal point",
            f"({cx:.1f}, {cy:.1f}) px",
            "inside the image",
            "good" if inside else "bad",
            f"{camera.name}'s principal point lies outside its image",
            "Record tilted views in all parts of the image, or check the image size.",
        )


def _projection_checks(
    calibration: Calibration, camera: CameraCalibration, found: ProjectionUncertainty | None
) -> Iterator[Check]:
    if found is None:
        if not can_be_told(calibration, camera):
            return
        found = projection_uncertainty(calibration, camera.name)
    scale = max(1.0, camera.image_size[0] / 2000.0)
    yield Check(
        camera.name,
        "projection 1-sigma, worst place",
        f"{found.worst_px:.2f} px (centre {found.centre_px:.2f}, rim {found.rim_px:.2f})",
        f"under {_PROJECTION_PX[0] * scale:.2g} px",
        _above(found.worst_px / scale, _PROJECTION_PX),
        f"{camera.name}'s projections are known to {found.worst_px:.1f} px (1-sigma) only, where corners were seen",
        "Record more views where the projection uncertainty is large, tilted and at several distances.",
    )


def _pose_checks(calibration: Calibration, camera: CameraCalibration) -> Iterator[Check]:
    for key, what in (("T_cn_cnm1", "pose to previous camera"), ("T_cam_imu", "pose to IMU")):
        if getattr(camera, key) is None or (sigma := sigma_of(calibration, f"{camera.name}.{key}")) is None:
            continue
        turn, shift = float(np.degrees(sigma[:3].max())), float(sigma[3:].max())
        levels = (_above(turn, _ROTATION_SIGMA_DEG), _above(shift, _TRANSLATION_SIGMA_M))
        yield Check(
            camera.name,
            f"{what}, 1-sigma",
            f"{turn:.3f} deg, {shift * 1e3:.2f} mm",
            f"under {_ROTATION_SIGMA_DEG[0]} deg, {_TRANSLATION_SIGMA_M[0] * 1e3:.0f} mm",
            min(levels, key=_severity),
            f"{camera.name}'s {what} is known to {turn:.2g} deg and {shift * 1e3:.2g} mm only",
            "Rotate the rig about all three axes, briskly, before the target."
            if key == "T_cam_imu"
            else "Record more moments in which both cameras see the target.",
        )


def _time_checks(calibration: Calibration, index: int) -> Iterator[Check]:
    estimate = timeshift_estimate(calibration, index)
    if estimate is None or estimate.sigma is None:
        return
    name = calibration.cameras[index].name
    yield Check(
        name,
        "time offset 1-sigma",
        f"{estimate.sigma:.3f} ms",
        f"under {_TIMESHIFT_SIGMA_MS[0]:g} ms",
        _above(estimate.sigma, _TIMESHIFT_SIGMA_MS),
        f"{name}'s time offset is known to {estimate.sigma:.1f} ms only",
        "Turn faster: a time offset shows only while the rig rotates.",
    )


def _imu_checks(imu: ImuCalibration, subject: str) -> Iterator[Check]:
    sensors = (
        ("gyroscope", imu.gyro_rad_s - imu.gyro_predicted, imu.gyro_sigma, imu.gyro_bias, "rad/s", _GYRO_BIAS_RAD_S),
        (
            "accelerometer",
            imu.accel_m_s2 - imu.accel_predicted,
            imu.accel_sigma,
            imu.accel_bias,
            "m/s²",
            _ACCEL_BIAS_M_S2,
        ),
    )
    for name, residuals, sigma, bias, unit, bias_limits in sensors:
        rms = float(np.sqrt(np.nanmean((residuals / sigma) ** 2)))
        yield Check(
            subject,
            f"{name} error over noise",
            f"{rms:.2f}",
            f"under {_IMU_RMS[0]:g}",
            _above(rms, _IMU_RMS),
            f"the {name} disagrees with the motion by {rms:.1f} times its stated noise",
            "Raise the noise in imu.yaml (vibration, optimistic datasheets), or raise the knot rate of the spline.",
        )
        largest = float(np.nanmax(np.abs(bias)))
        yield Check(
            subject,
            f"{name} bias",
            f"up to {largest:.3g} {unit}",
            f"under {bias_limits[0]:g} {unit}",
            _above(largest, bias_limits),
            f"the {name}'s bias reaches {largest:.2g} {unit}",
            "Check the units and axes of the IMU data; a wrong target size shows in the accelerometer's bias.",
        )


def _gravity_checks(calibration: Calibration) -> Iterator[Check]:
    if calibration.gravity is None:
        return
    size = float(np.linalg.norm(calibration.gravity))
    yield Check(
        "gravity",
        "size",
        f"{size:.3f} m/s²",
        f"9.81 within {_GRAVITY_M_S2[0]:g}",
        _above(abs(size - 9.81), _GRAVITY_M_S2),
        f"the size of gravity comes out as {size:.2f} m/s²",
        "Check the accelerometer's units and the size of the target.",
    )
