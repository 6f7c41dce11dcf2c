"""The tracks of a stored reconstruction, as plain arrays to be looked at and to be changed.

Of each track the observation seen most from the middle of all is the reference; the others are
compared with it. Pixels are those of the full pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from pipelines.tools.colmap_adjustment import Rounds, Run, adjust
from pipelines.tools.colmap_results import SparseModel, image_index, sparse_model

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

_MOST_PX, _LEAST_DEG = 4.0, 1.5
"""How far an observation may miss its point, and from how different directions a point must be
seen: what mapping itself demands by default."""


@dataclass(frozen=True)
class TrackPairs:
    """N observations, each with the reference of its track; those of a track together.

    points: [N] ids. image_ids, features: [N, 2], of reference and observation. xy: [N, 2, 2],
    pixels of both. warps: [N, 2, 2], a pixel's step in the reference -> in the other picture, of a
    plane through the point that faces the reference; not finite where there is none. angles_deg:
    [N], between both rays.
    """

    points: Integers
    image_ids: Integers
    features: Integers
    xy: Floats
    warps: Floats
    angles_deg: Floats


class StoredTracks:
    """The tracks of the model that COLMAP wrote to a folder.

    indices: of the images in the capture, by id. sizes: their (width, height), by id.
    """

    def __init__(self, folder: Path, *, num_threads: int, run: Run) -> None:
        self._model = pycolmap.Reconstruction(folder)
        self._model.update_point_3d_errors()
        self._num_threads = num_threads
        self._run = run
        images = [self._model.image(i) for i in sorted(self._model.reg_image_ids())]
        self.indices = {image.image_id: image_index(image.name) for image in images}
        lenses = {image.image_id: self._model.camera(image.camera_id) for image in images}
        self.sizes = {i: (int(lens.width), int(lens.height)) for i, lens in lenses.items()}

    @property
    def error_px(self) -> float:
        """Mean reprojection error, of all observations, as they were read or last adjusted."""
        return float(self._model.compute_mean_reprojection_error())

    def pairs(self) -> TrackPairs:
        """All observations but the references."""
        rows = [
            (point_id, element.image_id, element.point2D_idx)
            for point_id, point in self._model.points3D.items()
            if point.track.length() > 1
            for element in point.track.elements
        ]
        points, image_ids, features = np.array(rows, np.int64).reshape(-1, 3).T
        ids, places = np.unique(points, return_inverse=True)
        xyz = np.array([self._model.point3D(int(i)).xyz for i in ids]).reshape(-1, 3)[places]
        xy, centers = np.zeros((len(rows), 2)), np.zeros((len(rows), 3))
        for image_id in np.unique(image_ids).tolist():
            here = image_ids == image_id
            image = self._model.image(image_id)
            seen = image.points2D
            xy[here] = [seen[feature].xy for feature in features[here].tolist()]
            centers[here] = image.projection_center()
        rays = xyz - centers
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        reference = _most_central(places, rays)[places]
        other = np.flatnonzero(image_ids[reference] != image_ids)
        order = other[np.lexsort((points[other], image_ids[reference[other]]))]
        first = reference[order]
        cosines = (rays[first] * rays[order]).sum(-1)
        both = np.stack([first, order], 1)
        return TrackPairs(
            points=points[order],
            image_ids=image_ids[both],
            features=features[both],
            xy=xy[both],
            warps=self._warps(image_ids[both], xy[first], xyz[order]),
            angles_deg=np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))),
        )

    def _warps(self, image_ids: Integers, xy: Floats, xyz: Floats) -> Floats:
        """By projecting a pixel's steps to the right and down, through each lens."""
        directions = np.full((3, len(xy), 3), np.nan)
        at_point = np.zeros((len(xy), 3))
        for image_id, here in _groups(image_ids[:, 0]):
            image = self._model.image(image_id)
            camera, pose = self._model.camera(image.camera_id), image.cam_from_world().matrix()
            at_point[here] = xyz[here] @ pose[:, :3].T + pose[:, 3]
            for number, step in enumerate(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))):
                local = np.asarray(camera.cam_from_img(xy[here] + step))
                rays = np.column_stack([local, np.ones(len(local))]) @ pose[:, :3]
                directions[number, here] = rays
        normals = directions[0] / np.linalg.norm(directions[0], axis=1, keepdims=True)
        distances = np.linalg.norm(at_point, axis=1, keepdims=True)
        places = directions * distances / (directions * normals).sum(-1, keepdims=True)
        pixels = np.full((3, len(xy), 2), np.nan)
        for image_id, here in _groups(image_ids[:, 1]):
            image = self._model.image(image_id)
            camera, pose = self._model.camera(image.camera_id), image.cam_from_world().matrix()
            for number in range(3):
                world = places[number, here] + self._centers(image_ids[here, 0])
                local = world @ pose[:, :3].T + pose[:, 3]
                local[~(local[:, 2] > 0)] = np.nan
                pixels[number, here] = np.asarray(camera.img_from_cam(local))
        return np.stack([pixels[1] - pixels[0], pixels[2] - pixels[0]], -1)

    def _centers(self, image_ids: Integers) -> Floats:
        ids, places = np.unique(image_ids, return_inverse=True)
        return np.array([self._model.image(int(i)).projection_center() for i in ids])[places]

    def move(self, pairs: TrackPairs, which: Bools, xy: Floats) -> None:
        """Put observations where they were found. xy: [N, 2], read where `which` [N] is true."""
        for n in np.flatnonzero(which).tolist():
            image = self._model.image(int(pairs.image_ids[n, 1]))
            image.points2D[int(pairs.features[n, 1])].xy = xy[n]

    def drop(self, pairs: TrackPairs, which: Bools) -> None:
        """Take observations out of their tracks; a track of one is no point any more."""
        for n in np.flatnonzero(which).tolist():
            if self._model.exists_point3D(int(pairs.points[n])):
                self._model.delete_observation(
                    int(pairs.image_ids[n, 1]), int(pairs.features[n, 1])
                )

    def adjust(self, ends: Rounds, *, refine_principal_point: bool) -> None:
        """Adjust poses, points and lenses to the observations as they are now, and leave out what
        then fits none of them: of a fisheye, what left the angles that its lens is made for may be
        any number of pixels off."""
        adjust(
            self._model,
            ends,
            what="adjusting the poses",
            run=self._run,
            num_threads=self._num_threads,
            refine_principal_point=refine_principal_point,
        )
        pycolmap.ObservationManager(self._model).filter_all_points3D(_MOST_PX, _LEAST_DEG)
        self._model.update_point_3d_errors()

    def write(self, folder: Path) -> SparseModel:
        """Write the model to a folder, which may be there, and return it."""
        folder.mkdir(parents=True, exist_ok=True)
        self._model.write(folder)
        return sparse_model(self._model, folder)


def _most_central(tracks: Integers, rays: Floats) -> Integers:
    """For each track the row whose ray has the least angles to the others', [tracks].

    tracks: [N], the track of each row. The mean cosine to all is the product with their sum.
    """
    sums = np.stack([np.bincount(tracks, weights=rays[:, axis]) for axis in range(3)], 1)
    central = (rays * sums[tracks]).sum(-1)
    order = np.lexsort((-central, tracks))
    firsts = np.unique(tracks[order], return_index=True)[1]
    chosen: Integers = order[firsts]
    return chosen


def _groups(ids: Integers) -> list[tuple[int, Integers]]:
    """Each id with the rows that have it."""
    order = np.argsort(ids, kind="stable")
    values, starts = np.unique(ids[order], return_index=True)
    return list(zip(values.tolist(), np.split(order, starts[1:]), strict=True))
