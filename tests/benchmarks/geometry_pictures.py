"""Pictures of a job's geometry: depth beside the truth, and a turntable of the mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats.glb import read_mesh
from pipelines.exports.mesh import TexturedMesh
from pipelines.judging.asset_views import Texture
from pipelines.judging.depth_scores import known
from pipelines.nerf.judging.off_path import evenly
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.focus import find_focus
from pipelines.workspace import Workspace
from tests.benchmarks.geometry_truth import Compared
from tests.benchmarks.turntable import turntable

NUM_SHOWN = 4
SHOWN_DISTANCE = 0.6
"""Around what cameras look at, a turntable shows this part of their distance to it."""
FULL_ERROR = 0.10
"""Relative error shown in full red."""
_STOPS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_COLORS = np.array(
    [[253, 231, 37], [94, 201, 98], [33, 145, 140], [59, 82, 139], [68, 1, 84]], np.float64
)


def depth_picture(depth: NDArray[np.floating], near: float, far: float) -> NDArray[np.uint8]:
    """[H, W, 3]: near yellow, far violet, black where nothing is known."""
    share = np.clip((depth - near) / max(far - near, 1e-9), 0.0, 1.0)
    color = np.stack([np.interp(share, _STOPS, _COLORS[:, k]) for k in range(3)], axis=-1)
    color[~known(depth)] = 0.0
    return np.rint(color).astype(np.uint8)


def error_picture(found: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[H, W, 3]: white right, red too near, blue too far, black missing, grey no truth."""
    there, asked = known(found), known(truth)
    off = np.where(there & asked, (found - truth) / np.where(asked, truth, 1.0), 0.0)
    strength = np.clip(np.abs(off) / FULL_ERROR, 0.0, 1.0)[..., None]
    wrong = np.where(off[..., None] < 0, [220.0, 30.0, 30.0], [30.0, 60.0, 220.0])
    color = 255.0 * (1 - strength) + wrong * strength
    color[~there] = 0.0
    color[~asked] = 110.0
    return np.rint(color).astype(np.uint8)


def save_depths(compared: Compared, path: Path) -> None:
    """A row for some of the views: photo | true depth | the mesh's depth | error."""
    rows = []
    for index in evenly(len(compared.truth), NUM_SHOWN):
        truth, found = compared.truth[index], compared.found[index]
        values = truth[known(truth)]
        if not len(values):
            continue
        near, far = np.percentile(values, (1, 99))
        parts = [
            compared.photos[index],
            depth_picture(truth, near, far),
            depth_picture(found, near, far),
            error_picture(found, truth),
        ]
        rows.append(np.concatenate(parts, axis=1))
    widest = max((row.shape[1] for row in rows), default=0)
    padded = [np.pad(row, ((0, 0), (0, widest - row.shape[1]), (0, 0))) for row in rows]
    if padded:
        Image.fromarray(np.concatenate(padded)).save(path)


def save_turntable(job: Workspace, path: Path) -> None:
    """Draft and delivered mesh all round, coloured and shaded; of a subject what is near it."""
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    poses = np.asarray([image.world_from_camera for image in cameras.images], np.float64)
    focus = find_focus(poses)
    ball = None
    if focus is not None:
        distance = float(np.linalg.norm(poses[:, :, 3] - focus, axis=1).mean())
        ball = (focus, SHOWN_DISTANCE * distance)
    strips = []
    for file in (job.stage("draft") / "draft.glb", job.stage("mesh") / "mesh.glb"):
        if not file.exists():
            continue
        mesh = read_mesh(file)
        paint = Texture(mesh.uv, mesh.texture) if isinstance(mesh, TexturedMesh) else mesh.colors
        strips.append(turntable(mesh.vertices, mesh.faces, paint, ball=ball))
    Image.fromarray(np.concatenate(strips)).save(path)
