"""The plain data types that travel between rooms, validated when they are made; numpy only."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from jaxcal.atomic import write_bytes
from jaxcal.errors import CalibrationError


def _require(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise CalibrationError(message)


def _strictly_increasing(name: str, timestamps_ns: np.ndarray) -> None:
    steps = np.diff(timestamps_ns)
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0)) + 1
        kind = "duplicate" if steps[place - 1] == 0 else "out of order"
        raise CalibrationError(
            f"{name}: timestamp {place} ({timestamps_ns[place]} ns) is {kind} (the one before "
            f"is {timestamps_ns[place - 1]} ns). Timestamps must increase strictly: sort the recording and drop "
            "duplicates."
        )


def _finite(name: str, values: np.ndarray) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        raise CalibrationError(f"{name}: value at index {place} is {values[place]}; all values must be finite.")


@dataclass(frozen=True)
class Events:
    """A stretch of an event stream, in order of time.

    `t_ns` (N,) int64 nanoseconds, not decreasing; `x`, `y` (N,) uint16 pixel column and row; `p` (N,) bool, True for
    a rise in brightness; `width`, `height` of the sensor in pixels. Raises CalibrationError on shapes that differ, on
    time running backwards and on events outside the sensor.
    """

    t_ns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        n = len(self.t_ns)
        _require(
            len(self.x) == n and len(self.y) == n and len(self.p) == n,
            f"Events: t, x, y, p have {n}, {len(self.x)}, {len(self.y)}, {len(self.p)} entries; they must be equal.",
        )
        if n:
            steps = np.diff(np.asarray(self.t_ns))
            if np.any(steps < 0):
                place = int(np.argmax(steps < 0)) + 1
                raise CalibrationError(
                    f"Events: time runs backwards at event {place} (by {-int(steps[place - 1])} ns). Sort the stream."
                )
            outside = (np.asarray(self.x) >= self.width) | (np.asarray(self.y) >= self.height)
            if outside.any():
                place = int(np.argmax(outside))
                raise CalibrationError(
                    f"Events: event {place} at (x, y) = ({self.x[place]}, {self.y[place]}) lies outside the "
                    f"{self.width}x{self.height} sensor. Check the sensor size given for this camera."
                )

    def __len__(self) -> int:
        return len(self.t_ns)


@runtime_checkable
class ImageSequence(Protocol):
    """Anything that gives grey images by index: a list of arrays, or a lazy folder. Picklable, for process pools."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> np.ndarray: ...


@dataclass(frozen=True)
class Frames:
    """Images of one camera with their times.

    `timestamps_ns` (F,) int64, strictly increasing; `images` F grey uint8 images (H, W), possibly read lazily;
    `image_size` (width, height).
    """

    timestamps_ns: np.ndarray
    images: Sequence[np.ndarray] | ImageSequence
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        _require(
            len(self.timestamps_ns) == len(self.images),
            f"Frames: {len(self.timestamps_ns)} timestamps for {len(self.images)} images; there must be one each.",
        )
        _strictly_increasing("Frames", np.asarray(self.timestamps_ns))

    def __len__(self) -> int:
        return len(self.timestamps_ns)


# Kalibr's imu.yaml says "gyroscope" and "accelerometer"; both spellings build an ImuNoise.
_KALIBR_NOISE_NAMES = {
    "gyroscope_noise_density": "gyro_noise_density",
    "gyroscope_random_walk": "gyro_random_walk",
    "accelerometer_noise_density": "accel_noise_density",
    "accelerometer_random_walk": "accel_random_walk",
}


