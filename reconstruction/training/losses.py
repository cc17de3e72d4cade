"""What the training minimises: errors of the image, of its edges, and of where its corners lie."""

import torch
import torch.nn.functional as F
from jaxtyping import Float

_WINDOW = 9  # pixels; about the window in which detectors place a corner
_ROUND = 0.01  # smaller eigenvalue of the mean structure tensor from which on a place counts as a corner
_RIDGE = 1e-3
_SOFT_PX = 0.15  # displacements beyond this count by their length, not by its square


def image_loss(
    predicted: Float[torch.Tensor, "*n h w"], target: Float[torch.Tensor, "*n h w"], gradient_weight: float
) -> Float[torch.Tensor, ""]:
    """L1 error of the image, plus that of its differences between neighbours along rows and columns."""
    error = predicted - target
    differences = error.diff(dim=-1).abs().mean() + error.diff(dim=-2).abs().mean()
    return error.abs().mean() + gradient_weight * differences


def displacement_loss(
    predicted: Float[torch.Tensor, "*n h w"], target: Float[torch.Tensor, "*n h w"]
) -> Float[torch.Tensor, ""]:
    """How far corners are displaced, pixels: the mean over the places whose surroundings hold a corner.

    The L1 error of an image is content with edges that all lag a little; a calibration is not. A pattern displaced by
    d gives the error -d . grad(target): solved by least squares over a window around each place (Lucas & Kanade 1981).
    """
    error = (predicted - target).flatten(0, -3)[:, None, 1:-1, 1:-1]
    image = target.flatten(0, -3)[:, None]
    gx = 0.5 * (image[..., 1:-1, 2:] - image[..., 1:-1, :-2])
    gy = 0.5 * (image[..., 2:, 1:-1] - image[..., :-2, 1:-1])
    sums = F.avg_pool2d(torch.cat([gx * gx, gx * gy, gy * gy, gx * error, gy * error], dim=1), _WINDOW, stride=2)
    xx, xy, yy, ex, ey = sums.unbind(dim=1)
    smaller = 0.5 * (xx + yy) - (0.25 * (xx - yy) ** 2 + xy * xy + 1e-12).sqrt()
    weight = smaller / (smaller + _ROUND)
    determinant = (xx + _RIDGE) * (yy + _RIDGE) - xy * xy
    dx = ((yy + _RIDGE) * ex - xy * ey) / determinant
    dy = ((xx + _RIDGE) * ey - xy * ex) / determinant
    size = _SOFT_PX * ((1.0 + (dx * dx + dy * dy) / _SOFT_PX**2).sqrt() - 1.0)
    return (weight * size).sum() / weight.sum().clamp_min(1e-3)
