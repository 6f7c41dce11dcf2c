"""Batches of random pixels of training images, whole or as the means of squares of them.

Pixels are drawn where the images are held, so that a batch on a GPU costs no transfer. Symbols: N
images, B pixels of a batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pipelines.nerf.data.color_steps import LEVELS_PER_STEP, steps_of
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.plain_lines import PER_LINE, PlainLines
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import DataConfig, FlatLossConfig

BLOCK_PIXELS = 64
"""Pixels of a mask that are counted together, so that its usable pixels need no list of their own:
the counts take 3/8 of a byte a pixel, where positions would take 8."""

_LOOKS, _SHORTEST_PX = 34, 3.0
"""Places looked at along a line, the rays' among them; half of a line is no shorter."""


class Batch(NamedTuple):
    """Pixels of a training step: first those on L lines, all that are first on theirs, all second
    ones and so on; then single ones.

    position: [B] int64. pixels: [B, 2] float32, centres, x and y. colors: [B, 3] in [0, 1]. plain:
    [L] in [0, 1], how free of steps the colours along each line are; 0 of one that would leave its
    picture or its mask.
    """

    position: Tensor
    pixels: Tensor
    colors: Tensor
    plain: Tensor


def block_side(step: int, config: DataConfig) -> int:
    """Side, in pixels, of the squares whose means a step learns from; 1 from `coarse_steps` on.

    2^k with k = halvings - floor(step halvings / coarse_steps): each size for an equal share.
    """
    if step >= config.coarse_steps:
        return 1
    return int(2 ** (config.coarse_halvings - step * config.coarse_halvings // config.coarse_steps))


class PixelSampler:
    """Draws pixels uniformly over all usable pixels of some images.

    indices: the images drawn from; batches speak of positions in this list, not of image numbers.
    device: where pixels are held and drawn. Elsewhere than on the CPU this takes the images' bytes
        there once, and the generator given to `draw` must be of that device.
    block: side of the square of pixels that a ray stands for, 1 unless set. Images are cut into
        such squares from their first pixel on; a ray shows the mean of the usable pixels of its
        square and passes through the mean of their centres. What is drawn is the same at any side.
    lines: what of a batch lies on lines; None for single pixels alone.
    Raises NerfError `too_few_images` where masks leave nothing.
    """

    def __init__(
        self,
        images: ImageData,
        indices: Sequence[int],
        device: torch.device | str = "cpu",
        lines: PlainLines | None = None,
    ) -> None:
        self.lines = lines
        self.device = torch.device(device)
        self.block = 1
        rows = torch.tensor(list(indices), dtype=torch.int64)
        starts = images.offsets[rows]
        counts = images.offsets[rows + 1] - starts
        usable = None if images.valid is None else _UsablePixels.of(images.valid, starts, counts)
        self._total = int(counts.sum()) if usable is None else usable.total
        if self._total == 0:
            raise NerfError(
                "too_few_images", "The masks leave no pixel to train on.", "Check the masks."
            )
        self._usable = None if usable is None else usable.to(self.device)
        self._pixels = images.pixels.to(self.device)
        self._starts = starts.to(self.device)
        self._widths, self._heights = images.sizes[rows].to(self.device).unbind(-1)
        self._ends = counts.cumsum(0).to(self.device)
        self._firsts = self._ends - counts.to(self.device)
        self._steps = None if lines is None else self._color_steps(images, rows, lines.config.reach)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """(positions [B] int64, pixel centres [B, 2] float32 x and y, colours [B, 3] in [0, 1])."""
        position, x, y = self._pick(count, generator)
        if self.block > 1:
            return position, *self._block_means(position, x, y)
        places = torch.stack([x, y], dim=-1)
        return position, places.float() + 0.5, self._colors_at(position, places)

    def draw_batch(self, count: int, generator: torch.Generator) -> Batch:
        """The pixels of a training step, `count` of them, on lines and single ones as of `draw`."""
        num_lines = 0 if self.lines is None else self.lines.count(count)
        position, pixels, colors = self.draw(count - PER_LINE * num_lines, generator)
        if self.lines is None or self._steps is None or num_lines == 0:
            return Batch(position, pixels, colors, pixels.new_zeros(0))
        lined = self._draw_lines(num_lines, self.lines.config, self._steps, generator)
        return Batch(
            torch.cat([lined.position, position]),
            torch.cat([lined.pixels, pixels]),
            torch.cat([lined.colors, colors]),
            lined.plain,
        )

    def _pick(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Usable pixels: [B] int64 each of positions, columns and rows."""
        drawn = torch.randint(self._total, (count,), generator=generator, device=self.device)
        if self._usable is None:
            position = torch.searchsorted(self._ends, drawn, right=True)
            within = drawn - self._firsts[position]
        else:
            position, row = self._usable.find(drawn)
            within = row - self._starts[position]
        width = self._widths[position]
        return position, within % width, torch.div(within, width, rounding_mode="floor")

    def _rows_of(self, position: Tensor, places: Tensor) -> Tensor:
        """Rows of the images' pixels. position: [...] and places: [..., 2] int64, x and y."""
        return self._starts[position] + places[..., 1] * self._widths[position] + places[..., 0]

    def _colors_at(self, position: Tensor, places: Tensor) -> Tensor:
        return self._pixels[self._rows_of(position, places)].float() / 255.0

    def _draw_lines(
        self, count: int, config: FlatLossConfig, color_steps: Tensor, generator: torch.Generator
    ) -> Batch:
        """Lines of four pixels at equal distances: around a usable one, of a random length and
        direction. One that would leave its picture, or its mask, shrinks to that pixel.

        p = exp(-(s / contrast)^2), s the highest step of colour along the line; color_steps: [P],
        those of all pixels (`data.color_steps`).
        """
        position, x, y = self._pick(count, generator)
        middle = torch.stack([x, y], dim=-1)
        size = torch.stack([self._widths[position], self._heights[position]], dim=-1)
        longest = (size.amax(dim=-1) * config.reach / _SHORTEST_PX).clamp_min(1.0)
        drawn = torch.rand(2, count, generator=generator, device=self.device)
        length, angle = _SHORTEST_PX * longest ** drawn[0], math.pi * drawn[1]
        third = torch.stack([angle.cos(), angle.sin()], dim=-1) * (length / 3.0)[:, None]
        step = 3 * third.round().long()
        inside = ((middle >= step.abs()) & (middle + step.abs() < size)).all(dim=-1)
        step = torch.where(inside[:, None], step, 0)
        share = torch.linspace(0.0, 1.0, _LOOKS, device=self.device)[:, None]
        places = middle[:, None] + ((2.0 * share - 1.0) * step[:, None]).round().long()
        everywhere = position[:, None].expand(-1, _LOOKS)
        usable = inside
        if self._usable is not None:
            usable = inside & self._usable.valid[self._rows_of(everywhere, places)].all(dim=1)
            places = torch.where(usable[:, None, None], places, middle[:, None])
        steps = color_steps[self._rows_of(everywhere, places)].amax(dim=1)
        uneven = steps.float() / (LEVELS_PER_STEP * config.contrast)
        pixels = places[:, :: (_LOOKS - 1) // (PER_LINE - 1)].transpose(0, 1).flatten(0, 1)
        positions = position.repeat(PER_LINE)
        return Batch(
            positions,
            pixels.float() + 0.5,
            self._colors_at(positions, pixels),
            torch.where(usable, torch.exp(-uneven.square()), 0.0),
        )

    def _color_steps(self, images: ImageData, rows: Tensor, reach: float) -> Tensor:
        """[P] uint8, as `self._pixels`; of the images that are drawn from, 0 of others."""
        found = torch.zeros(len(self._pixels), dtype=torch.uint8, device=self.device)
        for index in rows.tolist():
            picture = images.image(index).to(self.device)
            spacing = 2.0 * reach * max(picture.shape[:2]) / (_LOOKS - 1)
            start, end = images.offsets[index : index + 2].tolist()
            found[start:end] = steps_of(picture, spacing).flatten()
        return found

    def _block_means(self, position: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Mean centre [B, 2] and colour [B, 3] of the usable pixels in the squares around pixels.

        position, x, y: [B] int64, of usable pixels, so that no square is empty. The same as pixels
        of reduced pictures, which would take memory.
        """
        offset = torch.arange(self.block, device=self.device)
        columns = (x - x % self.block)[:, None] + offset
        lines = (y - y % self.block)[:, None] + offset
        width, height = self._widths[position, None], self._heights[position, None]
        usable = (lines < height)[:, :, None] & (columns < width)[:, None, :]
        rows = self._starts[position, None, None] + lines[:, :, None] * width[:, :, None]
        rows = torch.where(usable, rows + columns[:, None, :], self._starts[position, None, None])
        if self._usable is not None:
            usable = usable & self._usable.valid[rows]
        share = usable / usable.sum(dim=(1, 2), keepdim=True)
        colors = (self._pixels[rows] / 255.0 * share[..., None]).sum(dim=(1, 2))
        center_x = (columns * share.sum(dim=1)).sum(dim=1)
        center_y = (lines * share.sum(dim=2)).sum(dim=1)
        return torch.stack([center_x, center_y], dim=-1) + 0.5, colors


@dataclass(frozen=True)
class _UsablePixels:
    """The k-th usable pixel of some images, without a list of them: counts of blocks of pixels.

    valid: [P] bool. Of each of K blocks, [K] int64: `positions` of the block's image in the list,
    `rows` its first row in `valid`, `lengths` its pixels, `ends` the usable pixels up to its end.
    """

    valid: Tensor
    positions: Tensor
    rows: Tensor
    lengths: Tensor
    ends: Tensor

    @property
    def total(self) -> int:
        return int(self.ends[-1])

    @classmethod
    def of(cls, valid: Tensor, starts: Tensor, counts: Tensor) -> _UsablePixels:
        """starts, counts: [N], first row and number of pixels of each image."""
        positions, rows, lengths, usable = [], [], [], []
        for position, (start, count) in enumerate(
            zip(starts.tolist(), counts.tolist(), strict=True)
        ):
            first = torch.arange(start, start + count, BLOCK_PIXELS)
            rows.append(first)
            lengths.append((start + count - first).clamp_max(BLOCK_PIXELS))
            positions.append(torch.full_like(first, position))
            padding = len(first) * BLOCK_PIXELS - count
            padded = torch.nn.functional.pad(valid[start : start + count], (0, padding))
            usable.append(padded.reshape(-1, BLOCK_PIXELS).sum(dim=1))
        ends = torch.cat(usable).cumsum(0)
        return cls(valid, torch.cat(positions), torch.cat(rows), torch.cat(lengths), ends)

    def to(self, device: torch.device) -> _UsablePixels:
        moved = {name: value.to(device) for name, value in vars(self).items()}
        return replace(self, **moved)

    def find(self, ranks: Tensor) -> tuple[Tensor, Tensor]:
        """(positions [B] in the list, rows [B] of `valid`) of the usable pixels with these ranks.

        ranks: [B] int64 in [0, total), counted image after image, row by row.
        """
        block = torch.searchsorted(self.ends, ranks, right=True)
        offset = torch.arange(BLOCK_PIXELS, device=ranks.device)
        first, length = self.rows[block], self.lengths[block]
        seen = self.valid[first[:, None] + torch.minimum(offset, length[:, None] - 1)]
        seen &= offset < length[:, None]
        left = self.ends[block] - ranks  # usable pixels of the block from this one on
        rank = seen.sum(dim=1) - left
        return self.positions[block], first + (seen.cumsum(dim=1) <= rank[:, None]).sum(dim=1)
