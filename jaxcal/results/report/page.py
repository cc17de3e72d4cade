"""`write_report`: one self-contained HTML page that says whether a calibration is good, and shows why."""

import contextlib
import gc
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.ticker import MaxNLocator, NullLocator

from jaxcal.atomic import write_text
from jaxcal.child import Child
from jaxcal.observations import Frames
from jaxcal.progress import Progress, no_progress
from jaxcal.results.advice import advice
from jaxcal.results.calibration import Calibration
from jaxcal.results.cross_validation import CrossValidation
from jaxcal.results.projection_uncertainty import can_be_told, projection_uncertainty
from jaxcal.results.report.camera_figures import camera_pictures
from jaxcal.results.report.cross_validation_section import cross_validation_section
from jaxcal.results.report.drawing import ACCENT, Picture, label, nothing_to_show, panel, to_svg
from jaxcal.results.report.frames import frame_pictures
from jaxcal.results.report.helper import ask
from jaxcal.results.report.imu_figures import imu_pictures
from jaxcal.results.report.rig_figures import rig_pictures
from jaxcal.results.report.rig_scene import rig_scene
from jaxcal.results.report.tables import camera_tables, check_rows, gravity_table, imu_facts
from jaxcal.results.report.time_figure import time_picture
from jaxcal.results.verdict import Verdict, judge

_STAGE = "report"  # of the progress


def write_report(
    calibration: Calibration,
    path: str | Path,
    images: Mapping[str, Frames] | None = None,
    progress: Progress = no_progress,
    cross_validation: CrossValidation | None = None,
    helper: Child | None = None,
) -> Verdict:
    """Write the report of a calibration to `path`, atomically, as a single HTML file without external references.

    `images` are the frames in which the corners of a camera were found, by camera name; cameras without them are
    reported without pictures of their detections. A `cross_validation` of this calibration gets a section of its own.
    A `helper` (`python_child("jaxcal.results.report.helper")`) draws some of the figures meanwhile: it has to load what
    this process has loaded already, and so is of use where it was started together with it, for a page of many cameras.
    Returns the verdict that the report opens with. Raises CalibrationError when an image has not its camera's size.
    """
    with _collections_put_off():
        page, verdict = _page(calibration, images or {}, progress, cross_validation, helper)
    write_text(Path(path), page)
    progress(_STAGE, len(calibration.cameras) + 1, len(calibration.cameras) + 1)
    return verdict


@contextlib.contextmanager
def _collections_put_off() -> Iterator[None]:
    """No search for garbage meanwhile: figures are circles of thousands of objects, and looking for them over and over,
    through all that jax holds, takes time (0.5 s with eight cameras)."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _page(
    calibration: Calibration,
    images: Mapping[str, Frames],
    progress: Progress,
    cross_validation: CrossValidation | None,
    helper: Child | None,
) -> tuple[str, Verdict]:
    """The report's HTML, and the verdict that it opens with."""
    total = len(calibration.cameras) + 1
    cameras = []
    progress(_STAGE, 0, total)
    residuals = ask(helper, calibration)
    told = [camera for camera in calibration.cameras if can_be_told(calibration, camera)]
    projections = {camera.name: projection_uncertainty(calibration, camera.name) for camera in told}
    for index, camera in enumerate(calibration.cameras):
        frames = frame_pictures(camera, images[camera.name]) if camera.name in images else []
        cameras.append(
            {
                "id": f"camera-{index}",
                "tables": camera_tables(calibration, index),
                "frames": frames,
                "pictures": camera_pictures(camera, projections.get(camera.name), residuals(index), f"c{index}"),
            }
        )
        progress(_STAGE, index + 1, total)
    cross = None if cross_validation is None else cross_validation_section(cross_validation)
    verdict = judge(calibration, projections)
    return _template().render(**_content(calibration, verdict), cameras=cameras, cross=cross), verdict


def _content(calibration: Calibration, verdict: Verdict) -> dict[str, Any]:
    imu = calibration.imu
    names = tuple(camera.name for camera in calibration.cameras)
    others = tuple(dict.fromkeys(check.subject for check in verdict.checks if check.subject not in names))
    is_rig = imu is not None or len(calibration.cameras) > 1
    times = time_picture(calibration, "time")
    return {
        "title": _title(calibration),
        "subtitle": _subtitle(calibration),
        "verdict": verdict,
        "camera_names": names,
        "camera_checks": check_rows(verdict.checks, names),
        "other_checks": [(subject, check_rows(verdict.checks, (subject,))) for subject in others],
        "warnings": calibration.warnings,
        "gravity": gravity_table(calibration),
        "scene": rig_scene(calibration) if is_rig else None,
        "rig": [*(rig_pictures(calibration, "rig") if is_rig else []), *([times] if times else [])],
        "advice": advice(calibration),
        "imu_pictures": [] if imu is None else imu_pictures(imu, "imu"),
        "imu_facts": imu_facts(calibration),
        "convergence": _convergence_picture(calibration, "convergence"),
        "settings": _readable(calibration.settings),
        "versions": _readable(calibration.versions),
        "target": _readable(calibration.target.to_yaml()),
    }


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxcal.results.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.jinja")


def _title(calibration: Calibration) -> str:
    count = len(calibration.cameras)
    cameras = "One camera" if count == 1 else f"{count} cameras"
    return f"{cameras} and an IMU" if calibration.imu is not None else cameras


def _subtitle(calibration: Calibration) -> str:
    names = ", ".join(camera.name for camera in calibration.cameras)
    corners = sum(int(camera.used.sum()) for camera in calibration.cameras)
    return f"{names}; {corners:,} target corners used"


def _readable(mapping: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        (str(key), value if isinstance(value, str) else json.dumps(value, default=str))
        for key, value in mapping.items()
    ]


def _convergence_picture(calibration: Calibration, prefix: str) -> Picture:
    figure, (axes,) = panel()
    cost = np.asarray(calibration.convergence, dtype=np.float64)
    cost = cost[np.isfinite(cost)]
    told, shown = "No cost was recorded.", np.zeros(0, dtype=bool)
    if len(cost):
        told = f"{len(cost) - 1} steps, from {cost[0]:.6g} to {cost[-1]:.6g}."
        # Against the last cost, since the first is often almost as low: earlier solves have done the work.
        above = (cost - cost.min()) / max(abs(cost.min()), np.finfo(np.float64).tiny)
        shown = above > 0
        axes.semilogy(np.arange(len(cost))[shown], above[shown], "o-", color=ACCENT, markersize=3.5, linewidth=1.1)
        axes.set_xlim(-0.5, max(len(cost), 2) - 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_minor_locator(NullLocator())
    if not shown.any():
        nothing_to_show(axes, "nothing left to gain" if len(cost) else "no cost recorded")
    label(axes, "step", "cost above the lowest, relative")
    return Picture(
        "Convergence",
        to_svg(figure, prefix),
        f"Cost after each step of the last solve: {told}",
        "a fall by orders of magnitude to under a millionth.",
        "a curve that ends high was stopped early; one that rises and falls met a poorly posed problem.",
    )
