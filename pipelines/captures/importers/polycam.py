"""A Polycam raw data export: pictures and ARKit poses of each keyframe.

    keyframes/images/<us>.jpg   keyframes/corrected_images/<us>.jpg    names are microseconds
    keyframes/cameras/<us>.json keyframes/corrected_cameras/<us>.json
    camera: fx fy cx cy width height blur_score t_00 .. t_23 (row-major world_from_camera [3, 4])

    keyframes/depth/<us>.png    16 bits, millimetres along the camera's axis, 0 where unknown
    keyframes/confidence/<us>.png   8 bits, the size of the depth: 0, 54 or 127, or 255, as ARKit
    rates it

The `corrected_` ones are there unless the session was too large for Polycam's optimiser, and are
better. Exports are told of that have corrected cameras without corrected pictures: then poses are
those, and lenses the phone's. World: ARKit's, metres, +Y up; turned to +Z up here. Only depth of
the highest confidence is kept: what is below is drawn across edges. Corrected pictures have a black
rim (`captures.rims`). Depth fits them: in a real export to 1 or 2 % of the focal length.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import PurePosixPath
from typing import NamedTuple

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, SensorDepth
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.parsing import (
    arkit_notes,
    each_frame,
    malformed,
    missing,
    number,
    resized,
    some_of,
    z_up_from_y_up,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics

MIN_BLUR_SCORE = 25.0
"""Frames below are blurred; nerfstudio drops them too."""
_MIN_SHARP = 20
_MIN_SHARP_SHARE = 0.5
_KEYFRAMES = "keyframes/"
_MILLIMETRE = 0.001


class _Folders(NamedTuple):
    """Of pictures and of their cameras, below `keyframes/`."""

    images: str
    cameras: str


_CORRECTED = _Folders("corrected_images", "corrected_cameras")
_CORRECTED_POSES = _Folders("images", "corrected_cameras")
_OF_THE_PHONE = _Folders("images", "cameras")
_CONFIDENT = 200
"""Of 0, 54 or 127, and 255 the last, with room for what an app might call it."""


def claims(listing: Listing) -> Claim | None:
    """An archive with pictures in one of the two folders of keyframes."""
    for root in listing.roots_of_folder(_KEYFRAMES):
        for folder in ("corrected_images/", "images/"):
            if listing.has_pictures_below(root + _KEYFRAMES + folder):
                return Claim(root, _KEYFRAMES + folder)
    return None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The sharp keyframes that have a pose, the corrected ones where there are any.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    root = claim.root
    warnings: list[str] = []
    for taken in (_CORRECTED, _CORRECTED_POSES, _OF_THE_PHONE):
        pairs, num_unposed = _pairs(archive, root, taken)
        if pairs:
            break
    else:
        raise missing("The export has pictures, but no camera file belongs to any of them.")
    corrected = taken is not _OF_THE_PHONE
    if not corrected:
        warnings.append(
            "The export has no corrected poses; those of the phone drift over long walks."
        )
    lenses = {}
    if taken is _CORRECTED_POSES:
        lenses = dict(_pairs(archive, root, _OF_THE_PHONE)[0])
    depths = _depths(archive, root, [image for image, _ in pairs], warnings)
    blurs: dict[str, float | None] = {}
    sources, failures = each_frame(
        archive,
        dict(pairs),
        lambda image, camera: _frame(
            archive, image, camera, lenses.get(image, camera), blurs, depths.get(image)
        ),
    )
    paired = {name for pair in pairs for name in pair} | set(lenses.values())
    _set_aside(archive, root, taken, paired, depths)
    of_frames = {name for source in sources for name in source.depth_files}
    of_all = {name for depth in depths.values() for name in depth.files}
    archive.set_aside(of_all - of_frames, "their pictures are left out")
    return PosedPictures(
        sources=_sharp(archive, sources, blurs, warnings),
        failures=failures,
        metric=True,
        is_dense=True,
        notes={"corrected": corrected, **arkit_notes()},
        details={
            "corrected": corrected,
            "num_frames": len(pairs),
            "num_without_pose": num_unposed,
        },
        warnings=warnings,
    )


def _depths(
    archive: CaptureArchive, root: str, images: list[str], warnings: list[str]
) -> dict[str, SensorDepth]:
    """The depth of each picture that has any, with its confidence; gaps go into `warnings`."""

    def by_stem(folder: str) -> dict[str, str]:
        whole = f"{root}{_KEYFRAMES}{folder}"
        return {PurePosixPath(name).stem: name for name in archive.names if _folder(name) == whole}

    maps, ratings = by_stem("depth"), by_stem("confidence")
    stems = {image: PurePosixPath(image).stem for image in images}
    found = {
        image: SensorDepth(maps[stem], _MILLIMETRE, ratings.get(stem), _CONFIDENT)
        for image, stem in stems.items()
        if stem in maps
    }
    lost = [image for image in images if image not in found]
    unrated = [depth.name for depth in found.values() if depth.confidence is None]
    if found and lost:
        warnings.append(
            f"{len(lost)} of {len(images)} pictures have no depth map: {some_of(lost)}."
        )
    if unrated:
        warnings.append(
            f"{len(unrated)} of {len(found)} depth maps have no confidence map, and are used "
            f"whole: {some_of(unrated)}."
        )
    return found


def _set_aside(
    archive: CaptureArchive,
    root: str,
    taken: _Folders,
    paired: set[str],
    depths: Mapping[str, SensorDepth],
) -> None:
    """Say of the export's files beside the paired ones why they are not used."""
    paired = paired | {name for depth in depths.values() for name in depth.files}
    whys = {
        "depth": "no picture that is used goes with them",
        "confidence": "no depth map that is used goes with them",
        "images": "corrected ones are taken instead",
        "cameras": "corrected ones are taken instead",
        taken.images: "without a camera file",
        taken.cameras: "without a picture",
    }
    for folder, why in whys.items():
        whole = f"{root}{_KEYFRAMES}{folder}"
        archive.set_aside([name for name in archive.names - paired if _folder(name) == whole], why)


