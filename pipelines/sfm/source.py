"""Which images a capture's poses are asked for, in which order, and which of them share a lens.

What EXIF said of camera and lens comes from the record of `ingest`: the pictures have none left.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from pipelines.errors import CaptureError
from pipelines.scene.panoramas import MODEL as PANORAMA
from pipelines.tools.colmap_results import SparseModel
from pipelines.tools.colmap_settings import CameraGroup
from pipelines.workspace import Workspace

_LENS_KEYS = ("make", "model", "lens", "focal_mm", "focal_35mm")
"""What of `pipelines.captures.exif.Exif` tells lenses apart."""
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_FOCAL_RANGE = (0.2, 50.0)
"""Focal lengths that are believed, in long sides of the picture: a fisheye's to a telescope's."""
_WIDE = 1.6
"""Sides' ratio beyond which a picture is taken to be a part of a sensor of 4:3."""
_FEW_VIEWS = 5
"""A lens seen by fewer images gets one radial coefficient: more would fit noise."""


@dataclass(frozen=True)
class Source:
    """Images in capture order.

    root: folder that `files` are relative to. files: paths with "/". timestamps_s: seconds of the
    film, None for photos and for frames whose time the file does not say. is_video: whether
    neighbours in the list are neighbours in time. exif: what the record says of each photo.
    clips: of a film, the clip that each frame is of, ascending; neighbours of one clip only are
    neighbours in time. views: for each image the views that were cut from it, none of one that is
    no panorama; of a capture without panoramas nothing at all. clip_names: what the sender called
    each clip, by its number. masks: as `files`, black where an image is to be ignored, None for
    those without; nothing at all of a capture without masks. cuts: the same of what images were cut
    out by, black where nothing stands.
    """

    root: Path
    files: tuple[str, ...]
    timestamps_s: tuple[float | None, ...]
    is_video: bool
    exif: tuple[Mapping[str, Any], ...] = ()
    clips: tuple[int, ...] = ()
    views: tuple[tuple[str, ...], ...] = ()
    clip_names: tuple[str, ...] = ()
    masks: tuple[str | None, ...] = ()
    cuts: tuple[str | None, ...] = ()

    @property
    def has_panoramas(self) -> bool:
        """Whether any image shows the whole sphere."""
        return any(self.views)

    def views_of(self, index: int) -> tuple[str, ...]:
        """The views cut from an image, which is a panorama then; none of any other."""
        return self.views[index] if self.views else ()

    def up_of(self, index: int) -> Sequence[float] | None:
        """Which way was up in an image, as measured (`pipelines.captures.attitude`), or None."""
        return self.exif[index].get("up") if self.exif else None

    def clip_name(self, index: int) -> str:
        """What the sender called the clip that an image is of; "" where it has no name."""
        number = self.clips[index] if self.clips else 0
        return self.clip_names[number] if number < len(self.clip_names) else ""

    @property
    def stretches(self) -> list[range]:
        """Indices of the frames of each clip in turn; all, where there are no clips."""
        clips = self.clips or (0,) * len(self.files)
        edges = [i for i in range(1, len(clips)) if clips[i] != clips[i - 1]]
        return [range(a, b) for a, b in zip([0, *edges], [*edges, len(clips)], strict=True)]

    @property
    def paths(self) -> list[Path]:
        """Where the images lie on this machine."""
        return [self.root / file for file in self.files]

    def mask_of(self, index: int) -> str | None:
        """The file of an image's mask, or None."""
        return self.masks[index] if self.masks else None

    def cut_of(self, index: int) -> str | None:
        """The file of what an image was cut out by, or None."""
        return self.cuts[index] if self.cuts else None

    @property
    def mask_paths(self) -> dict[int, Path]:
        """Where the masks lie on this machine, by the indices of their images."""
        return {i: self.root / mask for i, mask in enumerate(self.masks) if mask is not None}


def read_source(workspace: Workspace) -> Source:
    """The images of a job: of frames.json for a video, of capture.json for photos.

    Raises CaptureError (no_images, too_few_images) where there are none, or one.
    """
    root = workspace.images_root
    listing = root / "frames.json"
    if listing.is_file():
        film = json.loads(listing.read_text("utf-8"))
        frames = film["frames"]
        names = tuple(str(clip["name"]) for clip in film.get("clips", ()))
        files = tuple(str(frame["file"]) for frame in frames)
        times = tuple(_seconds(frame["timestamp_s"]) for frame in frames)
        clips = tuple(int(frame.get("clip", 0)) for frame in frames)
        masks, cuts = (tuple(frame.get(what) for frame in frames) for what in ("mask", "cut"))
        source = Source(
            root,
            files,
            times,
            is_video=True,
            clips=clips,
            views=_views(frames),
            clip_names=names,
            masks=masks if any(masks) else (),
            cuts=cuts if any(cuts) else (),
        )
    else:
        capture = json.loads((root / "capture.json").read_text("utf-8"))
        files = tuple(str(image["file"]) for image in capture["images"])
        exif = tuple(image.get("exif", {}) for image in capture["images"])
        none = (None,) * len(files)
        views = _views(capture["images"])
        masks, cuts = (
            tuple(image.get(what) for image in capture["images"]) for what in ("mask", "cut")
        )
        source = Source(
            root,
            files,
            none,
            is_video=False,
            exif=exif,
            views=views,
            masks=masks if any(masks) else (),
            cuts=cuts if any(cuts) else (),
        )
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


