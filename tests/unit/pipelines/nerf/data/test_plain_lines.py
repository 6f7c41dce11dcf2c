"""Lines of pixels on plain surfaces: which are drawn, how plain they are, what a run learns."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import Batch, PixelSampler
from pipelines.nerf.data.plain_lines import PER_LINE, PlainLines
from pipelines.nerf.options.train import FlatLossConfig, default_train_config
from tests.unit.pipelines.nerf.toy_scene import SIZE, toy_cameras

COUNT = 1200
LINES = PlainLines(FlatLossConfig(share=1.0, reach=0.3), 100)


def drawn(
    pictures: list[np.ndarray], masks: list[np.ndarray] | None = None, lines: PlainLines = LINES
) -> Batch:
    images = ImageData.from_arrays(pictures, masks)
    sampler = PixelSampler(images, range(len(pictures)), lines=lines)
    return sampler.draw_batch(COUNT, torch.Generator().manual_seed(3))


def shaded(width: int, height: int) -> np.ndarray:
    """Brightness that rises evenly along a slant."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([40 + (x + y) // 2, 30 + x, 200 - y // 2], axis=-1).astype(np.uint8)


def striped(width: int, height: int) -> np.ndarray:
    """Columns of 15 pixels, darker and brighter by turns."""
    line = np.where(np.arange(width) // 15 % 2, 165, 150)
    return np.broadcast_to(line[None, :, None], (height, width, 3)).astype(np.uint8)


def places_of(batch: Batch) -> torch.Tensor:
    """[4, L, 2], x and y of the pixels on each line."""
    return (batch.pixels - 0.5).reshape(PER_LINE, -1, 2)


def test_lines_are_straight_even_within_their_picture_and_carry_its_colours() -> None:
    pictures = [shaded(40, 30), shaded(20, 64)]
    batch = drawn(pictures)
    places = places_of(batch)
    assert len(batch.pixels) == COUNT
    assert batch.plain.shape == (COUNT // PER_LINE,)
    steps = places.diff(dim=0)
    assert torch.equal(steps[0], steps[1])
    assert torch.equal(steps[1], steps[2])
    assert (steps[0].abs().sum(dim=-1) > 0).float().mean() > 0.5
    for row, (position, place) in enumerate(
        zip(batch.position.tolist(), places.reshape(-1, 2).long().tolist(), strict=True)
    ):
        color = pictures[position][place[1], place[0]] / 255.0
        assert np.allclose(batch.colors[row].numpy(), color, atol=1e-6)
    lengths = (places[3] - places[0]).norm(dim=-1)
    assert float(lengths.max()) <= 2 * 0.3 * 64 + 6
    position = batch.position.reshape(PER_LINE, -1)
    assert (position == position[0]).all()


def test_even_shading_is_plain_and_stripes_are_not() -> None:
    plain = drawn([shaded(60, 60)]).plain
    assert float(plain[plain > 0].min()) > 0.9
    batch = drawn([striped(60, 60)])
    columns = places_of(batch)[..., 0]
    long = places_of(batch).diff(dim=0).abs().amax(dim=(0, 2)) > 0
    crosses = (columns // 15).amin(dim=0) < (columns // 15).amax(dim=0)
    assert float(batch.plain[crosses].max()) < 1e-4
    amid = long & ~crosses & ((columns % 15 - 7).abs() <= 1).all(dim=0)
    assert amid.any()
    assert (batch.plain[amid] == 1.0).all()


def test_a_line_that_would_leave_picture_or_mask_is_one_pixel_and_not_plain() -> None:
    mask = np.ones((50, 50), bool)
    mask[:, 25:] = False
    batch = drawn([shaded(50, 50)], [mask])
    places = places_of(batch)
    assert (places[..., 0] < 25).all()
    single = (places == places[0]).all(dim=0).all(dim=-1)
    assert single.any()
    assert not batch.plain[single].any()
    assert (batch.plain[~single] > 0.9).all()


def test_single_pixels_make_up_the_batch_and_none_are_lines_without_the_option() -> None:
    batch = drawn([shaded(40, 40)], lines=PlainLines(FlatLossConfig(share=0.2), 100))
    assert len(batch.plain) == COUNT // 20
    assert len(batch.pixels) == len(batch.position) == len(batch.colors) == COUNT
    images = ImageData.from_arrays([shaded(40, 40)])
    sampler = PixelSampler(images, range(1))
    alone = sampler.draw_batch(50, torch.Generator().manual_seed(1))
    as_drawn = sampler.draw(50, torch.Generator().manual_seed(1))
    assert len(alone.plain) == 0
    assert all(torch.equal(a, b) for a, b in zip(alone[:3], as_drawn, strict=True))


def test_weight_rises_over_the_first_fifth_of_the_run() -> None:
    lines = PlainLines(FlatLossConfig(weight=0.3), 1000)
    assert [lines.weight(step) for step in (0, 100, 200, 900)] == pytest.approx([0, 0.15, 0.3, 0.3])


def test_lines_whose_depth_is_known_are_left_out() -> None:
    cameras, count = toy_cameras(2), 8
    share = torch.tensor([-1.0, -1 / 3, 1 / 3, 1.0])[:, None, None]
    random = torch.Generator().manual_seed(0)
    middle = torch.rand(count, 2, generator=random) * 6 + 13
    pixels = (middle + share * torch.tensor([6.0, 3.0])).reshape(-1, 2)
    index = torch.zeros(len(pixels), dtype=torch.int64)
    rays = cameras.generate_rays(index, pixels)
    edges = torch.linspace(0.5, 2.0, 9).repeat(len(pixels), 1)
    weights = torch.rand(len(pixels), 8, generator=random)
    samples = SimpleNamespace(t_edges=edges)
    outputs: Any = {"weights": [weights], "samples": [samples]}
    plain, lines = torch.ones(count), PlainLines(FlatLossConfig(), 100)

    def found(known: np.ndarray) -> float:
        lens = (28.0, 28.0, SIZE / 2, SIZE / 2)
        maps = DepthMaps.from_arrays([known.astype(np.float32)] * 2, [lens] * 2, 1.0)
        term = lines.loss(outputs, rays, cameras, plain, 1.0, maps)
        assert term is not None
        return float(term)

    everywhere = lines.loss(outputs, rays, cameras, plain, 1.0)
    assert everywhere is not None
    nowhere = np.zeros((SIZE, SIZE))
    assert found(nowhere) == float(everywhere) > 0.0
    assert found(nowhere + 1.0) == 0.0
    ends = nowhere.copy()  # what both ends know says nothing of the middle
    for x, y in pixels.reshape(4, count, 2)[[0, 3]].reshape(-1, 2).tolist():
        ends[int(y), int(x)] = 1.0
    assert found(ends) == float(everywhere)


def test_methods_without_common_samples_have_no_such_term() -> None:
    cameras = toy_cameras(2)
    rays = cameras.generate_rays(torch.zeros(4, dtype=torch.int64), torch.full((4, 2), 9.5))
    outputs: Any = {"weights": [], "samples": []}
    assert LINES.loss(outputs, rays, cameras, torch.ones(1), 1.0) is None
    assert default_train_config("instant-ngp").flat.when == "never"
    assert PlainLines.of(default_train_config("instant-ngp")) is None


def test_the_library_alone_takes_lines_only_where_they_are_always_wanted() -> None:
    config = default_train_config("nerfacto")
    assert PlainLines.of(config) is None  # "unknown": whoever has the maps decides
    always = replace(config, flat=FlatLossConfig("always"))
    assert PlainLines.of(always) == PlainLines(always.flat, config.max_steps)
    assert PlainLines.of(replace(config, flat=FlatLossConfig("always", weight=0.0))) is None
