"""Bundle adjustment of poses that are known roughly, with what their images see of some points.

Axes here are COLMAP's: cameras look along +Z, +Y down.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from pipelines.scene.cameras_file import Intrinsics
from pipelines.tools.colmap_adjustment import Rounds, Run, adjust
from pipelines.tools.colmap_rays import camera_of

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TRIALS = 2000
_MIN_INLIERS, _MIN_RATIO = 30, 0.25
"""COLMAP's, of an image that is placed by points."""


@dataclass(frozen=True)
class Sightings:
    """K observations of T points. point, image: [K], numbers. xy: [K, 2], pixels."""

    point: Integers
    image: Integers
    xy: Floats


def adjusted(
    poses: Floats,
    lenses: Sequence[Intrinsics],
    points: Floats,
    seen: Sightings,
    ends: Rounds,
    *,
    centers: Mapping[int, Floats],
    slack: float,
    loss_px: float,
    run: Run,
    num_threads: int,
    refine_lenses: bool = False,
) -> tuple[Floats, Floats, list[Intrinsics]]:
    """Poses [N, 3, 4], points [T, 3] and lenses [N] that fit what is seen.

    Lenses stay as they are unless `refine_lenses` asks for focal lengths, k1, k2, p1 and p2 of
    plain ones; images with equal lenses go on sharing one.
    Images that see nothing keep their poses, points that nobody sees their places. centers: where
    images are known to be, give or take `slack` (one standard deviation, world units, beside one of
    `loss_px`): they hold frame and scale, and whatever else the observations leave open. loss_px:
    errors beyond count less.
    """
    model = pycolmap.Reconstruction()
    ids = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
    for lens, number in ids.items():
        model.add_camera_with_trivial_rig(camera_of(lens, number, distorted=refine_lenses))
    order = np.lexsort((seen.point, seen.image))
    tracks: dict[int, pycolmap.Track] = {}
    images, starts = np.unique(seen.image[order], return_index=True)
    for image, rows in zip(images.tolist(), np.split(order, starts[1:]), strict=True):
        rotation = poses[image, :, :3].T
        pose = np.column_stack([rotation, -rotation @ poses[image, :, 3]])
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                name=str(image),
                keypoints=seen.xy[rows],
                camera_id=ids[lenses[image]],
                image_id=image + 1,
            ),
            pycolmap.Rigid3d(pose),
        )
        for place, point in enumerate(seen.point[rows].tolist()):
            tracks.setdefault(point, pycolmap.Track()).add_element(image + 1, place)
    stored = {point: model.add_point3D(points[point], track) for point, track in tracks.items()}
    variance = np.eye(3) * (slack / loss_px) ** 2
    priors = [
        pycolmap.PosePrior(
            corr_data_id=model.image(image + 1).data_id,
            position=centers[image],
            position_covariance=variance,
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image in images.tolist()
        if image in centers
    ]
    adjust(
        model,
        ends,
        what="adjusting the poses",
        run=run,
        num_threads=num_threads,
        refine_focal=refine_lenses,
        refine_distortion=refine_lenses,
        loss_px=loss_px,
        priors=priors,
    )
    moved, placed = poses.copy(), points.copy()
    for image in images.tolist():
        moved[image] = model.image(image + 1).cam_from_world().inverse().matrix()
    for point, point_id in stored.items():
        placed[point] = model.point3D(point_id).xyz
    found = {
        lens: _plain_lens(lens, model.camera(number)) if refine_lenses else lens
        for lens, number in ids.items()
    }
    return moved, placed, [found[lens] for lens in lenses]


def _plain_lens(lens: Intrinsics, camera: pycolmap.Camera) -> Intrinsics:
    """The lens with the values of COLMAP's OPENCV camera."""
    fl_x, fl_y, cx, cy, k1, k2, p1, p2 = (float(value) for value in camera.params)
    return replace(
        lens, model="OPENCV", fl_x=fl_x, fl_y=fl_y, cx=cx, cy=cy, k1=k1, k2=k2, p1=p1, p2=p2
    )


def resected(
    lenses: Sequence[Intrinsics],
    points: Floats,
    seen: Sightings,
    limit_px: float,
    *,
    seed: int,
    run: Run,
) -> dict[int, Floats]:
    """World_from_camera [3, 4] of images by what they see of points, for those that can be placed.

    limit_px: how far from its point an observation may lie to count.
    """
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = limit_px
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = _TRIALS
    found = {}
    for image in np.unique(seen.image).tolist():
        mine = seen.image == image
        if mine.sum() < _MIN_INLIERS:
            continue
        estimate = run(
            "placing an image",
            functools.partial(
                _resect, seen.xy[mine], points[seen.point[mine]], camera_of(lenses[image]), options
            ),
        )
        if estimate is not None and estimate["num_inliers"] >= max(
            _MIN_INLIERS, _MIN_RATIO * mine.sum()
        ):
            found[image] = np.asarray(estimate["cam_from_world"].inverse().matrix(), np.float64)
    return found


def _resect(xy: Floats, points: Floats, camera: pycolmap.Camera, options: Any, token: Any) -> Any:
    del token
    return pycolmap.estimate_and_refine_absolute_pose(xy, points, camera, options)
