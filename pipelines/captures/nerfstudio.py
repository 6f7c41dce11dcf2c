"""A zip in nerfstudio's layout: `transforms.json` and the pictures that it names.

Top level or per frame: fl_x fl_y cx cy w h, k1..k4 p1 p2 or distortion_params (k1 k2 k3 k4 p1 p2),
camera_angle_x/y (radians) in place of focal lengths. Top level: camera_model, applied_transform,
applied_scale. Frame: file_path, transform_matrix (world_from_camera, OpenGL), mask_path.

The file's world is kept as it is and taken as +Z up: that is nerfstudio's own convention, and what
`applied_transform` has led to; both it and `applied_scale` are written down in the notes.
"""

from __future__ import annotations

import math
import posixpath
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.cameras_file import Intrinsics
from pipelines.captures.archive_rules import ArchiveLimits, shown
from pipelines.captures.posed import (
    Matrix,
    PosedSource,
    checked_pose,
    malformed,
    missing,
    number,
    numbers,
    resized,
    some_of,
    write_posed,
)
from pipelines.captures.record import Found
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.stage import StageContext

MODELS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "OPENCV",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}
"""nerfstudio's camera models that are read, and what they become."""

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")


def read(path: Path, root: str, options: IngestOptions, ctx: StageContext) -> Found:
    """Write `images/`, `masks/` and `cameras.json` from the `transforms.json` at `root`.

    Raises CaptureError: archive_unsafe (a path that leaves the archive), poses_missing,
    poses_malformed, and those of `write_posed`.
    """
    limits = ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes)
    with CaptureArchive(path, limits) as archive:
        transforms = archive.read_json(root + "transforms.json")
        frames = transforms.get("frames") if isinstance(transforms, dict) else None
        if not isinstance(frames, list) or not frames:
            raise missing("transforms.json lists no frames.")
        sources: dict[str, PosedSource] = {}
        absent: list[str] = []
        for index, frame in enumerate(frames):
            if not isinstance(frame, dict):
                raise malformed(f"Frame {index} of transforms.json is not an object.")
            name = _inside(archive, root, frame.get("file_path"), f"frame {index}")
            if name is None:
                absent.append(str(frame["file_path"]))
            elif name not in sources:
                sources[name] = _source(archive, root, name, transforms, frame)
        if not sources:
            raise missing(
                f"transforms.json lists {len(frames)} pictures, and none of them is in the archive."
            )
        unlisted = len(archive.images - sources.keys() - _masks(sources))
        found = write_posed(
            archive,
            list(sources.values()),
            ctx,
            options,
            source="nerfstudio",
            metric=False,
            notes=_notes(transforms),
        )
    return Found(
        images=found.images,
        details={
            **found.details,
            "num_listed": len(frames),
            "num_missing": len(absent),
            "num_unlisted": unlisted,
        },
        warnings=_warnings(len(frames), absent, unlisted) + found.warnings,
    )


def _warnings(num_listed: int, absent: list[str], unlisted: int) -> list[str]:
    warnings = []
    if absent:
        warnings.append(
            f"transforms.json lists {num_listed} pictures; {len(absent)} of them are not in the "
            f"archive: {some_of(absent)}."
        )
    if unlisted:
        warnings.append(f"{unlisted} pictures are not listed in transforms.json and not used.")
    return warnings


def _masks(sources: Mapping[str, PosedSource]) -> set[str]:
    return {source.mask for source in sources.values() if source.mask is not None}


def _notes(transforms: Mapping[str, Any]) -> dict[str, Any]:
    """What the file says of its world, for who wants to go back to the original one."""
    notes: dict[str, Any] = {"world": "as in transforms.json, taken as +Z up"}
    applied = transforms.get("applied_transform")
    if applied is not None:
        rows = applied if isinstance(applied, list) and len(applied) in (3, 4) else None
        if rows is None:
            raise malformed("applied_transform of transforms.json is not a 3x4 matrix.")
        notes["applied_transform"] = [
            numbers(row, 4, "A row of applied_transform") for row in rows[:3]
        ]
    if "applied_scale" in transforms:
        notes["applied_scale"] = number(transforms["applied_scale"], "applied_scale")
    return notes


