"""The rays that a lens of ours sees through places in its picture, by COLMAP's own formulas."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pycolmap

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.panoramas import MODEL as PANORAMA

Floats = npt.NDArray[np.float64]


def rays_through(lens: Intrinsics, places: Floats) -> Floats:
    """Unit rays [M, 3] in OpenCV camera axes through places [M, 2] in pixels; NaN where the lens
    shows nothing at a place. The eighth power of a plain lens's radius, which COLMAP has not, is
    left out."""
    return _rays(camera_of(lens), places)


def camera_of(lens: Intrinsics, camera_id: int = 1, *, distorted: bool = False) -> pycolmap.Camera:
    """A lens of ours as COLMAP's simplest camera that can express it.

    distorted: for a plain lens one that can distort, whether it does or not.
    """
    if lens.model == PANORAMA:
        size = (lens.width, lens.height)
        return pycolmap.Camera.create_from_model_name(camera_id, PANORAMA, 1.0, *size)
    model, params = lens.model, [lens.fl_x, lens.fl_y, lens.cx, lens.cy]
    if model == "OPENCV_FISHEYE":
        params += [lens.k1, lens.k2, lens.k3, lens.k4]
    elif lens.k3:
        model = "FULL_OPENCV"
        params += [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0]
    elif distorted or any((lens.k1, lens.k2, lens.p1, lens.p2)):
        model = "OPENCV"
        params += [lens.k1, lens.k2, lens.p1, lens.p2]
    else:
        model = "PINHOLE"
    return pycolmap.Camera(
        camera_id=camera_id, model=model, width=lens.width, height=lens.height, params=params
    )


def px_per_radian(lens: Intrinsics) -> float:
    """How many pixels an angle of one radian is in the middle of the picture."""
    return lens.width / (2 * np.pi) if lens.model == PANORAMA else max(lens.fl_x, lens.fl_y)


def _rays(camera: pycolmap.Camera, places: Floats) -> Floats:
    rays: Floats = np.asarray(camera.cam_ray_from_img(places), np.float64).reshape(-1, 3)
    return rays
