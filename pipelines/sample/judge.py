"""How far poses, a mesh and a cloud made from an analytic scene are from the truth.

Poses are aligned to the true cameras by a similarity of the camera centres; the mesh is moved by
that same similarity and nothing else, so a wrong scale or a tilt shows. Only what cameras saw
counts: no mesh can have what was never in a picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.sample.align import Floats, path_extent, similarity
from pipelines.sample.scene import (
    SAMPLE,
    SUBJECT,
    Region,
    Scene,
    in_picture,
    pose_matrix,
    seen_surface,
    surface_distance,
    surface_normals,
)
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.orientation import Similarity


@dataclass(frozen=True)
class PosesJudgement:
    """num_images: how many were compared. mean_center_error, max_center_error: relative to the
    extent of the true path. mean_rotation_error_deg: angle between the aligned and true cameras.
    alignment: from the judged frame to the true world.
    """

    num_images: int
    mean_center_error: float
    max_center_error: float
    mean_rotation_error_deg: float
    alignment: Similarity


@dataclass(frozen=True)
class MeshJudgement:
    """Median distances relative to the region's size.

    accuracy: from the mesh to the true surface. completeness: from the true surface to the mesh.
    num_mesh_points, num_true_points: how many points they are medians of.
    """

    accuracy: float
    completeness: float
    num_mesh_points: int
    num_true_points: int


@dataclass(frozen=True)
class SurfaceScores:
    """Shares of a surface within a tolerance of the other, keyed by the tolerance, a part of the
    scene's size.

    precision: of the mesh by area, how much lies that near to the true surface. recall: of the true
    surface that cameras saw, evenly by area, how much has the mesh that near. f_score: their
    harmonic mean. things_precision, things_recall: the same of things alone, without floor and
    walls. accuracy, completeness: medians of the two distances, relative to the size.
    Source: Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017, section 3.
    """

    precision: dict[float, float]
    recall: dict[float, float]
    f_score: dict[float, float]
    things_precision: dict[float, float]
    things_recall: dict[float, float]
    accuracy: float
    completeness: float


@dataclass(frozen=True)
class NormalScores:
    """How far normals are from the true surface's, of what lies within the first of `TOLERANCES`.

    num_points: how many were compared. median_deg: of the angles. over_30_deg, turned: shares off
    by more than 30 and by more than 90 degrees, which then point into the thing. All three are nan
    where there are no points.
    """

    num_points: int
    median_deg: float
    over_30_deg: float
    turned: float


TOLERANCES = (0.01, 0.02)
"""1 and 2 % of the scene's size."""
_RAYS_PER_POINT = 4


def judge_poses(cameras: CamerasFile, truth: CamerasFile) -> PosesJudgement:
    """Compare cameras with the true ones, image by image, paired by timestamp.

    Raises ValueError for an image without a timestamp or with none of the truth within half a
    frame, and where fewer than 3 images are left.
    """
    pairs = [(image, _true_image(image, truth)) for image in cameras.images]
    if len(pairs) < 3:
        raise ValueError(f"poses of {len(pairs)} images cannot be judged: at least 3 are needed")
    found = np.array([pose_matrix(image) for image, _ in pairs])
    true = np.array([pose_matrix(image) for _, image in pairs])
    alignment = similarity(found[:, :, 3], true[:, :, 3])
    extent = path_extent(np.array([pose_matrix(image)[:, 3] for image in truth.images]))
    errors = (
        np.linalg.norm(alignment.apply_to_points(found[:, :, 3]) - true[:, :, 3], axis=1) / extent
    )
    turned = np.einsum("ij,njk,nlk->nil", alignment.rotation, found[:, :, :3], true[:, :, :3])
    cosines = (np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0
    return PosesJudgement(
        num_images=len(pairs),
        mean_center_error=float(errors.mean()),
        max_center_error=float(errors.max()),
        mean_rotation_error_deg=float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).mean()),
        alignment=alignment,
    )


def _true_image(image: PosedImage, truth: CamerasFile) -> PosedImage:
    if image.timestamp_s is None:
        raise ValueError(f"{image.file} has no timestamp: it cannot be paired with the truth")
    times = np.array([np.nan if i.timestamp_s is None else i.timestamp_s for i in truth.images])
    index = int(np.nanargmin(np.abs(times - image.timestamp_s)))
    half_frame = 0.5 * float(np.nanmedian(np.diff(times)))
    if abs(times[index] - image.timestamp_s) > half_frame:
        raise ValueError(
            f"{image.file} at {image.timestamp_s:.3f} s has no true camera within half a frame"
        )
    return truth.images[index]


