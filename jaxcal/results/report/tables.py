"""The numbers of the report, as rows of text for the template."""

from dataclasses import dataclass

import numpy as np

from jaxcal.cameras import model_name
from jaxcal.results.calibration import Calibration, ImuCalibration
from jaxcal.results.coverage import coverage
from jaxcal.results.parameters import (
    Estimate,
    camera_estimates,
    format_estimate,
    timeshift_estimate,
    transform_estimates,
    vector_estimates,
)
from jaxcal.results.verdict import Check


@dataclass(frozen=True)
class Row:
    """One estimate as text: name, value, 1-sigma, unit."""

    name: str
    value: str
    sigma: str
    unit: str


@dataclass(frozen=True)
class Table:
    """A titled list of estimates, with a remark and (for transforms) the matrix as text."""

    title: str
    rows: tuple[Row, ...]
    remark: str = ""
    matrix: str = ""


@dataclass(frozen=True)
class CameraTables:
    """All numbers of one camera: a line of facts, its lens, and where it sits."""

    name: str
    facts: tuple[tuple[str, str], ...]
    lens: Table
    poses: tuple[Table, ...]


@dataclass(frozen=True)
class CheckRow:
    """One check over several subjects: what is wanted, and the outcome per subject (None where it does not apply)."""

    title: str
    wanted: str
    checks: tuple[Check | None, ...]


def check_rows(checks: tuple[Check, ...], subjects: tuple[str, ...]) -> tuple[CheckRow, ...]:
    """The checks of the given subjects, one row per title, one column per subject."""
    found = {(check.title, check.subject): check for check in checks if check.subject in subjects}
    # The order of the fullest subject: a first camera has no check of its pose to the one before.
    by_subject = sorted(subjects, key=lambda subject: -sum(other == subject for _, other in found))
    rows = []
    for title in dict.fromkeys(title for subject in by_subject for title, other in found if other == subject):
        row = tuple(found.get((title, subject)) for subject in subjects)
        wanted = dict.fromkeys(check.wanted for check in row if check is not None)
        rows.append(CheckRow(title, " or ".join(wanted), row))
    return tuple(rows)


def camera_tables(calibration: Calibration, index: int) -> CameraTables:
    """The tables of camera `index`."""
    camera = calibration.cameras[index]
    detections = camera.detections
    width, height = camera.image_size
    frames = len(np.unique(detections.frame[camera.used]))
    facts = (
        ("model", model_name(camera.model)),
        ("image", f"{width} x {height} px"),
        ("frames used", f"{frames} of {len(detections.timestamps_ns)}"),
        ("corners used", f"{int(camera.used.sum())} of {len(detections)}"),
        ("reprojection rms", f"{camera.reprojection_rms_px:.3f} px"),
        ("corner sigma", f"{camera.corner_sigma_px:.3f} px"),
        ("coverage", f"{100.0 * coverage(camera):.0f} %"),
    )
    return CameraTables(
        camera.name, facts, Table("Lens", _rows(camera_estimates(calibration, index))), _pose_tables(calibration, index)
    )


def gravity_table(calibration: Calibration) -> Table | None:
    """Gravity in the target's frame, or None without an IMU."""
    if calibration.gravity is None:
        return None
    rows = _rows(vector_estimates(calibration, calibration.gravity, "gravity", "g", "m/s²"))
    size = float(np.linalg.norm(calibration.gravity))
    return Table("In the target's frame", rows, f"x right, y up, z out of the board; size {size:.4f} m/s².")


def imu_facts(calibration: Calibration) -> tuple[tuple[str, str], ...]:
    """What was assumed of the IMU and of its motion."""
    imu = calibration.imu
    if imu is None:
        return ()
    return (
        ("samples", str(len(imu.t_s))),
        ("duration", f"{imu.t_s[-1] - imu.t_s[0]:.2f} s"),
        ("rate", f"{1.0 / float(np.median(np.diff(imu.t_s))):.1f} Hz"),
        ("spline", f"order {imu.spline_order}, {imu.knot_rate_hz:g} knots/s"),
        ("gyro noise", f"{imu.gyro_sigma:.3g} rad/s per sample, {_raised(imu, 'gyroscope', imu.gyro_sigma)}"),
        ("accel noise", f"{imu.accel_sigma:.3g} m/s² per sample, {_raised(imu, 'accelerometer', imu.accel_sigma)}"),
    )


def _raised(imu: ImuCalibration, sensor: str, assumed: float) -> str:
    """How the noise assumed compares with the density stated, which the calibration may have raised to fit."""
    stated = imu.noise[f"{sensor}_noise_density"] * np.sqrt(1.0 / float(np.median(np.diff(imu.t_s))))
    return f"{assumed / stated:.2g} times the stated"


def _pose_tables(calibration: Calibration, index: int) -> tuple[Table, ...]:
    camera = calibration.cameras[index]
    tables = []
    if camera.T_cn_cnm1 is not None:
        before = calibration.cameras[index - 1].name
        length = float(np.linalg.norm(camera.T_cn_cnm1[:3, 3])) * 1e3
        tables.append(
            Table(
                f"From {before} (T_cn_cnm1)",
                _rows(transform_estimates(calibration, camera.T_cn_cnm1, f"{camera.name}.T_cn_cnm1")),
                f"Maps points from {before} to {camera.name}; baseline {length:.2f} mm. r is the rotation vector.",
                _matrix(camera.T_cn_cnm1),
            )
        )
    if camera.T_cam_imu is not None:
        estimates = transform_estimates(calibration, camera.T_cam_imu, f"{camera.name}.T_cam_imu")
        shift = timeshift_estimate(calibration, index)
        tables.append(
            Table(
                "From the IMU (T_cam_imu)",
                _rows([*estimates, *([shift] if shift else [])]),
                f"Maps points from imu0 to {camera.name}; t_imu = t_cam + time offset. r is the rotation vector.",
                _matrix(camera.T_cam_imu),
            )
        )
    return tuple(tables)


def _rows(estimates: list[Estimate]) -> tuple[Row, ...]:
    return tuple(Row(e.name, *format_estimate(e.value, e.sigma), e.unit) for e in estimates)


def _matrix(transform: np.ndarray) -> str:
    return "\n".join("  ".join(f"{value: .8f}" for value in row) for row in transform)
