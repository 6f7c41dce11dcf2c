"""Where a picture's colours step: heights of steps, what shading and noise leave, spacing."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.data.color_steps import LEVELS_PER_STEP, steps_of

HEIGHT, WIDTH = 60, 80
EDGE = 40
"""First column on the brighter side."""


def stepped(height: float, width: int = WIDTH, edge: int = EDGE) -> torch.Tensor:
    picture = torch.full((HEIGHT, width, 3), 0.6)
    picture[:, edge:] += height
    return picture


def noise(picture: torch.Tensor, sigma: float) -> torch.Tensor:
    random = torch.Generator().manual_seed(4)
    return picture + sigma * torch.randn(picture.shape, generator=random)


def found(picture: torch.Tensor, spacing_px: float = 1.0) -> torch.Tensor:
    return steps_of(picture, spacing_px).float() / LEVELS_PER_STEP


@pytest.mark.parametrize("height", [0.01, 0.04, 0.2])
def test_a_step_counts_with_its_height_and_plain_colour_with_nothing(height: float) -> None:
    steps = found(stepped(height))
    assert steps.shape == (HEIGHT, WIDTH)
    # Sampled beside the edge, which lies between two pixels.
    assert float(steps[:, EDGE - 1 : EDGE + 1].min()) == pytest.approx(height, rel=0.15)
    assert float(steps[:, : EDGE - 5].max()) == float(steps[:, EDGE + 5 :].max()) == 0.0


def test_the_highest_of_the_colours_counts_and_the_slant_of_an_edge_does_not() -> None:
    blue = torch.full((HEIGHT, WIDTH, 3), 0.5)
    blue[:, EDGE:, 2] += 0.1
    x, y = torch.meshgrid(torch.arange(WIDTH), torch.arange(HEIGHT), indexing="xy")
    slanted = (0.5 + 0.1 * (x + y >= 70).float())[..., None].expand(-1, -1, 3)
    for picture in (blue, slanted):
        assert float(found(picture).max()) == pytest.approx(0.1, rel=0.15)


def test_even_shading_is_worth_some_pixels_of_it() -> None:
    slope = 0.004
    ramp = slope * (torch.arange(WIDTH) - EDGE).clamp_min(0).float()
    steps = found((0.3 + ramp)[None, :, None].expand(HEIGHT, -1, 3))
    assert float(steps[:, EDGE + 5 : -5].mean()) == pytest.approx(2.5 * slope, rel=0.05)
    assert float(steps[:, : EDGE - 5].max()) == 0.0
    assert float(steps[:, -5:].max()) <= 2.6 * slope  # the border is no step


def test_noise_is_no_step_and_hides_none() -> None:
    even = found(noise(stepped(0.0), 0.004))
    assert float((even > 0.015).float().mean()) < 0.01
    steps = found(noise(stepped(0.05), 0.004))
    assert float(steps[:, EDGE - 1 : EDGE + 1].amax(dim=1).min()) > 0.02


def test_texture_everywhere_is_not_taken_for_noise() -> None:
    assert float(found(noise(stepped(0.0), 0.1)).median()) > 0.06


def test_looks_some_pixels_apart_miss_no_step() -> None:
    steps = found(stepped(0.1), spacing_px=7.0)
    for first in range(7):
        assert float(steps[30, first::7].max()) == pytest.approx(0.1, rel=0.15)


def test_a_larger_picture_of_the_same_has_the_same_steps() -> None:
    """A blurred edge of six pixels is the same step as one of two in a third of the size."""
    small = torch.full((30, 320, 3), 0.5)
    small[:, 160:] += 0.06
    large = small.repeat_interleave(3, dim=0).repeat_interleave(3, dim=1)
    assert float(found(large).max()) == pytest.approx(float(found(small).max()), rel=0.1)


def test_a_picture_is_as_large_as_before_where_blocks_do_not_fit() -> None:
    picture = torch.full((301, 1003, 3), 0.5)  # blocks of two pixels
    picture[:, 500:] += 0.06
    steps = found(picture, spacing_px=6.0)
    assert steps.shape == (301, 1003)
    for first in range(6):
        assert float(steps[:, first::6].amax(dim=1).min()) == pytest.approx(0.06, rel=0.15)
    assert float(steps[:, :480].max()) == float(steps[:, 520:].max()) == 0.0