def judge_mesh(
    vertices: Floats,
    faces: NDArray[np.integer],
    alignment: Similarity,
    truth: CamerasFile,
    region: Region = SUBJECT,
    num_points: int = 20_000,
) -> MeshJudgement:
    """Compare a mesh with the true surface, both ways, within what the cameras saw of `region`.

    vertices: [V, 3], in the frame that `alignment` moves to the true world. faces: [F, 3].
    Accuracy takes points spread evenly over the mesh that lie in the region and in a camera's
    view; completeness takes true points that cameras saw.
    Raises ValueError for a mesh without faces, or none of it where the cameras looked.
    """
    if len(faces) == 0:
        raise ValueError("a mesh without faces cannot be judged")
    moved = alignment.apply_to_points(np.asarray(vertices, dtype=np.float64))
    points = _points_on_mesh(moved, faces, num_points)
    points = points[region.contains(points)]
    points = points[_in_view(points, truth)]
    if len(points) == 0:
        raise ValueError("no part of the mesh lies where the cameras looked")
    true_points = seen_surface(truth, region, num_points)
    return MeshJudgement(
        accuracy=float(np.median(surface_distance(points))) / region.size,
        completeness=float(np.median(_distance_to_mesh(true_points, moved, faces))) / region.size,
        num_mesh_points=len(points),
        num_true_points=len(true_points),
    )


def judge_surface(
    vertices: Floats,
    faces: NDArray[np.integer],
    alignment: Similarity,
    truth: CamerasFile,
    scene: Scene = SAMPLE,
    num_points: int = 40_000,
) -> SurfaceScores:
    """Precision, recall and F-score of a mesh at `TOLERANCES`, within the scene's subject.

    Arguments as of `judge_mesh`. A mesh without faces scores 0 with infinite distances.
    """
    true_points = _true_points(truth, scene, num_points)
    moved = alignment.apply_to_points(np.asarray(vertices, dtype=np.float64))
    points = np.zeros((0, 3))
    missing = np.full(len(true_points), np.inf)
    if len(faces):
        counted = scene.subject.grown(scene.beyond)
        points = _points_on_mesh(moved, _reaching_into(counted, moved, faces), num_points)
        points = points[counted.contains(points)]
        points = points[_in_view(points, truth)]
        missing = _distance_to_mesh(true_points, moved, faces)
    return _surface_scores(points, true_points, missing, scene)


def judge_cloud(
    points: Floats,
    alignment: Similarity,
    truth: CamerasFile,
    scene: Scene = SAMPLE,
    num_points: int = 40_000,
) -> SurfaceScores:
    """The same of a cloud: precision and accuracy are of its points as they are, not by area,
    recall and completeness by the point that is nearest.

    points: [P, 3], in the frame that `alignment` moves to the true world.
    """
    true_points = _true_points(truth, scene, num_points)
    moved = alignment.apply_to_points(np.asarray(points, dtype=np.float64))
    missing = np.full(len(true_points), np.inf)
    if len(moved):
        missing = np.asarray(cKDTree(moved).query(true_points)[0], np.float64)
    kept = scene.subject.grown(scene.beyond).contains(moved)
    kept[kept] = _in_view(moved[kept], truth)
    counted = moved[kept]
    if len(counted) > num_points:
        chosen = np.random.default_rng(0).choice(len(counted), num_points, replace=False)
        counted = counted[chosen]
    return _surface_scores(counted, true_points, missing, scene)


def _true_points(truth: CamerasFile, scene: Scene, num_points: int) -> Floats:
    """The true surface that cameras saw, about evenly by area."""
    seen = seen_surface(truth, scene.subject, _RAYS_PER_POINT * num_points, scene)
    return _thinned(seen, 0.5 * TOLERANCES[0] * scene.subject.size)


def _surface_scores(
    points: Floats, true_points: Floats, missing: Floats, scene: Scene
) -> SurfaceScores:
    """Scores of points [N, 3]. true_points: [T, 3]. missing: [T], how far what is judged is."""
    size = scene.subject.size
    off = surface_distance(points, scene) if len(points) else np.zeros(0)
    things, true_things = scene.things.contains(points), scene.things.contains(true_points)
    precision, recall = _shares(off, size), _shares(missing, size)
    return SurfaceScores(
        precision=precision,
        recall=recall,
        f_score={
            tolerance: 2
            * precision[tolerance]
            * recall[tolerance]
            / max(precision[tolerance] + recall[tolerance], 1e-12)
            for tolerance in TOLERANCES
        },
        things_precision=_shares(off[things], size),
        things_recall=_shares(missing[true_things], size),
        accuracy=float(np.median(off)) / size if len(off) else np.inf,
        completeness=float(np.median(missing)) / size,
    )


