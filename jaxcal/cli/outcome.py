"""What commands say of a finished calibration: words or JSON, where its files are, and the exit code."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import numpy as np

    from jaxcal.results import Calibration, CrossValidation, Verdict

# Exit codes of all commands; click itself ends in 2 when a command is used wrongly.
FINE, IMPOSSIBLE, MISUSED, NOT_GOOD = 0, 1, 2, 3

# What --rerun takes.
RERUN_FILE = click.Path(dir_okay=False, path_type=Path)

EXIT_CODES = (
    "Exit codes: 0 fine; 1 the input makes it impossible, said on stderr; 2 wrong usage; 3 there is a result, "
    "but the verdict is 'do not use'."
)


def show_calibration(
    calibration: "Calibration",
    output: Path,
    *,
    as_json: bool = False,
    files: dict[str, Path] | None = None,
    ground_truth: Path | None = None,
    cross_validation: "CrossValidation | None" = None,
) -> int:
    """Print a calibration that was written to `output`; gives the exit code.

    First the parameters, or their comparison with `ground_truth` where that file exists, and warnings; then what a
    `cross_validation` found, the verdict in words, and where the files are: report.html, and `files` by what they are.
    """
    from jaxcal.results import judge, results_text

    verdict = judge(calibration)
    listed = {"report": output / "report.html", "all results": output, **(files or {})}
    listed = {what: path.resolve() for what, path in listed.items() if path.exists()}
    if as_json:
        told = calibration_json(calibration, verdict, listed)
        if cross_validation is not None:
            told["cross_validation"] = plain(cross_validation.to_json())
        click.echo(json.dumps(told, indent=2))
        return exit_code(verdict)
    if ground_truth is not None and ground_truth.exists():
        from jaxcal.results.ground_truth import compare_with_ground_truth, comparison_table

        # Written by the simulator, and read only now that the calibration is finished.
        click.echo(comparison_table(compare_with_ground_truth(calibration, ground_truth)))
        for camera in calibration.cameras:
            click.echo(f"{camera.name}: reprojection error {camera.reprojection_rms_px:.3f} px rms")
        for warning in calibration.warnings:
            click.echo(f"warning: {warning}")
    else:
        click.echo(results_text(calibration))  # which ends in the warnings
    if cross_validation is not None:
        click.echo(f"cross-validation: {cross_validation.headline}")
    click.echo(f"verdict: {verdict.headline}")
    for what, path in listed.items():
        click.echo(f"{what}: {path}")
    return exit_code(verdict)


def exit_code(verdict: "Verdict") -> int:
    """3 where the verdict is 'do not use', else 0."""
    return NOT_GOOD if verdict.level == "bad" else FINE


def calibration_json(calibration: "Calibration", verdict: "Verdict", files: dict[str, Path]) -> dict[str, Any]:
    """A calibration as plain lists and numbers, in the units of `Calibration`; None for what is not known."""
    from jaxcal.cameras import model_name
    from jaxcal.results.parameters import sigma_of

    def sigma(block: str) -> Any:
        return plain(sigma_of(calibration, block))

    cameras = [
        {
            "name": camera.name,
            "model": model_name(camera.model),
            "image_size": list(camera.image_size),
            "intrinsics": plain(camera.model.intrinsics),
            "intrinsics_sigma": sigma(f"{camera.name}.intrinsics"),
            "distortion": plain(camera.model.distortion),
            "distortion_sigma": sigma(f"{camera.name}.distortion"),
            "T_cn_cnm1": plain(camera.T_cn_cnm1),
            "T_cn_cnm1_sigma": sigma(f"{camera.name}.T_cn_cnm1"),
            "T_cam_imu": plain(camera.T_cam_imu),
            "T_cam_imu_sigma": sigma(f"{camera.name}.T_cam_imu"),
            "timeshift_cam_imu": plain(camera.timeshift_cam_imu),
            "timeshift_cam_imu_sigma": sigma(f"{camera.name}.timeshift_cam_imu"),
            "timeshift_cam_cam0": plain(camera.timeshift_cam_cam0),
            "line_delay_s": plain(camera.line_delay_s),
            "reprojection_rms_px": plain(camera.reprojection_rms_px),
            "corner_sigma_px": plain(camera.corner_sigma_px),
            "corners": len(camera.detections),
            "corners_used": int(camera.used.sum()),
            "frames": len(camera.detections.seen_frames),
        }
        for camera in calibration.cameras
    ]
    imus = [
        {
            "name": f"imu{k}",
            "model": imu.model,
            "parameters": {name: plain(value) for name, value in imu.parameters.items()},
            "T_imu_imu0": plain(imu.T_imu_imu0),
            "timeshift_imu_imu0": plain(imu.timeshift_imu_imu0),
            "noise_ratio": plain(imu.noise_ratio),
        }
        for k, imu in enumerate(calibration.imus)
    ]
    return {
        "verdict": verdict_json(verdict),
        "warnings": list(calibration.warnings),
        "cameras": cameras,
        "imus": imus,
        "gravity": plain(calibration.gravity),
        "settings": plain(calibration.settings),
        "files": {what.replace(" ", "_"): str(path) for what, path in files.items()},
    }


def verdict_json(verdict: "Verdict") -> dict[str, Any]:
    """Level, headline and findings of a verdict."""
    findings = [
        {"subject": c.subject, "level": c.level, "problem": c.sentence, "remedy": c.remedy} for c in verdict.failed
    ]
    return {"level": verdict.level, "headline": verdict.headline, "findings": findings}


def plain(value: "np.ndarray | Any") -> Any:
    """Arrays as lists and NaN as None, all the way down, so that strict JSON readers take it."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
