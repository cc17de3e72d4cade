"""`results.txt`: the calibration as text, in the order and words of Kalibr's, with 1-sigma beside the values."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import model_name
from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration
from jaxcal.results.parameters import sigma_of
from jaxcal.results.projection_uncertainty import can_be_told, projection_uncertainty
from jaxcal.results.whiteness import residual_statistics
from jaxcal.targets import AprilGrid, Target


def results_text(calibration: Calibration) -> str:
    """The whole result as plain text, ending with a newline."""
    sections = [_heading("Calibration results", "="), *_residuals(calibration), _cameras(calibration)]
    if calibration.imu is not None:
        sections += [_camera_to_imu(calibration, k) for k in range(len(calibration.cameras))]
        sections += _gravity(calibration)
        sections += [text for k, imu in enumerate(calibration.imus) for text in _imu_parameters(calibration, imu, k)]
    sections += [_heading("Calibration configuration", "=")]
    sections += [_camera_configuration(camera) for camera in calibration.cameras]
    if calibration.imu is not None:
        sections += [_imu_configuration(imu, k) for k, imu in enumerate(calibration.imus)]
    sections += [_target_configuration(calibration.target)]
    if calibration.warnings:
        sections += ["\n".join([_heading("Warnings", "="), *(f"- {warning}" for warning in calibration.warnings)])]
    return "\n\n".join(sections) + "\n"


def _heading(title: str, line: str) -> str:
    return f"{title}\n{line * len(title)}"


def _numbers(values: np.ndarray) -> str:
    return np.array2string(np.asarray(values), precision=8, suppress_small=True, max_line_width=10_000)


def _with_sigma(values: np.ndarray, sigma: np.ndarray | None) -> str:
    return f"{_numbers(values)} +- {'unknown' if sigma is None else _numbers(sigma)}"


def _statistics(label: str, norms: np.ndarray) -> str:
    if not len(norms):
        return f"{label:<38} none used"
    return f"{label:<38} mean {norms.mean():.8g}, median {np.median(norms):.8g}, std: {norms.std():.8g}"


def _residuals(calibration: Calibration) -> list[str]:
    """Kalibr's two lists of norms: divided by the noise assumed, and in units."""
    normalised = [_heading("Normalized Residuals", "-")]
    plain = [_heading("Residuals", "-")]
    for camera in calibration.cameras:
        norms = np.linalg.norm(camera.residuals_px[camera.used], axis=1)
        normalised.append(_statistics(f"Reprojection error ({camera.name}):", norms / camera.corner_sigma_px))
        plain.append(_statistics(f"Reprojection error ({camera.name}) [px]:", norms))
    for k, imu in enumerate(calibration.imus):
        gyro = np.linalg.norm(imu.gyro_rad_s - imu.gyro_predicted, axis=1)
        accel = np.linalg.norm(imu.accel_m_s2 - imu.accel_predicted, axis=1)
        normalised.append(_statistics(f"Gyroscope error (imu{k}):", gyro / imu.gyro_sigma))
        normalised.append(_statistics(f"Accelerometer error (imu{k}):", accel / imu.accel_sigma))
        plain.append(_statistics(f"Gyroscope error (imu{k}) [rad/s]:", gyro))
        plain.append(_statistics(f"Accelerometer error (imu{k}) [m/s^2]:", accel))
    return ["\n".join(normalised), "\n".join(plain)]


