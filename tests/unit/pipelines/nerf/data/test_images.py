"""Splits, and image loading within its memory bound."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.nerf.data.images import (
    ImageData,
    image_sizes,
    load_images,
    memory_bytes,
    split_indices,
)
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import DataConfig


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
    ("num_images", "held_out"),
    [(210, 21), (50, 5), (30, 3), (20, 3), (11, 2), (8, 1), (4, 1), (3, 0)],
)
def test_fraction_holds_out_a_tenth_and_at_least_three_where_it_can(
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
        (20, 0.1, 0.5, range(8, 11)),  # 2 would be too few, so 3
        (8, 0.1, 0.5, range(3, 4)),  # an eighth of a small capture
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
