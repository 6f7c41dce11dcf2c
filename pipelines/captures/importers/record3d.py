"""A Record3D export: "EXR + JPG" (`metadata.json`, `rgb/<n>.jpg`) or `.r3d` (`metadata`, `rgbd/`).

Frame number n belongs to `poses[n]`, whichever files are there; names sort as numbers. `K` is
column-major (fx 0 0 0 fy 0 cx cy 1), `perFrameIntrinsicCoeffs[n]` is (fx, fy, cx, cy), poses are
(qx, qy, qz, qw, tx, ty, tz), world_from_camera, OpenGL camera, ARKit's world (+Y up, metres).

The export's `depth/<n>.exr` holds metres along the camera's axis in its R channel, and comes
without confidence. That of an `.r3d` (`.depth`, `.conf`) is packed with LZFSE, and not read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import PurePosixPath
from typing import Any

from pipelines.captures.contents import PosedPictures, PosedSource, SensorDepth
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.parsing import (
    arkit_notes,
    each_frame,
    malformed,
    missing,
    number,
    numbers,
    resized,
    rotation_of,
    some_of,
    z_up_from_y_up,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics

_LAYOUTS = (("metadata.json", "rgb/"), ("metadata", "rgbd/"))
"""The file of poses and the folder of pictures beside it: of an export, and of an .r3d file."""

_DEPTH_FOLDER = "depth"
_METRE = 1.0


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
    files = _numbered(archive.images, root + folder.rstrip("/"))
    depths = _numbered(
        (name for name in archive.names if name.endswith(".exr")), f"{root}{_DEPTH_FOLDER}"
    )
    usable = sorted(n for n in files if n < len(poses))
    if not usable:
        raise missing("No picture of the export has a pose: their numbers do not meet.")
    sources, failures = each_frame(
        archive,
        {files[n]: n for n in usable},
        lambda name, n: _source(name, n, metadata, poses, depths.get(n)),
    )
    _set_aside(archive, sources, {depths[n] for n in usable if n in depths})
    return PosedPictures(
        sources=sources,
        failures=failures,
        metric=True,
        is_dense=True,
        notes=arkit_notes(),
        details={"num_poses": len(poses), "num_frames": len(files)},
        warnings=_gaps(files, len(poses)) + _without_depth(usable, depths),
    )


def _set_aside(archive: CaptureArchive, sources: Sequence[PosedSource], paired: set[str]) -> None:
    """Say of depth beside that of the sources why it is not used."""
    packed = [name for name in archive.names if name.endswith((".depth", ".conf"))]
    archive.set_aside(
        packed, 'depth packed with LZFSE (.r3d) is not read; the export "EXR + JPG" brings it'
    )
    others = [name for name in archive.names - paired if name.endswith(".exr")]
    archive.set_aside(others, "no picture that is used goes with them")
    kept = {name for source in sources for name in source.depth_files}
    archive.set_aside(paired - kept, "their pictures are left out")


def _without_depth(usable: Sequence[int], depths: dict[int, str]) -> list[str]:
    """A warning where some pictures have depth, and others have none."""
    lost = [str(n) for n in usable if n not in depths]
    if not lost or len(lost) == len(usable):
        return []
    return [f"{len(lost)} of {len(usable)} pictures have no depth map: {some_of(lost)}."]


def _numbered(names: Iterable[str], folder: str) -> dict[int, str]:
    """The files of a folder by their number; copies such as `123(3).jpg` are no frames."""
    found: dict[int, str] = {}
    for name in names:
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


def _source(
    name: str, n: int, metadata: dict[str, Any], poses: list[Any], depth: str | None
) -> PosedSource:
    what = f"frame {n}"
    qx, qy, qz, qw, *position = numbers(poses[n], 7, f"The pose of {what}")
    rotation = rotation_of((qx, qy, qz, qw), what)
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
        depth=None if depth is None else SensorDepth(depth, _METRE),
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
