"""The measurements of one run of a study: views drawn anew, left out, or given fresh noise.

A run's random numbers follow from the study's seed and the run's number alone, so that they are the same whoever
computes it, and when.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxcal.observations import Detections, ImuRecording
from jaxcal.results import Calibration, ImuCalibration
from jaxcal.studies.spec import Study


def generator(seed: int, run: int) -> np.random.Generator:
    """The random generator of one run (numpy's `SeedSequence` with the run as its spawn key)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run,)))


def parts_of(study: Study, times_s: np.ndarray) -> np.ndarray:
    """Which part (V,) of the recording each view is, in order: itself, or a segment of about equally many views."""
    order = np.argsort(np.argsort(times_s, kind="stable"), kind="stable")
    if study.by == "views":
        return order
    count = min(study.segments, len(times_s))
    return order * count // len(times_s)


def part_weights(study: Study, count: int, run: int, halves: bool = False) -> np.ndarray:
    """How often (P,) each of `count` parts takes part in a run.

    With `halves` a bootstrap leaves a random half out rather than drawing with replacement, for recordings that cannot
    hold a moment twice: over such halves estimates scatter as much as over bootstrap samples (the delete-d jackknife
    with d = n / 2, Shao and Wu 1989, "A general theory for jackknife variance estimation").
    """
    if study.kind == "monte-carlo":
        return np.ones(count)
    if study.kind == "leave-one-out":
        return (np.arange(count) != run).astype(float)
    rng = generator(study.seed, run)
    if halves:
        weights = np.zeros(count)
        weights[rng.permutation(count)[: count // 2]] = 1.0
        return weights
    return rng.multinomial(count, np.full(count, 1.0 / count)).astype(float)


def noisy(fitted: Sequence[np.ndarray], sigma: Sequence[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """Corners (F, N, 2) of each camera with fresh noise of 1-sigma (F, N), px."""
    return [
        pixels + noise[..., None] * rng.standard_normal(pixels.shape)
        for pixels, noise in zip(fitted, sigma, strict=True)
    ]


def renoised(
    calibration: Calibration, rng: np.random.Generator, corner_noise_px: float | None
) -> tuple[list[Detections], list[ImuRecording]]:
    """What cameras and IMUs would have measured, were the calibration true: what it predicts, with noise of the size
    that it found (or `corner_noise_px`). Corners that it did not use are left out; such IMU samples stay.
    """
    detections = []
    for camera in calibration.cameras:
        used, old = camera.used, camera.detections
        precision = np.ones(len(old)) if old.precision is None else old.precision
        sigma = (camera.corner_sigma_px if corner_noise_px is None else corner_noise_px) / precision[used]
        pixels = old.pixels[used] + camera.residuals_px[used]
        detections.append(
            dataclasses.replace(
                old,
                frame=old.frame[used],
                point=old.point[used],
                pixels=pixels + sigma[:, None] * rng.standard_normal(pixels.shape),
                precision=None if old.precision is None else old.precision[used],
            )
        )
    return detections, [_renoised_imu(imu, rng) for imu in calibration.imus]


def _renoised_imu(imu: ImuCalibration, rng: np.random.Generator) -> ImuRecording:
    recording = imu.recording
    assert recording is not None, "checked where the study begins"
    rows = np.searchsorted(recording.timestamps_ns, imu.origin_ns + np.round(imu.t_s * 1e9).astype(np.int64))
    gyro, accel = recording.gyro_rad_s.copy(), recording.accel_m_s2.copy()
    gyro[rows] = imu.gyro_predicted + imu.gyro_sigma * rng.standard_normal(imu.gyro_predicted.shape)
    accel[rows] = imu.accel_predicted + imu.accel_sigma * rng.standard_normal(imu.accel_predicted.shape)
    return dataclasses.replace(recording, gyro_rad_s=gyro, accel_m_s2=accel)


@dataclasses.dataclass(frozen=True)
class Moments:
    """The views of a calibration: per camera the view (F,) of every frame listed, -1 where nothing was seen; and the
    views' times (V,), s since the first."""

    view: list[np.ndarray]
    times_s: np.ndarray


def moments_of(calibration: Calibration) -> Moments:
    """Frames of different cameras within the calibration's tolerance are one view, as they are calibrated."""
    tolerance = round(float(calibration.settings.get("sync_tolerance_s", 0.002)) * 1e9)
    seen = [camera.detections.seen_frames for camera in calibration.cameras]
    times = [camera.detections.timestamps_ns[s] for camera, s in zip(calibration.cameras, seen, strict=True)]
    together = np.sort(np.concatenate(times))
    starts = [int(together[0])]
    for time in together.tolist():
        if time - starts[-1] > tolerance:
            starts.append(time)
    view = []
    for camera, frames, own in zip(calibration.cameras, seen, times, strict=True):
        of_frame = np.full(len(camera.detections.timestamps_ns), -1)
        of_frame[frames] = np.searchsorted(starts, own, side="right") - 1
        view.append(of_frame)
    return Moments(view, (np.array(starts) - starts[0]) * 1e-9)


def with_weights(calibration: Calibration, moments: Moments, of_view: np.ndarray, repeat: bool) -> list[Detections]:
    """The corners of the views with a weight. With `repeat` a view stands there as often as its weight says, each time
    as a moment of its own (times then mean nothing but which frames go together); else once, at its own time."""
    if not repeat:
        return [
            camera.detections.of_frames((view >= 0) & (of_view[view] > 0))
            for camera, view in zip(calibration.cameras, moments.view, strict=True)
        ]
    drawn = np.repeat(np.arange(len(of_view)), of_view.astype(int))
    return [
        _drawn(camera.detections, view, drawn) for camera, view in zip(calibration.cameras, moments.view, strict=True)
    ]


def _drawn(detections: Detections, view: np.ndarray, drawn: np.ndarray) -> Detections:
    """Frames in the order drawn, a second apart, the same for all cameras."""
    frame_of_view = {int(v): int(f) for f, v in enumerate(view) if v >= 0}
    rows_of_frame = np.searchsorted(detections.frame, np.arange(len(view) + 1))
    rows, frame = [], []
    for place, v in enumerate(drawn.tolist()):
        if v in frame_of_view:
            f = frame_of_view[v]
            own = np.arange(rows_of_frame[f], rows_of_frame[f + 1])
            rows.append(own)
            frame.append(np.full(len(own), place))
    index = np.concatenate(rows) if rows else np.zeros(0, dtype=int)
    precision = detections.precision
    return Detections(
        np.arange(len(drawn), dtype=np.int64) * 1_000_000_000,
        np.concatenate(frame) if frame else index,
        detections.point[index],
        detections.pixels[index],
        detections.image_size,
        None if precision is None else precision[index],
    )