def _pairs(
    archive: CaptureArchive, root: str, folders: _Folders
) -> tuple[list[tuple[str, str]], int]:
    """(picture, camera file) of equal stem, and how many pictures have no camera file."""
    cameras = {
        PurePosixPath(name).stem: name
        for name in archive.names
        if _folder(name) == f"{root}{_KEYFRAMES}{folders.cameras}" and name.endswith(".json")
    }
    images = {
        PurePosixPath(name).stem: name
        for name in archive.images
        if _folder(name) == f"{root}{_KEYFRAMES}{folders.images}"
    }
    both = sorted(cameras.keys() & images.keys(), key=lambda stem: (len(stem), stem))
    return [(images[stem], cameras[stem]) for stem in both], len(images) - len(both)


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


class _Camera:
    """A camera file."""

    def __init__(self, archive: CaptureArchive, name: str) -> None:
        self._what = f'"{shown(name)}"'
        self._raw = archive.read_json(name)
        if not isinstance(self._raw, dict):
            raise malformed(f"{self._what} is not a camera.")

    def has(self, key: str) -> bool:
        """Whether it says something of it."""
        return key in self._raw

    def value(self, key: str) -> float:
        """A number of it. Raises CaptureError poses_malformed."""
        if key not in self._raw:
            raise malformed(f"{self._what} has no {key}.")
        return number(self._raw[key], f"{key} of {self._what}")


def _frame(
    archive: CaptureArchive,
    image: str,
    camera: str,
    lens_of: str,
    blurs: dict[str, float | None],
    depth: SensorDepth | None,
) -> PosedSource:
    """A keyframe; its blur score, where it has one (low = blurred), goes into `blurs`.

    camera, lens_of: files with its pose and with its lens.
    """
    posed = _Camera(archive, camera)
    pose = tuple(tuple(posed.value(f"t_{row}{column}") for column in range(4)) for row in range(3))
    value = _Camera(archive, lens_of).value
    lens = Intrinsics(
        width=round(value("width")),
        height=round(value("height")),
        fl_x=value("fx"),
        fl_y=value("fy"),
        cx=value("cx"),
        cy=value("cy"),
    )
    stem = PurePosixPath(image).stem
    blurs[image] = posed.value("blur_score") if posed.has("blur_score") else None
    return PosedSource(
        name=image,
        lens=partial(resized, lens),
        world_from_camera=z_up_from_y_up(pose),
        timestamp_s=int(stem) * 1e-6 if stem.isascii() and stem.isdigit() else None,
        depth=depth,
    )


def _sharp(
    archive: CaptureArchive,
    sources: list[PosedSource],
    blurs: dict[str, float | None],
    warnings: list[str],
) -> list[PosedSource]:
    """The frames that are not blurred, or all of them where too few would be left."""

    def is_blurred(source: PosedSource) -> bool:
        blur = blurs[source.name]
        return blur is not None and blur < MIN_BLUR_SCORE

    sharp = [source for source in sources if not is_blurred(source)]
    blurred = [source for source in sources if is_blurred(source)]
    if len(sharp) >= max(_MIN_SHARP, _MIN_SHARP_SHARE * len(sources)):
        archive.set_aside([source.name for source in blurred], "blurred")
        of_blurred = [name for source in blurred for name in source.depth_files]
        archive.set_aside(of_blurred, "their pictures are blurred")
        return sharp
    if blurred:
        warnings.append(
            f"{len(blurred)} of {len(sources)} frames are blurred; they are kept, since too few "
            "would be left."
        )
    return sources


IMPORTER = Importer(
    kind="polycam",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.polycam:read",
)
