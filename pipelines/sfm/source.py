"""Which images a capture's poses are asked for, in which order, and which of them share a lens."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from pipelines.errors import CaptureError
from pipelines.tools.colmap import CameraGroup
from pipelines.workspace import Workspace

_MAKE, _MODEL, _EXIF_IFD = 271, 272, 0x8769
_FOCAL_MM, _FOCAL_35MM = 37386, 41989
"""EXIF tags, from the Exif 2.32 standard."""
_FEW_VIEWS = 5
"""A lens seen by fewer images gets one radial coefficient: more would fit noise."""


@dataclass(frozen=True)
class Source:
    """Images in capture order.

    root: folder that `files` are relative to. files: paths with "/". timestamps_s: seconds of the
    film, all None for photos. is_video: whether neighbours in the list are neighbours in time.
    """

    root: Path
    files: tuple[str, ...]
    timestamps_s: tuple[float | None, ...]
    is_video: bool

    @property
    def paths(self) -> list[Path]:
        """Where the images lie on this machine."""
        return [self.root / file for file in self.files]


def read_source(workspace: Workspace) -> Source:
    """The images of a job: of frames.json for a video, of capture.json for photos.

    Raises CaptureError (no_images, too_few_images) where there are none, or one.
    """
    root = workspace.images_root
    listing = root / "frames.json"
    if listing.is_file():
        frames = json.loads(listing.read_text("utf-8"))["frames"]
        files = tuple(str(frame["file"]) for frame in frames)
        times = tuple(float(frame["timestamp_s"]) for frame in frames)
        source = Source(root, files, times, is_video=True)
    else:
        capture = json.loads((root / "capture.json").read_text("utf-8"))
        files = tuple(str(image["file"]) for image in capture["images"])
        source = Source(root, files, (None,) * len(files), is_video=False)
    missing = [file for file in source.files if not (root / file).is_file()]
    if not source.files or missing:
        raise CaptureError(
            f"There are no images to find poses for ({len(missing)} are missing).",
            code="no_images",
            details={"missing": missing[:10]},
        )
    if len(source.files) < 2:
        raise CaptureError(
            "Poses need at least two images, there is one.",
            code="too_few_images",
            hint="Send a video or at least 20 photos from different places.",
        )
    return source


def camera_groups(source: Source, lens: str) -> tuple[CameraGroup, ...]:
    """Images that share a lens, each with the COLMAP model to fit.

    Frames of a video are one group. Photos are grouped by size and by what EXIF says of camera and
    focal length. lens: the model wanted; groups of few images get a simpler one than OPENCV.
    Raises CaptureError (image_undecodable) for a file that is no picture.
    """
    members: dict[tuple[Any, ...], list[int]] = {}
    for index, path in enumerate(source.paths):
        members.setdefault(() if source.is_video else _lens_of(path), []).append(index)
    return tuple(
        CameraGroup(
            indices=tuple(indices),
            lens="SIMPLE_RADIAL" if lens == "OPENCV" and len(indices) < _FEW_VIEWS else lens,
        )
        for indices in members.values()
    )


def _lens_of(path: Path) -> tuple[Any, ...]:
    """What tells lenses apart: size, make, model, focal lengths."""
    try:
        with Image.open(path) as image:
            size = image.size
            exif = image.getexif()
            detail = exif.get_ifd(_EXIF_IFD)
    except (UnidentifiedImageError, OSError) as error:
        raise CaptureError(
            f"{path.name} is not a picture that can be read.", code="image_undecodable"
        ) from error
    tags = (exif.get(_MAKE), exif.get(_MODEL), detail.get(_FOCAL_MM), detail.get(_FOCAL_35MM))
    return (*size, *(str(tag) for tag in tags))
