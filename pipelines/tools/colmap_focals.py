"""A reconstruction in which images have cameras of their own, to see whether they had one lens."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any

import numpy as np
import pycolmap

from pipelines.tools.colmap_results import image_index


def with_own_cameras(model: Any, indices: Collection[int]) -> Any:
    """A copy of a `pycolmap.Reconstruction` in which each of these images, by their places in the
    capture, has a camera of its own: the one it shared, under an id beyond those that there are.

    Images, features and points keep their ids.
    """
    apart = pycolmap.Reconstruction()
    beyond = max(model.cameras) + 1
    for number, image_id in enumerate(sorted(model.reg_image_ids())):
        image = model.image(image_id)
        camera = copy.deepcopy(model.camera(image.camera_id))
        if image_index(image.name) in indices:
            camera.camera_id = beyond + number
        if not apart.exists_camera(camera.camera_id):
            apart.add_camera_with_trivial_rig(camera)
        apart.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name,
                keypoints=np.array([point.xy for point in image.points2D]).reshape(-1, 2),
                camera_id=camera.camera_id,
                image_id=image_id,
            ),
            image.cam_from_world(),
        )
    for point_id, point in model.points3D.items():
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(element.image_id, element.point2D_idx)
        apart.add_point3D_with_id(
            point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, track=track)
        )
    return apart


def focals_of_images(model: Any, indices: Collection[int]) -> dict[int, float]:
    """The focal lengths of these images' cameras in pixels, by their places in the capture; of
    those that a `pycolmap.Reconstruction` holds."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {
        image_index(image.name): float(model.camera(image.camera_id).mean_focal_length())
        for image in images
        if image_index(image.name) in indices
    }
