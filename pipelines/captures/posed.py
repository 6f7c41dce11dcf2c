"""Captures that bring camera poses: their poses checked, pictures, depth, `cameras.json` written.

World frame: +Z up. Camera frame: OpenGL (+X right, +Y up, looks along -Z).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from pipelines.captures.archive_rules import shown
from pipelines.captures.common_parts import mask_common_parts
from pipelines.captures.contents import PosedPictures, PosedSource, Rows, SparsePoints
from pipelines.captures.depth_files import DepthWriter
from pipelines.captures.films import FilmFrames
from pipelines.captures.minimum import MIN_POSED_IMAGES
from pipelines.captures.parsing import malformed
from pipelines.captures.photo_masks import NO_MASKS, PhotoMasks, find_masks
from pipelines.captures.pictures import Picture, PictureWriter, evenly_picked
from pipelines.captures.pose_order import proven
from pipelines.captures.posed_copies import without_copies
from pipelines.captures.record import Found, FoundPoints
from pipelines.captures.storing import store_each
from pipelines.captures.unpack import CaptureArchive
from pipelines.captures.world import Move, settled
from pipelines.options import IngestOptions
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.stage import StageContext

Matrix = npt.NDArray[np.float64]

_SLACK = 0.05
"""How far a rotation may be from orthonormal before it is called malformed; files are rounded."""
_COMMON = 0.75
"""Share of the poses whose rotations have one scale for it to be divided out of all."""


@dataclass(frozen=True)
class _Stored:
    """A picture as written, with its camera. mask, depth: below the stage's folder, or None.
    depth_lens: as in `PosedImage`."""

    picture: Picture
    lens: Intrinsics
    world_from_camera: Rows
    timestamp_s: float | None
    mask: str | None
    depth: str | None
    depth_lens: Intrinsics | None


def write_posed(
    archive: CaptureArchive,
    capture: PosedPictures,
    source: str,
    options: IngestOptions,
    ctx: StageContext,
) -> Found:
    """Write the pictures, masks, depth and `cameras.json` of a posed capture into `ctx.out`.

    source: what `cameras.json` says the poses came from.
    Frames that cannot be used are left out where they are few; depth that cannot be used costs no
    frame. Raises CaptureError as `pose_order.proven`, `FilmFrames.decode` and
    `storing.store_each` do, with the code of the frames' own errors where they are many.
    """
    if capture.readings:
        capture = proven(archive, capture, options, ctx)
    sources = without_copies(archive, capture.sources, options.max_pixels)
    num_passed_over = 0
    if capture.is_dense:
        picked = evenly_picked(len(sources), options.max_posed_images)
        kept = set(picked)
        left = [item for index, item in enumerate(sources) if index not in kept]
        archive.set_aside(
            [name for item in left for name in (item.name, *item.depth_files)],
            f"of {len(sources)} pictures {len(picked)} are taken, at even distances",
        )
        sources, num_passed_over = [sources[index] for index in picked], len(left)
    scale = common_scale(np.array([item.world_from_camera for item in sources], np.float64))
    depths = DepthWriter(archive, ctx.out, max_pixels=options.max_pixels)
    film = FilmFrames(archive, ctx.out, max_pixels=options.max_pixels)
    beside = _masks_beside(archive, sources, options, ctx)
    try:
        film.decode(sources, capture.num_film_frames, ctx)
        stored, warnings = store_each(
            archive,
            sources,
            partial(_store, depths, film, beside, scale),
            options,
            ctx,
            upright=False,
            minimum=MIN_POSED_IMAGES,
            failures=capture.failures,
            num_passed_over=num_passed_over,
        )
    finally:
        film.close()
        depths.close()
    archive.set_aside(
        [name for item in sources for name in item.depth_files], "their pictures are left out"
    )
    plain = [item.picture for item in stored if item.mask is None and item.picture.cut is None]
    common = mask_common_parts(ctx.out, plain, ctx)
    cameras: dict[Intrinsics, int] = {}
    poses = np.array([item.world_from_camera for item in stored], np.float64)
    orientations = [item.picture.exif.orientation for item in stored]
    measured = [item.picture.exif.up for item in stored]
    move = settled(poses, orientations, capture.up, capture.notes, measured)
    poses = move.poses(poses)
    images = tuple(
        PosedImage(
            file=item.picture.file,
            camera=cameras.setdefault(item.lens, len(cameras)),
            world_from_camera=_rows(pose),
            timestamp_s=item.timestamp_s,
            mask=common.masks.get(item.picture.file, item.mask),
            depth=item.depth,
            depth_lens=item.depth_lens,
            cut=item.picture.cut,
        )
        for item, pose in zip(stored, poses, strict=True)
    )
    CamerasFile(
        cameras=tuple(cameras),
        images=images,
        metric=capture.metric,
        source=source,
        notes=move.notes,
    ).save(ctx.out / "cameras.json")
    return Found(
        images=[item.picture.as_dict() for item in stored],
        details={
            "num_posed": len(images),
            "num_lenses": len(cameras),
            "num_depths": sum(image.depth is not None for image in images),
            "metric": capture.metric,
            **beside.details(),
            **common.details(),
            **capture.details,
        },
        warnings=[
            *capture.warnings,
            *_told_scale(scale),
            *film.warnings,
            *warnings,
            *move.warnings,
            *depths.warnings,
            *common.warnings(),
        ],
        points=None if capture.points is None else _points(capture.points, move),
    )


def _masks_beside(
    archive: CaptureArchive,
    sources: Sequence[PosedSource],
    options: IngestOptions,
    ctx: StageContext,
) -> PhotoMasks:
    """Masks that lie beside the pictures where the poses name none, of pictures without a sensor's
    depth: that knows what the phone saw around a thing, too."""
    if any(item.mask or item.depth or item.frame is not None for item in sources):
        return NO_MASKS
    names = list(dict.fromkeys(item.name for item in sources))
    return find_masks(archive, names, options.masks, options.max_pixels, ctx, upright=False)


def _store(
    depths: DepthWriter,
    film: FilmFrames,
    beside: PhotoMasks,
    scale: float,
    writer: PictureWriter,
    source: PosedSource,
    number: int,
) -> _Stored:
    """Write one picture, its mask and its depth.

    Raises CaptureError for what makes the frame unusable.
    """
    what = f'"{shown(source.label)}"'
    pose = checked_pose(np.array(source.world_from_camera, np.float64), what, scale)
    if source.frame is None:
        beside.check(source.name)
        picture = writer.store(source.name, number, beside.of.get(source.name), beside.meaning)
    else:
        picture = writer.store_frame(film.file(source), source.label, number)
    size = (picture.width, picture.height)
    lens = checked_lens(source.lens(picture.width, picture.height), what)
    mask = picture.mask
    if source.mask is not None:
        mask = writer.store_mask(source.mask, number, size)
    depth, depth_lens = None, None
    if source.depth is not None:
        depth = depths.store(source.depth, number, size)
        if depth is not None and source.depth.lens is not None:
            depth_lens = checked_lens(source.depth.lens(*size), what)
    return _Stored(
        picture=picture,
        lens=lens,
        world_from_camera=_rows(pose),
        timestamp_s=source.timestamp_s,
        mask=mask,
        depth=depth,
        depth_lens=depth_lens,
    )


def _points(points: SparsePoints, move: Move) -> FoundPoints | None:
    """The points that are in some place, in the world of the poses; None where none is."""
    places = np.array(points.places, np.float64).reshape(-1, 3)
    colors = np.array(points.colors, np.float64).reshape(-1, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        moved = move.points(places).astype(np.float32)
    kept = np.isfinite(moved).all(axis=1) & np.isfinite(colors).all(axis=1)
    if not kept.any():
        return None
    return FoundPoints(moved[kept], np.clip(colors[kept], 0, 255).astype(np.uint8))


def _rows(pose: Matrix) -> Rows:
    return tuple(tuple(float(value) for value in row) for row in pose)


def common_scale(poses: Matrix) -> float:
    """What the rotations of poses [N, 3, 4] are multiplied by, where it is one number for most of
    them; 1.0 where it is none, or differs: `checked_pose` then says which are wrong.

    Some programs leave the scale by which they moved a scene as a whole in the rotations; positions
    are right with it. Raises CaptureError poses_malformed where all axes are left-handed.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        volumes = np.linalg.det(poses.reshape(-1, 3, 4)[:, :, :3])
    volumes = volumes[np.isfinite(volumes) & (volumes != 0.0)]
    if len(volumes) > 1 and (volumes < 0.0).all():
        raise malformed(
            "The poses have left-handed axes: their rotations mirror what they turn.",
            "Export them with right-handed axes (nerfstudio's and Blender's: X right, Y up, seen "
            "along -Z; COLMAP's: X right, Y down, seen along +Z; the world mirrored likewise), or "
            "send the pictures alone to have their poses found.",
        )
    scales = np.cbrt(np.abs(volumes))
    middle = float(np.median(scales)) if len(scales) else 1.0
    is_common = np.mean(np.abs(scales / middle - 1.0) <= _SLACK / 2) >= _COMMON
    return middle if is_common and abs(middle - 1.0) > _SLACK / 2 else 1.0


