"""Pictures and sensor depths as stereo wants them, of lenses that bend."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.stereo_views import sensor_depth, stereo_view

LENS = Intrinsics(200, 120, 150.0, 150.0, 101.0, 58.0)
BENT = dataclasses.replace(LENS, model="OPENCV", k1=-0.2, k2=0.03, p1=0.004)
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def test_an_image_without_depth_has_none(tmp_path: Path) -> None:
    image = PosedImage("a.png", 0, POSE)
    assert sensor_depth(tmp_path, image, LENS, Pinhole.of(LENS, 100)) is None


@pytest.mark.parametrize("lens", [LENS, BENT], ids=["pinhole", "bent"])
def test_depth_lies_under_the_picture_that_it_belongs_to(tmp_path: Path, lens: Intrinsics) -> None:
    """A picture whose brightness is its depth, both stored as the lens has them."""
    column = (np.arange(200) + 0.5) / 200
    grey = np.tile(np.rint(60 + 120 * column), (120, 1)).astype(np.uint8)
    Image.fromarray(grey).convert("RGB").save(tmp_path / "a.png")
    small = grey.reshape(60, 2, 100, 2).mean(axis=(1, 3)).astype(np.float32) / 255.0
    np.savez_compressed(tmp_path / "a.npz", z=small)
    image = PosedImage("a.png", 0, POSE, depth="a.npz")
    view = stereo_view(tmp_path, image, lens, 200)
    pinhole = Pinhole(200, 120, *view.lens)
    z = sensor_depth(tmp_path, image, lens, pinhole)
    assert z is not None
    known = (view.picture >= 0) & (z > 0)
    assert known.mean() > 0.8
    assert np.abs(z - view.picture)[known].max() < 0.01
    straight = sensor_depth(tmp_path, image, LENS, pinhole)
    assert straight is not None
    if lens is BENT:
        assert np.abs(straight - view.picture)[known].max() > 0.02, "the test sees no bending"
