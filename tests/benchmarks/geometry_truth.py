"""A finished job against what is known of its capture: exact surfaces, or a sensor's depth.

Three kinds of truth: an analytic scene (`pipelines.sample`), depth pictures listed in a folder's
`transforms.json`, or none, where only the job's own report speaks. Depth of an analytic scene is
compared at the true cameras, the mesh moved there by the similarity of the camera centres.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipelines.captures.record import CaptureRecord
from pipelines.exports.formats.ply import Ply, read_ply
from pipelines.exports.frame import back_to_world
from pipelines.exports.judged import cloud_of
from pipelines.judging.asset_views import MeshCaster
from pipelines.judging.depth_scores import depth_scores, nearest
from pipelines.nerf.judging.off_path import evenly
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.sample.align import Floats
from pipelines.sample.judge import (
    NormalScores,
    SurfaceScores,
    judge_cloud,
    judge_normals,
    judge_poses,
    judge_surface,
)
from pipelines.sample.scene import depth_image, pose_matrix, render
from pipelines.sample.takes import Take
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.scene.orientation import Similarity
from pipelines.scene.trained_scene import nerf_cameras
from pipelines.workspace import Workspace

NUM_VIEWS = 8
LONG_SIDE_PX = 320


@dataclass(frozen=True)
class Compared:
    """Depth maps, one per view.

    photos: [H, W, 3] uint8. truth, found: [H, W] z-depth, 0 where unknown.
    """

    photos: list[NDArray[np.uint8]] = field(default_factory=list)
    truth: list[NDArray[np.floating]] = field(default_factory=list)
    found: list[NDArray[np.floating]] = field(default_factory=list)


def cameras_at(lens: Intrinsics, poses: Floats, frame: SceneTransform) -> Cameras:
    """The library's cameras at `LONG_SIDE_PX`. poses: [N, 3, 4], world."""
    return nerf_cameras([lens] * len(poses), poses, frame).resized(LONG_SIDE_PX)


def pinhole_of(cameras: Cameras) -> Intrinsics:
    """The lens of camera 0, which has no distortion."""
    width, height = cameras.size[0].tolist()
    fl_x, fl_y = cameras.focal[0].tolist()
    cx, cy = cameras.principal[0].tolist()
    return Intrinsics(width, height, fl_x, fl_y, cx, cy)


def judge_scene(job: Workspace, take: Take, truth: CamerasFile) -> tuple[dict[str, Any], Compared]:
    """The surface, the poses and the depth of a job made from a film of that take."""
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    mesh = read_ply(job.stage("mesh") / "mesh.ply")
    poses = judge_poses(cameras, truth)
    points = back_to_world(mesh.points, mesh.from_world)
    path = cloud_of(job.stage("pointcloud"))
    cloud = read_ply(path) if path.is_file() else None
    normals = {
        "mesh": _judge_normals(mesh, poses.alignment, take, truth),
        "cloud": cloud and _judge_normals(cloud, poses.alignment, take, truth),
    }
    surface = judge_surface(points, mesh.faces, poses.alignment, truth, take.scene)
    moved = poses.alignment.apply_to_points(points)
    compared = _depth_of_scene(moved, mesh, take, truth)
    return {
        "poses": {
            "num_images": poses.num_images,
            "mean_center_error": poses.mean_center_error,
            "mean_rotation_error_deg": poses.mean_rotation_error_deg,
        },
        "surface": asdict(surface)
        | {"normals": {name: found and asdict(found) for name, found in normals.items()}},
        "cloud": cloud and asdict(_judge_cloud(cloud, poses.alignment, take, truth)),
        "depth": depth_scores(compared.found, compared.truth),
    }, compared


def _judge_cloud(
    found: Ply, alignment: Similarity, take: Take, truth: CamerasFile
) -> SurfaceScores:
    points = back_to_world(found.points, found.from_world)
    return judge_cloud(points, alignment, truth, take.scene)


def _judge_normals(
    found: Ply, alignment: Similarity, take: Take, truth: CamerasFile
) -> NormalScores | None:
    """Of a mesh's vertices or of a cloud's points; None where the file has no normals."""
    if found.normals is None:
        return None
    points = back_to_world(found.points, found.from_world)
    normals = found.normals.astype(np.float64)
    if found.from_world is not None:
        # Turned back by the transpose, to which a similarity's inverse is proportional.
        normals = normals @ found.from_world[:, :3]
    return judge_normals(points, normals, alignment, truth, take.scene)


