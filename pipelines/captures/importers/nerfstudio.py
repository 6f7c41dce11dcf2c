"""nerfstudio's layout: `transforms.json` and the pictures that it names.

Keys: `pipelines.captures.transforms_json`; at the top also applied_transform, applied_scale.

The file's world is kept as it is and taken as +Z up, unless the pictures clearly say that another
of its axes is, and `orientation_override` does not forbid a turn: +Z is nerfstudio's own
convention, and what `applied_transform` has led to. That, a turn in it, and `applied_scale` are
written down in the notes. Nothing says that its unit is the metre, also where there is depth, but
for `metric`, which our own exports of metric worlds have.

KIRI Engine writes this layout as it is. NeRFCapture does too, and says more than it writes: its
files alone have `depth_integer_scale`, and then the world is ARKit's, metres, +Y up, and pixel
centres are at integers. The depth it keeps beside its pictures has four channels of 8 bits, or is
not there at all: it is not used. No real export of either was at hand: of NeRFCapture's the public
source was, of KIRI's nerfstudio's word.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pipelines.captures.contents import PosedPictures, PosedSource
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.named_files import NamedFiles
from pipelines.captures.parsing import arkit_notes, malformed, number, numbers, z_up_from_y_up
from pipelines.captures.transforms_json import (
    LARGEST,
    Values,
    read_frames,
    read_transforms,
    told_of_motion,
)
from pipelines.captures.unpack import CaptureArchive

_FILE = "transforms.json"
_ORIENTATION = "orientation_override"
"""Of nerfstudio: how to turn the world; "none" says that it is upright as it is."""
_OF_NERFCAPTURE = "depth_integer_scale"
_METRIC = "metric"
_PIXEL_CENTRE = 0.5
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")


def claims(listing: Listing) -> Claim | None:
    """An archive with pictures and a `transforms.json`, the least deep one."""
    roots = listing.roots_of(_FILE) if listing.pictures else []
    return Claim(roots[0], _FILE) if roots else None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures that are listed and there.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    top, frames = read_transforms(archive, claim.root + _FILE)
    is_arkit = _OF_NERFCAPTURE in top
    if is_arkit:
        top, frames = _centred(top), [_centred(frame) for frame in frames]
    listed = read_frames(archive, claim.root, _FILE, [(top, frame) for frame in frames], True)
    unlisted = archive.images - listed.named
    unread = _unread(archive, claim.root, top)
    archive.set_aside(unlisted, f"not listed in {_FILE}")
    sources = listed.sources
    if is_arkit:
        sources = [_turned(source) for source in sources]
    told, motion = told_of_motion(_FILE, frames)
    return PosedPictures(
        sources=sources,
        failures=listed.failures,
        metric=is_arkit or top.get(_METRIC) is True,
        up="known" if is_arkit or top.get(_ORIENTATION) == "none" else "assumed",
        notes=arkit_notes() if is_arkit else _notes(top) | motion,
        details={
            "num_listed": len(frames),
            "num_missing": listed.num_missing,
            "num_unlisted": len(unlisted),
        },
        warnings=[*listed.warnings, *unread, *told],
    )


def _centred(values: Any) -> Any:
    """Keys of the top or of a frame, with the principal point of pixels whose centre is at 0.5.

    What is no number stays as it is: whoever reads it says so."""
    if not isinstance(values, dict):
        return values
    moved = {
        key: values[key] + _PIXEL_CENTRE
        for key in ("cx", "cy")
        if isinstance(values.get(key), float | int) and abs(values[key]) < LARGEST
    }
    return {**values, **moved}


def _turned(source: PosedSource) -> PosedSource:
    """A picture in ARKit's world, in ours."""
    return replace(source, world_from_camera=z_up_from_y_up(source.world_from_camera))


def _unread(archive: CaptureArchive, root: str, top: Values) -> list[str]:
    """What the file says and nobody heeds: warnings; files that it names are set aside."""
    if isinstance(cloud := top.get("ply_file_path"), str):
        exact, loose = NamedFiles(archive.names, root).find([cloud])
        archive.set_aside((exact | loose).values(), "point clouds are not read")
    warnings = []
    if cloud:
        warnings.append(f"{_FILE} names a point cloud; it is not used.")
    if any(key in top for key in _SPLITS):
        warnings.append(
            f"{_FILE} says which pictures to hold out; training chooses them by its own rule."
        )
    if top.get(_ORIENTATION, "none") != "none":
        warnings.append(f"{_FILE} has {_ORIENTATION}; only its value none is heeded.")
    return warnings


def _notes(top: Values) -> dict[str, Any]:
    """What the file says of its world, for who wants to go back to the original one."""
    notes: dict[str, Any] = {"world": "as in transforms.json, taken as +Z up"}
    applied = top.get("applied_transform")
    if applied is not None:
        rows = applied if isinstance(applied, list) and len(applied) in (3, 4) else None
        if rows is None:
            raise malformed("applied_transform of transforms.json is not a 3x4 matrix.")
        notes["applied_transform"] = [
            numbers(row, 4, "A row of applied_transform") for row in rows[:3]
        ]
    if "applied_scale" in top:
        notes["applied_scale"] = number(top["applied_scale"], "applied_scale")
    return notes


IMPORTER = Importer(
    kind="nerfstudio",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.nerfstudio:read",
)
