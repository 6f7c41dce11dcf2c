"""Batches of random pixels: which are drawn, and what a coarse one shows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import BLOCK_PIXELS, PixelSampler, block_side
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import DataConfig
from pipelines.nerf.space.cameras import Cameras, SceneTransform


def _numbered(width: int, height: int, start: int) -> np.ndarray:
    values = np.arange(start, start + width * height, dtype=np.uint8)
    return np.stack([values, values, values], -1).reshape(height, width, 3)


def test_batches_carry_the_colour_at_the_pixel_they_name() -> None:
    images = ImageData.from_arrays([_numbered(4, 3, 0), _numbered(5, 2, 50), _numbered(2, 6, 100)])
    generator = torch.Generator().manual_seed(0)
    sampler = PixelSampler(images, [2, 0])
    position, pixels, colors = sampler.draw(500, generator)
    for where, (x, y), color in zip(
        position.tolist(), pixels.tolist(), (colors * 255).round().tolist(), strict=True
    ):
        width, start = ((2, 100), (4, 0))[where]
        assert color[0] == start + width * (y - 0.5) + (x - 0.5)
    # 12 pixels each: every one of them is drawn, about as often as any other.
    drawn, counts = torch.unique((colors[:, 0] * 255).round(), return_counts=True)
    assert len(drawn) == 24
    assert int(counts.max()) < 45


def test_masked_pixels_are_never_drawn() -> None:
    mask = np.ones((3, 4), bool)
    mask[1] = False
    images = ImageData.from_arrays([_numbered(4, 3, 0), _numbered(4, 3, 50)], [mask, None])
    position, pixels, _ = PixelSampler(images, [0, 1]).draw(300, torch.Generator().manual_seed(0))
    assert not bool(((position == 0) & (pixels[:, 1] == 1.5)).any())
    assert bool(((position == 1) & (pixels[:, 1] == 1.5)).any())


def test_masks_that_leave_nothing_are_refused() -> None:
    images = ImageData.from_arrays([_numbered(4, 3, 0)], [np.zeros((3, 4), bool)])
    with pytest.raises(NerfError, match="no pixel"):
        PixelSampler(images, [0])


def _frequencies(
    images: ImageData, indices: list[int], count: int, sampler: PixelSampler
) -> np.ndarray:
    """How often each pixel of `images.pixels` was drawn, by the pixel that the batch names."""
    position, pixels, _ = sampler.draw(count, torch.Generator().manual_seed(11))
    image = torch.tensor(indices)[position]
    x, y = (pixels - 0.5).long().unbind(-1)
    rows = images.offsets[image] + y * images.sizes[image, 0] + x
    return torch.bincount(rows, minlength=len(images.pixels)).numpy()


def test_every_usable_pixel_is_drawn_equally_often_whatever_sizes_and_masks() -> None:
    random = np.random.default_rng(2)
    shapes = [(9, 14), (30, 7), (1, 1), (16, 16), (5, 40)]
    pictures = [random.integers(0, 256, (*shape, 3), np.uint8) for shape in shapes]
    # One mask in scattered pixels, one in an empty stretch longer than a block, one image without.
    masks: list[np.ndarray | None] = [random.random(shape) < 0.4 for shape in shapes]
    holed = np.ones(shapes[1], bool)
    holed.reshape(-1)[30 : 30 + 2 * BLOCK_PIXELS] = False
    masks[1], masks[4] = holed, None
    images = ImageData.from_arrays(pictures, masks)
    indices = [4, 0, 1, 2]  # in another order, and one image left out
    assert images.valid is not None
    usable = torch.zeros(len(images.pixels), dtype=torch.bool)
    for index in indices:
        rows = slice(int(images.offsets[index]), int(images.offsets[index + 1]))
        usable[rows] = images.valid[rows]
    allowed = usable.numpy()

    count = 100 * int(allowed.sum())
    seen = _frequencies(images, indices, count, PixelSampler(images, indices))
    assert seen[~allowed].sum() == 0
    # Chi-square over k pixels: mean k - 1, variance 2 (k - 1); five deviations either way.
    chi_square = float(((seen[allowed] - 100.0) ** 2 / 100.0).sum())
    degrees = int(allowed.sum()) - 1
    assert abs(chi_square - degrees) < 5.0 * math.sqrt(2.0 * degrees)


def test_a_mask_of_ones_changes_no_draw() -> None:
    random = np.random.default_rng(5)
    pictures = [random.integers(0, 256, (h, w, 3), np.uint8) for h, w in ((20, 33), (41, 5))]
    plain = ImageData.from_arrays(pictures)
    masked = ImageData.from_arrays(pictures, [np.ones(p.shape[:2], bool) for p in pictures])
    draws = [
        PixelSampler(images, [1, 0]).draw(1000, torch.Generator().manual_seed(7))
        for images in (plain, masked)
    ]
    for one, other in zip(*draws, strict=True):
        assert torch.equal(one, other)


def test_the_k_th_usable_pixel_is_that_of_the_list_of_all_usable_pixels() -> None:
    random = np.random.default_rng(8)
    shapes = [(13, 11), (64, 2), (3, 100)]
    pictures = [random.integers(0, 256, (*shape, 3), np.uint8) for shape in shapes]
    images = ImageData.from_arrays(pictures, [random.random(shape) < 0.3 for shape in shapes])
    assert images.valid is not None
    listed = images.valid.nonzero().squeeze(-1)  # the slow twin: eight bytes a usable pixel
    drawn = torch.randint(len(listed), (2000,), generator=torch.Generator().manual_seed(1))
    position, pixels, colors = PixelSampler(images, [0, 1, 2]).draw(
        2000, torch.Generator().manual_seed(1)
    )
    rows = listed[drawn]
    assert torch.equal(position, torch.searchsorted(images.offsets[1:], rows, right=True))
    x, y = (pixels - 0.5).long().unbind(-1)
    assert torch.equal(images.offsets[position] + y * images.sizes[position, 0] + x, rows)
    assert torch.equal(colors, images.pixels[rows].float() / 255.0)


@pytest.mark.gpu
@pytest.mark.skipif(
    not torch.cuda.is_available(), reason="pixels on a GPU are NOT tested: no CUDA device"
)
def test_on_a_gpu_pixels_and_colours_are_those_of_the_images() -> None:
    random = np.random.default_rng(5)
    pictures = [random.integers(0, 256, (h, w, 3), np.uint8) for h, w in ((20, 33), (41, 5))]
    masks = [random.random(p.shape[:2]) < 0.5 for p in pictures]
    images = ImageData.from_arrays(pictures, masks)
    sampler = PixelSampler(images, [1, 0], "cuda")
    position, pixels, colors = sampler.draw(4000, torch.Generator("cuda").manual_seed(3))
    assert {item.device.type for item in (position, pixels, colors)} == {"cuda"}
    for where, (x, y), color in zip(
        position.tolist(), (pixels - 0.5).long().tolist(), colors.cpu().numpy(), strict=True
    ):
        index = (1, 0)[where]
        assert masks[index][y, x]
        expected = pictures[index][y, x].astype(np.float32) / np.float32(255.0)
        np.testing.assert_array_max_ulp(color, expected, 1)  # CUDA multiplies by 1 / 255


def _slow_block_mean(
    picture: np.ndarray, mask: np.ndarray, x: int, y: int, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean centre and colour of the usable pixels of the square that holds pixel (x, y)."""
    centers, colors = [], []
    for row in range(y // side * side, y // side * side + side):
        for column in range(x // side * side, x // side * side + side):
            if row < picture.shape[0] and column < picture.shape[1] and mask[row, column]:
                centers.append((column + 0.5, row + 0.5))
                colors.append(picture[row, column] / 255.0)
    return np.mean(centers, axis=0), np.mean(colors, axis=0)


@pytest.mark.parametrize("side", [2, 4, 8])
@pytest.mark.parametrize("masked", [False, True])
def test_a_coarse_ray_shows_the_mean_of_the_usable_pixels_of_its_square(
    side: int, masked: bool
) -> None:
    random = np.random.default_rng(6)
    shapes = [(13, 11), (16, 9), (3, 30)]  # few are multiples of the side
    pictures = [random.integers(0, 256, (*shape, 3), np.uint8) for shape in shapes]
    masks = [random.random(s) < 0.5 if masked else np.ones(s, bool) for s in shapes]
    images = ImageData.from_arrays(pictures, masks if masked else None)
    indices = [2, 0, 1]
    sampler = PixelSampler(images, indices)
    position, pixels, _ = sampler.draw(200, torch.Generator().manual_seed(4))
    sampler.block = side
    same, centers, colors = sampler.draw(200, torch.Generator().manual_seed(4))
    assert torch.equal(position, same)
    for k in range(200):
        image = indices[int(position[k])]
        x, y = (pixels[k] - 0.5).int().tolist()
        center, color = _slow_block_mean(pictures[image], masks[image], x, y, side)
        assert centers[k].tolist() == pytest.approx(center, abs=1e-4)
        assert colors[k].tolist() == pytest.approx(color, abs=1e-6)


def test_coarse_rays_are_those_of_the_reduced_images_and_cameras() -> None:
    random = np.random.default_rng(3)
    picture = random.integers(0, 256, (8, 12, 3), np.uint8)
    cameras = Cameras.from_arrays(
        world_from_camera=np.eye(4)[None, :3],
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[12],
        heights=[8],
        focal=[[10.0, 9.0]],
        principal=[[5.5, 4.25]],
    )
    sampler = PixelSampler(ImageData.from_arrays([picture]), [0])
    sampler.block = 4
    index, pixels, colors = sampler.draw(50, torch.Generator().manual_seed(0))
    rays = cameras.generate_rays(index, pixels)
    small = cameras.resized(3)
    assert small.size.tolist() == [[3, 2]]
    reduced = small.generate_rays(index, pixels / 4)
    assert torch.allclose(rays.directions, reduced.directions, atol=1e-6)
    truth = torch.from_numpy(picture).float().reshape(2, 4, 3, 4, 3).mean((1, 3)) / 255
    x, y = (pixels / 4 - 0.5).unbind(-1)
    assert torch.equal(x, x.round())
    assert torch.allclose(colors, truth[y.long(), x.long()], atol=1e-6)


def test_squares_shrink_in_equal_shares_of_the_coarse_steps() -> None:
    config = DataConfig(coarse_steps=90, coarse_halvings=3)
    sides = [block_side(step, config) for step in range(100)]
    assert sides == [8] * 30 + [4] * 30 + [2] * 30 + [1] * 10
    assert block_side(0, DataConfig()) == 1
