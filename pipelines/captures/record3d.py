"""A Record3D export: "EXR + RGB" (`metadata.json`, `rgb/<n>.jpg`) or `.r3d` (`metadata`, `rgbd/`).

Frame number n belongs to `poses[n]`, whichever files are there; names sort as numbers. `K` is
column-major (fx 0 0 0 fy 0 cx cy 1), `perFrameIntrinsicCoeffs[n]` is (fx, fy, cx, cy), poses are
(qx, qy, qz, qw, tx, ty, tz), world_from_camera, OpenGL camera, ARKit's world (+Y up, metres).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pipelines.cameras_file import Intrinsics
from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.pictures import evenly_picked
from pipelines.captures.posed import (
    Matrix,
    PosedSource,
    malformed,
    missing,
    number,
    numbers,
    resized,
    some_of,
    write_posed,
    z_up_from_y_up,
)
from pipelines.captures.record import Found
from pipelines.captures.unpack import CaptureArchive
from pipelines.options import IngestOptions
from pipelines.stage import StageContext


def read(path: Path, root: str, options: IngestOptions, ctx: StageContext) -> Found:
    """Write `images/` and `cameras.json` from the export that starts at `root` in the archive.

    Raises CaptureError: poses_missing, poses_malformed, and those of `write_posed`.
    """
    limits = ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes)
    with CaptureArchive(path, limits) as archive:
        is_r3d = root + "metadata.json" not in archive.names
        metadata = archive.read_json(root + ("metadata" if is_r3d else "metadata.json"))
        if not isinstance(metadata, dict):
            raise malformed("The export's metadata is not an object.")
        poses = metadata.get("poses")
        if not isinstance(poses, list) or not poses:
            raise missing("The export's metadata has no poses.")
        files = _numbered(archive, root + ("rgbd" if is_r3d else "rgb"))
        usable = sorted(n for n in files if n < len(poses))
        if not usable:
            raise missing("No picture of the export has a pose: their numbers do not meet.")
        warnings = _gaps(files, len(poses))
        picked = [usable[i] for i in evenly_picked(len(usable), options.max_posed_images)]
        sources = [_source(files[n], n, metadata, poses) for n in picked]
        found = write_posed(
            archive,
            sources,
            ctx,
            options,
            source="record3d",
            metric=True,
            notes={"world": "ARKit, turned to +Z up"},
        )
    return Found(
        images=found.images,
        details={**found.details, "num_poses": len(poses), "num_frames": len(files)},
        warnings=warnings + found.warnings,
    )


def _numbered(archive: CaptureArchive, folder: str) -> dict[int, str]:
    """The pictures by their number; copies such as `123(3).jpg` are no frames."""
    found: dict[int, str] = {}
    for name in archive.images:
        path = PurePosixPath(name)
        if str(path.parent) == folder and re.fullmatch(r"[0-9]{1,9}", path.stem):
            found[int(path.stem)] = name
    return found


def _gaps(files: dict[int, str], num_poses: int) -> list[str]:
    warnings = []
    without_file = [str(n) for n in range(num_poses) if n not in files]
    without_pose = [name for n, name in files.items() if n >= num_poses]
    if without_file:
        warnings.append(f"{len(without_file)} poses have no picture: {some_of(without_file)}.")
    if without_pose:
        warnings.append(f"{len(without_pose)} pictures have no pose: {some_of(without_pose)}.")
    return warnings


def _source(name: str, n: int, metadata: dict[str, Any], poses: list[Any]) -> PosedSource:
    what = f"frame {n}"
    qx, qy, qz, qw, *position = numbers(poses[n], 7, f"The pose of {what}")
    pose = np.concatenate([_rotation((qx, qy, qz, qw), what), np.array(position)[:, None]], axis=1)
    times = metadata.get("frameTimestamps")
    timestamp = None
    if isinstance(times, list) and n < len(times):
        timestamp = number(times[n], f"The time of {what}")
    return PosedSource(
        name=name,
        lens=partial(resized, _lens(n, metadata)),
        world_from_camera=z_up_from_y_up(pose),
        timestamp_s=timestamp,
    )


def _rotation(quaternion: Sequence[float], what: str) -> Matrix:
    """The rotation of a quaternion (x, y, z, w) of any length but zero. [3, 3]"""
    length = math.sqrt(sum(value * value for value in quaternion))
    if not 0.5 < length < 2.0:
        raise malformed(f"The pose of {what} has no rotation.")
    x, y, z, w = (value / length for value in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _lens(n: int, metadata: dict[str, Any]) -> Intrinsics:
    """The intrinsics of frame n: its own where the export has them, else `K`."""
    per_frame = metadata.get("perFrameIntrinsicCoeffs")
    if isinstance(per_frame, list) and n < len(per_frame):
        fx, fy, cx, cy = numbers(per_frame[n], 4, f"The intrinsics of frame {n}")
    else:
        k = numbers(metadata.get("K"), 9, "K in the export's metadata")
        fx, fy, cx, cy = k[0], k[4], k[6], k[7]
    return Intrinsics(
        width=round(number(metadata.get("w"), "w in the export's metadata")),
        height=round(number(metadata.get("h"), "h in the export's metadata")),
        fl_x=fx,
        fl_y=fy,
        cx=cx,
        cy=cy,
    )
