"""The figure of the time offsets: what the recording says of each, as a bell curve around its estimate."""

import numpy as np

from jaxcal.results.calibration import Calibration, CameraCalibration
from jaxcal.results.parameters import sigma_of
from jaxcal.results.report.drawing import ACCENT, Picture, label, nothing_to_show, panel, to_svg


def time_picture(calibration: Calibration, prefix: str) -> Picture | None:
    """The posterior of each camera's time offset, to the IMU or to the first camera; None where none was sought."""
    found = [entry for camera in calibration.cameras if (entry := _offset(calibration, camera)) is not None]
    if not found:
        return None
    figure, (axes,) = panel()
    known = [(name, shift, sigma) for name, shift, sigma in found if sigma]
    for k, (_, _, sigma) in enumerate(known):
        x = np.linspace(-4.0, 4.0, 161) * sigma
        density = np.exp(-0.5 * (x / sigma) ** 2)
        axes.fill_between(1e6 * x, -k, 0.85 * density - k, color=ACCENT, alpha=0.35, linewidth=0.0)
        axes.plot(1e6 * x, 0.85 * density - k, color=ACCENT, linewidth=1.2)
        axes.vlines(1e6 * sigma * np.array([-1.0, 1.0]), -k, 0.85 * np.exp(-0.5) - k, color=ACCENT, linewidth=0.7)
    if known:
        axes.set_ylim(-len(known) + 0.9, 1.0)
    else:
        nothing_to_show(axes, "the sigmas are not known")
    axes.set_yticks(
        [-k + 0.3 for k in range(len(known))], [f"{name}\n{1e3 * shift:.3f} ms" for name, shift, _ in known]
    )
    label(axes, "away from the estimate [µs]", "")
    told = "; ".join(f"{name} {1e3 * shift:.4f} ms ± {_sigma(sigma)}" for name, shift, sigma in found)
    other = "IMU" if calibration.imu is not None else calibration.cameras[0].name
    return Picture(
        "Time offsets",
        to_svg(figure, prefix),
        f"What the recording says of the offset of each camera's clock to the {other}'s: {told}.",
        "curves a small part of the frame interval wide, and equal estimates where cameras share a trigger.",
        "wide curves ask for faster turns; estimates that change with the recording, for a look at the clocks.",
    )


def _offset(calibration: Calibration, camera: CameraCalibration) -> tuple[str, float, float | None] | None:
    """Name, estimate (s) and sigma (s; 0: held, None: not known) of a camera's offset."""
    for block in ("timeshift_cam_imu", "timeshift_cam_cam0"):
        shift = getattr(camera, block)
        if shift is not None:
            sigma = sigma_of(calibration, f"{camera.name}.{block}")
            return camera.name, float(shift), None if sigma is None else float(sigma[0])
    return None


def _sigma(sigma: float | None) -> str:
    return "unknown" if sigma is None else "0 (held)" if sigma == 0.0 else f"{1e3 * sigma:.2g} ms"
