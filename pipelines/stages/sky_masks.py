"""Where images show the sky, held-out ones too, in captures where the stage `depth` found any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.formats.ply import read_ply
from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.stereo.sky import like_sky
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.orientation import find_up
from pipelines.scene.stereo_views import stereo_view, undistorted_picture
from pipelines.workspace import Workspace

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


def known_points(workspace: Workspace) -> Floats | None:
    """[P, 3], world, of structure from motion; None where there was none."""
    path = workspace.sparse_points
    return np.asarray(read_ply(path).points, np.float64) if path.is_file() else None


def up_and_points(workspace: Workspace, capture: CamerasFile) -> tuple[Floats, Floats]:
    """What tells sky from other things: up [3], unit, and `known_points`, none without any."""
    up, _ = find_up(np.array([image.world_from_camera for image in capture.images], np.float64))
    points = known_points(workspace)
    return up, np.zeros((0, 3)) if points is None else points


def sky_masks(
    workspace: Workspace, capture: CamerasFile, images: Sequence[PosedImage], cameras: Cameras
) -> list[Bools] | None:
    """Where each image shows the sky, [H, W] at its camera's size; None where `depth` found none.

    capture: that the images are of. cameras: theirs, in their order.
    """
    if not workspace.is_complete("depth"):
        return None
    made = workspace.manifest("depth")
    told = made["summary"].get("sky")
    if not told or told["share"] == 0.0:
        return None
    up, points = up_and_points(workspace, capture)
    side, root = made["options"]["long_side_px"], workspace.images_root
    found, lenses = [], []
    for image in images:
        lens = capture.cameras[image.camera]
        view = stereo_view(root, image, lens, side)
        height, width = view.picture.shape
        pinhole = Pinhole(width, height, *view.lens)
        # As `depth` saw it: before the pictures were brought to one light.
        picture = undistorted_picture(root, replace(image, light=None), lens, pinhole)
        found.append(like_sky(view, picture, up, points).astype(np.float32))
        lenses.append(view.lens)
    maps = DepthMaps.from_arrays(found, lenses, 1.0)
    masks = []
    for index, (width, height) in enumerate(cameras.size.tolist()):
        asked = maps.distances(cameras.image_rays(index), cameras)
        masks.append((asked > 0.0).numpy().reshape(height, width))
    return masks
