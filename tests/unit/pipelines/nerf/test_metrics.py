"""PSNR and SSIM against known values and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from pipelines.nerf.errors import NerfError
from pipelines.nerf.metrics import psnr, ssim


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


def test_unequal_shapes_and_tiny_pictures_are_refused() -> None:
    with pytest.raises(NerfError, match="cannot be compared"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(NerfError, match="11 x 11"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))
