"""How much of what is plain depth maps do not know: by pictures of which the truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.plain_share import unknown_plain_share
from pipelines.nerf.options.train import FlatLossConfig
from tests.unit.pipelines.nerf.toy_scene import SIZE, toy_cameras

NUM = 6
CONFIG = FlatLossConfig(reach=0.3)
LENS = (28.0, 28.0, SIZE / 2, SIZE / 2)


def left_plain() -> np.ndarray:
    """The left half of one colour, the right half noise."""
    picture = np.random.default_rng(1).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)
    picture[:, : SIZE // 2] = 180
    return picture


def share(known: list[np.ndarray], picture: np.ndarray | None = None) -> float:
    """known: [SIZE, SIZE] bool, of each of the images that are learned from: all but 1 and 4."""
    pictures = [left_plain() if picture is None else picture] * NUM
    for index in (1, 4):  # held out: what they show is not asked for
        pictures[index] = np.full((SIZE, SIZE, 3), 90, np.uint8)
    maps = DepthMaps.from_arrays([part.astype(np.float32) for part in known], [LENS] * 4, 1.0)
    images = ImageData.from_arrays(pictures)
    return unknown_plain_share(images, [0, 2, 3, 5], toy_cameras(NUM), maps, CONFIG)


def half(side: str) -> np.ndarray:
    known = np.zeros((SIZE, SIZE), bool)
    known[:, slice(None, SIZE // 2) if side == "left" else slice(SIZE // 2, None)] = True
    return known


def test_only_what_is_plain_counts() -> None:
    assert share([half("left")] * 4) < 0.1
    assert share([half("right")] * 4) > 0.9


def test_each_map_is_asked_for_its_own_picture() -> None:
    found = share([half("left"), half("right"), half("left"), half("left")])
    assert found == pytest.approx(0.25, abs=0.06)


def test_a_sky_is_known_and_nothing_plain_is_nothing_unknown() -> None:
    sky = np.where(half("left"), np.inf, 0.0)
    assert share([sky] * 4) < 0.1
    noise = np.random.default_rng(2).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)
    assert share([half("right")] * 4, noise) == 0.0


def test_without_maps_nothing_is_known() -> None:
    images = ImageData.from_arrays([left_plain()] * 2)
    assert unknown_plain_share(images, [0, 1], toy_cameras(2), None, CONFIG) == 1.0
