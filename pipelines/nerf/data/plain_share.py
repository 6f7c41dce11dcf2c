"""How much of what is plain in the pictures depth maps do not know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.data.plain_lines import PER_LINE, PlainLines, are_known
from pipelines.nerf.options.train import FlatLossConfig
from pipelines.nerf.space.cameras import Cameras

_MOST_IMAGES, _LINES = 32, 20_000


def unknown_plain_share(
    images: ImageData,
    indices: Sequence[int],
    cameras: Cameras,
    maps: DepthMaps | None,
    config: FlatLossConfig,
) -> float:
    """Of the lines that count as plain (`PixelSampler.draw_batch`), the share that no map knows.

    By some lines in some of the pictures, the same each time. images, cameras: all, of the same
    sizes. indices: the images that are learned from; maps: theirs, in their order. 1 without maps,
    0 where nothing is plain.
    """
    if maps is None:
        return 1.0
    some = torch.linspace(0, len(indices) - 1, min(_MOST_IMAGES, len(indices))).round().long()
    lines = PlainLines(replace(config, share=1.0), 1)
    sampler = PixelSampler(images, [indices[i] for i in some.tolist()], lines=lines)
    batch = sampler.draw_batch(PER_LINE * _LINES, torch.Generator().manual_seed(0))
    posed = cameras.select(indices)
    rays = posed.generate_rays(some[batch.position], batch.pixels)
    known = are_known(maps.distances(rays, posed))
    total = float(batch.plain.sum())
    return float(batch.plain[~known].sum()) / total if total > 0.0 else 0.0
