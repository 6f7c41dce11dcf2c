"""Splits, image loading and pixel batches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.nerf.config import DataConfig
from pipelines.nerf.data import ImageData, PixelSampler, load_images, split_indices
from pipelines.nerf.errors import NerfError


def test_fraction_holds_out_at_equal_intervals_as_nerfstudio_does() -> None:
    train, test = split_indices(50, DataConfig())
    # On the fox capture these are 0014, 0031, 0052, 0085 and 0110, as nerfstudio has them.
    assert len(train) == 45
    assert test == sorted(set(range(50)) - {int(x) for x in np.linspace(0, 49, 45)})
    assert len(test) == 5


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
