"""A Polycam raw data export: pictures and ARKit poses of each keyframe.

    keyframes/images/<us>.jpg   keyframes/corrected_images/<us>.jpg    names are microseconds
    keyframes/cameras/<us>.json keyframes/corrected_cameras/<us>.json
    camera: fx fy cx cy width height blur_score t_00 .. t_23 (row-major world_from_camera [3, 4])

The `corrected_` ones are there unless the session was too large for Polycam's optimiser, and are
better. World: ARKit's, metres, +Y up; turned to +Z up here.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from pipelines.cameras_file import Intrinsics
from pipelines.captures.archive_rules import ArchiveLimits, shown
from pipelines.captures.pictures import evenly_picked, natural_key
from pipelines.captures.posed import (
    PosedSource,
    checked_pose,
    malformed,
    missing,
    number,
    resized,
    write_posed,
    z_up_from_y_up,
)
from pipelines.captures.record import Found
from pipelines.captures.unpack import CaptureArchive
from pipelines.options import IngestOptions
from pipelines.stage import StageContext

MIN_BLUR_SCORE = 25.0
"""Frames below are blurred; nerfstudio drops them too."""
_MIN_SHARP = 20
_MIN_SHARP_SHARE = 0.5


def read(path: Path, root: str, options: IngestOptions, ctx: StageContext) -> Found:
    """Write `images/` and `cameras.json` from the export that starts at `root` in the archive.

    Raises CaptureError: poses_missing, poses_malformed, and those of `write_posed`.
    """
    limits = ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes)
    warnings: list[str] = []
    with CaptureArchive(path, limits) as archive:
        corrected = True
        pairs, num_unposed = _pairs(archive, root, "corrected_")
        if not pairs:
            corrected = False
            pairs, num_unposed = _pairs(archive, root, "")
            warnings.append(
                "The export has no corrected poses; those of the phone drift over long walks."
            )
        if not pairs:
            raise missing("The export has pictures, but no camera file belongs to any of them.")
        if num_unposed:
            warnings.append(f"{num_unposed} pictures have no camera file and are not used.")
        frames = [_frame(archive, image, camera) for image, camera in pairs]
        sources = _sharp(frames, warnings)
        picked = [sources[i] for i in evenly_picked(len(sources), options.max_posed_images)]
        found = write_posed(
            archive,
            picked,
            ctx,
            options,
            source="polycam",
            metric=True,
            notes={"corrected": corrected, "world": "ARKit, turned to +Z up"},
        )
    return Found(
        images=found.images,
        details={
            **found.details,
            "corrected": corrected,
            "num_frames": len(frames),
            "num_without_pose": num_unposed,
        },
        warnings=warnings + found.warnings,
    )


def _pairs(archive: CaptureArchive, root: str, prefix: str) -> tuple[list[tuple[str, str]], int]:
    """(picture, camera file) of equal stem, and how many pictures have no camera file."""
    cameras = {
        PurePosixPath(name).stem: name
        for name in archive.names
        if _folder(name) == f"{root}keyframes/{prefix}cameras" and name.endswith(".json")
    }
    images = {
        PurePosixPath(name).stem: name
        for name in archive.images
        if _folder(name) == f"{root}keyframes/{prefix}images"
    }
    both = sorted(cameras.keys() & images.keys(), key=natural_key)
    return [(images[stem], cameras[stem]) for stem in both], len(images) - len(both)


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _frame(archive: CaptureArchive, image: str, camera: str) -> tuple[PosedSource, float | None]:
    """A keyframe, and its blur score where it has one (low = blurred)."""
    raw = archive.read_json(camera)
    what = f'"{shown(camera)}"'
    if not isinstance(raw, dict):
        raise malformed(f"{what} is not a camera.")

    def value(key: str) -> float:
        if key not in raw:
            raise malformed(f"{what} has no {key}.")
        return number(raw[key], f"{key} of {what}")

    pose = np.array([[value(f"t_{row}{column}") for column in range(4)] for row in range(3)])
    lens = Intrinsics(
        width=round(value("width")),
        height=round(value("height")),
        fl_x=value("fx"),
        fl_y=value("fy"),
        cx=value("cx"),
        cy=value("cy"),
    )
    stem = PurePosixPath(image).stem
    source = PosedSource(
        name=image,
        lens=partial(resized, lens),
        world_from_camera=z_up_from_y_up(checked_pose(pose, what)),
        timestamp_s=int(stem) * 1e-6 if stem.isascii() and stem.isdigit() else None,
    )
    return source, value("blur_score") if "blur_score" in raw else None


def _sharp(
    frames: list[tuple[PosedSource, float | None]], warnings: list[str]
) -> list[PosedSource]:
    """The frames that are not blurred, or all of them where too few would be left."""
    sharp = [source for source, blur in frames if blur is None or blur >= MIN_BLUR_SCORE]
    num_blurred = len(frames) - len(sharp)
    if len(sharp) >= max(_MIN_SHARP, _MIN_SHARP_SHARE * len(frames)):
        if num_blurred:
            warnings.append(f"{num_blurred} of {len(frames)} frames are blurred and left out.")
        return sharp
    if num_blurred:
        warnings.append(
            f"{num_blurred} of {len(frames)} frames are blurred; they are kept, since too few "
            "would be left."
        )
    return [source for source, _ in frames]
