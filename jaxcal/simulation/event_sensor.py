"""The ESIM model of an event camera: log-intensity images at increasing times in, events out."""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np

from jaxcal.errors import CalibrationError

# Arrays of one batch of events: t_ns (N,) int64, x (N,), y (N,) uint16, p (N,) bool.
EventArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

# No pixel's threshold falls below this share of the nominal one, however large the mismatch.
_LEAST_THRESHOLD = 0.1
_NEVER = np.iinfo(np.int64).min // 2
_FIRST_BUFFER = 1 << 16


@dataclass(frozen=True)
class EventSensorConfig:
    """Settings of the sensor.

    `contrast_on`, `contrast_off`: nominal change of log intensity that makes an event. `threshold_mismatch`: relative
    standard deviation of each pixel's thresholds. `refractory_ns`: events of a pixel that follow its last one sooner
    than this are lost (the reference level still moves, as in ESIM). `leak_rate_hz`: ON events per second of a pixel
    with nominal threshold in constant light. `shot_noise_rate_hz`: random events per second and pixel, both
    polarities together. `hot_pixel_fraction` of the pixels fire at `hot_pixel_rate_hz` instead.
    """

    contrast_on: float = 0.25
    contrast_off: float = 0.25
    threshold_mismatch: float = 0.03
    refractory_ns: int = 100_000
    leak_rate_hz: float = 0.1
    shot_noise_rate_hz: float = 0.1
    hot_pixel_fraction: float = 0.0
    hot_pixel_rate_hz: float = 100.0

    def __post_init__(self) -> None:
        if not (self.contrast_on > 0 and self.contrast_off > 0):
            raise CalibrationError(
                f"EventSensorConfig: contrast thresholds are {self.contrast_on} and {self.contrast_off}; "
                "they are changes of log intensity and must be positive (0.1 to 0.5 is usual)."
            )
        for name in ("threshold_mismatch", "refractory_ns", "leak_rate_hz", "shot_noise_rate_hz"):
            if not getattr(self, name) >= 0:
                raise CalibrationError(f"EventSensorConfig: {name} is {getattr(self, name)}; it must not be negative.")
        if not (0 <= self.hot_pixel_fraction <= 1 and self.hot_pixel_rate_hz >= 0):
            raise CalibrationError("EventSensorConfig: hot_pixel_fraction lies in 0..1, hot_pixel_rate_hz is positive.")