def _cameras(calibration: Calibration) -> str:
    lines = [_heading("Camera-system parameters (+- is 1-sigma)", "-")]
    for camera in calibration.cameras:
        kept = camera.residuals_px[camera.used]
        spread = f"{_numbers(kept.mean(axis=0))} +- {_numbers(kept.std(axis=0))}" if len(kept) else "none used"
        lines += [
            f"{camera.name} (/{camera.name}/image_raw):",
            f"    type: {model_name(camera.model)}",
            "    distortion: "
            + _with_sigma(np.asarray(camera.model.distortion), sigma_of(calibration, f"{camera.name}.distortion")),
            "    projection: "
            + _with_sigma(np.asarray(camera.model.intrinsics), sigma_of(calibration, f"{camera.name}.intrinsics")),
            f"    reprojection error [px]: {spread} (rms of the 2-D error: {camera.reprojection_rms_px:.6f})",
            f"    corners: {int(camera.used.sum())} used of {len(camera.detections)}, "
            f"in {len(camera.detections.seen_frames)} frames",
        ]
        if can_be_told(calibration, camera):
            noise = projection_uncertainty(calibration, camera.name)
            lines.append(
                f"    projection uncertainty at infinity, 1-sigma [px]: {noise.centre_px:.3g} at the image's centre, "
                f"{noise.rim_px:.3g} at the rim of the corners, {noise.worst_px:.3g} at worst inside"
            )
        if camera.timeshift_cam_cam0 is not None:
            sigma = sigma_of(calibration, f"{camera.name}.timeshift_cam_cam0")
            shown = "held" if sigma is None else format(sigma[0], ".3g")
            lines.append(
                f"    timeshift to {calibration.cameras[0].name}: {camera.timeshift_cam_cam0!r} +- {shown} [s]"
            )
    for k, camera in enumerate(calibration.cameras):
        if camera.T_cn_cnm1 is not None:
            lines += _baseline(calibration, k, camera.T_cn_cnm1)
    return "\n".join([*lines, *_target_shape(calibration)])


def _target_shape(calibration: Calibration) -> list[str]:
    shape = calibration.target_shape
    if shape is None:
        return []
    lines = ["target, as found:"]
    for b in range(1, len(shape.T_target_board)):
        sigma = sigma_of(calibration, f"target.T_target_board{b}")
        shift = None if sigma is None else sigma[3:]
        vector = Rotation.from_matrix(shape.T_target_board[b, :3, :3]).as_rotvec()
        lines += [
            f"    board {b} in the frame of board 0: t: {_with_sigma(shape.T_target_board[b, :3, 3], shift)} [m]",
            f"        rotation vector: {_with_sigma(vector, None if sigma is None else sigma[:3])} [rad]",
        ]
    if shape.warp_m is not None:
        lines.append(f"    warp: {_with_sigma(shape.warp_m, sigma_of(calibration, 'target.warp'))} [m]")
    if shape.offsets_m is not None:
        rms, most = np.sqrt(np.mean(shape.offsets_m**2, axis=0)), np.abs(shape.offsets_m).max(axis=0)
        lines.append(f"    points off their place: rms {_numbers(rms)}, at most {_numbers(most)} [m]")
    return lines


def _baseline(calibration: Calibration, index: int, transform: np.ndarray) -> list[str]:
    sigma = sigma_of(calibration, f"{calibration.cameras[index].name}.T_cn_cnm1")
    quaternion = Rotation.from_matrix(transform[:3, :3]).as_quat()  # Kalibr prints x y z w
    turn, shift = (None, None) if sigma is None else (sigma[:3], sigma[3:])
    return [
        f"baseline T_{index}_{index - 1}:",
        f"    q: {_with_sigma(quaternion, turn)} (x y z w; Kalibr: -x -y -z w; the sigma is of a small rotation, rad)",
        f"    t: {_with_sigma(transform[:3, 3], shift)} [m]",
    ]


def _camera_to_imu(calibration: Calibration, index: int) -> str:
    camera = calibration.cameras[index]
    lines = [_heading(f"Transformation ({camera.name}):", "-")]
    if camera.T_cam_imu is not None:
        sigma = sigma_of(calibration, f"{camera.name}.T_cam_imu")
        lines += [
            f"T_ci:  (imu0 to {camera.name}): ",
            _numbers(camera.T_cam_imu),
            f"    rotation sigma [rad]: {'unknown' if sigma is None else _numbers(sigma[:3])}",
            f"    translation sigma [m]: {'unknown' if sigma is None else _numbers(sigma[3:])}",
            "",
            f"T_ic:  ({camera.name} to imu0): ",
            _numbers(np.linalg.inv(camera.T_cam_imu)),
        ]
    if camera.timeshift_cam_imu is not None:
        sigma = sigma_of(calibration, f"{camera.name}.timeshift_cam_imu")
        lines += [
            "",
            f"timeshift {camera.name} to imu0: [s] (t_imu = t_cam + shift)",
            f"{float(camera.timeshift_cam_imu)!r} +- {'unknown' if sigma is None else format(sigma[0], '.3g')}",
        ]
    return "\n".join(lines)


