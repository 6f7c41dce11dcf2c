"""The family of `transforms.json`: frames with `file_path` and `transform_matrix`, lenses in keys.

Instant NGP, nerfstudio and the Blender scenes of NeRF write it, each with keys of its own. At the
top or in a frame: fl_x fl_y cx cy w h, k1..k4 p1 p2 or distortion_params (k1 k2 k3 k4 p1 p2),
camera_angle_x/y (radians) in place of focal lengths, camera_model, is_fisheye. In a frame:
file_path, transform_matrix (world_from_camera, OpenGL camera), mask_path, timestamp or time,
depth_file_path (nerfstudio's) or depth_path (Instant NGP's). Standard library only.

Depth is counts along the camera's axis; a count is depth_unit_scale_factor (at the top or in the
frame, 0.001 without it) units of the original world, and applied_scale, where the file has it, has
brought the poses from that world to the file's: nerfstudio multiplies depth by both, and so do we.
A count of depth_path is integer_depth_scale units of the file's world, and means nothing without.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedSource, SensorDepth
from pipelines.captures.listed_pictures import listing_warnings, none_there
from pipelines.captures.named_files import NamedFiles
from pipelines.captures.parsing import (
    each_frame,
    malformed,
    missing,
    number,
    numbers,
    pose_rows,
    resized,
    some_of,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics

MODELS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "OPENCV",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}
"""Camera models that are read, and what they become."""

DEFAULT_DEPTH_UNIT = 0.001
"""nerfstudio's `depth_unit_scale_factor`: millimetres in a world of metres."""

LARGEST = 1e300
"""JSON has whole numbers that no float can hold; what is larger than this is no number."""
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Listed:
    """What the frames of a file come to.

    named: all files that frames name, masks and depth among them. num_missing: frames whose picture
    is not in the archive.
    """

    sources: list[PosedSource]
    failures: list[CaptureError]
    warnings: list[str]
    named: frozenset[str]
    num_missing: int


@dataclass(frozen=True)
class Frame:
    """A frame of a listing. values: its own keys over those of the top."""

    values: Values
    own: Values
    path: str

    @property
    def mask_path(self) -> str:
        """Where its mask should be, or ""."""
        return self._path("mask_path")

    @property
    def depth_path(self) -> str:
        """Where its depth should be, or ""."""
        return self._path("depth_file_path") or self._path("depth_path")

    def _path(self, key: str) -> str:
        path = self.own.get(key)
        return path if isinstance(path, str) else ""


def read_transforms(archive: CaptureArchive, name: str) -> tuple[Values, list[Any]]:
    """The keys at the top of a transforms file, and its frames, which may be none.

    Raises CaptureError poses_malformed where it is no JSON.
    """
    transforms = archive.read_json(name)
    frames = transforms.get("frames") if isinstance(transforms, dict) else None
    if not isinstance(frames, list):
        raise missing(f"{shown(name)} has no list of frames.")
    return {key: value for key, value in transforms.items() if key != "frames"}, frames


