"""A Polycam raw data export: pictures and ARKit poses of each keyframe.

    keyframes/images/<us>.jpg   keyframes/corrected_images/<us>.jpg    names are microseconds
    keyframes/cameras/<us>.json keyframes/corrected_cameras/<us>.json
    camera: fx fy cx cy width height blur_score t_00 .. t_23 (row-major world_from_camera [3, 4])

    keyframes/depth/<us>.png    16 bits, millimetres along the camera's axis, 0 where unknown
    keyframes/confidence/<us>.png   8 bits, the size of the depth: 0, 127 or 255, as ARKit rates it

The `corrected_` ones are there unless the session was too large for Polycam's optimiser, and are
better. World: ARKit's, metres, +Y up; turned to +Z up here. Only depth of the highest confidence is
kept: what is below is drawn across edges. No real export was at hand: the layout is that of the
public readers of the format. That depth fits the corrected pictures is nerfstudio's reading of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import PurePosixPath

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
_CONFIDENT = 200
"""Of 0, 127 and 255 the last, with room for what an app might call it."""


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
    depths = _depths(archive, root, [image for image, _ in pairs], warnings)
    blurs: dict[str, float | None] = {}
    sources, failures = each_frame(
        archive,
        dict(pairs),
        lambda image, camera: _frame(archive, image, camera, blurs, depths.get(image)),
    )
    paired = {name for pair in pairs for name in pair}
    _set_aside(archive, root, corrected, paired, depths)
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
    corrected: bool,
    paired: set[str],
    depths: Mapping[str, SensorDepth],
) -> None:
    """Say of the export's files beside the paired ones why they are not used."""
    paired = paired | {name for depth in depths.values() for name in depth.files}
    taken = ("corrected_images", "corrected_cameras") if corrected else ("images", "cameras")
    whys = {
        "depth": "no picture that is used goes with them",
        "confidence": "no depth map that is used goes with them",
        "images": "corrected ones are taken instead",
        "cameras": "corrected ones are taken instead",
        taken[0]: "without a camera file",
        taken[1]: "without a picture",
    }
    for folder, why in whys.items():
        whole = f"{root}{_KEYFRAMES}{folder}"
        archive.set_aside([name for name in archive.names - paired if _folder(name) == whole], why)


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
    both = sorted(cameras.keys() & images.keys(), key=lambda stem: (len(stem), stem))
    return [(images[stem], cameras[stem]) for stem in both], len(images) - len(both)


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _frame(
    archive: CaptureArchive,
    image: str,
    camera: str,
    blurs: dict[str, float | None],
    depth: SensorDepth | None,
) -> PosedSource:
    """A keyframe; its blur score, where it has one (low = blurred), goes into `blurs`."""
    what = f'"{shown(camera)}"'
    raw = archive.read_json(camera)
    if not isinstance(raw, dict):
        raise malformed(f"{what} is not a camera.")

    def value(key: str) -> float:
        if key not in raw:
            raise malformed(f"{what} has no {key}.")
        return number(raw[key], f"{key} of {what}")

    pose = tuple(tuple(value(f"t_{row}{column}") for column in range(4)) for row in range(3))
    lens = Intrinsics(
        width=round(value("width")),
        height=round(value("height")),
        fl_x=value("fx"),
        fl_y=value("fy"),
        cx=value("cx"),
        cy=value("cy"),
    )
    stem = PurePosixPath(image).stem
    blurs[image] = value("blur_score") if "blur_score" in raw else None
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
