"""What an importer's reader gives: which files of an archive are pictures, and what is known of
each. Standard library only.

World frame: right-handed, +Z up. Camera frame: OpenGL (+X right, +Y up, looks along -Z).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics

Rows = tuple[tuple[float, ...], ...]
"""A matrix [3, 4]: rotation and position, row-major."""


@dataclass(frozen=True)
class Photos:
    """Pictures whose poses are to be found. names: in the archive, those that may be photos."""

    names: Sequence[str]


@dataclass(frozen=True)
class PosedSource:
    """One picture of the archive that has a pose.

    name: in the archive. lens: gives the intrinsics for the picture's real width and height.
    world_from_camera: rows [3, 4] of finite numbers; whether they are a pose is checked later.
    mask: a picture in the archive, black where the picture is to be ignored, or None.
    """

    name: str
    lens: Callable[[int, int], Intrinsics]
    world_from_camera: Rows
    timestamp_s: float | None = None
    mask: str | None = None


@dataclass(frozen=True)
class PosedPictures:
    """A capture that brings its poses.

    sources: in the order of the capture. failures: why frames beside those cannot be used, one
    error for each; few are passed over, many fail the capture.
    metric: whether the world's unit is the metre. is_dense: whether neighbours are so alike that a
    long capture may be thinned. notes: about the world, for `cameras.json`. details, warnings: for
    the record.
    """

    sources: Sequence[PosedSource]
    metric: bool
    failures: Sequence[CaptureError] = ()
    is_dense: bool = False
    notes: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()


Contents = Photos | PosedPictures
