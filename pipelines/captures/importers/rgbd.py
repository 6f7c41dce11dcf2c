"""Folders of an RGB-D camera: pictures, 16-bit depth, and poses as plain numbers in text files.

    7-Scenes, 3DMatch   frame-000000.color.png .depth.png .pose.txt, one folder
    ScanNet             color/0.jpg depth/0.png pose/0.txt intrinsic/intrinsic_color.txt
    Replica             results/frame000000.jpg results/depth000000.png traj.txt, cam_params.json
    a list              images/*.png depth/*.png K.txt poses.txt (or traj.txt, traj_w_c.txt)

A pose is a 4x4 matrix, world_from_camera, of an OpenCV camera; in a list a row each. Depth is
counts along the camera's axis, millimetres where nothing says otherwise, and shows what the picture
shows, but in 7-Scenes, where it has a lens of its own. World: metres; which way is up differs, so
+Z is taken unless the pictures clearly say another axis. Rows of a list belong to pictures in an
order that the pictures confirm (`pipelines.captures.pose_order`). A pose of which no number is
finite is a frame that the camera had lost its way in (ScanNet). Intrinsics and published values:
`pipelines.captures.rgbd_lenses`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, Reading, SensorDepth
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.matrix_files import (
    broken,
    pose_of,
    read_list,
    read_matrix,
    starts_with_numbers,
)
from pipelines.captures.orders import orders, paired, readings_of
from pipelines.captures.parsing import (
    each_frame,
    missing,
    most_failures,
    opengl_camera,
    some_of,
)
from pipelines.captures.rgbd_lenses import (
    REPLICA,
    REPLICA_SEMANTIC,
    SEVEN_SCENES,
    RgbdCamera,
    find_lens_file,
    read_camera,
)
from pipelines.captures.roles import file_role
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError

_BESIDE = "<frame>.pose.txt beside <frame>.color"
_FOLDER = "a folder of poses"
_LISTS = ("poses.txt", "traj.txt", "traj_w_c.txt")
_POSE_FOLDERS = ("pose", "poses")
_PICTURE_FOLDERS = ("color", "rgb", "images", "image", "results")
_DEPTH_FOLDERS = ("depth", "depths", "results")
_FRAME = re.compile(r"(.+)\.(color|depth)\.[A-Za-z]+")
_PUBLISHED = {_BESIDE: SEVEN_SCENES, "traj.txt": REPLICA, "traj_w_c.txt": REPLICA_SEMANTIC}


@dataclass(frozen=True)
class _Found:
    """Pictures with poses. lost: pictures whose pose says that the camera had lost its way."""

    sources: Sequence[PosedSource]
    failures: Sequence[CaptureError]
    num_poses: int
    readings: Sequence[Reading] = ()
    lost: Sequence[str] = ()
    warnings: list[str] = field(default_factory=list)


def claims(listing: Listing) -> Claim | None:
    """The least deep folder that is one of the layouts."""
    with_photos = {_above(name) for name in listing.pictures if file_role(name) is None}
    found = [
        *_beside(listing),
        *_pose_folders(listing, with_photos),
        *_lists(listing, with_photos),
    ]
    return min(found, key=lambda claim: (claim.root.count("/"), claim.root), default=None)


def _beside(listing: Listing) -> Iterable[Claim]:
    """Folders of `<frame>.color.<suffix>` and `<frame>.pose.txt`."""
    for name in listing.pictures:
        frame = _FRAME.fullmatch(name)
        if frame and frame[2] == "color" and _is_numeric(listing, f"{frame[1]}.pose.txt"):
            yield Claim(_above(name), _BESIDE)


def _pose_folders(listing: Listing, with_photos: set[str]) -> Iterable[Claim]:
    """Folders of a folder of poses and one of pictures, with intrinsics or depth."""
    roots = {
        _above(_above(name)[:-1])
        for name in listing.heads
        if name.endswith(".txt")
        and name.rpartition("/")[0].rpartition("/")[2] in _POSE_FOLDERS
        and _is_numeric(listing, name)
    }
    for root in _rgbd_roots(listing, with_photos, roots):
        yield Claim(root, _FOLDER)


def _lists(listing: Listing, with_photos: set[str]) -> Iterable[Claim]:
    """Folders of a list of poses and a folder of pictures, with intrinsics or depth."""
    for file in _LISTS:
        roots = [root for root in listing.roots_of(file) if _is_numeric(listing, root + file)]
        for root in _rgbd_roots(listing, with_photos, roots):
            yield Claim(root, file)


def _rgbd_roots(listing: Listing, with_photos: set[str], roots: Iterable[str]) -> Iterable[str]:
    """Those of the folders that have pictures, and intrinsics or depth: numbers beside photos
    alone are mostly something else."""
    maps = [name for name in listing.pictures if name.endswith(".png")]
    with_maps = {_above(name) for name in maps}
    with_named_maps = {_above(name) for name in maps if file_role(name) == "depth maps"}
    for root in roots:
        photos = _photo_folder(with_photos, root)
        depths = {f"{root}{folder}/" for folder in _DEPTH_FOLDERS}
        has_depth = depths & (with_maps - {photos}) or depths & with_named_maps
        if photos and (find_lens_file(listing.heads, root) or has_depth):
            yield root


def _above(name: str) -> str:
    """The folder that a file lies in, "" or ending with "/"."""
    return name[: name.rfind("/") + 1]


def _is_numeric(listing: Listing, name: str) -> bool:
    return name in listing.heads and starts_with_numbers(listing.heads[name])


def _photo_folder(with_photos: set[str], root: str) -> str | None:
    """The folder of pictures below `root`, of those that have any."""
    folders = (f"{root}{folder}/" for folder in _PICTURE_FOLDERS)
    return next((folder for folder in folders if folder in with_photos), None)


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures that have a pose, with depth where they have some.

    Raises CaptureError: poses_missing, poses_malformed, too_large.
    """
    root, listed = claim.root, claim.why in _LISTS
    camera = read_camera(archive, root, _PUBLISHED.get(claim.why))
    if claim.why == _BESIDE:
        pictures = _frames(archive.images, root, "color")
        maps = _frames(archive.names, root, "depth")
    else:
        folder = _photo_folder({_above(n) for n in archive.images if file_role(n) is None}, root)
        pictures = [n for n in archive.images if _above(n) == folder and file_role(n) is None]
        maps = _depth_maps(archive, root, pictures)
    depths, told = _depths(archive, pictures, maps, camera)
    if listed:
        found = _by_list(archive, root + claim.why, pictures, camera, depths)
    else:
        found = _by_files(archive, root, claim.why, pictures, camera, depths)
    _set_aside(archive, found, pictures, maps, camera)
    return PosedPictures(
        sources=found.sources,
        readings=found.readings,
        failures=found.failures,
        metric=True,
        is_dense=True,
        up="unknown" if claim.why == _BESIDE else "assumed",
        notes={"world": "as in the files of poses"},
        details={"num_poses": found.num_poses, "num_frames": len(pictures)},
        warnings=[*camera.warnings, *told, *found.warnings, *_without_depth(found, depths)],
    )