def _told_scale(scale: float) -> list[str]:
    if scale == 1.0:
        return []
    return [
        f"The poses' rotations are {scale:.4g} times as large as rotations are; that was divided "
        "out. Positions are as they came."
    ]


def checked_pose(matrix: Matrix, what: str, scale: float = 1.0) -> Matrix:
    """A pose whose rotation is made exactly orthonormal. [3, 4] to [3, 4].

    scale: what its rotation is multiplied by (`common_scale`). Raises CaptureError poses_malformed
    for a mirrored, sheared, otherwise scaled or empty rotation.
    """
    rotation = matrix[:, :3] / scale
    with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers are refused below
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not np.isfinite(matrix).all() or not error <= _SLACK or np.linalg.det(rotation) < 0:
        raise malformed(f"The pose of {what} is no rotation and position.")
    u, _, vt = np.linalg.svd(rotation)
    result: Matrix = np.concatenate([u @ vt, matrix[:, 3:]], axis=1)
    return result


def checked_lens(lens: Intrinsics, what: str) -> Intrinsics:
    """Raise CaptureError poses_malformed for intrinsics that no camera has."""
    size = max(lens.width, lens.height)
    if not all(0.05 * size < focal < 100 * size for focal in (lens.fl_x, lens.fl_y)):
        raise malformed(f"The focal length of {what} is not one of a camera.")
    if not (-lens.width < lens.cx < 2 * lens.width and -lens.height < lens.cy < 2 * lens.height):
        raise malformed(f"The principal point of {what} is far outside the picture.")
    return lens
