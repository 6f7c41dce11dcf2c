"""How large the trained scene is rendered for a film that it shares with the mesh."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pipelines.exports.shots import MixedStudio
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.depth_views import Pinhole

OWN = Intrinsics(1920, 1080, 1680.0, 1680.0, 960.0, 540.0)
"""Trained at 320 px, it has 280 pixels for a radian."""
SPHERE = Intrinsics(3840, 1920, 1.0, 1.0, 0.0, 0.0, "EQUIRECTANGULAR")
FISHEYE = Intrinsics(1000, 1000, 320.0, 320.0, 500.0, 500.0, "OPENCV_FISHEYE")


class Scene:
    """Notes the size that it is asked for."""

    def __init__(self) -> None:
        self.asked = 0

    def render(self, lens: Intrinsics, pose: Any, long_side: int) -> SimpleNamespace:
        del pose
        self.asked = long_side
        ratio = long_side / max(lens.width, lens.height)
        size = round(lens.height * ratio), round(lens.width * ratio)
        return SimpleNamespace(rgb=torch.full((*size, 3), 0.5))


@pytest.mark.parametrize(
    ("lens", "long_side"),
    [
        (Pinhole(960, 540, 840.0, 840.0, 480.0, 270.0), 320),
        (Pinhole(200, 100, 175.0, 175.0, 100.0, 50.0), 200),
        (SPHERE, 1760),
        (FISHEYE, 876),
        (Intrinsics(640, 320, 1.0, 1.0, 0.0, 0.0, "EQUIRECTANGULAR"), 640),
    ],
    ids=["plain", "small", "all round", "fisheye", "small all round"],
)
def test_wide_pictures_are_rendered_as_finely_as_those_that_were_trained_on(
    lens: Pinhole | Intrinsics, long_side: int
) -> None:
    scene = Scene()
    studio = MixedStudio(scene, None, 320, OWN)  # type: ignore[arg-type]
    picture = studio.picture(lens, np.eye(3, 4))
    assert scene.asked == long_side
    assert picture.shape == (lens.height, lens.width, 3)
    np.testing.assert_allclose(picture, 128, atol=1)
