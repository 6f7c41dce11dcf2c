"""A ball with fine stripes, photographed from all round: what its colour is is known everywhere."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import open3d
from PIL import Image

from pipelines.exports.mesh import Floats, TriangleMesh
from pipelines.exports.texture.photos import Photos
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_view

SIDE = 160
LENS = Intrinsics(SIDE, SIDE, 170.0, 170.0, SIDE / 2, SIDE / 2)
CENTER = np.array([5.0, -2.0, 1.0])

_geometry: Any = open3d.geometry


def stripes(points: Floats) -> Floats:
    """[..., 3] in [0.2, 0.8]: red has twelve stripes from pole to pole, green and blue are slow."""
    x, y, z = np.moveaxis(np.asarray(points) - CENTER, -1, 0)
    return np.stack([0.5 + 0.3 * np.sin(18.0 * z), 0.5 + 0.3 * x, 0.5 + 0.3 * y], axis=-1)


def ball(resolution: int = 16) -> TriangleMesh:
    """The ball as a mesh too coarse for its stripes, its vertices grey."""
    made = _geometry.TriangleMesh.create_sphere(1.0, resolution)
    vertices = np.asarray(made.vertices, np.float64)
    faces = np.asarray(made.triangles, np.int32)
    grey = np.full_like(vertices, 0.5)
    return TriangleMesh(vertices + CENTER, faces, grey, vertices)


def picture(pose: Floats) -> np.ndarray:
    """What a camera sees, [SIDE, SIDE, 3] uint8; black beyond the ball."""
    view = sphere_view(Pinhole.of(LENS, SIDE), pose, CENTER)
    shown = np.where(view.z_depth[..., None] > 0, stripes(view.points()), 0.0)
    return np.rint(255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8)


def write_photos(
    folder: Path,
    poses: Sequence[Floats],
    gains: Sequence[float] | None = None,
    mask: np.ndarray | None = None,
) -> list[PosedImage]:
    """Photos below a folder. gains: what each one's brightness is multiplied by."""
    images = []
    for index, pose in enumerate(poses):
        gain = 1.0 if gains is None else gains[index]
        bright = np.rint(np.clip(picture(pose) * gain, 0, 255)).astype(np.uint8)
        Image.fromarray(bright).save(folder / f"{index:02d}.png")
        rows = tuple(tuple(float(value) for value in row) for row in pose)
        images.append(PosedImage(f"{index:02d}.png", 0, rows))
    if mask is not None:
        Image.fromarray(mask).save(folder / "mask.png")
        images = [dataclasses.replace(image, mask="mask.png") for image in images]
    return images


def photos_of(folder: Path, images: Sequence[PosedImage], lens: Intrinsics = LENS) -> Photos:
    """The photos as a source of colour."""
    return Photos(folder, images, [lens] * len(images))


def all_round(num: int = 12) -> list[Floats]:
    """Cameras around the ball."""
    return list(ring(num, CENTER))