def _gravity(calibration: Calibration) -> list[str]:
    if calibration.gravity is None:
        return []
    sigma = sigma_of(calibration, "gravity")
    return [f"Gravity vector in target coords: [m/s^2]\n{_with_sigma(calibration.gravity, sigma)}"]


def _camera_configuration(camera: CameraCalibration) -> str:
    projection, _, distortion = model_name(camera.model).partition("-")
    return "\n".join(
        [
            _heading(camera.name, "-"),
            f"  Camera model: {projection}",
            f"  Projection parameters: {np.asarray(camera.model.intrinsics).tolist()}",
            f"  Distortion model: {distortion or 'part of the camera model'}",
            f"  Distortion coefficients: {np.asarray(camera.model.distortion).tolist()}",
            f"  Resolution: {list(camera.image_size)}",
            f"  Corner noise (1-sigma of a coordinate): {camera.corner_sigma_px:.6g} [px]",
        ]
    )


def _imu_parameters(calibration: Calibration, imu: ImuCalibration, number: int) -> list[str]:
    """The place and clock of a further IMU, and the parameters of an IMU's model; nothing for a plain first one."""
    lines = []
    if imu.T_imu_imu0 is not None and imu.timeshift_imu_imu0 is not None:
        sigma = sigma_of(calibration, f"imu{number}.T_imu_imu0")
        clock = sigma_of(calibration, f"imu{number}.timeshift_imu_imu0")
        lines += [
            f"T_ib:  (imu0 to imu{number}): ",
            _numbers(imu.T_imu_imu0),
            f"+- {'unknown' if sigma is None else _numbers(sigma)} (rotation x y z [rad], translation x y z [m])",
            f"time offset imu{number} to imu0: [s] (t_imu0 = t_imu + offset)",
            f"{imu.timeshift_imu_imu0!r} +- {'unknown' if clock is None else format(clock[0], '.3g')}",
        ]
    for name, value in imu.parameters.items():
        sigma = sigma_of(calibration, f"imu{number}.{name}")
        lines += [f"{name}:", _numbers(value), f"+- {'unknown' if sigma is None else _numbers(sigma)}"]
    return ["\n".join([_heading(f"IMU {number} (+- is 1-sigma)", "-"), *lines])] if lines else []


def _imu_configuration(imu: ImuCalibration, number: int) -> str:
    rate = imu.noise.get("update_rate") or 1.0 / float(np.median(np.diff(imu.t_s)))
    return "\n".join(
        [
            _heading(f"IMU{number}", "-"),
            f"  Model: {imu.model}",
            f"  Update rate: {rate:.6g}",
            "  Accelerometer:",
            f"    Noise density: {imu.noise['accelerometer_noise_density']}",
            f"    Noise density (discrete): {imu.accel_sigma}",
            f"    Random walk: {imu.noise['accelerometer_random_walk']}",
            "  Gyroscope:",
            f"    Noise density: {imu.noise['gyroscope_noise_density']}",
            f"    Noise density (discrete): {imu.gyro_sigma}",
            f"    Random walk: {imu.noise['gyroscope_random_walk']}",
            *_noise_shown(imu),
            "  Residuals, in units of the noise used:",
            *(f"    {statistics.sentence()}" for statistics in residual_statistics(imu)),
            f"  Spline: order {imu.spline_order}, {imu.knot_rate_hz:g} knots per second",
        ]
    )


def _noise_shown(imu: ImuCalibration) -> list[str]:
    if imu.noise_ratio is None:
        return []
    gyro, accel = imu.noise_ratio
    return [f"  Noise that the residuals show, over the stated: gyroscope {gyro:.3g}, accelerometer {accel:.3g}"]


def _target_configuration(target: Target) -> str:
    if isinstance(target, AprilGrid):
        details = [
            "  Type: aprilgrid",
            "  Tags:",
            f"    Rows: {target.rows}",
            f"    Cols: {target.cols}",
            f"    Size: {target.tag_size} [m]",
            f"    Spacing {target.tag_size * target.tag_spacing:.12g} [m]",
        ]
    else:
        details = [f"  {key}: {value}" for key, value in target.to_yaml().items()]
    return "\n".join([_heading("Target configuration", "="), *details])