def judge_normals(
    points: Floats,
    normals: Floats,
    alignment: Similarity,
    truth: CamerasFile,
    scene: Scene = SAMPLE,
    num_points: int = 40_000,
) -> NormalScores:
    """The angles between normals and the true ones, where cameras looked.

    points: [P, 3], normals: [P, 3] of any length above 0, in the frame that `alignment` moves to
    the true world. num_points: so many of them are looked at, the same ones on every call.
    """
    if len(points) > num_points:
        chosen = np.random.default_rng(0).choice(len(points), num_points, replace=False)
        points, normals = points[chosen], normals[chosen]
    moved = alignment.apply_to_points(np.asarray(points, np.float64))
    kept = scene.subject.grown(scene.beyond).contains(moved)
    kept[kept] = surface_distance(moved[kept], scene) <= TOLERANCES[0] * scene.subject.size
    kept[kept] = _in_view(moved[kept], truth)
    if not kept.any():
        return NormalScores(0, np.nan, np.nan, np.nan)
    found = alignment.apply_to_directions(np.asarray(normals, np.float64)[kept])
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    cosines = (found * surface_normals(moved[kept], scene)).sum(axis=1)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return NormalScores(
        num_points=len(angles),
        median_deg=float(np.median(angles)),
        over_30_deg=float((angles > 30.0).mean()),
        turned=float((angles > 90.0).mean()),
    )


def _reaching_into(
    region: Region, vertices: Floats, faces: NDArray[np.integer]
) -> NDArray[np.integer]:
    """The faces [F, 3] whose box meets the region's, or all of them where none does: what lies far
    away would take most of the points that are spread by area.
    """
    corners = vertices[faces]
    near = (corners.min(axis=1) <= region.high) & (corners.max(axis=1) >= region.low)
    met = near.all(axis=1)
    return faces[met] if met.any() else faces


def _shares(distances: Floats, size: float) -> dict[float, float]:
    """By tolerance, the share of distances [N] that are within it; 0 where there are none."""
    return {
        tolerance: float((distances <= tolerance * size).mean()) if len(distances) else 0.0
        for tolerance in TOLERANCES
    }


def _thinned(points: Floats, side: float) -> Floats:
    """One of the points [N, 3] in each cube of that side: about evenly spread by area."""
    _, first = np.unique(np.floor(points / side).astype(np.int64), axis=0, return_index=True)
    kept: Floats = points[np.sort(first)]
    return kept


def _points_on_mesh(vertices: Floats, faces: NDArray[np.integer], num_points: int) -> Floats:
    """Points spread over the faces by area, [num_points, 3]; the same ones on every call."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    if not areas.sum() > 0.0:
        raise ValueError("a mesh without area cannot be judged")
    random = np.random.default_rng(0)
    chosen = corners[random.choice(len(faces), size=num_points, p=areas / areas.sum())]
    a, b = random.random((2, num_points, 1))
    root = np.sqrt(a)
    points: Floats = (
        (1.0 - root) * chosen[:, 0] + root * (1.0 - b) * chosen[:, 1] + root * b * chosen[:, 2]
    )
    return points


def _in_view(points: Floats, truth: CamerasFile) -> NDArray[np.bool_]:
    """Which points [N, 3] project into a true picture, hidden or not: [N]."""
    seen = np.zeros(len(points), dtype=np.bool_)
    for image in truth.images:
        seen |= in_picture(points, truth.cameras[image.camera], pose_matrix(image))
    return seen


def _distance_to_mesh(points: Floats, vertices: Floats, faces: NDArray[np.integer]) -> Floats:
    """Exact distance of points [N, 3] to the nearest triangle, [N]."""
    import open3d  # takes a second to import, and only meshes need it

    def tensor(values: Any, kind: Any) -> Any:
        return open3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=kind))

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(vertices, np.float32), tensor(faces, np.uint32))
    distances = scene.compute_distance(tensor(points, np.float32))
    return np.asarray(distances.numpy(), dtype=np.float64)