def read_frames(
    archive: CaptureArchive,
    root: str,
    file: str,
    listed: Sequence[tuple[Values, Any]],
    with_depth: bool = False,
) -> Listed:
    """The pictures that frames name, and their poses.

    root: folder that paths are relative to. file: what messages call the listing. listed: keys of
    the top, and a frame, for each frame. with_depth: whether depth_file_path is heeded.
    Raises CaptureError: poses_missing where no picture is in the archive.
    """
    if not listed:
        raise missing(f"{file} lists no frames.")
    frames, failures = _checked(file, listed)
    files = NamedFiles(archive.images, root)
    exact, loose = files.find(frame.path for frame in frames)
    mask_exact, mask_loose = files.find(frame.mask_path for frame in frames if frame.mask_path)
    found, masks = exact | loose, mask_exact | mask_loose
    there: dict[str, Frame] = {}
    for frame in frames:
        if frame.path in found:
            there.setdefault(found[frame.path], frame)
    if not there:
        raise (failures or [none_there(file, [frame.path for frame in frames])])[0]
    depths = _Depths()
    if with_depth:
        taken = {*found.values(), *masks.values()}
        depths = _depths(archive, root, file, frames, there, taken)
    sources, unusable = each_frame(
        archive,
        there,
        lambda name, frame: _source(
            file, name, frame, masks.get(frame.mask_path), depths.of.get(name)
        ),
    )
    absent = [frame.path for frame in frames if frame.path not in found]
    paths = [frame.path for frame in frames]
    warnings = listing_warnings(file, paths, absent, loose | mask_loose)
    lost = [
        frame.mask_path
        for frame in there.values()
        if frame.mask_path and frame.mask_path not in masks
    ]
    if lost:
        warnings.append(
            f"{len(lost)} masks that {file} names are not in the archive, and their pictures "
            f"are used whole: {some_of(lost)}."
        )
    warnings += depths.warnings
    return Listed(
        sources=sources,
        failures=failures + unusable,
        warnings=warnings,
        named=frozenset([*found.values(), *masks.values()]) | depths.named,
        num_missing=len(absent),
    )


def told_of_motion(file: str, frames: Sequence[Any]) -> tuple[list[str], dict[str, Any]]:
    """What is to be told where frames have `time`, as D-NeRF's do, and the scene moves: warnings,
    and notes for `cameras.json`. Nothing where all are of one time."""
    values = [frame.get("time") for frame in frames if isinstance(frame, dict)]
    times = {
        value
        for value in values
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
    }
    if len(times) < 2:
        return [], {}
    span = f"{min(times):g} to {max(times):g}"
    told = (
        f"{file} gives its pictures {len(times)} different times ({span}): the scene moves. Motion "
        "is not modelled: what moves comes out blurred, or not at all."
    )
    return [told], {"times": [min(times), max(times)], "motion": "not modelled"}


def _checked(
    file: str, listed: Sequence[tuple[Values, Any]]
) -> tuple[list[Frame], list[CaptureError]]:
    """The frames that name a picture, and the errors of the others."""
    frames = []
    failures = []
    for index, (top, own) in enumerate(listed):
        path = own.get("file_path") if isinstance(own, dict) else None
        if isinstance(path, str) and path:
            frames.append(Frame({**top, **own}, own, path))
        else:
            failures.append(malformed(f"Frame {index} of {file} has no file_path."))
    return frames, failures


@dataclass(frozen=True)
class _Depths:
    """Depth of pictures, by their names. named: all files that frames name as depth."""

    of: dict[str, SensorDepth] = field(default_factory=dict)
    named: frozenset[str] = frozenset()
    warnings: list[str] = field(default_factory=list)


def _depths(
    archive: CaptureArchive,
    root: str,
    file: str,
    frames: Sequence[Frame],
    there: Mapping[str, Frame],
    taken: Collection[str],
) -> _Depths:
    """The depth that frames name.

    there: frames whose pictures are there, by those. taken: files that are something else already.
    """
    files = NamedFiles(archive.names - frozenset(taken), root)
    exact, loose = files.find(frame.depth_path for frame in frames if frame.depth_path)
    names = exact | loose
    wanted = {name: frame for name, frame in there.items() if frame.depth_path}
    depths: dict[str, SensorDepth] = {}
    faults: list[str] = []
    for name, frame in wanted.items():
        if depth := names.get(frame.depth_path):
            try:
                depths[name] = SensorDepth(depth, _depth_unit(frame, file))
            except CaptureError as error:
                faults.append(error.message)
                archive.told([depth])
    archive.set_aside(names.values(), "their pictures are left out")
    lost = [frame.depth_path for frame in wanted.values() if frame.depth_path not in names]
    warnings = []
    if lost:
        warnings.append(
            f"{len(lost)} of {len(wanted)} depth maps that {file} names are not in the archive, "
            f"and their pictures are used without: {some_of(lost)}."
        )
    if faults:
        warnings.append(f"{len(faults)} depth maps are not used: {faults[0]}")
    if loose:
        path, found = min(loose.items())
        warnings.append(
            f"{len(loose)} depth maps were matched by the end of the name, as "
            f'"{shown(path)}" with "{shown(found)}".'
        )
    return _Depths(depths, frozenset(names.values()), warnings)


