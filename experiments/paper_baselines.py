"""Images from events without a network, for comparison: leaky integration, and counting."""

from collections.abc import Iterable, Iterator

import numpy as np

from jaxcal.observations import Events
from jaxcal.recording.windows import Window

_LEAK_S = 0.1  # time in which the integrator forgets


def leaky_integration(windows: Iterable[Window], width: int, height: int) -> Iterator[tuple[int, np.ndarray]]:
    """Events summed up with their sign, older ones less: exp(-age / 100 ms), as of the window's end."""
    level, before = np.zeros(width * height), None
    for end_ns, events, *_ in windows:
        if before is not None:
            level *= np.exp(-(end_ns - before) * 1e-9 / _LEAK_S)
        sign = np.where(events.p > 0, 1.0, -1.0) * np.exp(-(end_ns - events.t_ns) * 1e-9 / _LEAK_S)
        level += np.bincount(_cells(events, width), weights=sign, minlength=width * height)
        before = end_ns
        span = max(float(np.percentile(np.abs(level), 99.0)), 1e-6)
        yield end_ns, _eight_bits(0.5 + 0.5 * level / span, width, height)


def event_count(windows: Iterable[Window], width: int, height: int) -> Iterator[tuple[int, np.ndarray]]:
    """How many events each pixel had in the window: moving edges are bright."""
    for end_ns, events, *_ in windows:
        count = np.bincount(_cells(events, width), minlength=width * height)
        yield end_ns, _eight_bits(count / max(float(np.percentile(count, 99.0)), 1.0), width, height)


def _cells(events: Events, width: int) -> np.ndarray:
    return events.y.astype(np.int64) * width + events.x


def _eight_bits(values: np.ndarray, width: int, height: int) -> np.ndarray:
    return np.clip(np.round(255.0 * values), 0, 255).astype(np.uint8).reshape(height, width)
