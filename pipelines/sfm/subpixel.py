"""Keypoints moved to where pictures show the same, and the model adjusted to them.

Features are found in each picture by itself, 0.3 to 0.8 pixels from where they belong at small
sizes, and not the same way in all: what is seen more from the side is found elsewhere. Here the
patch around each track's reference is looked for in the track's other pictures
(`pipelines.sfm.alignment`); what is found near and alike is moved there, what is not is dropped,
and then poses, points and lens are adjusted to the end.

Pictures are taken in tiles of blocks of images, of which two are in memory at a time, whatever the
number of images. Coordinates here are pixels of the pictures as they are looked at, at most
`long_side_px` long, unless said otherwise.

Sources: Lindenberger et al., "Pixel-perfect structure-from-motion with featuremetric refinement",
ICCV 2021 (keypoints are adjusted to a track's reference before the structure is); Furukawa and
Ponce, "Accurate camera calibration from multi-view stereo and bundle adjustment", IJCV 2009.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from pipelines.options import PosesOptions
from pipelines.sfm.alignment import Alignments, Arena
from pipelines.sfm.source import Source
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_adjustment import Rounds, share_done
from pipelines.tools.colmap_results import SparseModel
from pipelines.tools.colmap_tracks import Bools, Floats, Integers, StoredTracks, TrackPairs

Report = Callable[[float], None]
"""Receives the share that is done; what it raises ends the work."""

MEMORY_BYTES = 200_000_000
"""For pictures: those of two blocks."""
MIN_ALIKE = 0.8
"""Correlation from which a patch counts as found."""
MAX_MOVE_PX = 2.0
MAX_ANGLE_DEG = 40.0
"""Beyond, no affine map of a patch that faces one picture is what the other shows."""
MIN_SHARE = 0.5
"""Of an image's observations that must be found: a blurred one keeps all as they are."""
MIN_FOUND = 0.3
"""Of all observations that must be found for anything to be changed."""
_PORTION = 20_000
"""Alignments between two reports."""
_ENDS = Rounds(iterations=20, rounds=6, tolerance=1e-7)
_ENDS_AS_MAPPED = Rounds(iterations=20, rounds=3, tolerance=1e-5)
"""Mapping stops when observations hardly change, some way before poses do; less than this does not
show in them."""


@dataclass(frozen=True)
class Refinement:
    """What was changed. All pixels are of the full pictures.

    num_observations: that were compared with a reference. num_moved, num_dropped: of these.
    median_move_px: of those moved. error_before_px, error_after_px: mean reprojection error.
    """

    num_observations: int
    num_moved: int
    num_dropped: int
    median_move_px: float
    error_before_px: float
    error_after_px: float

    def as_dict(self) -> dict[str, float | int]:
        """As report.json has it."""
        return {
            "num_observations": self.num_observations,
            "num_moved": self.num_moved,
            "num_dropped": self.num_dropped,
            "median_move_px": round(self.median_move_px, 3),
            "error_before_px": round(self.error_before_px, 4),
            "error_after_px": round(self.error_after_px, 4),
        }


def refine_model(
    reconstructor: Reconstructor,
    model: SparseModel,
    source: Source,
    options: PosesOptions,
    report: Report,
    num_threads: int,
) -> tuple[SparseModel, Refinement | None]:
    """The model with its keypoints refined, and what was changed; where that is not wanted, or not
    possible, adjusted to the end with the keypoints it has, and None.

    Panoramas' keypoints stay: what a patch of theirs looks like from elsewhere is no affine map.
    report: called while poses are adjusted, too, which is the second half.
    """
    report(0.0)
    tracks = reconstructor.stored_tracks(
        model, lambda rounds: report(0.5 + 0.5 * share_done(rounds))
    )
    report(0.02)
    refined = None
    if options.subpixel and not source.has_panoramas:
        refined = refine_keypoints(
            tracks,
            {image_id: source.paths[index] for image_id, index in tracks.indices.items()},
            lambda share: report(0.05 + 0.45 * share),
            long_side_px=options.max_image_px,
            num_threads=num_threads,
            refine_principal_point=options.refine_principal_point,
        )
    if refined is None:
        tracks.adjust(_ENDS_AS_MAPPED, refine_principal_point=options.refine_principal_point)
    written = tracks.write(reconstructor.scratch / "refined")
    return replace(written, agreement=model.agreement), refined


def refine_keypoints(
    tracks: StoredTracks,
    pictures: Mapping[int, Path],
    report: Report,
    *,
    long_side_px: int,
    num_threads: int,
    refine_principal_point: bool,
) -> Refinement | None:
    """Move and drop observations of the tracks, and adjust the model to them.

    pictures: by the image's id. Returns None, with nothing changed, where too few patches are found
    in other pictures.
    """
    before = tracks.error_px
    pairs = tracks.pairs()
    report(0.0)
    xy, alike = find_again(
        pairs, pictures, tracks.sizes, report, long_side_px=long_side_px, num_threads=num_threads
    )
    good = alike > MIN_ALIKE
    if not good.any() or good.mean() < MIN_FOUND:
        return None
    bad = droppable(pairs.image_ids[:, 1], good)
    tracks.move(pairs, good, xy)
    tracks.drop(pairs, bad)
    tracks.adjust(_ENDS, refine_principal_point=refine_principal_point)
    return Refinement(
        num_observations=len(good),
        num_moved=int(good.sum()),
        num_dropped=int(bad.sum()),
        median_move_px=float(np.median(np.linalg.norm(xy - pairs.xy[:, 1], axis=1)[good])),
        error_before_px=before,
        error_after_px=tracks.error_px,
    )