def _depth_unit(frame: Frame, file: str) -> float:
    """World units per count of a depth map. Raises CaptureError poses_malformed."""
    key, unknown, values = "depth_unit_scale_factor", DEFAULT_DEPTH_UNIT, frame.values
    scale = number(values.get("applied_scale", 1.0), f"applied_scale of {file}")
    if "depth_file_path" not in frame.own:
        key, unknown, scale = "integer_depth_scale", 0.0, 1.0
    unit = number(values.get(key, unknown), f"{key} of {file}")
    if unit <= 0 or scale <= 0:
        raise malformed(f"{key} or applied_scale of {file} is missing or not above 0.")
    return unit * scale


def _source(
    file: str, name: str, frame: Frame, mask: str | None, depth: SensorDepth | None
) -> PosedSource:
    what = f'"{shown(name)}"'
    rows = frame.own.get("transform_matrix")
    if rows is None:
        raise missing(f"{what} has no transform_matrix in {file}.")
    time = next((frame.own[key] for key in ("timestamp", "time") if key in frame.own), None)
    return PosedSource(
        name=name,
        lens=partial(_lens, frame.values, what),
        world_from_camera=pose_rows(rows, f"the pose of {what}"),
        timestamp_s=None if time is None else number(time, f"The time of {what}"),
        mask=mask,
        depth=depth,
    )


def _model(values: Values, distortion: Mapping[str, float], what: str) -> str:
    name = values.get("camera_model")
    if name is None:
        if values.get("is_fisheye"):
            return "OPENCV_FISHEYE"
        return "OPENCV" if any(distortion.values()) else "PINHOLE"
    if not isinstance(name, str) or name not in MODELS:
        raise malformed(
            f'The camera model of {what} is "{shown(str(name))}"; '
            f"{', '.join(MODELS)} are supported."
        )
    return MODELS[name]


def _distortion(values: Values, what: str) -> dict[str, float]:
    if "distortion_params" in values:
        listed = numbers(values["distortion_params"], 6, f"distortion_params of {what}")
        return dict(zip(_DISTORTION, listed, strict=True))
    return {key: number(values.get(key, 0.0), f"{key} of {what}") for key in _DISTORTION}


def _lens(values: Values, what: str, width: int, height: int) -> Intrinsics:
    """The intrinsics for a picture that really is `width` x `height`.

    Raises CaptureError: poses_missing without a focal length, poses_malformed.
    """
    stated_w = round(number(values.get("w", width), f"w of {what}"))
    stated_h = round(number(values.get("h", height), f"h of {what}"))
    distortion = _distortion(values, what)
    model = _model(values, distortion, what)
    if model == "PINHOLE":
        distortion = dict.fromkeys(_DISTORTION, 0.0)
    elif model == "OPENCV_FISHEYE":
        distortion = {**distortion, "p1": 0.0, "p2": 0.0}
    focal_x = _focal(values, "x", stated_w, what)
    focal_y = _focal(values, "y", stated_h, what)
    if focal_x is None and focal_y is None:
        raise missing(f"There is no focal length for {what}.")
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


def _focal(values: Values, axis: str, size: int, what: str) -> float | None:
    """The focal length along an axis in pixels, from fl_ or the field of view; else None."""
    if f"fl_{axis}" in values:
        return number(values[f"fl_{axis}"], f"fl_{axis} of {what}")
    if f"camera_angle_{axis}" in values:
        angle = number(values[f"camera_angle_{axis}"], f"camera_angle_{axis} of {what}")
        if not 0 < angle < math.pi:
            raise malformed(f"camera_angle_{axis} of {what} is no field of view.")
        return 0.5 * size / math.tan(0.5 * angle)
    return None
