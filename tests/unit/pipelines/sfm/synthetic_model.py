"""A COLMAP model whose true lens is known: cameras on an arc around points, observed with noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from pipelines.tools.colmap_lenses import LensTrials, change_lens

WIDTH, HEIGHT = 640, 480
Lens = tuple[str, Sequence[float]]


def call_at_once(_what: str, call: Callable[[Any], Any]) -> Any:
    """Runs a trial here, as nobody cancels it."""
    return call(pycolmap.CancellationToken())


def trials_of(
    folder: Path,
    lenses: Sequence[Lens],
    *,
    arc_deg: float,
    num_images: int = 14,
    num_points: int = 600,
    depth: float = 1.0,
    swing: float = 1.0,
    mapped_as: str = "SIMPLE_RADIAL",
) -> LensTrials:
    """Trials on a model that was written as if it had been mapped with `mapped_as`.

    lenses: true ones, used in turn by the images. arc_deg: how far the camera walks around the
    points, which fill the picture and reach `depth` to either side along the view in mid-arc.
    swing: how much the camera nods and rolls on its way.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
    random = np.random.default_rng(0)
    points = random.uniform(-1.0, 1.0, (num_points, 3)) * (1.8, 1.4, depth)
    model = pycolmap.Reconstruction()
    for number, (lens, params) in enumerate(lenses, 1):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=number, model=lens, width=WIDTH, height=HEIGHT, params=list(params)
            )
        )
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    for index, angle in enumerate(np.radians(np.linspace(-arc_deg / 2, arc_deg / 2, num_images))):
        # Without pitch and roll, the height of the scene and the vertical focal length are one.
        turns = np.array([0.3 * np.sin(3 * index), angle, 0.4 * np.sin(2 * index)])
        rotation = Rotation.from_euler("xyz", turns * (swing, 1.0, swing)).as_matrix()
        pose = np.column_stack([rotation, (0.05 * random.normal(), 0.05 * random.normal(), 3.0)])
        camera_id = 1 + index % len(lenses)
        local = points @ rotation.T + pose[:, 3]
        pixels = model.camera(camera_id).img_from_cam(local) + random.normal(
            0, 0.4, (len(points), 2)
        )
        seen = np.flatnonzero(
            ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1)
            & (random.random(len(points)) < 0.7)
        )
        for position, point in enumerate(seen):
            tracks[point].append((index + 1, position))
        image = pycolmap.Image(
            name=f"{index:06d}.jpg", keypoints=pixels[seen], camera_id=camera_id, image_id=index + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for point, elements in zip(points, tracks, strict=True):
        if len(elements) >= 2:
            track = pycolmap.Track()
            for image_id, position in elements:
                track.add_element(image_id, position)
            model.add_point3D(point, track)
    for number in range(1, len(lenses) + 1):
        change_lens(model.camera(number), mapped_as)
    folder.mkdir(parents=True, exist_ok=True)
    model.write(folder)
    return LensTrials(folder, refine_principal_point=False, num_threads=1, seed=0, run=call_at_once)
