"""Where a picture's colours step: the faint edges between white things and white walls, too.

What lies between two pixels is one surface the likelier, the less its colours step there: noise
and shading are no steps. Plain PyTorch, on any device.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LEVELS_PER_STEP = 1000.0
"""Steps are stored by thousandths of black to white; .255 and all beyond are one."""

_SIDE_PER_SIGMA, _LEAST_SIGMA_PX = 320.0, 1.0
"""Long side of a picture, in standard deviations of what it is smoothed by: 1.5 pixels of 480."""
_REACH_SIGMAS = 3.0
_FINE_SIGMA_PX = 1.25
"""Pictures are reduced, by means of blocks, as far as leaves the smoothing so wide."""
_PLAINEST, _NOISE_SPAN, _MOST_NOISE = 0.1, 3.0, 0.005
"""What the plainest tenth of a picture shows is noise, unless it is more than a camera's; along a
line noise goes up to some times that."""


def steps_of(picture: Tensor, spacing_px: float = 1.0) -> Tensor:
    """[H, W] uint8, the highest step of colour at and around each pixel, in `LEVELS_PER_STEP`.

    The slope of the smoothed picture, times sqrt(2 pi) of the smoothing's standard deviation: of
    a step between two plain colours its height, of even shading some pixels' worth of it; less
    what the picture's noise makes. Of red, green and blue the highest counts, and of the square
    about each pixel, so wide that looks `spacing_px` apart see every step. picture: [H, W, 3] in
    [0, 1].
    """
    height, width = picture.shape[:2]
    sigma = max(max(height, width) / _SIDE_PER_SIGMA, _LEAST_SIGMA_PX)
    block = max(1, int(sigma / _FINE_SIGMA_PX))
    colors = picture.permute(2, 0, 1)[:, None].float()
    colors = torch.nn.functional.avg_pool2d(colors, block, ceil_mode=True)
    gradient = _gradient(colors, sigma / block)
    step = gradient.amax(dim=0) * (math.sqrt(2.0 * math.pi) * sigma / block)
    noise = step.flatten().kthvalue(1 + int(_PLAINEST * (step.numel() - 1))).values
    step = (step - _NOISE_SPAN * noise.clamp_max(_MOST_NOISE)).clamp_min(0.0)
    half = math.ceil((int(spacing_px / 2.0) - block // 2) / block)
    if half > 0:
        for side in ((2 * half + 1, 1), (1, 2 * half + 1)):
            around = (side[0] // 2, side[1] // 2)
            step = torch.nn.functional.max_pool2d(step, side, stride=1, padding=around)
    step = (step[0] * LEVELS_PER_STEP).round().clamp_max(255.0).to(torch.uint8)
    whole = step.repeat_interleave(block, dim=0).repeat_interleave(block, dim=1)
    return whole[:height, :width]


def _gradient(colors: Tensor, sigma: float) -> Tensor:
    """[3, 1, H, W], per pixel, of colours [3, 1, H, W] smoothed by a Gaussian."""
    reach = math.ceil(_REACH_SIGMAS * sigma)
    offset = torch.arange(-reach, reach + 1, dtype=torch.float32, device=colors.device)
    smooth = torch.exp(-0.5 * (offset / sigma).square())
    smooth = smooth / smooth.sum()
    slope = offset * smooth
    slope = slope / (slope * offset).sum()  # of a ramp exactly its slope
    # Borders repeat the outermost pixels.
    padded = torch.nn.functional.pad(colors, (reach, reach, reach, reach), mode="replicate")

    def filtered(across: Tensor, down: Tensor) -> Tensor:
        rows = torch.nn.functional.conv2d(padded, across[None, None, None, :])
        return torch.nn.functional.conv2d(rows, down[None, None, :, None])

    return torch.hypot(filtered(slope, smooth), filtered(smooth, slope))
