"""A whole recording as a stream: windows of events in, time-stamped images out, in constant memory."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Events
from reconstruction.networks import ReconstructionNetwork
from reconstruction.reconstructor import Reconstructor


def reconstruct(
    windows: Iterable[tuple[int, Events] | tuple[int, Events, bool] | tuple[int, Events, bool, int]],
    network: ReconstructionNetwork,
    *,
    width: int,
    height: int,
    **options: Any,
) -> Iterator[tuple[int, np.ndarray]]:
    """The images of one event camera, one per window, as they become ready: `(t_ns, uint8 (height, width))`.

    `windows` gives `(t_end_ns, events)` in order of time, each with the events since the window before; `t_ns` of an
    image is the moment that it shows: where the network's `shown_at` puts it between the window's start and end, unless
    a fourth entry says otherwise. A third entry says whether the image is wanted; those that are not are computed, but
    not given. `options` are those of `Reconstructor`. Nothing is kept but the network's state, whatever the recording's
    length.

    Raises CalibrationError when windows run backwards, hold events after their end, or are to show a moment outside, or
    another one than their end with a network that shows the end.
    """
    reconstructor = Reconstructor(network, width, height, **options)
    previous_end: int | None = None
    origin_ns: int | None = None  # of the float microseconds: since 1970 they would lose the last digits
    for t_end_ns, events, *more in windows:
        end = int(t_end_ns)
        if previous_end is not None and end <= previous_end:
            raise CalibrationError(
                f"Reconstruction: a window ends at {end} ns, the one before at {previous_end} ns; windows must come "
                "in order of time."
            )
        if len(events) and int(events.t_ns[-1]) > end:
            raise CalibrationError(
                f"Reconstruction: the window that ends at {end} ns holds an event at {int(events.t_ns[-1])} ns."
            )
        if origin_ns is None and len(events):
            origin_ns = int(events.t_ns[0])
        t_us = (np.asarray(events.t_ns) - (origin_ns or 0)) * 1e-3
        # The first window's start is told by nothing but its events.
        start = previous_end if previous_end is not None else int(events.t_ns[0]) if len(events) else end
        shown = int(more[1]) if len(more) > 1 else end - round((1.0 - network.shown_at) * (end - start))
        if previous_end is None:
            start = min(start, shown)
        if shown != end and not (start <= shown < end and network.shown_at < 1.0):
            raise CalibrationError(
                f"Reconstruction: the window from {start} to {end} ns is to show {shown} ns, which "
                f"{'lies outside' if network.shown_at < 1.0 else 'this network cannot: it shows the end'}."
            )
        previous_end = end
        origin = origin_ns or 0
        span_us = (1e-3 * (start - origin), 1e-3 * (shown - origin), 1e-3 * (end - origin))
        image = reconstructor(events.x, events.y, t_us, events.p, span_us)
        if not more or more[0]:
            yield shown, image