def droppable(image_ids: Integers, good: Bools) -> Bools:
    """Which observations to drop, [N]: those not found, in images where most are."""
    _, images = np.unique(image_ids, return_inverse=True)
    share = np.bincount(images, weights=good) / np.bincount(images)
    bad: Bools = ~good & (share[images] >= MIN_SHARE)
    return bad


def find_again(
    pairs: TrackPairs,
    pictures: Mapping[int, Path],
    sizes: Mapping[int, tuple[int, int]],
    report: Report,
    *,
    long_side_px: int,
    num_threads: int,
) -> tuple[Floats, Floats]:
    """Where each observation's patch is, [N, 2] in pixels of the full picture, and how alike it is
    there, [N]; -1 where it was not found or is too far off.

    sizes: (width, height) of the full pictures, by id.
    """
    # Kernels bring numba along, which a stage that does not come here need not load.
    from pipelines.sfm.alignment_kernel import align_fast

    shown = {i: _shown_size(size, long_side_px) for i, size in sizes.items()}
    scale = {i: np.divide(shown[i], size) for i, size in sizes.items()}
    xy, alike = pairs.xy[:, 1].copy(), np.full(len(pairs.xy), -1.0)
    ready = np.isfinite(pairs.warps).all((1, 2)) & (pairs.angles_deg < MAX_ANGLE_DEG)
    chosen = np.flatnonzero(ready)
    shelf = Shelf(pictures, shown)
    done = 0
    for rows in tiles(pairs.image_ids[chosen], shelf.block):
        here = chosen[rows]
        arena, slots = shelf.arena(pairs.image_ids[here])
        for first in range(0, len(here), _PORTION):
            part = slice(first, first + _PORTION)
            these = here[part]
            from_scale, to_scale = (
                np.array([scale[i] for i in side.tolist()]) for side in pairs.image_ids[these].T
            )
            wanted = Alignments(
                slots=slots[part],
                references=pairs.points[these],
                from_xy=pairs.xy[these, 0] * from_scale,
                to_xy=pairs.xy[these, 1] * to_scale,
                warps=to_scale[:, :, None] * pairs.warps[these] / from_scale[:, None, :],
            )
            found, score = align_fast(arena, wanted, num_threads)
            far = np.linalg.norm(found - wanted.to_xy, axis=1) > MAX_MOVE_PX
            xy[these], alike[these] = found / to_scale, np.where(far, -1.0, score)
            done += len(these)
            report(done / len(chosen))
    return xy, alike


def tiles(image_ids: Integers, block: int) -> Iterator[Integers]:
    """Rows of image_ids [N, 2] whose images lie in one pair of blocks, `block` images each, in an
    order in which neighbours share a block. Rows keep their order within a tile."""
    _, places = np.unique(image_ids, return_inverse=True)
    blocks = places.reshape(-1, 2) // block
    order = np.lexsort((np.arange(len(blocks)), blocks[:, 1], blocks[:, 0]))
    ends = np.flatnonzero(np.any(np.diff(blocks[order], axis=0) != 0, axis=1)) + 1
    yield from (rows for rows in np.split(order, ends) if len(rows))


class Shelf:
    """Grey pictures in memory, those of two blocks at most.

    block: images of a block. pictures, shown: paths and (width, height) to be looked at, by id.
    """

    def __init__(self, pictures: Mapping[int, Path], shown: Mapping[int, tuple[int, int]]) -> None:
        self._pictures, self._shown = pictures, shown
        largest = max(width * height for width, height in shown.values())
        num = min(len(shown), max(2, MEMORY_BYTES // largest))
        self.block = max(1, num // 2) if num < len(shown) else num
        self._arena = Arena(np.zeros((num, largest), np.uint8), np.ones((num, 2), np.int64))
        self._slot_of: dict[int, int] = {}

    def arena(self, image_ids: Integers) -> tuple[Arena, npt.NDArray[np.int64]]:
        """The pictures of a tile, and the slots [N, 2] that they lie in."""
        wanted = np.unique(image_ids).tolist()
        free = set(range(len(self._arena.grey))) - set(self._slot_of.values())
        for image_id in [i for i in wanted if i not in self._slot_of]:
            if not free:
                left = next(i for i in self._slot_of if i not in wanted)
                free.add(self._slot_of.pop(left))
            slot = self._slot_of[image_id] = free.pop()
            width, height = self._shown[image_id]
            picture = read_grey(self._pictures[image_id], (width, height))
            self._arena.grey[slot, : width * height] = picture.ravel()
            self._arena.heights_widths[slot] = height, width
        slots = [[self._slot_of[i] for i in row] for row in image_ids.tolist()]
        return self._arena, np.array(slots, np.int64).reshape(-1, 2)


def read_grey(path: Path, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """A picture at (width, height), [height, width]. Raises OSError where it cannot be read."""
    with Image.open(path) as opened:
        opened.draft("L", size)
        grey = opened.convert("L")
        if grey.size != size:
            grey = grey.resize(size, Image.Resampling.BOX)
        return np.asarray(grey)


def _shown_size(size: tuple[int, int], long_side_px: int) -> tuple[int, int]:
    scale = min(1.0, long_side_px / max(size))
    width, height = size
    return max(1, round(width * scale)), max(1, round(height * scale))
