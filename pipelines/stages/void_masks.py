"""Where images show that nothing stands, held-out ones too, in captures where `depth` found any."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.formats.ply import read_ply
from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.stereo.blank import blank_of, like_blank
from pipelines.nerf.stereo.dark import before_solid, like_dark, solid_points
from pipelines.nerf.stereo.sky import like_sky
from pipelines.nerf.stereo.views import StereoView
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.orientation import find_up
from pipelines.scene.stereo_views import cut_away, stereo_view, undistorted_picture, view_of
from pipelines.workspace import Workspace

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
BY_CUTS = "masks"
"""What `depth` says that a blank ground was told by where masks cut the pictures out."""
_ABOUT = 0.9
"""Cosine between up by level pictures and +Z, from which they are believed."""
Look = Callable[[StereoView, Bytes], Bools]
"""What of a view's picture, [H, W, 3] sRGB, is nothing: [H, W]."""


def known_points(workspace: Workspace) -> Floats | None:
    """[P, 3], world, of structure from motion; None where there was none."""
    path = workspace.sparse_points
    return np.asarray(read_ply(path).points, np.float64) if path.is_file() else None


def up_and_points(workspace: Workspace, capture: CamerasFile) -> tuple[Floats, Floats]:
    """What tells sky from other things: `up_of_world`, and `known_points`, none without any."""
    points = known_points(workspace)
    return up_of_world(capture), np.zeros((0, 3)) if points is None else points


def up_of_world(capture: CamerasFile) -> Floats:
    """Up, [3], unit: about +Z, as `ingest` or `poses` have turned the world, by a quarter perhaps;
    as its pictures have it, if they are level to that or nobody turned it. Those that are stored on
    their side may be level to something else.
    """
    told = capture.notes.get("up_from")
    if told == "measured":
        return np.array([0.0, 0.0, 1.0])
    poses = np.array([image.world_from_camera for image in capture.images], np.float64)
    up, seen_by = find_up(poses)
    is_level = seen_by in ("vertical", "sideways") and up[2] >= _ABOUT
    return up if is_level or told == "none" else np.array([0.0, 0.0, 1.0])


def void_masks(
    workspace: Workspace, capture: CamerasFile, images: Sequence[PosedImage], cameras: Cameras
) -> list[Bools] | None:
    """Where nothing stands in each image, [H, W] at its camera's size; None where `depth` found no
    sky, no dark and no blank ground.

    capture: that the images are of. cameras: theirs, in their order.
    """
    if not workspace.is_complete("depth"):
        return None
    made = workspace.manifest("depth")
    looks = _looks(workspace, capture, made["summary"])
    blank = made["summary"].get("blank", {})
    by_cuts, is_cut_out = blank.get("by") == BY_CUTS, bool(blank.get("share"))
    if not looks and not by_cuts:
        return None
    side, root = made["options"]["long_side_px"], workspace.images_root
    found, lenses = [], []
    for image in images:
        lens = capture.cameras[image.camera]
        view = stereo_view(root, image, lens, side)
        height, width = view.picture.shape
        pinhole = Pinhole(width, height, *view.lens)
        cut = cut_away(root, image, lens, pinhole) if by_cuts else None
        if cut is None:
            # As `depth` saw it: before the pictures were brought to one light.
            picture = undistorted_picture(root, replace(image, light=None), lens, pinhole)
            cut = np.any([look(view, picture) for look in looks], axis=0)
        found.append(cut.astype(np.float32))
        lenses.append(view.lens)
    maps = DepthMaps.from_arrays(found, lenses, 1.0)
    whole = None
    if is_cut_out:
        whole = DepthMaps.from_arrays([np.ones_like(mask) for mask in found], lenses, 1.0)
    masks = []
    for index, (width, height) in enumerate(cameras.size.tolist()):
        rays = cameras.image_rays(index)
        mask = maps.distances(rays, cameras) > 0.0
        if whole is not None:
            # The margin that a picture without distortion lacks.
            mask |= whole.distances(rays, cameras) == 0.0
        masks.append(mask.numpy().reshape(height, width))
    return masks


def _looks(workspace: Workspace, capture: CamerasFile, told: dict[str, Any]) -> list[Look]:
    """How to tell each of the kinds of nothing that `depth` told of."""
    looks: list[Look] = []
    blank = told.get("blank", {})
    if blank.get("share") and blank.get("by") != BY_CUTS:
        on_thing, (red, green, blue) = _solid_points(workspace, capture), blank["color"]
        color, is_paper = (red, green, blue), bool(blank.get("is_paper"))
        looks.append(
            lambda view, picture: blank_of(
                view, like_blank(view, picture, color, is_paper=is_paper), on_thing
            )
        )
    sky = told.get("sky", {})
    if sky.get("share"):
        known, by_day = up_and_points(workspace, capture), bool(sky.get("by_day"))
        looks.append(lambda view, picture: like_sky(view, picture, *known, by_day=by_day))
    if told.get("dark", {}).get("share"):
        solid = _solid_points(workspace, capture)
        looks.append(lambda view, picture: like_dark(view, picture) & ~before_solid(view, solid))
    return looks


def _solid_points(workspace: Workspace, capture: CamerasFile) -> Floats:
    """[P, 3], world, on surfaces that the depth maps know."""
    images = {image.file: image for image in capture.images}
    views, depths, void = [], [], []
    for image, found in DepthMapsFile(workspace.stage("depth")):
        views.append(view_of(images[image.file], image.lens, found.z))
        depths.append(found.z)
        void.append(found.is_void)
    return solid_points(views, depths, void)
