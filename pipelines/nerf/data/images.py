"""Training images in memory, and the held-out split; drawing their pixels is left to `pixels`.

Images are held once, as uint8 in one flat buffer, so that they may differ in size: three bytes a
pixel, four with masks (`memory_bytes`), however many there are. The buffer is taken before the
first picture is decoded, and one decoded picture at a time is held beside it. Images arrive
upright: EXIF orientation is not looked at here. Symbols: N images.
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

from pipelines.nerf.data.light import Light, levelled
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import SplitConfig
from pipelines.nerf.space.cameras import reduced_size

MIN_HELD_OUT = 3
MASK_THRESHOLD = 128


def split_indices(num_images: int, config: SplitConfig) -> tuple[list[int], list[int]]:
    """(training indices, held-out indices) of N images in order of their file names.

    `fraction`: training takes int(linspace(0, N - 1, n)) with n = ceil((1 - f) N), the rest is held
    out; where that leaves fewer than 3, n is lowered until 3 are held out, or an eighth of a small
    capture. `interval`: indices 0, k, 2k... are held out. `stretch`: as many neighbours as
    `fraction` would hold out, starting int(place * (N - held out)) images along the path. `none`:
    nothing is. Raises NerfError `too_few_images` where nothing is left to train on.
    """
    everything = list(range(num_images))
    if config.eval_mode == "interval":
        test = everything[:: config.eval_interval]
    elif config.eval_mode == "fraction" and config.eval_fraction > 0.0:
        num_train = num_images - _num_held_out(num_images, config.eval_fraction)
        chosen = set(np.linspace(0, num_images - 1, num_train, dtype=np.int64).tolist())
        test = [index for index in everything if index not in chosen]
    elif config.eval_mode == "stretch" and config.eval_stretch_fraction > 0.0:
        num_test = _num_held_out(num_images, config.eval_stretch_fraction)
        first = int(config.eval_stretch_place * (num_images - num_test))
        test = everything[first : first + num_test]
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


def _num_held_out(num_images: int, fraction: float) -> int:
    """N - ceil((1 - f) N), at least 3 or an eighth of a small capture."""
    # The small term keeps (1 - 0.1) * 50 = 45.00000000000001 from becoming 46.
    num_train = math.ceil((1.0 - fraction) * num_images - 1e-9)
    few = min(MIN_HELD_OUT, math.ceil(num_images / 8), num_images // 4)
    return max(num_images - num_train, few)


def memory_bytes(sizes: Sequence[tuple[int, int]], *, masked: bool) -> int:
    """What `ImageData` takes for pictures of these (width, height): 3 bytes a pixel, 4 masked."""
    return (4 if masked else 3) * sum(width * height for width, height in sizes)


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

    @property
    def nbytes(self) -> int:
        """Bytes of `pixels` and `valid`; `memory_bytes` tells them in advance."""
        return self.pixels.nbytes + (0 if self.valid is None else self.valid.nbytes)

    def image(self, index: int) -> Tensor:
        """One image as [H, W, 3] float32 in [0, 1]."""
        width, height = self.sizes[index].tolist()
        return self.pixels[self._rows(index)].reshape(height, width, 3).float() / 255.0

    def mask(self, index: int) -> Tensor | None:
        """The usable pixels of one image as [H, W] bool, or None where there are no masks."""
        if self.valid is None:
            return None
        width, height = self.sizes[index].tolist()
        return self.valid[self._rows(index)].reshape(height, width)

    def to(self, device: torch.device | str) -> ImageData:
        """The images on another device; sizes and offsets too."""
        return ImageData(
            pixels=self.pixels.to(device),
            sizes=self.sizes.to(device),
            offsets=self.offsets.to(device),
            valid=None if self.valid is None else self.valid.to(device),
        )

    def _rows(self, index: int) -> slice:
        return slice(int(self.offsets[index]), int(self.offsets[index + 1]))

    @classmethod
    def empty(cls, sizes: Sequence[tuple[int, int]], *, masked: bool) -> ImageData:
        """Room for pictures of these (width, height), to be filled by `put`; all is usable."""
        if len(sizes) == 0:
            raise NerfError("too_few_images", "There is no image.", "Send some images.")
        sides = torch.tensor(list(sizes), dtype=torch.int64)
        ends = sides.prod(dim=1).cumsum(0)
        total = int(ends[-1])
        return cls(
            pixels=torch.from_numpy(np.empty((total, 3), np.uint8)),
            sizes=sides,
            offsets=torch.cat([torch.zeros(1, dtype=torch.int64), ends]),
            valid=torch.from_numpy(np.ones(total, np.bool_)) if masked else None,
        )

    def put(
        self, index: int, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> None:
        """Write one picture [H, W, 3] and its mask [H, W] (true = use) into its place."""
        rows = self._rows(index)
        self.pixels.numpy()[rows] = image.reshape(-1, 3)
        if self.valid is not None and mask is not None:
            self.valid.numpy()[rows] = mask.reshape(-1)

    @classmethod
    def from_arrays(
        cls,
        images: Sequence[NDArray[np.uint8]],
        masks: Sequence[NDArray[np.bool_] | None] | None = None,
    ) -> ImageData:
        """From pictures [H, W, 3] uint8 and masks [H, W] bool (true = use) or None."""
        given = [None] * len(images) if masks is None else list(masks)
        masked = any(mask is not None for mask in given)
        data = cls.empty([(image.shape[1], image.shape[0]) for image in images], masked=masked)
        for index, (image, mask) in enumerate(zip(images, given, strict=True)):
            data.put(index, image, mask)
        return data


def image_sizes(paths: Sequence[Path], long_side: int) -> list[tuple[int, int]]:
    """(width, height) that `load_images` would give, from the headers alone: nothing is decoded.

    Raises NerfError `bad_image` naming the file.
    """
    sizes = []
    for path in paths:
        with _open(path) as opened:
            sizes.append(reduced_size(opened.width, opened.height, long_side))
    return sizes


def load_images(
    paths: Sequence[Path],
    long_side: int,
    masks: Sequence[Path | None] | None = None,
    *,
    lights: Sequence[Light | None] | None = None,
    max_bytes: int | None = None,
) -> ImageData:
    """Read images, reduced by area averaging to at most `long_side` pixels.

    masks: one-channel pictures of the same shape, black = ignore, or None for an image. lights: of
    those that are brought to the mean light (`data.light`). Transparent pictures are laid on white.
    max_bytes: more than that is refused unread.
    Memory: `memory_bytes` of the reduced sizes, and one decoded picture at a time.
    Raises NerfError `bad_image` naming the file, `too_much_memory` naming what would fit.
    """
    given = [None] * len(paths) if masks is None else list(masks)
    masked = any(mask is not None for mask in given)
    sizes = image_sizes(paths, long_side)
    needed = memory_bytes(sizes, masked=masked)
    if max_bytes is not None and needed > max_bytes:
        fitting = int(long_side * math.sqrt(max_bytes / needed))
        raise NerfError(
            "too_much_memory",
            f"{len(paths)} images of at most {long_side} pixels take {needed / 2**30:.1f} GiB, "
            f"allowed are {max_bytes / 2**30:.1f}.",
            f"Set train.data.long_side_px to {fitting}, or raise train.data.max_memory_gib.",
        )
    data = ImageData.empty(sizes, masked=masked)
    taken_in = [None] * len(paths) if lights is None else list(lights)
    for index, (path, mask, light) in enumerate(zip(paths, given, taken_in, strict=True)):
        usable = None if mask is None else _load_mask(mask, sizes[index])
        data.put(index, levelled(_load_image(path, long_side), light), usable)
    return data


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
