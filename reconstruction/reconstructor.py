"""From windows of events to grey images: the network with everything around it that the reference E2VID does."""

import logging
import os
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from scipy.stats import norm

from jaxcal.errors import CalibrationError
from reconstruction import voxel_torch
from reconstruction.colour import bayer_places, merged
from reconstruction.networks import ReconstructionNetwork
from reconstruction.networks.base import State
from reconstruction.voxel import RunningAndScale, accumulate, scaler, window_time

logger = logging.getLogger(__name__)

# (K, 2) columns and rows, or a text file of them.
HotPixels = np.ndarray | Sequence[Sequence[int]] | str | os.PathLike[str]

# As the reference: after a longer silence, or when time jumps back, the old state is worth nothing.
_MAX_SILENCE_US = 5_000_000


class Reconstructor:
    """Reconstructs the images of one event camera, window after window; the network's state carries over.

    `network` from `load_network`; `width`, `height` of the sensor (any size: the input is padded to the network's
    multiple). The options are named as in rpg_e2vid and e2calib and mean the same:

    - `unsharp_mask_amount`, `unsharp_mask_sigma`: sharpening before the image is cut to 8 bits; amount 0 for none.
    - `bilateral_filter_sigma`: edge-preserving smoothing of the 8-bit image; 0 for none.
    - `Imin`, `Imax`: network output that becomes 0 and 255. `auto_hdr`: take them from the images instead, as the
      median over the last `auto_hdr_median_filter_size` ones.
    - `hot_pixels`: (K, 2) columns and rows whose events are ignored, or the path of a text file with "x,y" lines.
    - `flip`: turn the image by half a turn. `no_normalize`: leave voxel grids unscaled. `no_recurrent`: forget the
      state after each window.
    - `device`: 'cpu', 'cuda', 'cuda:1' ...; 'auto' for a GPU where there is one; None for the CPU.
    - `precision`: 'float32', 'bfloat16', 'float16' (on a GPU only), or 'auto': bfloat16 where the network was trained
      in it and the machine computes it in hardware. The last layer and all filters are in float32 in any case.
    - `bayer`: the colour filters of a colour event camera, by their first two rows: 'rggb' (DAVIS346 colour; e2calib's
      `--color`), 'bggr', 'grbg' or 'gbrg'. Images are then (H, W, 3), BGR; see `reconstruction.colour`.

    Raises CalibrationError on options out of range and on events outside the sensor.
    """

    def __init__(
        self,
        network: ReconstructionNetwork,
        width: int = 640,
        height: int = 480,
        *,
        unsharp_mask_amount: float = 0.3,
        unsharp_mask_sigma: float = 1.0,
        bilateral_filter_sigma: float = 0.0,
        Imin: float = 0.0,
        Imax: float = 1.0,
        auto_hdr: bool = False,
        auto_hdr_median_filter_size: int = 10,
        hot_pixels: HotPixels | None = None,
        flip: bool = False,
        no_normalize: bool = False,
        no_recurrent: bool = False,
        device: str | torch.device | None = None,
        precision: str = "auto",
        bayer: str | None = None,
    ):
        if width < 1 or height < 1:
            raise CalibrationError(f"Reconstructor: sensor size is {width}x{height}; expected positive numbers.")
        if Imax <= Imin:
            raise CalibrationError(f"Reconstructor: Imax ({Imax}) must be above Imin ({Imin}).")
        if unsharp_mask_amount < 0 or unsharp_mask_sigma <= 0 or bilateral_filter_sigma < 0:
            raise CalibrationError("Reconstructor: filter amounts must not be negative and the mask's sigma positive.")
        self.device = find_device(device)
        self.network = network.to(self.device).eval()
        self.width, self.height = int(width), int(height)
        self.unsharp_mask_amount = unsharp_mask_amount
        self.bilateral_filter_sigma = bilateral_filter_sigma
        self.flip, self.no_normalize, self.no_recurrent = flip, no_normalize, no_recurrent
        if bayer is not None and auto_hdr:
            logger.warning("auto_hdr is left out: it would scale each colour by itself")
        self._tone_curve = ToneCurve(Imin, Imax, auto_hdr and bayer is None, auto_hdr_median_filter_size)
        self._kernel = unsharp_kernel(unsharp_mask_sigma).to(self.device)
        self._working_cells = _working_cells(hot_pixels, self.width, self.height)
        dtype = reduced_precision(network, self.device, precision)
        self._plane = Plane(self.network, self.width, self.height, self.device, dtype, no_recurrent)
        self._colours: dict[str, tuple[Plane, int, int]] = {}
        if bayer is not None:
            for colour, (row, column) in bayer_places(bayer, self.width, self.height).items():
                size = (self.width // 2, self.height // 2)
                plane = Plane(self.network, *size, self.device, dtype, no_recurrent)
                self._colours[colour] = (plane, row, column)
        self.reset()

    def reset(self) -> None:
        """Forget everything seen so far: the next window starts a new recording."""
        for plane in (self._plane, *(plane for plane, _, _ in self._colours.values())):
            plane.state = None
        self._last_image: np.ndarray | None = None
        self._last_us: float | None = None
        self._tone_curve.reset()
        self._scaled = scaler(self.network.scaling)

    def __call__(
        self,
        x: np.ndarray,
        y: np.ndarray,
        t_us: np.ndarray,
        p: np.ndarray,
        span_us: tuple[float, float, float] | None = None,
    ) -> UInt8[np.ndarray, "{self.height} {self.width} *channels"]:
        """The image of a window of events, uint8 (H, W), in colour (H, W, 3); arguments as for `voxel_grid`.

        `span_us`: the window's start, the moment that the image is to show, and its end, on the clock of `t_us`. Only
        networks whose `shown_at` is not 1 need it, E2VID's show the end in any case; without it the window is that from
        the first event to the last one.

        A window without events says that nothing changed: the last image is given again (grey before the first), and
        the state stays as it is.
        """
        if len(t_us) == 0:
            channels = (3,) if self._colours else ()
            grey = np.full((self.height, self.width, *channels), 127, dtype=np.uint8)
            return grey if self._last_image is None else self._last_image.copy()
        self._notice_jump(float(np.min(t_us)), float(np.max(t_us)))
        with torch.inference_mode():
            if span_us is None:
                span_us = _span(t_us, self.network.shown_at)
            time, span = window_time(t_us, span_us, self.network.shown_at)
            voxels = self._voxels(x, y, time, p, span)
            image = self._tone(self._plane, voxels)
            if self._colours:
                planes = {
                    colour: (self._tone(plane, voxels[:, row::2, column::2]), row, column)
                    for colour, (plane, row, column) in self._colours.items()
                }
                image = merged(image, planes)
        if self.bilateral_filter_sigma > 0:
            image = _bilateral(image, self.bilateral_filter_sigma)
        self._last_image = image
        return image.copy()

    def _notice_jump(self, first_us: float, last_us: float) -> None:
        if self._last_us is not None and not -1.0 <= first_us - self._last_us <= _MAX_SILENCE_US:
            logger.info("time jumps by %.3f s: the reconstruction starts anew", (first_us - self._last_us) * 1e-6)
            self.reset()
        self._last_us = last_us

    def _voxels(
        self, x: np.ndarray, y: np.ndarray, t_us: np.ndarray, p: np.ndarray, span: tuple[float, float] | None
    ) -> Float[torch.Tensor, "bins {self.height} {self.width}"]:
        size: dict[str, int] = {"width": self.width, "height": self.height, "num_bins": self.network.num_bins}
        raw = self.no_normalize or self.network.scaling == "none"
        if self.device.type == "cuda" and self.network.scaling in ("window", "none"):
            return self._voxels_on_gpu(
                voxel_torch.accumulate(x, y, t_us, p, **size, device=self.device, span=span), raw
            )
        grid = accumulate(x, y, t_us, p, **size, span=span, threads=torch.get_num_threads())
        if self._working_cells is not None:
            grid = grid * self._working_cells
        if self.flip:
            grid = grid[:, ::-1, ::-1]
        if not raw:
            grid = self._scaled(grid)
        elif isinstance(self._scaled, RunningAndScale):
            self._scaled(grid)  # for the plane beside it
            grid = self._scaled.beside(grid)
        return torch.from_numpy(np.ascontiguousarray(grid)).to(self.device)

    def _voxels_on_gpu(self, grid: torch.Tensor, raw: bool) -> torch.Tensor:
        if self._working_cells is not None:
            grid = grid * torch.from_numpy(self._working_cells).to(self.device)
        if self.flip:
            grid = grid.flip(1, 2)
        return grid if raw else voxel_torch.normalise(grid)

    def _tone(self, plane: "Plane", voxels: torch.Tensor) -> UInt8[np.ndarray, "height width"]:
        """Reconstructed, sharpened, scaled to 8 bits (cut off, not rounded, as the reference does), without padding."""
        image = plane(voxels)
        if self.unsharp_mask_amount > 0:
            blurred = F.conv2d(image, self._kernel, padding=self._kernel.shape[-1] // 2)
            image = (1 + self.unsharp_mask_amount) * image - self.unsharp_mask_amount * blurred
        return plane.cropped(self._tone_curve(image))


class Plane:
    """The network at work on one image plane, whose `state` carries over from window to window."""

    def __init__(
        self,
        network: ReconstructionNetwork,
        width: int,
        height: int,
        device: torch.device,
        dtype: torch.dtype | None,
        forgets: bool,
    ):
        self.network, self.width, self.height = network, width, height
        self.padding = _padding(width, height, network.multiple)
        self.device_type, self.dtype, self.forgets = device.type, dtype, forgets
        self.state: State | None = None

    def __call__(self, voxels: torch.Tensor) -> Float[torch.Tensor, "1 1 padded_height padded_width"]:
        """The image, with its padding, in float32."""
        padded = _pad(voxels[None], self.padding, self.network.padding)
        precision: AbstractContextManager = nullcontext()
        if self.network.channels_last_input:  # up to four times as quick
            padded = padded.contiguous(memory_format=torch.channels_last)
        if self.dtype is not None:
            precision = torch.autocast(self.device_type, self.dtype)
        with precision:
            image, state = self.network(padded, self.state)
        self.state = None if self.forgets else state
        return image.float()

    def cropped(self, image: torch.Tensor) -> np.ndarray:
        """The image (1, 1, padded height, padded width) without its padding, as an array (height, width)."""
        left, _, top, _ = self.padding
        return image[0, 0, top : top + self.height, left : left + self.width].cpu().numpy().copy()


class ToneCurve:
    """Network output to 8 bits: linear between two bounds, fixed or (`auto_hdr`) the median of recent extremes."""

    def __init__(self, lowest: float, highest: float, auto_hdr: bool, median_size: int):
        self.lowest, self.highest, self.auto_hdr = lowest, highest, auto_hdr
        # The reference drops the oldest entry only once there are more than `median_size` of them.
        self._recent: deque[tuple[float, float]] = deque(maxlen=median_size + 1)

    def reset(self) -> None:
        """Forget the ranges of the images so far."""
        self._recent.clear()

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        low, high = self._measured(image) if self.auto_hdr else (self.lowest, self.highest)
        return (255.0 * (image - low) / (high - low)).clamp_(0.0, 255.0).byte()

    def _measured(self, image: torch.Tensor) -> tuple[float, float]:
        # The limits keep a range of at least 0.1 when an image is flat.
        low, high = float(np.clip(image.min().item(), 0.0, 0.45)), float(np.clip(image.max().item(), 0.55, 1.0))
        self._recent.append((low, high))
        lows, highs = zip(*self._recent, strict=True)
        return float(np.median(lows)), float(np.median(highs))


def _span(t_us: np.ndarray, shown_at: float) -> tuple[float, float, float]:
    first, last = float(np.min(t_us)), float(np.max(t_us))
    return first, first + shown_at * (last - first), last


def unsharp_kernel(sigma: float, size: int = 5) -> Float[torch.Tensor, "1 1 size size"]:
    """The reference's smoothing kernel: a Gaussian integrated over cells that span +-sigma, not +-(size / 2) pixels.

    It is therefore much flatter than a Gaussian of `sigma` pixels; kept, since published results depend on it.
    """
    half_cell = (2 * sigma + 1.0) / size / 2.0
    cells = np.diff(norm.cdf(np.linspace(-sigma - half_cell, sigma + half_cell, size + 1)))
    kernel = np.sqrt(np.outer(cells, cells))
    return torch.from_numpy(kernel / kernel.sum()).float()[None, None]


def _padding(width: int, height: int, multiple: int) -> tuple[int, int, int, int]:
    """Columns left and right, rows above and below that make both sizes divisible; the odd one goes first."""
    columns, rows = -width % multiple, -height % multiple
    return columns - columns // 2, columns // 2, rows - rows // 2, rows // 2


def _pad(voxels: torch.Tensor, padding: tuple[int, int, int, int], kind: str) -> torch.Tensor:
    """Padded with zeros, or reflected at the border; a sensor narrower than the padding repeats its border instead."""
    if not any(padding):
        return voxels
    if kind == "zeros":
        return F.pad(voxels, padding)
    height, width = voxels.shape[-2:]
    reflects = max(padding[:2]) < width and max(padding[2:]) < height
    return F.pad(voxels, padding, mode="reflect" if reflects else "replicate")


def _bilateral(image: np.ndarray, sigma: float) -> np.ndarray:
    import cv2  # not needed otherwise

    return np.asarray(cv2.bilateralFilter(image, 5, 25.0 * sigma, 25.0 * sigma), dtype=np.uint8)


def _working_cells(hot_pixels: HotPixels | None, width: int, height: int) -> np.ndarray | None:
    """(H, W) float32 ones with zeros at the hot pixels, or None when there are none."""
    if hot_pixels is None:
        return None
    place = "hot_pixels"
    if isinstance(hot_pixels, str | os.PathLike):
        place = str(hot_pixels)
        try:
            hot_pixels = np.loadtxt(Path(hot_pixels), delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise CalibrationError(f"{place}: hot pixels unreadable ({error}); expected lines 'x,y'.") from error
    pixels = np.asarray(hot_pixels).reshape(-1, 2).astype(np.int64)
    inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    if not inside.all():
        bad = pixels[~inside][0]
        raise CalibrationError(f"{place}: pixel ({bad[0]}, {bad[1]}) lies outside the {width}x{height} sensor.")
    cells = np.ones((height, width), dtype=np.float32)
    cells[pixels[:, 1], pixels[:, 0]] = 0.0
    return cells


def find_device(device: str | torch.device | None) -> torch.device:
    """The device of that name; None is the CPU, 'auto' a GPU where there is one, else the CPU.

    Raises CalibrationError when torch does not know it, or the machine does not have it.
    """
    if device is None:
        return torch.device("cpu")
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(device)
        torch.zeros(1, device=found)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise CalibrationError(
            f"Reconstructor: device {str(device)!r} cannot be used ({str(error).splitlines()[0]}). Leave it out to "
            "compute on the CPU."
        ) from error
    return found


def reduced_precision(network: ReconstructionNetwork, device: torch.device, precision: str) -> torch.dtype | None:
    """The type to compute in where it is not float32. float16 on a CPU is an error: bfloat16 is as quick there."""
    if precision not in ("auto", "float32", "bfloat16", "float16"):
        raise CalibrationError(
            f"Reconstructor: precision is {precision!r}; expected auto, float32, bfloat16 or float16."
        )
    if precision == "float16":
        if device.type == "cpu":
            raise CalibrationError(
                "Reconstructor: float16 is for GPUs; CPUs compute it slowly or not at all. Use bfloat16 or float32, or "
                "a device such as cuda."
            )
        return torch.float16
    if precision == "auto":
        if not network.reduced_precision:
            return None
        if device.type == "cpu":
            quick = bool(torch.cpu.get_capabilities().get("amx_bf16", False))
        else:
            quick = device.type == "cuda" and torch.cuda.is_bf16_supported()
        return torch.bfloat16 if quick else None
    return torch.bfloat16 if precision == "bfloat16" else None
