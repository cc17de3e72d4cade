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
from reconstruction.networks import ReconstructionNetwork
from reconstruction.networks.base import State
from reconstruction.voxel import accumulate, normalise

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
    - `device`: 'cpu', 'cuda' ...; None for the CPU.
    - `precision`: 'float32', 'bfloat16', or 'auto': bfloat16 where the network was trained in it and the machine
      computes it in hardware. The last layer and all filters are in float32 in any case.

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
    ):
        if width < 1 or height < 1:
            raise CalibrationError(f"Reconstructor: sensor size is {width}x{height}; expected positive numbers.")
        if Imax <= Imin:
            raise CalibrationError(f"Reconstructor: Imax ({Imax}) must be above Imin ({Imin}).")
        if unsharp_mask_amount < 0 or unsharp_mask_sigma <= 0 or bilateral_filter_sigma < 0:
            raise CalibrationError("Reconstructor: filter amounts must not be negative and the mask's sigma positive.")
        self.device = torch.device("cpu" if device is None else device)
        self.network = network.to(self.device).eval()
        self.width, self.height = int(width), int(height)
        self.unsharp_mask_amount = unsharp_mask_amount
        self.bilateral_filter_sigma = bilateral_filter_sigma
        self.flip, self.no_normalize, self.no_recurrent = flip, no_normalize, no_recurrent
        self.padding = _padding(self.width, self.height, network.multiple)
        self._tone_curve = ToneCurve(Imin, Imax, auto_hdr, auto_hdr_median_filter_size)
        self._kernel = unsharp_kernel(unsharp_mask_sigma).to(self.device)
        self._working_cells = _working_cells(hot_pixels, self.width, self.height)
        self._autocast = _uses_bfloat16(network, self.device, precision)
        self.reset()

    def reset(self) -> None:
        """Forget everything seen so far: the next window starts a new recording."""
        self._state: State | None = None
        self._last_image: np.ndarray | None = None
        self._last_us: float | None = None
        self._tone_curve.reset()

    def __call__(
        self, x: np.ndarray, y: np.ndarray, t_us: np.ndarray, p: np.ndarray
    ) -> UInt8[np.ndarray, "{self.height} {self.width}"]:
        """The image at the end of a window of events, uint8 (H, W); arguments as for `voxel_grid`.

        A window without events says that nothing changed: the last image is given again (grey before the first), and
        the state stays as it is.
        """
        if len(t_us) == 0:
            grey = np.full((self.height, self.width), 127, dtype=np.uint8)
            return grey if self._last_image is None else self._last_image.copy()
        self._notice_jump(float(np.min(t_us)), float(np.max(t_us)))
        with torch.inference_mode():
            image = self._tone(self._predict(self._voxels(x, y, t_us, p)))
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
        self, x: np.ndarray, y: np.ndarray, t_us: np.ndarray, p: np.ndarray
    ) -> Float[torch.Tensor, "bins {self.height} {self.width}"]:
        grid = accumulate(x, y, t_us, p, width=self.width, height=self.height, num_bins=self.network.num_bins)
        if self._working_cells is not None:
            grid = grid * self._working_cells
        if self.flip:
            grid = grid[:, ::-1, ::-1]
        raw = self.no_normalize or not self.network.normalises
        grid = np.ascontiguousarray(grid) if raw else normalise(grid)
        return torch.from_numpy(grid).to(self.device)

    def _predict(self, voxels: torch.Tensor) -> Float[torch.Tensor, "1 1 padded_height padded_width"]:
        padded = _pad(voxels[None], self.padding, self.network.padding)
        if self._autocast:
            padded = padded.contiguous(memory_format=torch.channels_last)
        precision: AbstractContextManager = (
            torch.autocast(self.device.type, torch.bfloat16) if self._autocast else nullcontext()
        )
        with precision:
            image, state = self.network(padded, self._state)
        self._state = None if self.no_recurrent else state
        return image.float()

    def _tone(self, image: Float[torch.Tensor, "1 1 padded_height padded_width"]) -> UInt8[np.ndarray, "height width"]:
        """Sharpened, scaled to 8 bits (cut off, not rounded, as the reference does) and freed of the padding."""
        if self.unsharp_mask_amount > 0:
            blurred = F.conv2d(image, self._kernel, padding=self._kernel.shape[-1] // 2)
            image = (1 + self.unsharp_mask_amount) * image - self.unsharp_mask_amount * blurred
        grey = self._tone_curve(image)
        left, _, top, _ = self.padding
        return grey[0, 0, top : top + self.height, left : left + self.width].cpu().numpy().copy()


class ToneCurve:
    """Network output to 8 bits: linear between two bounds, fixed or (`auto_hdr`) the median of recent extremes."""

    def __init__(self, lowest: float, highest: float, auto_hdr: bool, median_size: int):
        self.lowest, self.highest, self.auto_hdr = lowest, highest, auto_hdr
        # The reference drops the oldest entry only once there are more than `median_size` of them.
        self._recent: deque[tuple[float, float]] = deque(maxlen=median_size + 1)

    def reset(self) -> None:
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


def _uses_bfloat16(network: ReconstructionNetwork, device: torch.device, precision: str) -> bool:
    if precision not in ("auto", "float32", "bfloat16"):
        raise CalibrationError(f"Reconstructor: precision is {precision!r}; expected auto, float32 or bfloat16.")
    if precision != "auto":
        return precision == "bfloat16"
    if not network.reduced_precision:
        return False
    if device.type == "cpu":
        return bool(torch.cpu.get_capabilities().get("amx_bf16", False))
    return device.type == "cuda" and torch.cuda.is_bf16_supported()
