"""The world that a capture's poses came in: `ingest` turns, moves and scales it, and notes that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.captures.world import Move, settled

Floats = NDArray[np.float64]

_NOT_RIGID = 1e-3
_TURNED = "up"
"""What `ingest` notes where it turned a world for how its pictures look: by poses as they were
written."""


@dataclass(frozen=True)
class SentWorld:
    """world = rotation @ sent + shift, where the unit is already that of the world.

    notes: of cameras.json.
    """

    rotation: Floats
    shift: Floats
    notes: Mapping[str, Any]

    @classmethod
    def of(cls, notes: Mapping[str, Any]) -> SentWorld:
        """By what cameras.json notes."""
        applied = np.array(notes.get("applied_transform", np.eye(3, 4).tolist()), np.float64)
        shift = float(notes.get("applied_scale", 1.0)) * applied[:, 3]
        return cls(applied[:, :3], shift, notes)

    @property
    def is_rigid(self) -> bool:
        """Whether that is a turn and a shift, so that it can be undone."""
        off = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        return bool(off < _NOT_RIGID and np.linalg.det(self.rotation) > 0.0)

    def sent(self, poses: Floats) -> Floats:
        """Poses [N, 3, 4] of the world, in the one that they came in, but for its unit."""
        found: Floats = self.rotation.T @ poses
        found[:, :, 3] -= self.rotation.T @ self.shift
        return found

    def settle(self, poses: Floats) -> Move:
        """How the world that they came in is to be moved, for poses [N, 3, 4] in it, OpenGL axes.

        As `ingest` did, unless it did so because of how the pictures looked by other poses.
        """
        notes = dict(self.notes)
        if notes.pop(_TURNED, None) is not None:
            notes.pop("applied_transform", None)
            return settled(poses, [None] * len(poses), "assumed", notes)
        as_before = Move(self.rotation, self.shift, notes, [])
        again = settled(as_before.poses(poses), [None] * len(poses), "assumed", notes)
        rotation = again.rotation @ self.rotation
        return Move(rotation, again.rotation @ self.shift + again.shift, again.notes, [])