@dataclass(frozen=True, init=False)
class ImuNoise:
    """Noise model of an IMU, continuous-time densities as in Kalibr's `imu.yaml` (whose key names work here too).

    `gyro_noise_density` rad/s/sqrt(Hz); `gyro_random_walk` rad/s^2/sqrt(Hz); `accel_noise_density` m/s^2/sqrt(Hz);
    `accel_random_walk` m/s^3/sqrt(Hz); `update_rate` Hz, or None to take it from the timestamps.
    """

    gyro_noise_density: float
    gyro_random_walk: float
    accel_noise_density: float
    accel_random_walk: float
    update_rate: float | None

    def __init__(
        self,
        gyro_noise_density: float | None = None,
        gyro_random_walk: float | None = None,
        accel_noise_density: float | None = None,
        accel_random_walk: float | None = None,
        update_rate: float | None = None,
        **kalibr: float,
    ):
        values = {
            "gyro_noise_density": gyro_noise_density,
            "gyro_random_walk": gyro_random_walk,
            "accel_noise_density": accel_noise_density,
            "accel_random_walk": accel_random_walk,
        }
        for name, value in kalibr.items():
            if name not in _KALIBR_NOISE_NAMES:
                known = ", ".join([*values, "update_rate", *_KALIBR_NOISE_NAMES])
                raise CalibrationError(f"ImuNoise: unknown field '{name}'. Known fields: {known}.")
            values[_KALIBR_NOISE_NAMES[name]] = value
        for name, value in values.items():
            if value is None or not np.isfinite(value) or value <= 0:
                raise CalibrationError(
                    f"ImuNoise: {name} is {value}; a positive density is needed. Take it from the IMU's datasheet or "
                    "an Allan-variance recording; ten times the datasheet value is a common choice."
                )
            object.__setattr__(self, name, float(value))
        _require(
            update_rate is None or (np.isfinite(update_rate) and update_rate > 0),
            f"ImuNoise: update_rate is {update_rate}; give the sample rate in Hz, or leave it out.",
        )
        object.__setattr__(self, "update_rate", None if update_rate is None else float(update_rate))


