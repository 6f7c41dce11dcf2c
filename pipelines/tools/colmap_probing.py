"""How well a lens explains the matches of a few pairs, before any model is made.

A pair of images fits an essential matrix where the rays through matched places are right, so lenses
can be compared by how many matches fit. Everything goes through pycolmap's own access to its
database, see `pipelines.tools.colmap`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from pipelines.errors import ToolError

Floats = npt.NDArray[np.float64]

_TRIALS = 1000


class MatchedPairs:
    """Matches of pairs of images of one camera, P pairs.

    database: holds their features and raw matches. names: of the images. pairs: of indices.
    size: width and height of the images.
    """

    def __init__(
        self, database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]], seed: int
    ) -> None:
        self._options = pycolmap.TwoViewGeometryOptions()
        self._options.ransac.random_seed = seed
        self._options.ransac.max_num_trials = _TRIALS
        self._pairs: list[tuple[Floats, Floats, Any]] = []
        places: dict[int, Floats] = {}
        with pycolmap.Database.open(database) as opened:
            for i, j in pairs:
                ids = [_image(opened, names[index]).image_id for index in (i, j)]
                if not opened.exists_matches(*ids):
                    continue
                for image_id in ids:
                    if image_id not in places:
                        rows = np.asarray(opened.read_keypoints(image_id), np.float64)
                        places[image_id] = rows[:, :2]
                matches = opened.read_matches(*ids)
                self._pairs.append((places[ids[0]], places[ids[1]], matches))
            camera_id = _image(opened, names[pairs[0][0]]).camera_id
            camera = opened.read_camera(camera_id)
        self.size = (int(camera.width), int(camera.height))

    def num_fitting(self, lens: str, focal_px: float | None) -> int:
        """Matches that fit a lens of that model, undistorted; None asks for no lens in particular:
        a fundamental matrix, which any plain one fits."""
        camera = pycolmap.Camera.create_from_model_name(1, lens, focal_px or 1.0, *self.size)
        if focal_px is None:
            estimate = pycolmap.estimate_two_view_geometry
        else:
            camera.has_prior_focal_length = True
            estimate = pycolmap.estimate_calibrated_two_view_geometry
        return sum(
            len(estimate(camera, first, camera, second, matches, self._options).inlier_matches)
            for first, second, matches in self._pairs
        )


def set_lens(
    database: Path,
    names: Sequence[str],
    indices: Sequence[int],
    lens: str,
    focal_px: float,
) -> None:
    """Give images another lens, whose focal length counts as known, and forget which of their
    matches fitted the old one: they are verified anew when they are matched again."""
    with pycolmap.Database.open(database) as opened:
        images = [_image(opened, names[index]) for index in indices]
        for camera_id in {image.camera_id for image in images}:
            before = opened.read_camera(camera_id)
            camera = pycolmap.Camera.create_from_model_name(
                camera_id, lens, focal_px, before.width, before.height
            )
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
        of_camera = {image.image_id for image in images}
        known, _ = opened.read_two_view_geometry_num_inliers()
        for pair_id in known:
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            if of_camera & set(pair):
                opened.delete_two_view_geometry(*pair)


def give_own_camera(
    database: Path, names: Sequence[str], indices: Sequence[int], scale: float
) -> None:
    """Give images of one camera another one of their own, its focal length so many times as long.

    Which matches are verified stays as it is: without a known focal length any lens fits.
    """
    with pycolmap.Database.open(database) as opened:
        images = [_image(opened, names[index]) for index in indices]
        before = opened.read_camera(images[0].camera_id)
        camera = pycolmap.Camera.create_from_model_name(
            0, before.model.name, scale * before.mean_focal_length(), before.width, before.height
        )
        camera.has_prior_focal_length = before.has_prior_focal_length
        camera.camera_id = opened.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(camera.sensor_id)
        rig_id = opened.write_rig(rig)
        for image in images:
            frame = opened.read_frame(image.frame_id)
            frame.clear_data_ids()
            frame.add_data_id(pycolmap.data_t(camera.sensor_id, image.image_id))
            frame.rig_id = rig_id
            opened.update_frame(frame)
            image.camera_id = camera.camera_id
            opened.update_image(image)


def forget_pairs(database: Path, names: Sequence[str], pairs: Iterable[tuple[int, int]]) -> None:
    """Take what was verified of these pairs of indices out of the database: mapping does not know
    that they match."""
    with pycolmap.Database.open(database) as opened:
        for i, j in pairs:
            ids = [_image(opened, names[index]).image_id for index in (i, j)]
            if opened.exists_two_view_geometry(*ids):
                opened.delete_two_view_geometry(*ids)


def start_focal(
    database: Path, names: Sequence[str], indices: Sequence[int], long_sides: float
) -> int:
    """Let mapping start from a focal length, in units of the picture's long side, for those cameras
    of these images of which none is known. Returns the number of such cameras.

    Which matches are verified stays as it is. COLMAP's own start is 1.2 long sides.
    """
    with pycolmap.Database.open(database) as opened:
        images = [opened.read_image_with_name(names[index]) for index in indices]
        cameras = sorted({image.camera_id for image in images if image is not None})
        unknown = [camera for camera in map(opened.read_camera, cameras) if _is_unknown(camera)]
        for camera in unknown:
            focal_px = long_sides * max(camera.width, camera.height)
            started = pycolmap.Camera.create_from_model_name(
                camera.camera_id, camera.model.name, focal_px, camera.width, camera.height
            )
            started.has_prior_focal_length = True
            opened.update_camera(started)
    return len(unknown)


def _is_unknown(camera: Any) -> bool:
    return not camera.has_prior_focal_length and len(camera.focal_length_idxs()) > 0


def _image(opened: Any, name: str) -> Any:
    """An image of the database. Raises ToolError for one that COLMAP could not read."""
    image = opened.read_image_with_name(name)
    if image is None:
        raise ToolError(f"COLMAP has no features of image {name}.", code="tool_failed")
    return image
