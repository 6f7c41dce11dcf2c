"""A capture with given poses beside pictures of a room whose true poses are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from pipelines.options import PosesOptions
from pipelines.sample.align import path_extent, similarity
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.scene.sensor_depth import save_sensor_depth
from pipelines.stage import StageContext
from pipelines.workspace import Workspace
from tests.unit.pipelines.sfm.synthetic_room import FOCAL, HEIGHT, WIDTH, arc_poses

NUM, FEW = 16, 7
TRUTH = arc_poses(NUM)
EXTENT = path_extent(TRUTH[:, :, 3])
OPTIONS = PosesOptions(num_features=1500, max_image_px=400, upsample="off", num_threads=2)
Poses = np.ndarray


def drifted(centers: float = 0.015, turns_deg: float = 1.0) -> Poses:
    """The truth, off by up to so much of its extent and so many degrees, smoothly along the way."""
    along = np.linspace(0.0, 2 * np.pi, NUM)
    waves = np.stack([np.sin(along), np.cos(1.3 * along + 1.0), np.sin(0.7 * along + 2.0)], 1)
    poses = TRUTH.copy()
    poses[:, :, :3] = (
        Rotation.from_rotvec(np.radians(turns_deg) * waves[:, ::-1]).as_matrix() @ (TRUTH[:, :, :3])
    )
    poses[:, :, 3] += centers * EXTENT * waves
    return poses


def context(
    root: Path,
    poses: Poses,
    pictures: list[Image.Image],
    *,
    depth: float = 0.0,
    metric: bool = True,
    focal: float = FOCAL,
    depth_focal: float = FOCAL,
    is_stated: bool = False,
    **more: Any,
) -> StageContext:
    """A capture as `ingest` leaves it. depth: with a sensor's depth, of that scale. metric: whether
    its poses are in metres. focal: what it says of its lens. depth_focal: of the depth's, which it
    says as well if `is_stated`."""
    folder = Workspace(root).stage("ingest")
    (folder / "images").mkdir(parents=True)
    (folder / "depth").mkdir()
    lens = Intrinsics(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2)
    images = []
    for index, (pose, picture) in enumerate(zip(poses, pictures, strict=True)):
        file, depth_file = f"images/{index:05d}.jpg", f"depth/{index:05d}.npz"
        picture.save(folder / file, quality=95)
        if depth:
            z = depth * true_depth(TRUTH[index], depth_focal)
            save_sensor_depth(folder / depth_file, z.astype(np.float32))
        rows = tuple(tuple(float(value) for value in row) for row in pose)
        own = replace(lens, fl_x=depth_focal, fl_y=depth_focal) if is_stated else None
        images.append(
            PosedImage(file, 0, rows, depth=depth_file if depth else None, depth_lens=own)
        )
    CamerasFile((lens,), tuple(images), metric=metric, source="nerfstudio").save(
        folder / "cameras.json"
    )
    out = root / ".partial" / "poses"
    out.mkdir(parents=True)
    return StageContext("poses", Workspace(root), out, Workspace(root).checkpoint("poses"), **more)


def true_depth(pose: Poses, focal: float = FOCAL) -> np.ndarray:
    """[75, 100] of the room, along the camera's axis."""
    u, v = np.meshgrid((np.arange(100) + 0.5) * 4, (np.arange(75) + 0.5) * 4)
    local = np.stack(
        [(u - WIDTH / 2) / focal, -(v - HEIGHT / 2) / focal, -np.ones_like(u)], axis=-1
    )
    rays = local @ pose[:, :3].T
    with np.errstate(divide="ignore"):
        return np.where(rays < 0, -pose[:, 3] / rays, np.inf).min(axis=-1)


def found(ctx: StageContext) -> Poses:
    images = CamerasFile.load(ctx.out / "cameras.json").images
    return np.array([image.world_from_camera for image in images])


def errors(poses: Poses) -> tuple[float, float]:
    """Of centres, as a share of the extent, and of turns in degrees, means after the best
    similarity."""
    truth = TRUTH[: len(poses)]
    move = similarity(poses[:, :, 3], truth[:, :, 3])
    centers = np.linalg.norm(move.apply_to_points(poses[:, :, 3]) - truth[:, :, 3], axis=1)
    turned = move.apply_to_cameras(poses)[:, :, :3]
    cosines = ((turned * truth[:, :, :3]).sum((1, 2)) - 1) / 2
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return float(centers.mean() / EXTENT), float(angles.mean())


def assert_as_given(ctx: StageContext) -> None:
    given_bytes = (ctx.workspace.stage("ingest") / "cameras.json").read_bytes()
    assert (ctx.out / "cameras.json").read_bytes() == given_bytes


def codes(summary: dict[str, Any]) -> list[str]:
    return [warning["code"] for warning in summary["warnings"]]