@dataclass(frozen=True)
class ImuRecording:
    """What one IMU measured.

    `timestamps_ns` (N,) int64, strictly increasing; `gyro_rad_s` (N, 3) angular velocity and `accel_m_s2` (N, 3)
    specific force, both in the IMU's frame; `noise` its densities.
    """

    timestamps_ns: np.ndarray
    gyro_rad_s: np.ndarray
    accel_m_s2: np.ndarray
    noise: ImuNoise

    def __post_init__(self) -> None:
        times = np.asarray(self.timestamps_ns)
        n = len(times)
        _require(
            n >= 2, f"ImuRecording: {n} samples; at least 2 are needed. Was the IMU topic or csv file the right one?"
        )
        _require(
            times.dtype.kind in "iu",
            f"ImuRecording: timestamps have type {times.dtype}; give int64 nanoseconds (not float seconds).",
        )
        object.__setattr__(self, "timestamps_ns", times.astype(np.int64))
        for name in ("gyro_rad_s", "accel_m_s2"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            _require(values.shape == (n, 3), f"ImuRecording: {name} has shape {values.shape}; expected {(n, 3)}.")
            _finite(f"ImuRecording: {name}", values)
            object.__setattr__(self, name, values)
        _strictly_increasing("ImuRecording", self.timestamps_ns)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def rate_hz(self) -> float:
        """Samples per second: what the noise model states, else the median of the recording."""
        return self.noise.update_rate or 1e9 / float(np.median(np.diff(self.timestamps_ns)))


def _indices(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    whole = values.dtype.kind in "iu" or (values.dtype.kind == "f" and bool(np.all(values == np.floor(values))))
    _require(
        whole or values.size == 0,
        f"Detections: `{name}` has type {values.dtype}; expected whole numbers.",
    )
    return values.astype(np.int64)


@dataclass(frozen=True)
class Detections:
    """Target corners that one camera saw.

    `timestamps_ns` (F,) int64, strictly increasing, one per frame (frames without corners may be listed); for each of
    M corners: `frame` (M,) index into `timestamps_ns`, `point` (M,) index into `target.points`, `pixels` (M, 2) with
    the centre of the top-left pixel at (0, 0); `image_size` (width, height). `precision` (M,), for detectors that know
    some corners better than others, is proportional to 1 / sigma of each; None where all are alike.

    Raises CalibrationError when shapes differ, an index is out of range, a point appears twice in a frame, a
    coordinate is not finite or a precision not positive.
    """

    timestamps_ns: np.ndarray
    frame: np.ndarray
    point: np.ndarray
    pixels: np.ndarray
    image_size: tuple[int, int]
    precision: np.ndarray | None = None

    def __post_init__(self) -> None:
        times = np.asarray(self.timestamps_ns)
        _require(
            times.dtype.kind in "iu" or times.size == 0,
            f"Detections: timestamps have type {times.dtype}; give int64 nanoseconds (not float seconds).",
        )
        object.__setattr__(self, "timestamps_ns", times.astype(np.int64))
        frame, point = _indices("frame", self.frame), _indices("point", self.point)
        m = len(frame)
        pixels = np.asarray(self.pixels, dtype=np.float64)
        _require(
            pixels.size == 0 or (pixels.ndim == 2 and pixels.shape[1] == 2),
            f"Detections: pixels have shape {pixels.shape}; expected {(m, 2)}.",
        )
        pixels = pixels.reshape(-1, 2)
        _require(
            len(point) == m and len(pixels) == m,
            f"Detections: frame, point and pixels have {m}, {len(point)} and {len(pixels)} rows; they must be equal.",
        )
        _strictly_increasing("Detections", self.timestamps_ns)
        _require(
            m == 0 or (frame.min() >= 0 and frame.max() < len(times)),
            f"Detections: `frame` must index the {len(times)} timestamps.",
        )
        _require(m == 0 or point.min() >= 0, "Detections: `point` must not be negative.")
        _finite("Detections: pixels", pixels)
        order = np.lexsort((point, frame))
        frame, point, pixels = frame[order], point[order], pixels[order]
        twice = (np.diff(frame) == 0) & (np.diff(point) == 0)
        if twice.any():
            place = int(np.argmax(twice))
            raise CalibrationError(
                f"Detections: point {point[place]} appears twice in frame {frame[place]} "
                f"({times[frame[place]]} ns); each point may be seen once per frame."
            )
        object.__setattr__(self, "frame", frame)
        object.__setattr__(self, "point", point)
        object.__setattr__(self, "pixels", pixels)
        if self.precision is not None:
            precision = np.asarray(self.precision, dtype=np.float64)
            _require(precision.shape == (m,), f"Detections: precision has shape {precision.shape}; expected {(m,)}.")
            _require(
                bool(np.all(np.isfinite(precision) & (precision > 0))),
                "Detections: `precision` must be positive; leave corners out that are worth nothing.",
            )
            object.__setattr__(self, "precision", precision[order])
        width, height = self.image_size
        _require(width > 0 and height > 0, f"Detections: image_size is {self.image_size}; expected (width, height).")
        object.__setattr__(self, "image_size", (int(width), int(height)))

    def __len__(self) -> int:
        """The number of corners."""
        return len(self.frame)

    @property
    def seen_frames(self) -> np.ndarray:
        """Indices of the frames that hold at least one corner, increasing."""
        return np.unique(self.frame)

    def of_frames(self, chosen: np.ndarray) -> "Detections":
        """The corners of some frames, `chosen` (F,) true for each; the other frames stay listed, without corners."""
        rows = np.asarray(chosen, dtype=bool)[self.frame]
        return replace(
            self,
            frame=self.frame[rows],
            point=self.point[rows],
            pixels=self.pixels[rows],
            precision=None if self.precision is None else self.precision[rows],
        )

    def save(self, path: str | Path) -> None:
        """Write an npz file, atomically: a reader sees the old file or the whole new one."""
        content = io.BytesIO()
        np.savez_compressed(
            content,
            timestamps_ns=self.timestamps_ns,
            frame=self.frame,
            point=self.point,
            pixels=self.pixels,
            image_size=np.array(self.image_size),
            **({} if self.precision is None else {"precision": self.precision}),  # pyright: ignore[reportArgumentType]
        )
        write_bytes(Path(path), content.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> "Detections":
        """Read what `save` wrote. Raises CalibrationError when the file is missing, truncated or of another kind."""
        path = Path(path)
        if not path.exists():
            raise CalibrationError(f"{path}: no such detections file.")
        try:
            # Opened here, because numpy leaves a file open that turns out to be damaged.
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
                fields = {name: data[name] for name in ("timestamps_ns", "frame", "point", "pixels")}
                fields["precision"] = data.get("precision")
                width, height = (int(value) for value in data["image_size"])
        except Exception as error:
            raise CalibrationError(
                f"{path}: not a detections file ({error}). Expected an npz with timestamps_ns, frame, point, pixels "
                "and image_size; delete it and detect again."
            ) from error
        try:
            return cls(**fields, image_size=(width, height))
        except CalibrationError as error:
            raise CalibrationError(f"{path}: {error}") from error
