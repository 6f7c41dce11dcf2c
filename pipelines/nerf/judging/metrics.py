"""How close a picture is to the truth: PSNR and SSIM of [H, W, 3] pictures in [0, 1].

Both can be asked about a part of the picture: `valid` [H, W] bool is true where a pixel counts.
LPIPS, which needs a pretrained network, is in `lpips`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError

SSIM_SIGMA = 1.5
SSIM_RADIUS = 5
SSIM_K1, SSIM_K2 = 0.01, 0.03


def psnr_from_mse(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of values in [0, 1]; infinite for an error of 0."""
    return math.inf if mse <= 0.0 else -10.0 * math.log10(mse)


def psnr(predicted: Tensor, truth: Tensor, valid: Tensor | None = None) -> float:
    """PSNR in dB of two pictures [H, W, 3] in [0, 1], over the valid pixels.

    valid: [H, W] bool; None for all. Raises NerfError `bad_image` where shapes differ or no pixel
    is valid.
    """
    _check(predicted, truth, valid)
    squared = (predicted.double() - truth.double()).square()
    return psnr_from_mse(float((squared if valid is None else squared[valid]).mean()))


def ssim(predicted: Tensor, truth: Tensor, valid: Tensor | None = None) -> float:
    """Structural similarity of two pictures [H, W, 3] in [0, 1], at least 11 pixels each side.

    The mean of `ssim_map` over channels and over the pixels whose window lies inside the picture;
    with `valid` [H, W] bool, over those of them that are valid. Only the window's centre is asked:
    a valid pixel closer than 6 pixels to an invalid one also sees that one's colour.
    Raises NerfError `bad_image` where shapes differ, a side is too short or no pixel counts.
    """
    _check(predicted, truth, valid)
    values = ssim_map(predicted, truth)
    if valid is None:
        return float(values.mean())
    inside = valid[SSIM_RADIUS:-SSIM_RADIUS, SSIM_RADIUS:-SSIM_RADIUS]
    if not bool(inside.any()):
        raise NerfError(
            "bad_image",
            "No valid pixel is 5 pixels or more away from the picture's border, so SSIM has none.",
            "Check the mask.",
        )
    return float(values[:, inside].mean())


def ssim_map(predicted: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity around each pixel: [3, H - 10, W - 10] in [-1, 1], float64.

    Gaussian window of 11 x 11, sigma 1.5, data range 1, K1 = 0.01, K2 = 0.03, biased variances.
    Their mean is torchmetrics' default, which pads by reflection and then crops just that border.
    Source: Wang et al., "Image quality assessment", IEEE TIP 13(4), 2004, eq. 13.
    """
    _check(predicted, truth, None)
    if min(predicted.shape[:2]) <= 2 * SSIM_RADIUS:
        raise NerfError("bad_image", "SSIM needs pictures of at least 11 x 11 pixels.")
    offsets = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64)
    window = torch.exp(-0.5 * (offsets / SSIM_SIGMA).square())
    window = (window / window.sum()).to(predicted.device)
    x, y = predicted.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)
    stack = torch.cat([x, y, x * x, y * y, x * y])[:, None]  # [15, 1, H, W]
    blurred = torch.nn.functional.conv2d(stack, window[None, None, :, None])
    blurred = torch.nn.functional.conv2d(blurred, window[None, None, None, :])[:, 0]
    mean_x, mean_y, square_x, square_y, product = torch.split(blurred, 3)
    variance_x = (square_x - mean_x.square()).clamp_min(0.0)
    variance_y = (square_y - mean_y.square()).clamp_min(0.0)
    covariance = product - mean_x * mean_y
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    luminance = (2.0 * mean_x * mean_y + c1) / (mean_x.square() + mean_y.square() + c1)
    contrast = (2.0 * covariance + c2) / (variance_x + variance_y + c2)
    return luminance * contrast


def _check(predicted: Tensor, truth: Tensor, valid: Tensor | None) -> None:
    if predicted.shape != truth.shape or predicted.ndim != 3 or predicted.shape[2] != 3:
        raise NerfError(
            "bad_image",
            f"Pictures of shapes {tuple(predicted.shape)} and {tuple(truth.shape)} cannot be "
            "compared; both must be [H, W, 3].",
        )
    if valid is None:
        return
    if valid.shape != predicted.shape[:2] or valid.dtype != torch.bool:
        raise NerfError(
            "bad_image",
            f"A mask of shape {tuple(valid.shape)} and type {valid.dtype} does not fit a picture "
            f"of shape {tuple(predicted.shape)}; it must be [H, W] of bool.",
        )
    if not bool(valid.any()):
        raise NerfError("bad_image", "The mask leaves no pixel to compare.", "Check the mask.")
