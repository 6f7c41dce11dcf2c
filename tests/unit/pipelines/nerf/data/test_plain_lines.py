"""Lines of pixels on plain surfaces: which are drawn, how plain they are, what a run learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import Batch, PixelSampler
from pipelines.nerf.data.plain_lines import PER_LINE, PlainLines
from pipelines.nerf.options.train import FlatLossConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import SceneTransform
from pipelines.nerf.training.loop import train
from tests.unit.pipelines.nerf.toy_scene import SIZE, tiny_config, toy_cameras, toy_color

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
    return np.stack([40 + x + y, 30 + 2 * x, 200 - y], axis=-1).astype(np.uint8)


def striped(width: int, height: int) -> np.ndarray:
    """Columns of three pixels, black and white by turns."""
    line = np.where(np.arange(width) // 3 % 2, 255, 0)
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
    across = places_of(batch).diff(dim=0)[0, :, 0].abs() >= 1
    assert float(batch.plain[across].max()) < 1e-6
    along = ~across & (batch.plain > 0)
    assert along.any()
    assert torch.equal(batch.plain[along], torch.ones(int(along.sum())))


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


def roughness(weight: float) -> float:
    """How unevenly the learnt depth of a plain white ball bends, in the mean of some lines."""
    cameras = toy_cameras(12)
    pictures = []
    for index in range(len(cameras)):
        colors, distance = toy_color(cameras.image_rays(index))
        colors = torch.where(distance.isfinite()[:, None], 0.9, colors)
        pictures.append((colors.reshape(SIZE, SIZE, 3) * 255).round().byte().numpy())
    flat = FlatLossConfig(weight=weight, reach=0.2)
    config = tiny_config(max_steps=160, flat=flat)
    model = train(ImageData.from_arrays(pictures), cameras, range(12), config, seed=1)
    found = []
    for index in range(len(cameras)):
        seen = Renderer(model, SceneTransform((0.0, 0.0, 0.0), 1.0)).render(cameras, index)
        _, truth = toy_color(cameras.image_rays(index))
        on_ball = truth.isfinite().reshape(SIZE, SIZE).numpy()
        q = 1.0 / np.asarray(seen.depth, np.float64).reshape(SIZE, SIZE)
        bends = np.abs(q[:, 3:] - 3 * q[:, 2:-1] + 3 * q[:, 1:-2] - q[:, :-3])
        inside = np.lib.stride_tricks.sliding_window_view(on_ball, 4, axis=1).all(axis=-1)
        found.append(bends[inside])
    return float(np.concatenate(found).mean())


def test_a_plain_ball_gets_smoother() -> None:
    assert roughness(0.3) < 0.7 * roughness(0.0)
