"""3D Scanner App's "All Data" export: ARKit's pictures, poses and depth, all in one folder.

    frame_00000.jpg    every third frame or so has one    info.json    thumb_00000.jpg
    frame_00000.json   every frame: cameraPoseARFrame (16 numbers, row-major world_from_camera),
                       intrinsics (9, row-major), projectionMatrix (16, row-major), time
    depth_00000.png    every frame: 16 bits, millimetres along the camera's axis, 0 where unknown
    conf_00000.png     every frame: 8 bits, the size of the depth: 0, 1 or 2, as ARKit rates it

Phones without LiDAR write no depth. World: ARKit's, metres, +Y up; turned to +Z up here. Pixel
centres of `intrinsics` are at integers, in an image whose size only `projectionMatrix` tells: with
half a pixel added both say the same lens, in every frame of a real export (app 1.9.7). Only depth
of the highest confidence is kept, as for Polycam. Where the phone was (latitude, longitude) is not
read: it knows that to 20 m, and no result has a use for it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, Rows, SensorDepth
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.parsing import (
    arkit_notes,
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

_MILLIMETRE = 0.001
_CONFIDENT = 2
_PIXEL_CENTRE = 0.5
_SAME_ASPECT = 0.02
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
_SLACK = 1e-3
"""How far the last row of a matrix may be from its place; the app writes floats of 32 bits."""
_WITNESSES = ("info.json", "depth_", "conf_")
"""One of these lies beside the frames of this app: others call pictures and JSON files so too."""


def claims(listing: Listing) -> Claim | None:
    """A folder where `frame_<n>` is a picture and a JSON file, with a file of this app beside."""
    witnessed = {
        _folder(name) for name in listing.heads if name.rpartition("/")[2].startswith(_WITNESSES)
    }
    roots = {
        folder
        for name in listing.pictures
        if (folder := _folder(name)) in witnessed
        and (n := _number(name, "frame_"))
        and f"{folder}frame_{n}.json" in listing.heads
    }
    if not roots:
        return None
    root = min(roots, key=lambda root: (root.count("/"), root))
    return Claim(root, "frame_<n>.json beside frame_<n>.jpg")


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The frames that have a picture and a pose, with depth where they have some.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    pictures = _numbered(archive.images, claim.root, "frame_")
    poses = _numbered(_ending(archive.names, ".json"), claim.root, "frame_")
    maps = _numbered(_ending(archive.names, ".png"), claim.root, "depth_")
    ratings = _numbered(_ending(archive.names, ".png"), claim.root, "conf_")
    usable = sorted(pictures.keys() & poses.keys())
    if not usable:
        raise missing("No picture of the export has a file with its pose.")
    depths = {
        n: SensorDepth(maps[n], _MILLIMETRE, ratings.get(n), _CONFIDENT)
        for n in usable
        if n in maps
    }
    sources, failures = each_frame(
        archive,
        {pictures[n]: n for n in usable},
        lambda name, n: _source(archive, name, poses[n], depths.get(n)),
    )
    _set_aside(archive, claim.root, sources, usable)
    return PosedPictures(
        sources=sources,
        failures=failures,
        metric=True,
        is_dense=True,
        notes=arkit_notes(),
        details={"num_poses": len(poses), "num_frames": len(pictures)},
        warnings=_gaps(pictures, poses) + _without_depth(usable, depths),
    )


def _folder(name: str) -> str:
    return name[: name.rfind("/") + 1]


def _number(name: str, prefix: str) -> str:
    """The digits of a file called `<prefix><digits>.<suffix>`; "" for any other."""
    found = re.fullmatch(rf"{prefix}([0-9]{{1,9}})\.[A-Za-z]+", name.rpartition("/")[2])
    return found[1] if found else ""


def _numbered(names: Iterable[str], root: str, prefix: str) -> dict[int, str]:
    """Files of the folder `root` by their number."""
    return {
        int(digits): name
        for name in sorted(names)
        if _folder(name) == root and (digits := _number(name, prefix))
    }


def _ending(names: Iterable[str], suffix: str) -> list[str]:
    return [name for name in names if name.endswith(suffix)]


def _set_aside(
    archive: CaptureArchive, root: str, sources: Sequence[PosedSource], usable: Sequence[int]
) -> None:
    """Say why files of the export beside those of the sources are not used."""
    kept = {name for source in sources for name in source.depth_files}
    for prefix in ("frame_", "depth_", "conf_"):
        beside = _numbered(archive.names - archive.images, root, prefix)
        if prefix != "frame_":
            beside = _numbered(archive.names - kept, root, prefix)
        archive.set_aside(
            [name for n, name in beside.items() if n not in set(usable)],
            "the app keeps a picture of some frames only, and these have none",
        )
        archive.set_aside(beside.values(), "their pictures are left out")
    archive.told(_numbered(archive.images, root, "thumb_").values())
    archive.told({root + "info.json"} & archive.names)


def _gaps(pictures: Mapping[int, str], poses: Mapping[int, str]) -> list[str]:
    lost = [name for n, name in pictures.items() if n not in poses]
    return [f"{len(lost)} pictures have no pose: {some_of(lost)}."] if lost else []


def _without_depth(usable: Sequence[int], depths: Mapping[int, SensorDepth]) -> list[str]:
    """Warnings where some pictures have depth or confidence, and others have none."""
    warnings = []
    lost = [str(n) for n in usable if n not in depths]
    if depths and lost:
        warnings.append(
            f"{len(lost)} of {len(usable)} pictures have no depth map: {some_of(lost)}."
        )
    unrated = [depth.name for depth in depths.values() if depth.confidence is None]
    if unrated:
        warnings.append(
            f"{len(unrated)} of {len(depths)} depth maps have no confidence map, and are used "
            f"whole: {some_of(unrated)}."
        )
    return warnings


def _source(
    archive: CaptureArchive, name: str, file: str, depth: SensorDepth | None
) -> PosedSource:
    what = f'"{shown(file)}"'
    values = archive.read_json(file)
    if not isinstance(values, dict):
        raise malformed(f"{what} is not a frame.")
    pose = _matrix(values.get("cameraPoseARFrame"), f"cameraPoseARFrame of {what}")
    time = values.get("time")
    return PosedSource(
        name=name,
        lens=partial(_lens, values, what),
        world_from_camera=z_up_from_y_up(pose[:3]),
        timestamp_s=None if time is None else number(time, f"time of {what}"),
        depth=depth,
    )


def _matrix(values: Any, what: str) -> Rows:
    """16 numbers as rows [4, 4] of a rigid move. Raises CaptureError poses_malformed.

    A last row that is another says that the numbers are column-major.
    """
    listed = numbers(values, 16, what)
    rows = tuple(tuple(listed[at : at + 4]) for at in range(0, 16, 4))
    if any(abs(a - b) > _SLACK for a, b in zip(rows[3], _LAST_ROW, strict=True)):
        raise malformed(f"{what} has no last row 0 0 0 1.")
    return rows


def _lens(values: Mapping[str, Any], what: str, width: int, height: int) -> Intrinsics:
    """The intrinsics for a picture that really is `width` x `height`.

    Raises CaptureError poses_malformed.
    """
    k = numbers(values.get("intrinsics"), 9, f"intrinsics of {what}")
    if max(abs(k[6]), abs(k[7]), abs(k[8] - 1.0)) > _SLACK:
        raise malformed(f"intrinsics of {what} has no last row 0 0 1.")
    stated = width, height
    if "projectionMatrix" in values:
        stated = _stated_size(values["projectionMatrix"], k, what, stated)
    lens = Intrinsics(
        width=stated[0],
        height=stated[1],
        fl_x=k[0],
        fl_y=k[4],
        cx=k[2] + _PIXEL_CENTRE,
        cy=k[5] + _PIXEL_CENTRE,
    )
    return resized(lens, width, height)


def _stated_size(
    projection: Any, k: Sequence[float], what: str, size: tuple[int, int]
) -> tuple[int, int]:
    """Width and height of the image that the intrinsics `k` are for.

    The projection scales a picture's half sides to 1. Where it is for another view than the picture
    of this `size`, a screen held upright, it says nothing of the picture.
    """
    p = numbers(projection, 16, f"projectionMatrix of {what}")
    if not (p[0] > _SLACK and p[5] > _SLACK and k[0] > 0 and k[4] > 0):
        raise malformed(f"projectionMatrix or intrinsics of {what} is not one of a camera.")
    width, height = 2.0 * k[0] / p[0], 2.0 * k[4] / p[5]
    if min(width, height) < 1 or abs(width * size[1] / (height * size[0]) - 1) > _SAME_ASPECT:
        return size
    return round(width), round(height)


IMPORTER = Importer(
    kind="3dscannerapp",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.scanner_app:read",
)
