"""The world of a posed capture: which way is up in it, and whether its origin is anywhere near.

Later stages want +Z up, and hold poses in float32: a world in map coordinates, 5,000 km from its
origin, would lose half a metre there. What is moved is written down (`applied_transform`, as
nerfstudio calls it), and told. Everything here is float64.

Symbols: N cameras, `world_from_camera` [N, 3, 4], OpenGL axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.captures.attitude import VIEWED, Direction
from pipelines.captures.contents import Up
from pipelines.scene.orientation import find_up, rotation_to_z

Matrix = npt.NDArray[np.float64]

_CLEARLY = 0.8
"""Cosine up to which an axis of the world is the vertical, and nothing else is."""
_SIDEWAYS = 0.7
"""Mean height of the cameras' X axes above which pictures may be upright ones stored sideways."""
_LEANS = {"measured": 0.94, "vertical": 0.94, "sideways": 0.94, "camera_up": 0.5}
"""Cosine between +Z and the vertical, by how that was found, below which a world without a known
one is turned. A world that stands already, as one that we wrote, stays as it is."""
_FAR = 100.0
"""How many times the cameras' extent the origin may be away."""


@dataclass(frozen=True)
class Move:
    """x -> rotation @ x + shift. rotation: [3, 3]. shift: [3]. notes: those of the world, with what
    was done to it. warnings: what is to be told."""

    rotation: Matrix
    shift: Matrix
    notes: dict[str, Any]
    warnings: list[str]

    def poses(self, world_from_camera: Matrix) -> Matrix:
        """[N, 3, 4] in the old world, to the new one."""
        moved: Matrix = self.rotation @ world_from_camera
        moved[:, :, 3] += self.shift
        return moved

    def points(self, points: Matrix) -> Matrix:
        """[P, 3] in the old world, to the new one."""
        moved: Matrix = points @ self.rotation.T + self.shift
        return moved


def settled(
    world_from_camera: Matrix,
    orientations: Sequence[int | None],
    up: Up,
    notes: Mapping[str, Any],
    measured: Sequence[Direction | None] = (),
) -> Move:
    """How a world is to be moved; not at all where nothing asks for it.

    orientations: N, EXIF's, of the pixels as stored. up: what is known of the world's vertical.
    measured: N, which way was up in each picture as it is viewed, where its device told that.
    notes: of the world as it came; `applied_transform` and `applied_scale` of it are heeded.
    """
    told: list[str] = []
    changed = dict(notes)
    rotation = np.eye(3)
    if up == "assumed" and (found := other_axis_up(world_from_camera)) is not None:
        axis, rotation = found
        changed["up"] = axis
        told.append(f"In the pictures {axis} of the file's world is up, not +Z: it was turned.")
    elif up == "unknown":
        vertical, found_by = find_up(as_viewed(world_from_camera, orientations), measured)
        changed["up_from"] = found_by
        if vertical[2] < _LEANS[found_by]:
            rotation = rotation_to_z(vertical)
    centers = world_from_camera[:, :, 3] @ rotation.T
    middle = centers.mean(axis=0)
    extent = float(np.linalg.norm(centers - middle, axis=1).max(initial=0.0))
    shift = np.zeros(3)
    away = float(np.linalg.norm(middle))
    if away > _FAR * extent > 0.0:
        shift = -middle
        told.append(
            f"The cameras are {away:.4g} units from the world's origin, as map coordinates are: "
            "it was moved among them, and cameras.json says by how much (applied_transform)."
        )
    if shift.any() or not np.array_equal(rotation, np.eye(3)):
        before = np.array(changed.get("applied_transform", np.eye(3, 4).tolist()), np.float64)
        after = rotation @ before
        after[:, 3] += shift / float(changed.get("applied_scale", 1.0))
        changed["applied_transform"] = after.tolist()
    return Move(rotation, shift, changed, told)


def as_viewed(world_from_camera: Matrix, orientations: Sequence[int | None]) -> Matrix:
    """The poses of the pictures as people see them: turned by what EXIF says of each. [N, 3, 4]."""
    turned = world_from_camera.copy()
    for index, orientation in enumerate(orientations):
        if orientation in VIEWED:
            axes = np.array(VIEWED[orientation])
            turned[index, :, :2] = world_from_camera[index, :, :2] @ axes
    return turned


def other_axis_up(poses: Matrix) -> tuple[str, Matrix] | None:
    """The axis of a world that is up in its pictures, and the quarter turn that makes it +Z.

    poses: [N, 3, 4], OpenGL cameras. None where that is +Z, and where it is not clear: of an arc
    pictures stored on their side may have level X axes in a world that lies.
    """
    up, found_by = find_up(poses)
    axis = int(np.abs(up).argmax())
    stored_so = float(np.abs(poses[:, 2, 0]).mean()) > _SIDEWAYS
    clear = found_by == "sideways" or (found_by == "vertical" and not stored_so)
    if not clear or abs(up[axis]) < _CLEARLY or up[2] >= _CLEARLY:
        return None
    direction = np.zeros(3)
    direction[axis] = np.sign(up[axis])
    return f"{'+' if direction[axis] > 0 else '-'}{'XYZ'[axis]}", rotation_to_z(direction)