def _frames(names: Iterable[str], root: str, role: str) -> list[str]:
    """Files called `<frame>.<role>.<suffix>` in the folder `root`."""
    return [
        name
        for name in names
        if _above(name) == root and (frame := _FRAME.fullmatch(name)) and frame[2] == role
    ]


def _depth_maps(archive: CaptureArchive, root: str, photos: Iterable[str]) -> list[str]:
    """The PNGs of the first folder of depth that has any, beside the photos or apart from them;
    of those only what is called depth, where anything there is."""
    taken = frozenset(photos)
    for folder in _DEPTH_FOLDERS:
        whole = f"{root}{folder}/"
        maps = [name for name in archive.names - taken if _above(name) == whole]
        maps = [name for name in maps if name.endswith(".png")]
        called = [name for name in maps if file_role(name) == "depth maps"]
        if maps:
            return called or maps
    return []


def _depths(
    archive: CaptureArchive, pictures: Sequence[str], maps: Sequence[str], camera: RgbdCamera
) -> tuple[dict[str, SensorDepth], list[str]]:
    """The depth of pictures, by their names; and why there is none, where that is to be told."""
    unit = camera.depth_unit
    if unit is None:
        return {}, []
    try:
        both = paired(pictures, maps)
    except CaptureError as error:
        archive.told(maps)
        return {}, [f"{len(maps)} depth maps are not used. {error.message}"]
    lens = camera.depth_lens
    return {name: SensorDepth(file, unit, lens=lens) for name, file in both.items()}, []


