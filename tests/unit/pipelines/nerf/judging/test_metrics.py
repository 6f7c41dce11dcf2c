"""PSNR and SSIM against known values and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.metrics import psnr, ssim, ssim_map


def _pictures() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(31.0), indexing="ij")
    truth = torch.stack([torch.sin(x / 5), torch.cos(y / 7), torch.sin((x + y) / 9)], -1) / 2 + 0.5
    noise = 0.1 * torch.randn(truth.shape, generator=generator)
    return (truth + noise).clamp(0, 1), truth


def test_psnr_of_a_constant_error() -> None:
    truth = torch.full((8, 8, 3), 0.5)
    assert math.isclose(psnr(truth + 0.1, truth), 20.0, abs_tol=1e-4)
    assert psnr(truth, truth) == math.inf


def test_ssim_equals_scikit_image() -> None:
    predicted, truth = _pictures()
    expected = structural_similarity(
        truth.numpy().astype(np.float64),
        predicted.numpy().astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    assert 0.1 < expected < 0.9
    assert math.isclose(ssim(predicted, truth), expected, abs_tol=1e-9)


def test_ssim_of_equal_pictures_is_one() -> None:
    _, truth = _pictures()
    assert math.isclose(ssim(truth, truth), 1.0, abs_tol=1e-12)


def _mask(height: int, width: int) -> torch.Tensor:
    """A disc and one lonely pixel."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    mask = (y - 20).square() + (x - 14).square() < 90
    mask[7, 24] = True
    return mask


def test_masked_psnr_is_that_of_the_valid_pixels_alone() -> None:
    predicted, truth = _pictures()
    mask = _mask(40, 31)
    total, count = 0.0, 0
    for y in range(40):
        for x in range(31):
            if mask[y, x]:
                for channel in range(3):
                    total += float(predicted[y, x, channel] - truth[y, x, channel]) ** 2
                    count += 1
    assert math.isclose(
        psnr(predicted, truth, mask), -10.0 * math.log10(total / count), abs_tol=1e-4
    )
    spoilt = torch.where(mask[..., None], predicted, 1.0 - truth)
    assert psnr(spoilt, truth, mask) == psnr(predicted, truth, mask)
    everything = torch.ones(40, 31, dtype=torch.bool)
    assert math.isclose(psnr(predicted, truth, everything), psnr(predicted, truth), abs_tol=1e-12)


def test_masked_ssim_is_the_mean_of_scikit_images_map_at_the_valid_centres() -> None:
    predicted, truth = _pictures()
    mask = _mask(40, 31)
    mask[0, :] = True  # On the border there is no whole window: these count nothing.
    _, values = structural_similarity(
        truth.numpy().astype(np.float64),
        predicted.numpy().astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    inner = np.zeros((40, 31), bool)
    inner[5:-5, 5:-5] = mask.numpy()[5:-5, 5:-5]
    expected = values[inner].mean()
    assert abs(expected - ssim(predicted, truth)) > 1e-3, "the mask makes a difference"
    assert math.isclose(ssim(predicted, truth, mask), expected, abs_tol=1e-9)
    crop = values[5:-5, 5:-5].transpose(2, 0, 1)
    assert np.allclose(ssim_map(predicted, truth).numpy(), crop, atol=1e-9)


def test_masks_that_leave_nothing_or_do_not_fit_are_refused() -> None:
    predicted, truth = _pictures()
    border = torch.zeros(40, 31, dtype=torch.bool)
    border[:5] = True
    with pytest.raises(NerfError, match="no pixel"):
        psnr(predicted, truth, torch.zeros(40, 31, dtype=torch.bool))
    with pytest.raises(NerfError, match="No valid pixel"):
        ssim(predicted, truth, border)
    for wrong in (torch.ones(31, 40, dtype=torch.bool), torch.ones(40, 31)):
        with pytest.raises(NerfError, match="does not fit"):
            psnr(predicted, truth, wrong)


def test_unequal_shapes_and_tiny_pictures_are_refused() -> None:
    with pytest.raises(NerfError, match="cannot be compared"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(NerfError, match="11 x 11"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))
