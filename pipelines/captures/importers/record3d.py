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
from pathlib import PurePosixPath
from typing import Any

from pipelines.captures.contents import PosedPictures, PosedSource, Rows
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.parsing import (
    each_frame,
    malformed,
    missing,
    number,
    numbers,
    resized,
    some_of,
    z_up_from_y_up,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics

_LAYOUTS = (("metadata.json", "rgb/"), ("metadata", "rgbd/"))
"""The file of poses and the folder of pictures beside it: of an export, and of an .r3d file."""


def claims(listing: Listing) -> Claim | None:
    """An archive with the metadata beside the folder of pictures."""
    for file, folder in _LAYOUTS:
        for root in listing.roots_of(file):
            if listing.has_pictures_below(root + folder):
                return Claim(root, f"{file} beside {folder}")
    return None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The numbered pictures that have a pose.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    root = claim.root
    file, folder = next(
        layout for layout in _LAYOUTS if claim.why == f"{layout[0]} beside {layout[1]}"
    )
    metadata = archive.read_json(root + file)
    if not isinstance(metadata, dict):
        raise malformed("The export's metadata is not an object.")
    poses = metadata.get("poses")
    if not isinstance(poses, list) or not poses:
        raise missing("The export's metadata has no poses.")
    files = _numbered(archive, root + folder.rstrip("/"))
    usable = sorted(n for n in files if n < len(poses))
    if not usable:
        raise missing("No picture of the export has a pose: their numbers do not meet.")
    depth = [name for name in archive.names if name.endswith((".exr", ".depth", ".conf"))]
    archive.set_aside(depth, "the phone's depth is not read")
    sources, failures = each_frame(
        archive,
        {files[n]: n for n in usable},
        lambda name, n: _source(name, n, metadata, poses),
    )
    return PosedPictures(
        sources=sources,
        failures=failures,
        metric=True,
        is_dense=True,
        notes={"world": "ARKit, turned to +Z up"},
        details={"num_poses": len(poses), "num_frames": len(files)},
        warnings=_gaps(files, len(poses)),
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
    rotation = _rotation((qx, qy, qz, qw), what)
    pose = tuple((*row, place) for row, place in zip(rotation, position, strict=True))
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


def _rotation(quaternion: Sequence[float], what: str) -> Rows:
    """The rotation of a quaternion (x, y, z, w) of any length but zero. Rows [3, 3]."""
    length = math.sqrt(sum(value * value for value in quaternion))
    if not 0.5 < length < 2.0:
        raise malformed(f"The pose of {what} has no rotation.")
    x, y, z, w = (value / length for value in quaternion)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
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


IMPORTER = Importer(
    kind="record3d",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.record3d:read",
)