class EventSensor:
    """A sensor of `width` x `height` pixels that remembers what it saw.

    A pixel fires each time its log intensity, taken as linear between two images, has moved by its threshold away
    from the level of its last event: Rebecq, Gehrig and Scaramuzza, "ESIM: an open event camera simulator", CoRL
    2018, eq. 1-2 and section 4. Thresholds differ from pixel to pixel; leak events arise because the reference level
    sinks slowly; noise events come as a Poisson process and leave the reference level alone.

    Feed images often enough that edges move by at most about one pixel between them.
    """

    def __init__(self, width: int, height: int, config: EventSensorConfig | None = None, seed: int = 0):
        self.width, self.height = int(width), int(height)
        self.config = config or EventSensorConfig()
        self._random = np.random.default_rng(seed)
        count = self.width * self.height
        self._threshold_on = self._thresholds(self.config.contrast_on, count)
        self._threshold_off = self._thresholds(self.config.contrast_off, count)
        hot = self._random.random(count) < self.config.hot_pixel_fraction
        self._hot, self._normal = np.flatnonzero(hot), np.flatnonzero(~hot)
        # The leak is a drift of the level in log units per ns, common to all pixels; their thresholds set the rate.
        self._leak_per_ns = self.config.leak_rate_hz * self.config.contrast_on * 1e-9
        self._last_event_ns = np.full(count, _NEVER, dtype=np.int64)
        self._start_ns = self._previous_ns = 0
        self._level: np.ndarray | None = None  # log intensity plus leak at the last image
        self._reference = np.zeros(count, dtype=np.float32)

    def _thresholds(self, nominal: float, count: int) -> np.ndarray:
        relative = 1.0 + self.config.threshold_mismatch * self._random.standard_normal(count)
        return (nominal * np.maximum(relative, _LEAST_THRESHOLD)).astype(np.float32)

    def feed(self, t_ns: int, log_intensity: np.ndarray) -> EventArrays:
        """Events since the last image, sorted by time: t_ns (N,) int64, x, y (N,) uint16, p (N,) bool.

        `log_intensity` (H, W) is the natural logarithm of the intensity at time `t_ns`. The first call sets the
        pixels' reference levels and returns no events. Event times lie in (previous t_ns, t_ns]. Raises
        CalibrationError when the shape differs from the sensor's, time does not increase or a value is not finite.
        """
        if log_intensity.shape != (self.height, self.width):
            raise CalibrationError(
                f"EventSensor.feed: image of shape {log_intensity.shape}; expected {(self.height, self.width)}."
            )
        image = np.ascontiguousarray(log_intensity, dtype=np.float32).reshape(-1)
        if self._level is None:
            return self._initialise(int(t_ns), image)
        if t_ns <= self._previous_ns:
            raise CalibrationError(
                f"EventSensor.feed: time {t_ns} ns does not follow {self._previous_ns} ns; feed images in order."
            )
        index, time, polarity = self._merge(self._crossings(int(t_ns), image), self._noise(int(t_ns)))
        kept = _outside_refractory(index, time, self._last_event_ns, self.config.refractory_ns)
        index, time, polarity = index[kept], time[kept], polarity[kept]
        self._previous_ns = int(t_ns)
        y, x = np.divmod(index, self.width)
        return time, x.astype(np.uint16), y.astype(np.uint16), polarity

    def _initialise(self, t_ns: int, image: np.ndarray) -> EventArrays:
        if not np.isfinite(image).all():
            raise CalibrationError("EventSensor.feed: the image holds values that are not finite; use log(I + small).")
        self._level = image.copy()
        self._reference = image.copy()
        if self.config.leak_rate_hz > 0:
            # Else all pixels would leak in step.
            self._reference -= self._threshold_on * self._random.random(image.size, dtype=np.float32)
        self._start_ns = self._previous_ns = t_ns
        return (np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.bool_))

    def _crossings(self, t_ns: int, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flat pixel index, time and polarity of all threshold crossings, not sorted."""
        assert self._level is not None
        leak = self._leak_per_ns * (t_ns - self._start_ns)
        parts, first, size = [], 0, _FIRST_BUFFER
        while first < image.size:
            index, time, polarity = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.bool_)
            first, count = _find_crossings(
                first, image, leak, self._previous_ns, t_ns, self._level, self._reference, self._threshold_on,
                self._threshold_off, index, time, polarity,
            )  # fmt: skip
            if first < 0:
                raise CalibrationError(f"EventSensor.feed: the image at {t_ns} ns holds values that are not finite.")
            parts.append((index[:count], time[:count], polarity[:count]))
            size *= 2
        return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # pyright: ignore[reportReturnType]

    def _noise(self, t_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poisson noise since the last image: flat pixel index, time and polarity, not sorted."""
        seconds = (t_ns - self._previous_ns) * 1e-9
        chosen = []
        for pixels, rate in (
            (self._normal, self.config.shot_noise_rate_hz),
            (self._hot, self.config.hot_pixel_rate_hz),
        ):
            count = self._random.poisson(rate * seconds * len(pixels)) if len(pixels) else 0
            chosen.append(pixels[self._random.integers(0, len(pixels), count)] if count else pixels[:0])
        index = np.concatenate(chosen)
        time = self._random.integers(self._previous_ns, t_ns, len(index), dtype=np.int64, endpoint=False) + 1
        return index, time, self._random.random(len(index)) < 0.5

    @staticmethod
    def _merge(*sources: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index, time, polarity = (np.concatenate(arrays) for arrays in zip(*sources, strict=True))
        order = np.argsort(time, kind="stable")
        return index[order], time[order], polarity[order]


# `no_type_check`: a runtime type checker would wrap the loops in code that numba cannot compile.


@numba.njit(cache=True)
@no_type_check
def _find_crossings(
    first, image, leak, t0_ns, t1_ns, level, reference, threshold_on, threshold_off, index, time, polarity
):
    """Threshold crossings of pixels `first`..; updates `level` and `reference` in place.

    Writes to `index`, `time`, `polarity` (N,) and returns (next pixel, number written); stops before a pixel whose
    crossings do not fit. The next pixel is -1 where a value is not finite.
    """
    count = 0
    for i in range(first, image.size):
        new = np.float32(image[i] + leak)
        old = level[i]
        on, off = threshold_on[i], threshold_off[i]
        above = new - reference[i]
        if above < on and above > -off:
            level[i] = new
            continue
        if not np.isfinite(new):
            return -1, count
        step = on if above > 0 else -off
        crossings = int(above / step)
        if count + crossings > index.size:
            return i, count
        # A level beyond the threshold with no change in time can only be rounding; time the event at the end.
        slope = (t1_ns - t0_ns) / (float(new) - float(old)) if new != old else 0.0
        for k in range(1, crossings + 1):
            offset = (float(reference[i]) + k * float(step) - float(old)) * slope if slope != 0.0 else t1_ns - t0_ns
            index[count] = i
            time[count] = t0_ns + min(max(np.int64(offset), 1), t1_ns - t0_ns)
            polarity[count] = step > 0
            count += 1
        reference[i] += np.float32(crossings) * step
        level[i] = new
    return image.size, count


@numba.njit(cache=True)
@no_type_check
def _outside_refractory(index, time, last_event_ns, refractory_ns):
    """Which of the time-ordered events their pixels can report; updates `last_event_ns` (pixels,) in place."""
    kept = np.empty(index.size, dtype=np.bool_)
    for k in range(index.size):
        i = index[k]
        kept[k] = time[k] - last_event_ns[i] >= refractory_ns
        if kept[k]:
            last_event_ns[i] = time[k]
    return kept
