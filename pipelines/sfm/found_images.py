"""The images that later stages see, with the poses that were found: photos and frames as they are,
panoramas as the views cut from them (`pipelines.scene.panoramas`).

Axes here are OpenCV's, the frame and scale those of the reconstruction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.panoramas import MODEL, view_lens, world_from_views
from pipelines.sfm.source import Source
from pipelines.tools.colmap_results import SparseModel


@dataclass(frozen=True)
class FoundImages:
    """N images in capture order.

    files, timestamps_s: as in `Source`. cameras: their lenses. camera_of: [N], index into
    `cameras`. world_from_camera: [N, 3, 4] float64. up: N, the direction away from gravity in
    OpenGL camera axes (+X right, +Y up, looks along -Z) where the device measured it, else None.
    masks: N files, black where an image is to be ignored, or None. cuts: the same of what images
    were cut out by, black where nothing stands.
    """

    files: tuple[str, ...]
    timestamps_s: tuple[float | None, ...]
    cameras: tuple[Intrinsics, ...]
    camera_of: tuple[int, ...]
    world_from_camera: npt.NDArray[np.float64]
    up: tuple[Sequence[float] | None, ...]
    masks: tuple[str | None, ...]
    cuts: tuple[str | None, ...]


def found_images(model: SparseModel, source: Source) -> FoundImages:
    """The images of a model, panoramas replaced by all their views."""
    lenses = tuple(view_lens(lens.width) if lens.model == MODEL else lens for lens in model.cameras)
    files: list[str] = []
    times: list[float | None] = []
    camera_of: list[int] = []
    poses: list[npt.NDArray[np.float64]] = []
    up: list[Sequence[float] | None] = []
    masks: list[str | None] = []
    cuts: list[str | None] = []
    for index, camera, pose in zip(
        model.indices, model.camera_of, model.world_from_camera, strict=True
    ):
        views = source.views_of(index)
        files += views or (source.files[index],)
        poses += world_from_views(pose, len(views)) if views else [pose]
        num = len(poses) - len(times)
        times += [source.timestamps_s[index]] * num
        camera_of += [camera] * num
        up += [None if views else source.up_of(index)] * num
        masks += [None if views else source.mask_of(index)] * num
        cuts += [None if views else source.cut_of(index)] * num
    return FoundImages(
        tuple(files),
        tuple(times),
        lenses,
        tuple(camera_of),
        np.stack(poses),
        tuple(up),
        tuple(masks),
        tuple(cuts),
    )
