"""A picture of what was detected: some frames with their corners, and all corners over the image."""

from pathlib import Path

import numpy as np

from jaxcal.observations import Detections, Frames

_SHOWN = 11  # frames; the last panel holds all corners
_COLUMNS = 4


def write_detection_figure(found: Detections, frames: Frames, path: Path) -> None:
    """Draw up to eleven frames spread over the recording, and the corners of all, to a .png, .svg or .pdf."""
    import io

    from matplotlib.figure import Figure

    from jaxcal.atomic import write_bytes

    seen = found.seen_frames
    chosen = seen[np.linspace(0, len(seen) - 1, min(_SHOWN, len(seen))).round().astype(int)]
    rows = -(-(len(chosen) + 1) // _COLUMNS)
    width, height = found.image_size
    figure = Figure(figsize=(4.0 * _COLUMNS, (4.0 * height / width + 0.35) * rows), layout="constrained")
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for panel, number in zip(panels, chosen.tolist(), strict=False):
        mine = found.frame == number
        panel.imshow(frames.images[number], cmap="gray", vmin=0, vmax=255)
        panel.plot(*found.pixels[mine].T, ".", color="#e4572e", markersize=3)
        seconds = (found.timestamps_ns[number] - found.timestamps_ns[0]) * 1e-9
        panel.set_title(f"{seconds:.2f} s: {int(mine.sum())} corners", fontsize=9)
    last = panels[len(chosen)]
    last.set_axis_on()
    last.plot(*found.pixels.T, ".", color="#2e6fe4", markersize=1)
    last.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xticks=[], yticks=[])
    last.set_title(f"all {len(found):,} corners of {len(seen)} frames", fontsize=9)
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:], dpi=110)
    write_bytes(path, content.getvalue())
