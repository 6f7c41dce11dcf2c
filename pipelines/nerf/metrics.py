"""How close a picture is to the truth: PSNR and SSIM of [H, W, 3] pictures in [0, 1]."""

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


def psnr(predicted: Tensor, truth: Tensor) -> float:
    """PSNR in dB of two pictures [H, W, 3] in [0, 1]."""
    _check(predicted, truth)
    return psnr_from_mse(float((predicted.double() - truth.double()).square().mean()))


def ssim(predicted: Tensor, truth: Tensor) -> float:
    """Structural similarity of two pictures [H, W, 3] in [0, 1], at least 11 pixels each side.

    Gaussian window of 11 x 11, sigma 1.5, data range 1, K1 = 0.01, K2 = 0.03, biased variances;
    the mean over channels and over the pixels whose window lies inside the picture. These are the
    values of torchmetrics' default, which pads by reflection and then crops just that border.
    Source: Wang et al., "Image quality assessment", IEEE TIP 13(4), 2004.
    """
    _check(predicted, truth)
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
    return float((luminance * contrast).mean())


def _check(predicted: Tensor, truth: Tensor) -> None:
    if predicted.shape != truth.shape or predicted.ndim != 3 or predicted.shape[2] != 3:
        raise NerfError(
            "bad_image",
            f"Pictures of shapes {tuple(predicted.shape)} and {tuple(truth.shape)} cannot be "
            "compared; both must be [H, W, 3].",
        )
