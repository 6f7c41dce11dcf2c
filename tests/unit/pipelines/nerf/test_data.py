"""Splits, image loading within its memory bound, and pixel batches."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.nerf.cameras import Cameras, SceneTransform
from pipelines.nerf.config import DataConfig
from pipelines.nerf.data import (
    BLOCK_PIXELS,
    ImageData,
    PixelSampler,
    block_side,
    image_sizes,
    load_images,
    memory_bytes,
    split_indices,
)
from pipelines.nerf.errors import NerfError


def test_fraction_holds_out_at_equal_intervals_as_nerfstudio_does() -> None:
    train, test = split_indices(50, DataConfig())
    # On the fox capture these are 0014, 0031, 0052, 0085 and 0110, as nerfstudio has them.
    assert len(train) == 45
    assert test == sorted(set(range(50)) - {int(x) for x in np.linspace(0, 49, 45)})
    assert len(test) == 5


@pytest.mark.parametrize("num_images", [50, 51, 57, 60, 99, 100, 123, 314, 1061])
def test_fraction_is_nerfstudios_formula_for_every_capture_of_fifty_images(num_images: int) -> None:
    chosen = np.linspace(0, num_images - 1, math.ceil(num_images * 0.9), dtype=int)
    assert split_indices(num_images, DataConfig())[0] == chosen.tolist()


@pytest.mark.parametrize(
    ("num_images", "held_out"), [(210, 21), (50, 5), (30, 5), (20, 5), (11, 2), (8, 2), (3, 0)]
)
def test_fraction_holds_out_a_tenth_and_at_least_five_where_it_can(
    num_images: int, held_out: int
) -> None:
    train, test = split_indices(num_images, DataConfig())
    assert len(test) == held_out
    assert sorted(train + test) == list(range(num_images))
    if held_out > 1:
        gaps = np.diff(test)
        assert gaps.max() - gaps.min() <= 1


def test_interval_and_none_and_zero() -> None:
    assert split_indices(10, DataConfig(eval_mode="interval", eval_interval=4))[1] == [0, 4, 8]
    assert split_indices(10, DataConfig(eval_mode="none")) == (list(range(10)), [])
    assert split_indices(10, DataConfig(eval_fraction=0.0))[1] == []


@pytest.mark.parametrize(
    ("num_images", "fraction", "place", "stretch"),
    [
        (50, 0.1, 0.5, range(22, 27)),  # 45 images stay, 22 before and 23 behind
        (50, 0.1, 0.0, range(5)),
        (50, 0.1, 1.0, range(45, 50)),
        (210, 0.1, 0.5, range(94, 115)),  # 21 of 210
        (100, 0.25, 0.2, range(15, 40)),  # 25 of 100, a fifth of the other 75 before
        (20, 0.1, 0.5, range(7, 12)),  # 2 would be too few, so 5
        (8, 0.1, 0.5, range(3, 5)),  # a quarter of a small capture
        (50, 0.0, 0.5, range(0)),
    ],
)
def test_a_stretch_holds_out_neighbours_along_the_path(
    num_images: int, fraction: float, place: float, stretch: range
) -> None:
    config = DataConfig(
        eval_mode="stretch", eval_stretch_fraction=fraction, eval_stretch_place=place
    )
    train, test = split_indices(num_images, config)
    assert test == list(stretch)
    assert sorted(train + test) == list(range(num_images))


def test_a_split_that_leaves_nothing_is_refused() -> None:
    with pytest.raises(NerfError, match="none is left"):
        split_indices(1, DataConfig(eval_mode="interval"))


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


def test_loading_averages_areas_and_lays_transparency_on_white(tmp_path: Path) -> None:
    board = np.zeros((40, 60, 3), np.uint8)
    board[::2, ::2] = 200
    Image.fromarray(board).save(tmp_path / "board.png")
    Image.fromarray(np.zeros((40, 60, 4), np.uint8)).save(tmp_path / "clear.png")
    images = load_images([tmp_path / "board.png", tmp_path / "clear.png"], 30)
    assert images.sizes.tolist() == [[30, 20], [30, 20]]
    assert torch.allclose(images.image(0), torch.tensor(50 / 255))
    assert torch.allclose(images.image(1), torch.tensor(1.0))


def test_a_jpeg_keeps_its_colours_when_reduced(tmp_path: Path) -> None:
    y, x = np.mgrid[0:400, 0:600]
    picture = np.stack([x * 255 / 600, y * 255 / 400, 0 * x + 90], -1).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "ramp.jpg", quality=95)
    image = load_images([tmp_path / "ramp.jpg"], 60).image(0)
    truth = torch.from_numpy(picture).float().reshape(40, 10, 60, 10, 3).mean((1, 3)) / 255
    assert float((image - truth).abs().max()) < 0.02


def test_reduced_masks_keep_only_pixels_that_are_wholly_allowed(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "image.png")
    mask = np.full((4, 4), 255, np.uint8)
    mask[0, 0] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    images = load_images([tmp_path / "image.png"], 2, [tmp_path / "mask.png"])
    assert images.valid is not None
    assert images.valid.tolist() == [False, True, True, True]


def test_a_broken_image_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 not a picture")
    with pytest.raises(NerfError, match=r"broken\.jpg"):
        load_images([tmp_path / "broken.jpg"], 60)


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
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
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
        assert np.array_equal(color, pictures[index][y, x].astype(np.float32) / np.float32(255.0))


def _write_pictures(folder: Path, shapes: list[tuple[int, int]]) -> list[Path]:
    random = np.random.default_rng(0)
    paths = []
    for index, (height, width) in enumerate(shapes):
        small = random.integers(0, 256, (height // 50, width // 50, 3), np.uint8)
        picture = small.repeat(50, axis=0).repeat(50, axis=1)
        paths.append(folder / f"{index:02d}.png")
        Image.fromarray(picture).save(paths[-1])
    return paths


def test_memory_is_told_before_anything_is_decoded(tmp_path: Path) -> None:
    paths = _write_pictures(tmp_path, [(400, 600), (600, 400), (100, 100)])
    Image.fromarray(np.full((400, 600), 255, np.uint8)).save(tmp_path / "mask.png")
    sizes = image_sizes(paths, 300)
    assert sizes == [(300, 200), (200, 300), (100, 100)]
    # 3 bytes for each of 130,000 pixels, and a fourth where there are masks.
    assert memory_bytes(sizes, masked=False) == 390_000
    assert memory_bytes(sizes, masked=True) == 520_000
    assert load_images(paths, 300).nbytes == 390_000
    masked = load_images(paths, 300, [tmp_path / "mask.png", None, None])
    assert masked.nbytes == 520_000
    assert masked.sizes.tolist() == [list(size) for size in sizes]


def test_loading_holds_the_buffer_and_one_picture_and_no_second_copy(tmp_path: Path) -> None:
    paths = _write_pictures(tmp_path, [(400, 600)] * 20)
    buffer, one = 20 * 400 * 600 * 3, 400 * 600 * 3
    load_images(paths[:1], 600)  # whatever Pillow keeps from its first picture
    tracemalloc.start()
    try:
        images = load_images(paths, 600)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert images.nbytes == buffer
    # The buffer itself is traced; a picture on its way is there as bytes and as an array.
    assert held >= buffer
    assert peak < buffer + 3 * one


def test_images_that_take_too_much_memory_are_refused_with_a_size_that_fits(tmp_path: Path) -> None:
    paths = _write_pictures(tmp_path, [(400, 600)] * 3)
    limit = 3 * 3 * 200 * 300
    with pytest.raises(NerfError, match="3 images of at most 600 pixels") as caught:
        load_images(paths, 600, max_bytes=limit)
    assert caught.value.code == "too_much_memory"
    assert "long_side_px to 300" in caught.value.hint
    assert load_images(paths, 300, max_bytes=limit).nbytes == limit


def test_one_image_and_its_mask_come_back_as_they_were_put() -> None:
    random = np.random.default_rng(3)
    pictures = [random.integers(0, 256, (*shape, 3), np.uint8) for shape in ((4, 7), (6, 2))]
    mask = random.random((6, 2)) < 0.5
    images = ImageData.from_arrays(pictures, [None, mask])
    for index, usable in enumerate((np.ones((4, 7), bool), mask)):
        assert np.array_equal(
            images.image(index).numpy(), pictures[index].astype(np.float32) / np.float32(255.0)
        )
        found = images.mask(index)
        assert found is not None
        assert np.array_equal(found.numpy(), usable)
    assert ImageData.from_arrays(pictures).mask(0) is None


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