def _depth_of_scene(vertices: Floats, mesh: Ply, take: Take, truth: CamerasFile) -> Compared:
    compared = Compared()
    picked = [truth.images[index] for index in evenly(len(truth.images), NUM_VIEWS)]
    matrices = np.stack([pose_matrix(image) for image in picked])
    frame = SceneTransform((0.0, 0.0, 0.0), 1.0)
    cameras = cameras_at(truth.cameras[0], matrices, frame)
    lens = pinhole_of(cameras)
    caster = MeshCaster(vertices, mesh.faces, None)
    for index, matrix in enumerate(matrices):
        compared.photos.append(render(lens, matrix, take.scene))
        compared.truth.append(depth_image(lens, matrix, take.scene))
        compared.found.append(caster.view(cameras, index).z_depth(cameras, index))
    return compared


def judge_sensor(job: Workspace, capture: Path) -> tuple[dict[str, Any], Compared] | None:
    """The mesh's depth at held-out views against the capture's; None where it has none.

    capture: a folder with a `transforms.json` that names a `depth_file_path` per frame, in whose
    world and unit the job works, because its poses came with it.
    """
    listed = depth_files(capture)
    if not listed:
        return None
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    record = CaptureRecord.load(job.stage("ingest"))
    source = {item["file"]: str(item["source"]) for item in record.images}
    held_out = [image for image in cameras.images if image.split == "test"]
    posed = [image for image in held_out if _depth_of(image, source, listed) is not None]
    if not posed:
        return None
    mesh = read_ply(job.stage("mesh") / "mesh.ply")
    poses = np.asarray([image.world_from_camera for image in posed], np.float64)
    frame = SceneTransform.fit(poses[:, :, 3], scale_poses=False)
    caster = MeshCaster(frame.scene_from_world(mesh.points), mesh.faces, None)
    compared = Compared()
    for row, image in enumerate(posed):
        # Through the lens that measured depth was seen through, whatever the picture's is by now.
        lens = image.depth_lens or cameras.cameras[image.camera]
        view = cameras_at(lens, poses[row : row + 1], frame)
        found = caster.view(view, 0)
        path = _depth_of(image, source, listed)
        assert path is not None
        shape = (found.hit.shape[0], found.hit.shape[1])
        compared.truth.append(read_depth_png(path[0], path[1], shape))
        compared.found.append(found.z_depth(view, 0))
        compared.photos.append(_photo(job.images_root / image.file, shape))
    return {"depth": depth_scores(compared.found, compared.truth)}, compared


def depth_files(capture: Path) -> dict[str, tuple[Path, float]]:
    """By the picture's path in the capture: its depth picture, and world units per value."""
    listing = capture / "transforms.json"
    if not listing.is_file():
        return {}
    transforms = json.loads(listing.read_text("utf-8"))
    unit = float(transforms.get("depth_unit_scale_factor", 0.001))
    return {
        str(Path(frame["file_path"])): (capture / frame["depth_file_path"], unit)
        for frame in transforms["frames"]
        if frame.get("depth_file_path")
    }


def _depth_of(
    image: PosedImage, source: dict[str, str], listed: dict[str, tuple[Path, float]]
) -> tuple[Path, float] | None:
    name = source.get(image.file, "")
    return next((depth for path, depth in listed.items() if name.endswith(path)), None)


def _photo(path: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    with Image.open(path) as opened:
        return np.asarray(opened.convert("RGB").resize((shape[1], shape[0])))


def read_depth_png(path: Path, unit: float, shape: tuple[int, int]) -> NDArray[np.float32]:
    """A 16-bit one-channel PNG as z-depth [H, W] in world units, brought to `shape`, 0 for unknown.

    unit: world units per stored value, nerfstudio's `depth_unit_scale_factor`; 0.001 for
    millimetres. Each pixel takes the nearest stored value, as a mean across an edge lies on neither
    surface. Raises ValueError for what is no such picture.
    """
    try:
        with Image.open(path) as opened:
            mode, stored = opened.mode, np.asarray(opened)
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"{path.name} is no depth picture: {error}") from error
    if stored.ndim != 2 or mode == "L":
        raise ValueError(f"{path.name} is no 16-bit one-channel depth picture, but {mode}")
    return (nearest(stored, shape).astype(np.float64) * unit).astype(np.float32)