def _views(entries: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(map(str, entry.get("views", ()))) for entry in entries)


def camera_groups(source: Source, lens: str) -> tuple[CameraGroup, ...]:
    """Images that share a lens, each with the COLMAP model to fit and the focal length EXIF gives.

    Frames of a clip are one group. Photos are grouped by size and by what EXIF says of camera and
    focal length. Panoramas are apart, with a model that has nothing to fit. lens: the model wanted
    for the others; groups of few images get a simpler one than OPENCV.
    Raises CaptureError (image_undecodable) for a file that is no picture.
    """
    if source.is_video:
        return tuple(
            _group(stretch, PANORAMA if source.views_of(stretch[0]) else lens, None)
            for stretch in source.stretches
        )
    members: dict[tuple[Any, ...], list[int]] = {}
    focal_px: dict[tuple[Any, ...], float | None] = {}
    exif = source.exif or ({},) * len(source.files)
    for index, (path, tags) in enumerate(zip(source.paths, exif, strict=True)):
        width, height = _size_of(path)
        model = PANORAMA if source.views_of(index) else lens
        key: tuple[Any, ...] = (model, width, height)
        if model != PANORAMA:
            key = (*key, *(tags.get(name) for name in _LENS_KEYS))
        members.setdefault(key, []).append(index)
        focal_px[key] = None if model == PANORAMA else prior_focal_px(tags, width, height)
    return tuple(_group(indices, key[0], focal_px[key]) for key, indices in members.items())


def unknown_lenses(source: Source, wanted: str) -> list[tuple[int, ...]]:
    """The photos of which nothing says whether they share a lens, those of one size together; none
    of a film, beside panoramas, or where a fisheye is wanted (`poses.camera_model`), whose focal
    length is known by itself."""
    if source.is_video or source.has_panoramas or wanted == "OPENCV_FISHEYE":
        return []
    groups = camera_groups(source, wanted)
    told = [bool(tags.get("focal_mm") or tags.get("focal_35mm")) for tags in source.exif]
    return [
        tuple(group.indices)
        for group in groups
        if group.focal_px is None and not (told and told[group.indices[0]])
    ]


def prior_focal_px(exif: Mapping[str, Any], width: int, height: int) -> float | None:
    """The focal length in pixels of a picture of that size, by its EXIF; None where it is silent.

    From the 35 mm equivalent, which compares diagonals (CIPA DCG-001), else from the focal length
    and the sensor's long side. Phones and drones write the same equivalent into 16:9 pictures, cut
    out of their sensors' 4:3, so there it is that diagonal. Values that no camera has are not
    believed.
    """
    long_side, short_side = max(width, height), min(width, height)
    if exif.get("focal_35mm"):
        whole = 0.75 * long_side if long_side > _WIDE * short_side else short_side
        focal = exif["focal_35mm"] / _DIAGONAL_35MM * math.hypot(long_side, whole)
    elif exif.get("focal_mm") and exif.get("sensor_mm"):
        focal = exif["focal_mm"] / exif["sensor_mm"] * long_side
    else:
        return None
    return focal if _FOCAL_RANGE[0] <= focal / long_side <= _FOCAL_RANGE[1] else None


def prior_focals_px(model: SparseModel, source: Source) -> dict[int, float]:
    """What EXIF says of the focal lengths of a model's cameras, by their index; without those of
    which it says nothing."""
    found: dict[int, float] = {}
    if source.exif:
        for image, camera in zip(model.indices, model.camera_of, strict=True):
            lens = model.cameras[camera]
            focal = prior_focal_px(source.exif[image], lens.width, lens.height)
            if focal is not None:
                found.setdefault(camera, focal)
    return found


def _group(indices: Sequence[int], lens: str, focal_px: float | None) -> CameraGroup:
    simple = lens == "OPENCV" and len(indices) < _FEW_VIEWS
    return CameraGroup(tuple(indices), "SIMPLE_RADIAL" if simple else lens, focal_px)


def _size_of(path: Path) -> tuple[int, int]:
    """Width and height of a picture file."""
    try:
        with Image.open(path) as image:
            return image.size
    except (UnidentifiedImageError, OSError) as error:
        raise CaptureError(
            f"{path.name} is not a picture that can be read.", code="image_undecodable"
        ) from error


def _seconds(value: float | None) -> float | None:
    return None if value is None else float(value)
