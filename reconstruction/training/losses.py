"""What the training minimises: errors of the image, of its edges, and of where its corners lie."""

import torch
import torch.nn.functional as F
from jaxtyping import Float

_WINDOW = 9  # pixels; about the window in which detectors place a corner
_ROUND = 0.01  # smaller eigenvalue of the mean structure tensor from which on a place counts as a corner
_RIDGE = 1e-3
_SOFT_PX = 0.15  # displacements beyond this count by their length, not by its square
_SOFT_SHARED_PX = 0.02  # of what the corners of an image share
_EDGE = 0.6  # of net events in scaled units, averaged over 3 x 3 pixels: an edge has passed by a pixel
_NEAR = 13  # pixels; side of the square about a passing edge that shows what lies there


def weights_of_places(
    voxels: Float[torch.Tensor, "t b c h w"], num_bins: int, unseen_weight: float
) -> Float[torch.Tensor, "t b 1 h w"]:
    """How much each place counts, window after window of a clip: 1 once an edge has passed near it, before that
    `unseen_weight`.

    A place that nothing has passed yet cannot be known. A network that is asked for it all the same does well to call
    it grey, and learns to call grey what it has long not seen.
    """
    if unseen_weight == 1.0:
        return torch.ones_like(voxels[:, :, :1])
    # The sum so far is the change of brightness since the clip's start; noise of both signs cancels in it.
    change = voxels[:, :, :num_bins].sum(dim=2).cumsum(dim=0)
    edges = F.avg_pool2d(change, 3, stride=1, padding=1).abs() > _EDGE
    near = F.max_pool2d(edges.to(change.dtype), _NEAR, stride=1, padding=_NEAR // 2)
    seen = near.cummax(dim=0).values[:, :, None]
    return unseen_weight + (1.0 - unseen_weight) * seen


def image_loss(
    predicted: Float[torch.Tensor, "*n h w"],
    target: Float[torch.Tensor, "*n h w"],
    weight: Float[torch.Tensor, "*n h w"],
    gradient_weight: float,
) -> Float[torch.Tensor, ""]:
    """Weighted L1 error of the image, plus that of its differences between neighbours along rows and columns."""
    error = predicted - target
    along_rows = _mean(error.diff(dim=-1).abs(), weight[..., 1:])
    along_columns = _mean(error.diff(dim=-2).abs(), weight[..., 1:, :])
    return _mean(error.abs(), weight) + gradient_weight * (along_rows + along_columns)


def _mean(values: torch.Tensor, weight: torch.Tensor) -> Float[torch.Tensor, ""]:
    return (values * weight).sum() / weight.sum().clamp_min(1e-3)


def displacement_losses(
    predicted: Float[torch.Tensor, "t b 1 h w"],
    target: Float[torch.Tensor, "t b 1 h w"],
    weight: Float[torch.Tensor, "t b 1 h w"],
) -> tuple[Float[torch.Tensor, ""], Float[torch.Tensor, ""]]:
    """How far corners are displaced, pixels: each by itself, and together.

    The first is the weighted mean over the places whose surroundings hold a corner; the L1 error of an image is
    content with edges that all lag a little, a calibration is not. The second is the length of an image's mean
    displacement, plus that of a whole clip's: small beside the first, but what all corners of an image share, a
    calibration takes for a motion of the camera, and no residual shows it.
    """
    dx, dy, places = _displacements(predicted, target, weight)
    squared = dx * dx + dy * dy
    each = _mean(_soft_length(squared, _SOFT_PX), places)
    bounded = (1.0 + squared / _SOFT_PX**2).rsqrt()  # a place that fits nothing may not speak for its image
    corners = places.sum(dim=(-2, -1))
    sums = torch.stack([(d * bounded * places).sum(dim=(-2, -1)) for d in (dx, dy)])
    images = _mean(_soft_length(_squared_mean(sums, corners), _SOFT_SHARED_PX), corners)
    clips = _mean(_soft_length(_squared_mean(sums.sum(dim=1), corners.sum(dim=0)), _SOFT_SHARED_PX), corners.sum(dim=0))
    return each, images + clips


def _squared_mean(sums: Float[torch.Tensor, "2 *n"], weight: Float[torch.Tensor, "*n"]) -> Float[torch.Tensor, "*n"]:
    return ((sums / weight.clamp_min(1e-3)) ** 2).sum(dim=0)


def _soft_length(squared: Float[torch.Tensor, "*n"], soft: float) -> Float[torch.Tensor, "*n"]:
    """The square of small lengths, over 2 `soft`; beyond `soft` the length."""
    return soft * ((1.0 + squared / soft**2).sqrt() - 1.0)


def _displacements(
    predicted: Float[torch.Tensor, "t b 1 h w"],
    target: Float[torch.Tensor, "t b 1 h w"],
    weight: Float[torch.Tensor, "t b 1 h w"],
) -> tuple[Float[torch.Tensor, "t b i j"], Float[torch.Tensor, "t b i j"], Float[torch.Tensor, "t b i j"]]:
    """Along x and y, pixels, around every second pixel, and how much each counts: none where there is no corner.

    A pattern displaced by d gives the error -d . grad(target): solved by least squares over a window around each place
    (Lucas & Kanade 1981).
    """
    clips = target.shape[:2]
    error = (predicted - target).flatten(0, 1)[..., 1:-1, 1:-1]
    image = target.flatten(0, 1)
    gx = 0.5 * (image[..., 1:-1, 2:] - image[..., 1:-1, :-2])
    gy = 0.5 * (image[..., 2:, 1:-1] - image[..., :-2, 1:-1])
    sums = F.avg_pool2d(torch.cat([gx * gx, gx * gy, gy * gy, gx * error, gy * error], dim=1), _WINDOW, stride=2)
    xx, xy, yy, ex, ey = sums.unflatten(0, clips).unbind(dim=2)
    smaller = 0.5 * (xx + yy) - (0.25 * (xx - yy) ** 2 + xy * xy + 1e-12).sqrt()
    cornered = smaller / (smaller + _ROUND)
    places = F.avg_pool2d(weight.flatten(0, 1)[..., 1:-1, 1:-1], _WINDOW, stride=2).unflatten(0, clips)[:, :, 0]
    determinant = (xx + _RIDGE) * (yy + _RIDGE) - xy * xy
    dx = (xy * ey - (yy + _RIDGE) * ex) / determinant
    dy = (xy * ex - (xx + _RIDGE) * ey) / determinant
    return dx, dy, cornered * places