def _by_files(
    archive: CaptureArchive,
    root: str,
    layout: str,
    pictures: Sequence[str],
    camera: RgbdCamera,
    depths: Mapping[str, SensorDepth],
) -> _Found:
    """Pictures that have a file with their pose: of the same name, or number in it."""
    texts = [name for name in archive.names if name.endswith(".txt")]
    if layout == _BESIDE:
        files = [n for n in texts if _above(n) == root and n.endswith(".pose.txt")]
    else:
        folders = {f"{root}{folder}/" for folder in _POSE_FOLDERS}
        files = [name for name in texts if _above(name) in folders]
    both = paired(pictures, files)
    lost: list[str] = []

    def source(name: str, file: str) -> PosedSource | None:
        values = read_matrix(archive, file)
        if _is_lost(values):
            lost.append(name)
            return None
        return _source(name, values, f'"{shown(file)}"', camera, depths)

    if not both:
        raise missing("No picture has a file with its pose: neither names nor numbers are equal.")
    sources, failures = each_frame(archive, both, source)
    if not sources and not failures:
        raise missing(f"None of the {len(both)} poses is one: the camera had lost its way in all.")
    without = [name for name in pictures if name not in both]
    used = set(both.values())
    no_file = [name for name in files if name not in used]
    warnings = []
    if without:
        warnings.append(f"{len(without)} pictures have no pose: {some_of(without)}.")
        archive.told(without)
    if no_file:
        warnings.append(f"{len(no_file)} poses have no picture: {some_of(no_file)}.")
        archive.told(no_file)
    return _Found(sources, failures, len(files), lost=lost, warnings=warnings)


def _by_list(
    archive: CaptureArchive,
    file: str,
    pictures: Sequence[str],
    camera: RgbdCamera,
    depths: Mapping[str, SensorDepth],
) -> _Found:
    """Pictures with the rows of a list, in every order in which they may belong together."""
    what = shown(file.rpartition("/")[2])
    rows = read_list(archive, file)
    if not rows:
        raise missing(f"{what} has no poses.")
    found = orders(pictures, len(rows), by_number=True)
    if not found:
        raise broken(
            f"{what} has {len(rows)} poses, and there are {len(pictures)} pictures, whose names do "
            "not say by a number which pose is whose."
        )
    failures: list[CaptureError] = []
    usable: set[int] = set()
    for number, row in enumerate(rows):
        if not _is_lost(row):
            try:
                pose_of(row, f"Row {number} of {what}")
                usable.add(number)
            except CaptureError as error:
                if len(failures) <= most_failures(len(rows)):
                    failures.append(error)

    def source(name: str, row: int) -> PosedSource | None:
        if row not in usable:
            return None
        return _source(name, rows[row], f"Row {row} of {what}", camera, depths)

    readings = [item for item in readings_of(found, source) if item.sources]
    if not readings:
        raise (failures or [missing(f"None of the {len(rows)} poses of {what} is one.")])[0]
    warnings = []
    if len(rows) != len(pictures):
        warnings.append(f"{what} has {len(rows)} poses, and there are {len(pictures)} pictures.")
    num_lost = sum(_is_lost(row) for row in rows)
    if num_lost:
        warnings.append(f"In {num_lost} of {len(rows)} poses of {what} no number is finite.")
    return _Found(readings[0].sources, failures, len(rows), readings, warnings=warnings)


def _is_lost(values: Sequence[float]) -> bool:
    """Whether a pose says that there is none."""
    return len(values) in (12, 16) and not any(math.isfinite(value) for value in values[:12])


def _source(
    name: str,
    values: Sequence[float],
    what: str,
    camera: RgbdCamera,
    depths: Mapping[str, SensorDepth],
) -> PosedSource:
    return PosedSource(
        name=name,
        lens=camera.lens,
        world_from_camera=opengl_camera(pose_of(values, what)),
        depth=depths.get(name),
    )


def _set_aside(
    archive: CaptureArchive,
    found: _Found,
    pictures: Sequence[str],
    maps: Sequence[str],
    camera: RgbdCamera,
) -> None:
    """Say why files of the layout are not used."""
    kept = {name for source in found.sources for name in source.depth_files}
    if found.lost:
        archive.told(found.lost)
        found.warnings.append(
            f"{len(found.lost)} of {len(pictures)} pictures have a pose without a finite number, "
            f"for which the camera had lost its way: {some_of(found.lost)}."
        )
    why = camera.why_no_depth or "no picture that is used goes with them"
    archive.set_aside([name for name in maps if name not in kept], why)
    posed = {source.name for source in found.sources}
    archive.set_aside([name for name in pictures if name not in posed], "they have no pose")


def _without_depth(found: _Found, depths: Mapping[str, SensorDepth]) -> list[str]:
    """A warning where some pictures have depth, and others have none."""
    lost = [source.name for source in found.sources if source.name not in depths]
    if not depths or not lost:
        return []
    count = len(found.sources)
    return [f"{len(lost)} of {count} pictures have no depth map: {some_of(lost)}."]


IMPORTER = Importer(
    kind="rgbd",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.rgbd:read",
)
