"""Training images in memory, the held-out split, and batches of random pixels.

Images are held as uint8 in one flat buffer, so that they may differ in size and cost three bytes a
pixel. They arrive upright: EXIF orientation is not looked at here. Symbols: N images, B pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from pipelines.nerf.cameras import reduced_size
from pipelines.nerf.config import DataConfig
from pipelines.nerf.errors import NerfError

MIN_HELD_OUT = 5
MASK_THRESHOLD = 128


def split_indices(num_images: int, config: DataConfig) -> tuple[list[int], list[int]]:
    """(training indices, held-out indices) of N images in order of their file names.

    `fraction`: training takes int(linspace(0, N - 1, n)) with n = ceil((1 - f) N), the rest is held
    out; where that leaves fewer than 5, n is lowered until 5 are held out, or a quarter of a small
    capture. `interval`: indices 0, k, 2k... are held out. `none`: nothing is.
    Raises NerfError `too_few_images` where nothing is left to train on.
    """
    everything = list(range(num_images))
    if config.eval_mode == "interval":
        test = everything[:: config.eval_interval]
    elif config.eval_mode == "fraction" and config.eval_fraction > 0.0:
        # The small term keeps (1 - 0.1) * 50 = 45.00000000000001 from becoming 46.
        num_train = math.ceil((1.0 - config.eval_fraction) * num_images - 1e-9)
        num_train = min(num_train, num_images - min(MIN_HELD_OUT, num_images // 4))
        chosen = set(np.linspace(0, num_images - 1, num_train, dtype=np.int64).tolist())
        test = [index for index in everything if index not in chosen]
    else:
        test = []
    held_out = set(test)
    train = [index for index in everything if index not in held_out]
    if not train:
        raise NerfError(
            "too_few_images",
            f"Of {num_images} images none is left to train on.",
            "Send more images, or set train.data.eval_mode to none.",
        )
    return train, test


@dataclass(frozen=True)
class ImageData:
    """N images in memory.

    pixels: [P, 3] uint8, sRGB, image after image, row by row. sizes: [N, 2] int64, width and
    height. offsets: [N + 1] int64, each image's first row in `pixels`.
    valid: [P] bool, false where a mask says that a pixel is not to be learned; None without masks.
    """

    pixels: Tensor
    sizes: Tensor
    offsets: Tensor
    valid: Tensor | None = None

    def __len__(self) -> int:
        return self.sizes.shape[0]

    def image(self, index: int) -> Tensor:
        """One image as [H, W, 3] float32 in [0, 1]."""
        width, height = self.sizes[index].tolist()
        rows = self.pixels[int(self.offsets[index]) : int(self.offsets[index + 1])]
        return rows.reshape(height, width, 3).float() / 255.0

    @classmethod
    def from_arrays(
        cls,
        images: Sequence[NDArray[np.uint8]],
        masks: Sequence[NDArray[np.bool_] | None] | None = None,
    ) -> ImageData:
        """From pictures [H, W, 3] uint8 and masks [H, W] bool (true = use) or None."""
        if len(images) == 0:
            raise NerfError("too_few_images", "There is no image.", "Send some images.")
        sizes = torch.tensor([(image.shape[1], image.shape[0]) for image in images])
        counts = torch.tensor([image.shape[0] * image.shape[1] for image in images])
        offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
        pixels = torch.empty((int(offsets[-1]), 3), dtype=torch.uint8)
        valid = None
        if masks is not None and any(mask is not None for mask in masks):
            valid = torch.ones(len(pixels), dtype=torch.bool)
        for index, image in enumerate(images):
            rows = slice(int(offsets[index]), int(offsets[index + 1]))
            pixels[rows] = torch.tensor(image).reshape(-1, 3)
            mask = masks[index] if masks is not None else None
            if valid is not None and mask is not None:
                valid[rows] = torch.tensor(mask).reshape(-1)
        return cls(pixels=pixels, sizes=sizes, offsets=offsets, valid=valid)


def load_images(
    paths: Sequence[Path], long_side: int, masks: Sequence[Path | None] | None = None
) -> ImageData:
    """Read images, reduced by area averaging to at most `long_side` pixels.

    masks: one-channel pictures of the same shape, black = ignore, or None for an image.
    Transparent pictures are laid on white. Raises NerfError `bad_image` naming the file.
    """
    images: list[NDArray[np.uint8]] = []
    kept: list[NDArray[np.bool_] | None] = []
    for index, path in enumerate(paths):
        images.append(_load_image(path, long_side))
        mask = masks[index] if masks is not None else None
        size = (images[-1].shape[1], images[-1].shape[0])
        kept.append(None if mask is None else _load_mask(mask, size))
    return ImageData.from_arrays(images, kept)


def _open(path: Path) -> Image.Image:
    try:
        return Image.open(path)
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise _undecodable(path) from error


def _undecodable(path: Path) -> NerfError:
    return NerfError(
        "bad_image", f"The image {path.name} cannot be decoded.", "Replace or remove that image."
    )


def _load_image(path: Path, long_side: int) -> NDArray[np.uint8]:
    with _open(path) as opened:
        size = reduced_size(opened.width, opened.height, long_side)
        # A JPEG decodes at half or a quarter of its size for less than the whole costs.
        opened.draft("RGB", size)
        try:
            picture: Image.Image = opened
            if picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info:
                ground = Image.new("RGBA", picture.size, "white")
                picture = Image.alpha_composite(ground, picture.convert("RGBA"))
            picture = picture.convert("RGB")
        except (OSError, SyntaxError) as error:
            raise _undecodable(path) from error
        if picture.size != size:
            picture = picture.resize(size, Image.Resampling.BOX)
        return np.asarray(picture, dtype=np.uint8)


def _load_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    with _open(path) as opened:
        try:
            allowed = np.asarray(opened.convert("L"), dtype=np.uint8) >= MASK_THRESHOLD
        except (OSError, SyntaxError) as error:
            raise _undecodable(path) from error
    picture = Image.fromarray(allowed.astype(np.uint8) * 255).resize(size, Image.Resampling.BOX)
    # A reduced pixel counts only where all of it is allowed.
    usable: NDArray[np.bool_] = np.asarray(picture, dtype=np.uint8) == 255
    return usable


class PixelSampler:
    """Draws pixels uniformly over all usable pixels of some images.

    indices: the images drawn from; batches speak of positions in this list, not of image numbers.
    """

    def __init__(self, images: ImageData, indices: Sequence[int]) -> None:
        self._images = images
        rows = torch.tensor(list(indices), dtype=torch.int64)
        self._starts = images.offsets[rows]
        self._widths = images.sizes[rows, 0]
        counts = images.offsets[rows + 1] - self._starts
        self._ends = counts.cumsum(0)
        self._firsts = self._ends - counts
        self._usable: Tensor | None = None
        if images.valid is not None:
            parts = [
                images.valid[int(start) : int(start + count)]
                for start, count in zip(self._starts, counts, strict=True)
            ]
            self._usable = torch.cat(parts).nonzero().squeeze(-1)
        self._total = int(self._ends[-1]) if self._usable is None else len(self._usable)
        if self._total == 0:
            raise NerfError(
                "too_few_images", "The masks leave no pixel to train on.", "Check the masks."
            )

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """(positions [B] int64, pixel centres [B, 2] float32 x and y, colours [B, 3] in [0, 1])."""
        drawn = torch.randint(self._total, (count,), generator=generator)
        if self._usable is not None:
            drawn = self._usable[drawn]
        position = torch.searchsorted(self._ends, drawn, right=True)
        within = drawn - self._firsts[position]
        width = self._widths[position]
        x, y = within % width, torch.div(within, width, rounding_mode="floor")
        colors = self._images.pixels[self._starts[position] + within].float() / 255.0
        return position, torch.stack([x, y], dim=-1).float() + 0.5, colors
