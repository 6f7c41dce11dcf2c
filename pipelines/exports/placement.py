"""The frame that an export is asked for, and the way there from the world of `cameras.json`.

    gravity     that world itself: +Z up as far as the capture tells, in metres where it is metric
    source      the world that the capture's own poses are given in, where it brought some: what
                moved, turned and scaled them (notes.applied_transform, applied_scale) is undone.
                Poses that were found from pictures have no such world: it is as gravity
    normalised  up as in gravity; the origin where the cameras look, or else their mean; the largest
                coordinate of a camera is 1

All options of an export but its crop are in the world of `cameras.json`, and so is what it says of
itself beside `frame`. Float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ExportError
from pipelines.exports.crop import Crop
from pipelines.exports.frame import FROM_WORLD, WORLDS, Axis, Frame, FrameName, back_to_world
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.orientation import Similarity, normalise

Floats = NDArray[np.float64]
AnyMesh = TypeVar("AnyMesh", bound=TriangleMesh | TexturedMesh)

_NOT_RIGID = 1e-3
_TRANSFORM, _SCALE = "applied_transform", "applied_scale"


@dataclass(frozen=True)
class Placement:
    """name: of the frame. similarity: there from the world of cameras.json; None for no change.

    metric: whether its unit is a metre.
    """

    name: FrameName
    similarity: Similarity | None
    metric: bool

    def __post_init__(self) -> None:
        if self.similarity is not None and not np.isfinite(self._matrix()).all():
            raise ValueError("a frame is where numbers are finite")

    @property
    def scale(self) -> float:
        """Units of the frame in a unit of the world."""
        return 1.0 if self.similarity is None else self.similarity.scale

    def frame(self, up: Axis = "z") -> Frame:
        """The axes of a file in this frame."""
        if self.similarity is None:
            return Frame(up, self.metric)
        rows = tuple(tuple(map(float, row)) for row in self._matrix())
        return Frame(up, self.metric, WORLDS[self.name], rows)

    def points(self, points: Floats) -> Floats:
        """[P, 3] positions of the world, in the frame."""
        return points if self.similarity is None else self.similarity.apply_to_points(points)

    def directions(self, directions: Floats) -> Floats:
        """[P, 3] directions of the world, in the frame."""
        if self.similarity is None:
            return directions
        return self.similarity.apply_to_directions(directions)

    def mesh(self, mesh: AnyMesh) -> AnyMesh:
        """A mesh of the world, in the frame."""
        if self.similarity is None:
            return mesh
        vertices, normals = self.points(mesh.vertices), self.directions(mesh.normals)
        return replace(mesh, vertices=vertices, normals=normals)

    def crop(self, crop: Crop | None) -> Crop | None:
        """A crop of the frame, in the world."""
        if crop is None or self.similarity is None:
            return crop
        turn, scale = self.similarity.rotation, self.similarity.scale
        return Crop(
            center=(crop.center - self.similarity.translation) @ turn / scale,
            axes=turn.T @ crop.axes,
            half=crop.half / scale,
            radius=None if crop.radius is None else crop.radius / scale,
            frame_from_world=self.similarity,
        )

    def cameras(self, cameras: CamerasFile) -> CamerasFile:
        """Cameras of the world, in the frame. What moved their capture's own is adapted too."""
        if self.similarity is None:
            return cameras
        poses = np.asarray([image.world_from_camera for image in cameras.images], np.float64)
        images = tuple(
            replace(image, world_from_camera=tuple(tuple(map(float, row)) for row in pose))
            for image, pose in zip(
                cameras.images, self.similarity.apply_to_cameras(poses), strict=True
            )
        )
        notes = {
            key: cameras.notes[key] for key in cameras.notes if key not in (_TRANSFORM, _SCALE)
        }
        moved = _moved(cameras)
        if moved is not None and self.name != "source":
            rotation, shift, scale = moved
            whole = self.similarity.scale * scale
            turn = self.similarity.rotation
            place = turn @ shift + self.similarity.translation / whole
            notes[_TRANSFORM] = np.column_stack([turn @ rotation, place]).tolist()
            notes[_SCALE] = whole
        return replace(cameras, images=images, metric=self.metric, notes=notes)

    def as_dict(self) -> dict[str, Any]:
        """For the summary: from_world is [3, 4], x -> from_world[:, :3] @ x + from_world[:, 3]."""
        rows = self._matrix().tolist()
        return {"name": self.name, "metric": self.metric, FROM_WORLD: rows}

    def _matrix(self) -> Floats:
        """[3, 4] there from the world of cameras.json."""
        matrix = np.eye(3, 4)
        if self.similarity is not None:
            matrix[:, :3] = self.similarity.scale * self.similarity.rotation
            matrix[:, 3] = self.similarity.translation
        return matrix


def placement_of(name: FrameName, cameras: CamerasFile) -> Placement:
    """The way to a frame. cameras: of the world of `cameras.json`.

    Raises ExportError (frame_unknown) where what the capture says of its own world is no turn and
    shift.
    """
    if name == "normalised":
        poses = np.asarray([image.world_from_camera for image in cameras.images], np.float64)
        return Placement(name, normalise(poses, orient=False).similarity, metric=False)
    moved = _moved(cameras) if name == "source" else None
    if moved is None:
        return Placement(name, None, cameras.metric)
    rotation, shift, scale = moved
    back = Similarity(rotation.T, -rotation.T @ shift, 1.0 / scale)
    return Placement(name, back, cameras.metric and scale == 1.0)


def _moved(cameras: CamerasFile) -> tuple[Floats, Floats, float] | None:
    """What brought the capture's own world here: world = scale * (rotation @ own + shift)."""
    if _TRANSFORM not in cameras.notes and _SCALE not in cameras.notes:
        return None
    matrix = np.asarray(cameras.notes.get(_TRANSFORM, np.eye(3, 4)), np.float64)
    scale = float(cameras.notes.get(_SCALE, 1.0))
    rotation = matrix[:, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not off < _NOT_RIGID or np.linalg.det(rotation) < 0 or not 0 < scale < np.inf:
        raise ExportError(
            "The capture's own world cannot be told: its applied_transform is no turn and shift.",
            code="frame_unknown",
            hint="Take the frame gravity, which is the world of cameras.json.",
        )
    return rotation, matrix[:, 3], scale


def to_world(points: NDArray[np.floating[Any]], summary: Mapping[str, Any]) -> Floats:
    """[P, 3] points of an export's file in the world of cameras.json.

    summary: of the export, which says where it lies (`Placement.as_dict`).
    """
    matrix = summary.get("frame", {}).get(FROM_WORLD)
    return back_to_world(points, None if matrix is None else np.asarray(matrix, np.float64))
