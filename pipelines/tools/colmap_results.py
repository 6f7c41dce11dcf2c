"""What COLMAP found, as plain arrays: matches from its database, models from its reconstructions.

Axes are COLMAP's: cameras look along +Z, +Y down. Pixel centres lie at (0.5, 0.5), as ours.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from pipelines.errors import ToolError
from pipelines.scene import panoramas
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.colmap_lenses import COLMAP_LENSES, lens_from_colmap

_ANGLE_SAMPLE = 3000

LENS_PARAMETERS = {name: lens.terms for name, lens in COLMAP_LENSES.items()}
"""The order of COLMAP's parameters; `f` is both focal lengths."""

_ONE_HOMOGRAPHY = (
    int(pycolmap.TwoViewGeometryConfiguration.PLANAR),
    int(pycolmap.TwoViewGeometryConfiguration.PANORAMIC),
    int(pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC),
)


VerifiedMatches = dict[tuple[int, int], tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]
"""By pairs of indices: places in pixels in the one and the other, [M, 2] each."""


@dataclass(frozen=True)
class PairStatistics:
    """What matching found.

    num_features: [N] int, per image. best_inliers: [N] int, verified matches with the image's best
    partner. num_pairs: pairs compared. num_verified: pairs with a verified geometry.
    homographies: [H, 3, 3], of the verified pairs that one homography explains (a turning camera,
    or one plane), in units of the image's long side from its centre, x right, y down.
    verified: [V, 3] int, of each verified pair both images, the lower first, and its matches.
    """

    num_features: npt.NDArray[np.int64]
    best_inliers: npt.NDArray[np.int64]
    num_pairs: int
    num_verified: int
    homographies: npt.NDArray[np.float64]
    verified: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))

    @classmethod
    def nothing(cls, num_images: int) -> PairStatistics:
        """Before anything was looked at."""
        none = np.zeros(num_images, np.int64)
        return cls(none, none, 0, 0, np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class SparseModel:
    """One reconstruction, in its own arbitrary frame and scale.

    indices: [N], the images it holds, ascending. cameras: lenses in use.
    camera_of: [N], index into `cameras`. world_from_camera: [N, 3, 4] float64, OpenCV axes.
    points: [P, 3] float64. colors: [P, 3] uint8. track_lengths: [P], images that see each point.
    agreement: the share of verified matches that its poses can be right about
    (`pipelines.sfm.agreement`), None where nobody looked or too few pairs tell.
    error_px: mean reprojection error. angle_deg: median over points of the widest angle between
    two of its rays; small where the camera hardly moved. stored: the folder it was written to.
    """

    indices: tuple[int, ...]
    cameras: tuple[Intrinsics, ...]
    camera_of: tuple[int, ...]
    world_from_camera: npt.NDArray[np.float64]
    points: npt.NDArray[np.float64]
    colors: npt.NDArray[np.uint8]
    track_lengths: npt.NDArray[np.int64]
    error_px: float
    angle_deg: float
    stored: Path | None = None
    agreement: float | None = None

    @property
    def weight(self) -> float:
        """What it counts against others: images, less where matches contradict it."""
        return len(self.indices) * (1.0 if self.agreement is None else self.agreement)


def best_model(models: Sequence[SparseModel]) -> SparseModel | None:
    """The model of most weight, then most points; None where there is none.

    COLMAP's first model is often a spurious one of a few images: its order says nothing. Nor does
    the number of images alone, or the reprojection error: a twisted model may have the best.
    """
    return max(models, key=lambda model: (model.weight, len(model.points)), default=None)


def intrinsics_from_colmap(
    model: str, width: int, height: int, params: Sequence[float]
) -> Intrinsics:
    """A COLMAP camera as ours. Raises ToolError for a lens model that we cannot express."""
    if model == panoramas.MODEL:
        return panoramas.panorama_lens(width, height)
    try:
        return lens_from_colmap(model, width, height, params)
    except ValueError as error:
        raise ToolError(
            f"A camera that COLMAP returned {error}.",
            hint=f"Choose one of {', '.join(sorted(COLMAP_LENSES))}.",
        ) from error


def read_statistics(database: Path, num_images: int) -> PairStatistics:
    """What extraction and matching put into the database.

    Call it only while pycolmap has the database closed (see `pipelines.tools.colmap`).
    """
    num_features = np.zeros(num_images, np.int64)
    best = np.zeros(num_images, np.int64)
    with contextlib.closing(sqlite3.connect(database)) as connection:
        images = {
            image_id: (image_index(name), width, height)
            for image_id, name, width, height in connection.execute(
                "SELECT image_id, name, width, height FROM images "
                "JOIN cameras ON cameras.camera_id = images.camera_id"
            )
        }
        for image_id, rows in connection.execute("SELECT image_id, rows FROM keypoints"):
            num_features[images[image_id][0]] = rows
        pairs = connection.execute(
            "SELECT pair_id, rows, config, H FROM two_view_geometries"
        ).fetchall()
    homographies: list[npt.NDArray[np.float64]] = []
    verified: list[tuple[int, int, int]] = []
    for pair_id, rows, config, blob in pairs:
        first, second = (images[i] for i in pycolmap.pair_id_to_image_pair(pair_id))
        for index, _, _ in (first, second):
            best[index] = max(best[index], rows)
        if rows > 0:
            verified.append((*sorted((first[0], second[0])), rows))
        if rows > 0 and config in _ONE_HOMOGRAPHY and blob:
            pixels = np.frombuffer(blob, np.float64).reshape(3, 3)
            homographies.append(
                _centred(*second[1:]) @ pixels @ np.linalg.inv(_centred(*first[1:]))
            )
    return PairStatistics(
        num_features=num_features,
        best_inliers=best,
        num_pairs=len(pairs),
        num_verified=len(verified),
        homographies=np.array(homographies, np.float64).reshape(-1, 3, 3),
        verified=np.array(sorted(verified), np.int64).reshape(-1, 3),
    )


def read_features(database: Path, num_images: int, per_image: int) -> list[npt.NDArray[np.uint8]]:
    """Descriptors of every image, [at most per_image, 128] each, evenly out of all it has.

    They are read image by image. Call it only while pycolmap has the database closed.
    """
    found = [np.zeros((0, 128), np.uint8) for _ in range(num_images)]
    with contextlib.closing(sqlite3.connect(database)) as connection:
        for name, rows, columns, blob in connection.execute(
            "SELECT name, rows, cols, data FROM descriptors "
            "JOIN images ON images.image_id = descriptors.image_id WHERE rows > 0"
        ):
            whole = np.frombuffer(blob, np.uint8).reshape(rows, columns)
            chosen = np.linspace(0, rows - 1, min(rows, per_image)).round().astype(np.int64)
            found[image_index(name)] = whole[chosen]
    return found


def read_matches(
    database: Path, num_images: int, most_pairs: int | None = None, most_matches: int | None = None
) -> VerifiedMatches:
    """Verified matches of pairs of indices, the lower first: places in pixels in the one and the
    other, [M, 2] each.

    most_pairs, most_matches: of each pair, evenly picked where there are more.

    Call it only while pycolmap has the database closed.
    """
    found = {}
    with contextlib.closing(sqlite3.connect(database)) as connection:
        index_of, places = _features(connection, num_images)
        (count,) = connection.execute(
            "SELECT COUNT(*) FROM two_view_geometries WHERE rows > 0"
        ).fetchone()
        kept = set(_evenly(count, most_pairs).tolist())
        for number, (pair_id, rows, blob) in enumerate(
            connection.execute("SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0")
        ):
            if number not in kept:
                continue
            i, j, matches = _in_order(index_of, pair_id, blob)
            matches = matches[_evenly(rows, most_matches)]
            found[i, j] = places[i][matches[:, 0]], places[j][matches[:, 1]]
    return found


def _in_order(
    index_of: dict[int, int], pair_id: int, blob: bytes
) -> tuple[int, int, npt.NDArray[np.int64]]:
    """A pair's indices, the lower first, and its matches [M, 2] in that order.

    COLMAP orders a pair by its images' ids, which they get as their features are found: by several
    threads, so now and then in another order than that of their names.
    """
    i, j = (index_of[image] for image in pycolmap.pair_id_to_image_pair(pair_id))
    matches = np.frombuffer(blob, np.uint32).reshape(-1, 2).astype(np.int64)
    return (i, j, matches) if i < j else (j, i, matches[:, ::-1])


def _features(
    connection: sqlite3.Connection, num_images: int
) -> tuple[dict[int, int], list[npt.NDArray[np.float64]]]:
    """The index of each image by its id, and by index where its features are, [F, 2] pixels."""
    places: list[npt.NDArray[np.float64]] = [np.zeros((0, 2)) for _ in range(num_images)]
    index_of = {
        image_id: image_index(name)
        for image_id, name in connection.execute("SELECT image_id, name FROM images")
    }
    for image_id, rows, columns, blob in connection.execute(
        "SELECT image_id, rows, cols, data FROM keypoints WHERE rows > 0"
    ):
        values = np.frombuffer(blob, np.float32).reshape(rows, columns)
        places[index_of[image_id]] = values[:, :2].astype(np.float64)
    return index_of, places


@dataclass(frozen=True)
class Correspondences:
    """Which features of which images show the same, N images.

    places: of each image [F, 2], where its features are, in pixels. matches: by pairs of indices,
    the lower first, [M, 2], rows of `places` in the one and the other.
    """

    places: tuple[npt.NDArray[np.float64], ...]
    matches: dict[tuple[int, int], npt.NDArray[np.int64]]


def read_correspondences(database: Path, num_images: int) -> Correspondences:
    """All verified matches. Call it only while pycolmap has the database closed."""
    found = {}
    with contextlib.closing(sqlite3.connect(database)) as connection:
        index_of, places = _features(connection, num_images)
        for pair_id, blob in connection.execute(
            "SELECT pair_id, data FROM two_view_geometries WHERE rows > 0"
        ):
            i, j, matches = _in_order(index_of, pair_id, blob)
            found[i, j] = matches
    return Correspondences(tuple(places), found)


def _evenly(count: int, most: int | None) -> npt.NDArray[np.int64]:
    """Indices of `count`, at most `most` of them."""
    num = count if most is None else min(count, most)
    return np.linspace(0, max(count - 1, 0), num).round().astype(np.int64)


def _centred(width: int, height: int) -> npt.NDArray[np.float64]:
    """Pixels to units of the long side from the image's centre, [3, 3]."""
    side = float(max(width, height))
    return np.array(
        [[1 / side, 0, -width / 2 / side], [0, 1 / side, -height / 2 / side], [0, 0, 1]]
    )


def image_index(name: str) -> int:
    """The index that an image's name in the database stands for."""
    return int(Path(name).stem)


def sparse_model(reconstruction: Any, stored: Path | None = None) -> SparseModel:
    """A `pycolmap.Reconstruction` as plain arrays. stored: the folder that it was written to."""
    images = sorted(
        (reconstruction.image(image_id) for image_id in reconstruction.reg_image_ids()),
        key=lambda image: image_index(image.name),
    )
    camera_ids = sorted({image.camera_id for image in images})
    cameras = [reconstruction.camera(camera_id) for camera_id in camera_ids]
    poses = np.stack([image.cam_from_world().inverse().matrix() for image in images])
    points = list(reconstruction.points3D.values())
    center_of = {image.image_id: pose[:, 3] for image, pose in zip(images, poses, strict=True)}
    return SparseModel(
        indices=tuple(image_index(image.name) for image in images),
        cameras=tuple(
            intrinsics_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
            for camera in cameras
        ),
        camera_of=tuple(camera_ids.index(image.camera_id) for image in images),
        world_from_camera=poses,
        points=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        track_lengths=np.array([point.track.length() for point in points], np.int64),
        error_px=float(reconstruction.compute_mean_reprojection_error()),
        angle_deg=_median_widest_angle_deg(points, center_of),
        stored=stored,
    )


def without_images(model: SparseModel, indices: Sequence[int]) -> SparseModel:
    """A model that COLMAP wrote without some of its images and what only they saw; there, too."""
    if model.stored is None:
        raise ValueError("the model was not written by COLMAP")
    reconstruction = pycolmap.Reconstruction(model.stored)
    for image_id in list(reconstruction.reg_image_ids()):
        image = reconstruction.image(image_id)
        if image_index(image.name) in indices:
            reconstruction.deregister_frame(image.frame_id)
    reconstruction.update_point_3d_errors()
    reconstruction.write(model.stored)
    return replace(sparse_model(reconstruction, model.stored), agreement=model.agreement)


def _median_widest_angle_deg(
    points: Sequence[Any], center_of: dict[int, npt.NDArray[np.float64]]
) -> float:
    """The median over (at most 3,000) points of the widest angle between their rays, degrees."""
    if not points:
        return 0.0
    widest: list[float] = []
    for point in points[:: max(1, len(points) // _ANGLE_SAMPLE)]:
        centers = np.array([center_of[element.image_id] for element in point.track.elements])
        rays = point.xyz - centers
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        widest.append(float(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return float(np.degrees(np.median(widest)))