def _inside(archive: CaptureArchive, root: str, value: Any, what: str) -> str | None:
    """The picture in the archive that a path names; None where there is none.

    Raises CaptureError: archive_unsafe for a path out of the archive, poses_malformed.
    """
    if not isinstance(value, str) or not value:
        raise malformed(f"file_path of {what} in transforms.json is not a path.")
    plain = value.replace("\\", "/")
    name = posixpath.normpath(posixpath.join(root, plain))
    if plain.startswith("/") or plain[1:2] == ":" or name.split("/")[0] == ".." or "\0" in name:
        raise CaptureError(
            f'transforms.json names a file outside the archive: "{shown(value)}".',
            code="archive_unsafe",
            hint="Write paths relative to transforms.json, and pack the pictures with it.",
        )
    return next((name + end for end in _SUFFIXES if name + end in archive.images), None)


def _source(
    archive: CaptureArchive,
    root: str,
    name: str,
    transforms: Mapping[str, Any],
    frame: Mapping[str, Any],
) -> PosedSource:
    what = f'"{shown(name)}"'
    values = {**transforms, **frame}
    mask = None
    if frame.get("mask_path"):
        mask = _inside(archive, root, frame["mask_path"], f"the mask of {what}")
    time = next((frame[key] for key in ("timestamp", "time") if key in frame), None)
    return PosedSource(
        name=name,
        lens=partial(_lens, values, what),
        world_from_camera=checked_pose(_matrix(frame, what), what),
        timestamp_s=None if time is None else number(time, f"The time of {what}"),
        mask=mask,
    )


def _matrix(frame: Mapping[str, Any], what: str) -> Matrix:
    rows = frame.get("transform_matrix")
    if rows is None:
        raise missing(f"{what} has no transform_matrix in transforms.json.")
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise malformed(f"transform_matrix of {what} is not a 4x4 matrix.")
    return np.array([numbers(row, 4, f"A row of the pose of {what}") for row in rows[:3]])


def _model(values: Mapping[str, Any], distortion: Mapping[str, float]) -> str:
    name = values.get("camera_model")
    if name is None:
        if values.get("is_fisheye"):
            return "OPENCV_FISHEYE"
        return "OPENCV" if any(distortion.values()) else "PINHOLE"
    if name not in MODELS:
        raise malformed(
            f'transforms.json has the camera model "{shown(str(name))}"; '
            f"{', '.join(MODELS)} are supported."
        )
    return MODELS[name]


def _distortion(values: Mapping[str, Any], what: str) -> dict[str, float]:
    if "distortion_params" in values:
        listed = numbers(values["distortion_params"], 6, f"distortion_params of {what}")
        return dict(zip(_DISTORTION, listed, strict=True))
    return {key: number(values.get(key, 0.0), f"{key} of {what}") for key in _DISTORTION}


def _lens(values: Mapping[str, Any], what: str, width: int, height: int) -> Intrinsics:
    """The intrinsics for a picture that really is `width` x `height`.

    Raises CaptureError: poses_missing without a focal length, poses_malformed.
    """
    stated_w = round(number(values.get("w", width), f"w of {what}"))
    stated_h = round(number(values.get("h", height), f"h of {what}"))
    distortion = _distortion(values, what)
    model = _model(values, distortion)
    if model == "PINHOLE":
        distortion = dict.fromkeys(_DISTORTION, 0.0)
    elif model == "OPENCV_FISHEYE":
        distortion = {**distortion, "p1": 0.0, "p2": 0.0}
    focal_x = _focal(values, "x", stated_w, what)
    focal_y = _focal(values, "y", stated_h, what)
    if focal_x is None and focal_y is None:
        raise missing(f"transforms.json has no focal length for {what}.")
    lens = Intrinsics(
        width=stated_w,
        height=stated_h,
        fl_x=focal_x or focal_y or 0.0,
        fl_y=focal_y or focal_x or 0.0,
        cx=number(values.get("cx", stated_w / 2), f"cx of {what}"),
        cy=number(values.get("cy", stated_h / 2), f"cy of {what}"),
        model=model,
        **distortion,
    )
    return resized(lens, width, height)


def _focal(values: Mapping[str, Any], axis: str, size: int, what: str) -> float | None:
    """The focal length along an axis in pixels, from fl_ or the field of view; else None."""
    if f"fl_{axis}" in values:
        return number(values[f"fl_{axis}"], f"fl_{axis} of {what}")
    if f"camera_angle_{axis}" in values:
        angle = number(values[f"camera_angle_{axis}"], f"camera_angle_{axis} of {what}")
        if not 0 < angle < math.pi:
            raise malformed(f"camera_angle_{axis} of {what} is no field of view.")
        return 0.5 * size / math.tan(0.5 * angle)
    return None
