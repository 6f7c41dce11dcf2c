"""Other lens models fitted to a reconstruction that is there, and judged by what they did not see.

`LensTrials` sets some observations of many tracks aside, adjusts poses, points and lens to the
others, and projects the points into the images again where the observations were left out. Nothing
is matched or placed anew: a trial is one bundle adjustment of a part of the tracks. What the errors
mean is left to `pipelines.sfm.intrinsics`.

Symbols: H held-out observations. Lenses are named as COLMAP names them; a lens is given per camera,
by COLMAP's camera id.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from pipelines.tools.colmap_adjustment import Rounds, Run, adjust
from pipelines.tools.colmap_focals import focals_of_images, with_own_cameras
from pipelines.tools.colmap_results import LENS_PARAMETERS, SparseModel, image_index, sparse_model

Floats = npt.NDArray[np.float64]

MIN_TRACK = 4
"""Observations of a track of which some are held out, one in so many: at least three stay, of which
two place the point and the third says where that is wrong."""
MIN_SEEN = 2
"""Images that a point needs to lie anywhere."""
ENOUGH_OBSERVATIONS = 12_000
ENOUGH_PER_IMAGE = 200
"""Tracks are taken until they have so many observations, whichever is more: enough to fix every
pose and to tell lenses apart, and a fraction of what mapping adjusts many times (docs/poses.md)."""
MOST_IMAGES, FEWEST_OF_CAMERA = 150, 20
"""Images that tell of lenses, and how many of each camera at least, evenly out of all it took: a
lens is told by as many of a long film as of a short one."""
_OWN_ENDS = Rounds(iterations=20, rounds=3, tolerance=1e-5)
"""Of focal lengths by image, which have far to go where one was shared by two lenses."""
_ENDS = Rounds(iterations=10, rounds=5, tolerance=1e-6)
"""COLMAP's own tolerance goes on for 2 to 3 times as many rounds, for errors that are equal in four
digits."""


@dataclass(frozen=True)
class Fit:
    """A trial's result.

    lenses, focal_xy_px: by camera id. most_bent: the largest term of each one's distortion; 0 of a
    fisheye, which bends by what it is. errors_px: [H], infinite behind the camera. reconstruction:
    pycolmap's, of the tracks that were fitted.
    """

    lenses: dict[int, str]
    focal_xy_px: dict[int, tuple[float, float]]
    most_bent: dict[int, float]
    errors_px: Floats
    reconstruction: Any

    @property
    def focal_px(self) -> dict[int, float]:
        """The mean of both axes, by camera id."""
        return {camera: (x + y) / 2 for camera, (x, y) in self.focal_xy_px.items()}


@dataclass(frozen=True)
class OwnFocals:
    """What comes of it where each image has a focal length of its own.

    focal_px: by the images' places in the capture. errors_px: as in `Fit`.
    """

    focal_px: dict[int, float]
    errors_px: Floats


class LensTrials:
    """Trials on one model, all with the same observations held out.

    folder: where COLMAP wrote the model. cameras: lens by camera id, as it was mapped. num_views:
    images by camera id. image_of, camera_of: [H] ids of the held-out observations. every_image:
    whether all images tell, of how many ever.
    """

    def __init__(
        self,
        folder: Path,
        *,
        refine_principal_point: bool,
        num_threads: int,
        seed: int,
        run: Run,
        every_image: bool = False,
    ) -> None:
        self._run = run
        self._principal = refine_principal_point
        self._num_threads = num_threads
        self._folder = folder
        self._whole = pycolmap.Reconstruction(folder)
        images = [self._whole.image(i) for i in self._whole.reg_image_ids()]
        used = sorted({image.camera_id for image in images})
        self.cameras = {i: str(self._whole.camera(i).model.name) for i in used}
        self.num_views = {i: sum(image.camera_id == i for image in images) for i in used}
        told_by = (
            sorted(self._whole.reg_image_ids()) if every_image else _evenly_of_cameras(self._whole)
        )
        self._part = _part_of(self._whole, told_by)
        held = self._hold_out(np.random.default_rng(seed), len(told_by))
        self._held_point = [point for point, _, _ in held]
        self._held_xy = np.array([xy for _, _, xy in held], np.float64).reshape(-1, 2)
        self.image_of = np.array([image for _, image, _ in held], np.int64)
        self.camera_of = np.array(
            [self._whole.image(int(image)).camera_id for image in self.image_of], np.int64
        )

    def _hold_out(
        self, random: np.random.Generator, num_images: int
    ) -> list[tuple[int, int, Floats]]:
        """Keep some tracks in the part, without observations that are returned: (point, image,
        pixel)."""
        part = self._part
        lengths = {i: point.track.length() for i, point in part.points3D.items()}
        long = sorted(i for i, length in lengths.items() if length >= MIN_TRACK)
        order = random.permutation(np.array(long, np.int64))
        counted = np.cumsum([lengths[int(i)] for i in order])
        enough = max(ENOUGH_OBSERVATIONS, ENOUGH_PER_IMAGE * num_images)
        kept = set(order[: int(np.searchsorted(counted, enough)) + 1].tolist())
        for point in set(part.point3D_ids()) - kept:
            part.delete_point3D(point)
        held = []
        for point in sorted(kept):
            elements = [
                (element.image_id, element.point2D_idx)
                for element in part.point3D(point).track.elements
            ]
            for chosen in random.permutation(len(elements))[: len(elements) // MIN_TRACK]:
                image, index = elements[int(chosen)]
                held.append((point, image, np.array(part.image(image).points2D[index].xy)))
                part.delete_observation(image, index)
        return held

    def fit(
        self,
        lenses: Mapping[int, str],
        *,
        start: Fit | None = None,
        focals_px: Mapping[int, float] | None = None,
    ) -> Fit:
        """Adjust the tracks with these lenses, from what mapping found or from another fit.

        focals_px: by camera id, to be held; None fits them.
        """
        fitted = copy.deepcopy(self._part if start is None else start.reconstruction)
        _change_lenses(fitted, lenses, focals_px)
        self._adjust(fitted, refine_focal=focals_px is None)
        cameras = {i: fitted.camera(i) for i in lenses}
        return Fit(
            lenses=dict(lenses),
            focal_xy_px={
                i: (float(camera.focal_length_x), float(camera.focal_length_y))
                for i, camera in cameras.items()
            },
            most_bent={
                i: 0.0
                if "FISHEYE" in lenses[i]
                else max((abs(camera.params[k]) for k in camera.extra_params_idxs()), default=0.0)
                for i, camera in cameras.items()
            },
            errors_px=self._errors(fitted),
            reconstruction=fitted,
        )

    @property
    def indices_held_out(self) -> npt.NDArray[np.int64]:
        """Places in the capture of the images of the held-out observations, [H]."""
        found = [image_index(self._whole.image(int(i)).name) for i in self.image_of]
        return np.array(found, np.int64)

    def fit_apart(self, indices: Collection[int]) -> OwnFocals:
        """Adjust the tracks with a focal length of each of these images, given by their places in
        the capture; distortions stay as they were mapped."""
        apart = with_own_cameras(self._part, indices)
        adjust(
            apart,
            _OWN_ENDS,
            what="comparing focal lengths",
            run=self._run,
            num_threads=self._num_threads,
            refine_distortion=False,
        )
        return OwnFocals(focals_of_images(apart, indices), self._errors(apart))

    def adopt(
        self, lenses: Mapping[int, str], focals_px: Mapping[int, float] | None = None
    ) -> SparseModel:
        """The whole model, adjusted once more with these lenses. focals_px: as in `fit`."""
        whole = copy.deepcopy(self._whole)
        _change_lenses(whole, lenses, focals_px)
        self._adjust(whole, refine_focal=focals_px is None)
        whole.update_point_3d_errors()
        return sparse_model(whole, self._folder)

    def _adjust(self, reconstruction: Any, *, refine_focal: bool) -> None:
        adjust(
            reconstruction,
            _ENDS,
            what="fitting the lens",
            run=self._run,
            num_threads=self._num_threads,
            refine_focal=refine_focal,
            refine_principal_point=self._principal,
        )

    def _errors(self, fitted: Any) -> Floats:
        """Distance of each held-out observation from where its point is seen now, [H] pixels."""
        errors = np.full(len(self._held_point), np.inf)
        for image_id in np.unique(self.image_of).tolist():
            here = np.flatnonzero(self.image_of == image_id)
            image = fitted.image(image_id)
            pose = image.cam_from_world().matrix()
            there = [k for k in here if fitted.exists_point3D(self._held_point[k])]
            points = np.array([fitted.point3D(self._held_point[k]).xyz for k in there])
            local = points.reshape(-1, 3) @ pose[:, :3].T + pose[:, 3]
            front = local[:, 2] > 0
            seen = np.array(there, np.int64)[front]
            pixels = np.array(fitted.camera(image.camera_id).img_from_cam(local[front]))
            errors[seen] = np.linalg.norm(pixels.reshape(-1, 2) - self._held_xy[seen], axis=1)
        errors[~np.isfinite(errors)] = np.inf
        return errors


def _evenly_of_cameras(whole: Any) -> list[int]:
    """Of a model of many images MOST_IMAGES or a few more, ids ascending; all of any other."""
    by_camera: dict[int, list[int]] = {}
    for image_id in sorted(whole.reg_image_ids()):
        by_camera.setdefault(whole.image(image_id).camera_id, []).append(image_id)
    share = min(MOST_IMAGES / max(whole.num_reg_images(), 1), 1.0)
    chosen: set[int] = set()
    for image_ids in by_camera.values():
        num = max(round(share * len(image_ids)), min(FEWEST_OF_CAMERA, len(image_ids)))
        places = np.linspace(0, len(image_ids) - 1, num).round().astype(int)
        chosen |= {image_ids[place] for place in places}
    return sorted(chosen)


def _part_of(whole: Any, image_ids: Sequence[int]) -> Any:
    """A model of these images alone, without features that are of no track: a copy of it is light.

    Images keep their ids, tracks the order of theirs.
    """
    part = pycolmap.Reconstruction()
    for camera_id in sorted({whole.image(i).camera_id for i in image_ids}):
        part.add_camera_with_trivial_rig(copy.deepcopy(whole.camera(camera_id)))
    tracks: dict[int, Any] = {}
    for image_id in image_ids:
        image = whole.image(image_id)
        seen = image.get_observation_points2D()
        for index, point in enumerate(seen):
            tracks.setdefault(point.point3D_id, pycolmap.Track()).add_element(image_id, index)
        part.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name,
                keypoints=np.array([point.xy for point in seen]).reshape(-1, 2),
                camera_id=image.camera_id,
                image_id=image_id,
            ),
            image.cam_from_world(),
        )
    for point_id in sorted(tracks):
        if tracks[point_id].length() >= MIN_SEEN:
            part.add_point3D(whole.point3D(point_id).xyz, tracks[point_id])
    return part


def _change_lenses(
    model: Any, lenses: Mapping[int, str], focals_px: Mapping[int, float] | None
) -> None:
    for camera_id, lens in lenses.items():
        camera = model.camera(camera_id)
        change_lens(camera, lens)
        if focals_px is not None:
            params = np.array(camera.params)
            scale = focals_px[camera_id] / float(camera.mean_focal_length())
            params[list(camera.focal_length_idxs())] *= scale
            camera.params = params


def change_lens(camera: Any, lens: str) -> None:
    """Make a pycolmap camera one of another model, with what both have in common; the rest is 0.

    Two focal lengths become their mean where the new model has one.
    """
    names, given = LENS_PARAMETERS[lens], camera.params
    values = dict(zip(LENS_PARAMETERS[camera.model.name], map(float, given), strict=True))
    focal = float(camera.mean_focal_length())
    values = {"f": focal, "fl_x": focal, "fl_y": focal} | values
    camera.model = getattr(pycolmap.CameraModelId, lens)
    camera.params = np.array([values.get(name, 0.0) for name in names])


def name_unbent(model: Any) -> None:
    """Give cameras of a model whose one radial term mapping held, at none, the lens that has none:
    no later adjustment bends it."""
    for camera_id in model.cameras:
        camera = model.camera(camera_id)
        if camera.model.name == "SIMPLE_RADIAL" and camera.params[-1] == 0.0:
            change_lens(camera, "SIMPLE_PINHOLE")
