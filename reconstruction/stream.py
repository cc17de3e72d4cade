"""A whole recording as a stream: windows of events in, time-stamped images out, in constant memory."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Events
from reconstruction.networks import ReconstructionNetwork
from reconstruction.reconstructor import Reconstructor


def reconstruct(
    windows: Iterable[tuple[int, Events] | tuple[int, Events, bool]],
    network: ReconstructionNetwork,
    *,
    width: int,
    height: int,
    **options: Any,
) -> Iterator[tuple[int, np.ndarray]]:
    """The images of one event camera, one per window, as they become ready: `(t_ns, uint8 (height, width))`.

    `windows` gives `(t_end_ns, events)` in order of time, each with the events since the window before; `t_ns` of an
    image is its window's end, the moment that the image shows. A third entry says whether the image is wanted; those
    that are not are computed, but not given. `options` are those of `Reconstructor`. Nothing is kept but the network's
    state, whatever the recording's length.

    Raises CalibrationError when windows run backwards, or hold events after their end.
    """
    reconstructor = Reconstructor(network, width, height, **options)
    previous_end: int | None = None
    origin_ns: int | None = None  # of the float microseconds: since 1970 they would lose the last digits
    for t_end_ns, events, *wanted in windows:
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
        previous_end = end
        image = reconstructor(events.x, events.y, t_us, events.p)
        if not wanted or wanted[0]:
            yield end, image
