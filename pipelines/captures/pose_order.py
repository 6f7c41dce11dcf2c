"""Which picture a pose belongs to, where the files do not say: the pictures themselves tell.

Some formats hold poses as bare rows (`poses_bounds.npy`, `poses.txt`): the first row is the first
picture's, in an order of names that everybody takes for granted, and that differs between programs
(0, 1, 2, ... or 0, 1, 10, ...). Here some pairs of pictures are matched. Under the right reading a
place in one lies on the line in the other that the poses and lenses say; under a wrong one it lies
pixels beside it. A reading is taken where it alone fits, and otherwise the capture is refused.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import PIL.Image

from pipelines.captures.contents import PosedPictures, PosedSource, Reading
from pipelines.captures.pictures import opened
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError, ToolError
from pipelines.options import IngestOptions
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.natural_order import natural_key
from pipelines.scene.nearness import apart
from pipelines.stage import StageContext
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import read_matches
from pipelines.tools.colmap_settings import CameraGroup, FeatureSettings

Floats = npt.NDArray[np.float64]
Pair = tuple[int, int]
Matches = tuple[Floats, Floats]

MOST_OFF = 2.5e-3
"""Median distance from the epipolar line, in diagonals of the picture, up to which a reading fits.
Right ones have 0.0002 (structure from motion) to 0.0013 (a headset's own tracking); rows that are
one picture late 0.0047 and more, names as text where people count 0.009."""
CLEARLY = 2.0
"""The next best reading must be off by this factor more."""
_FEWEST_PAIRS = 3
_FEWEST_MATCHES = 24
_LONG_SIDE_PX = 1000
_FEATURES = 2500
_THREADS = 2
_SPOTS = 12
_GAPS = (1, 3)
_APART = 0.5
"""How far apart the two cameras of a pair should be: near enough to see the same, far enough for
another pose to show. See `apart`."""


@dataclass(frozen=True)
class _Looked:
    """A picture that was looked at: its features are found at width, height of its own."""

    name: str
    path: Path
    width: int
    height: int


def proven(
    archive: CaptureArchive, capture: PosedPictures, options: IngestOptions, ctx: StageContext
) -> PosedPictures:
    """The capture with the sources of the reading that the pictures confirm.

    Raises CaptureError poses_malformed where they contradict all, or cannot tell which it is.
    """
    ctx.progress(0.0, "Matching pictures, to see which pose is whose")
    off = _distances(archive, capture.readings, options, ctx)
    order = sorted(range(len(off)), key=lambda index: off[index])
    best = capture.readings[order[0]]
    if not np.isfinite(off[order[0]]):
        return _unproven(capture)
    if off[order[0]] > MOST_OFF or (len(order) > 1 and off[order[1]] < CLEARLY * off[order[0]]):
        raise _contradicted(capture.readings, off)
    return replace(
        capture,
        sources=best.sources,
        readings=(),
        details={
            **capture.details,
            "pose_order": best.rule,
            "epipolar_error": {
                reading.rule: round(distance, 6)
                for reading, distance in zip(capture.readings, off, strict=True)
            },
        },
    )


def _unproven(capture: PosedPictures) -> PosedPictures:
    """What is to be done where no pictures could be matched. Raises CaptureError."""
    (*plain,) = (reading for reading in capture.readings if reading.is_plain)
    if len(plain) != 1:
        rules = ", or ".join(reading.rule for reading in capture.readings)
        raise CaptureError(
            f"It cannot be told which pose is whose: the poses may belong to the pictures {rules}, "
            "and too few of the pictures match each other to tell.",
            code="poses_malformed",
            hint="Give the pictures names with leading zeros, one for each row of poses.",
        )
    return replace(
        capture,
        sources=plain[0].sources,
        readings=(),
        details={**capture.details, "pose_order": plain[0].rule},
        warnings=[
            *capture.warnings,
            "Too few of the pictures match each other to tell whether their poses are right; they "
            f"are taken to belong to the pictures {plain[0].rule}.",
        ],
    )


def _contradicted(readings: Sequence[Reading], off: Sequence[float]) -> CaptureError:
    told = ", ".join(
        f"{reading.rule}: {100 * distance:.2f} %"
        for reading, distance in zip(readings, off, strict=True)
    )
    several = min(off) <= MOST_OFF
    fit = "fit the pictures in several ways" if several else "do not fit the pictures"
    return CaptureError(
        f"The poses {fit}: places that are the same in two pictures lie beside the line where the "
        f"poses have them, by this share of the picture's diagonal: {told}.",
        code="poses_malformed",
        hint="Check that no picture was added, removed or renamed since the poses were written, or "
        "send the pictures alone to have their poses found.",
    )


def _distances(
    archive: CaptureArchive,
    readings: Sequence[Reading],
    options: IngestOptions,
    ctx: StageContext,
) -> list[float]:
    """How far matches lie from their lines under each reading, in diagonals; inf for unknown."""
    names = sorted(
        set.intersection(*({item.name for item in reading.sources} for reading in readings)),
        key=natural_key,
    )
    if len(names) < 2:
        return [float("inf")] * len(readings)
    poses = [_poses(reading.sources, names) for reading in readings]
    pairs = _pairs(poses)
    scratch = ctx.out / ".order"
    scratch.mkdir(parents=True)
    try:
        wanted = sorted({index for pair in pairs for index in pair})
        looked = _look(archive, [names[index] for index in wanted], scratch, options)
        place = {item.name: index for index, item in enumerate(looked)}
        chosen = [(names[i], names[j]) for i, j in pairs]
        there = [(place[i], place[j]) for i, j in chosen if i in place and j in place]
        matches = _matched(looked, there, scratch, ctx)
    finally:
        shutil.rmtree(scratch)
    if len(matches) < _FEWEST_PAIRS:
        return [float("inf")] * len(readings)
    return [_distance(reading.sources, looked, matches) for reading in readings]


def _poses(sources: Sequence[PosedSource], names: Sequence[str]) -> Floats:
    """[N, 3, 4] in the order of the names."""
    of = {item.name: item.world_from_camera for item in sources}
    return np.array([of[name] for name in names], np.float64).reshape(-1, 3, 4)


def _pairs(poses: Sequence[Floats]) -> list[Pair]:
    """Pairs of indices to be matched: under each reading some that see the same, and neighbours.

    Only pictures whose pose depends on the reading tell anything.
    """
    num = len(poses[0])
    telling = np.zeros(num, bool)
    for other in poses[1:]:
        telling |= np.abs(other - poses[0]).max(axis=(1, 2)) > 0
    if not telling.any():
        telling[:] = True
    indices = np.flatnonzero(telling)
    spots = indices[np.linspace(0, len(indices) - 1, min(_SPOTS, len(indices))).astype(int)]
    pairs = {(i, i + gap) for i in spots.tolist() for gap in _GAPS if i + gap < num}
    for each in poses:
        for i in spots.tolist():
            badness = np.abs(np.log(np.maximum(apart(each, i), 1e-9) / _APART))
            badness[i] = np.inf
            j = int(badness.argmin())
            pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def _look(
    archive: CaptureArchive, names: Sequence[str], scratch: Path, options: IngestOptions
) -> list[_Looked]:
    """Reduced copies of the pictures that decode; the archive does not count them as used."""
    looked = []
    raw = scratch / "raw"
    for number, name in enumerate(names):
        archive.copy(name, raw)
        try:
            image = opened(raw, name, archive.image_format(name), options.max_pixels)
        except CaptureError:
            continue  # whoever stores it tells
        with image:
            width, height = image.size
            copy = image.convert("RGB").convert("L")
        copy.thumbnail((_LONG_SIDE_PX, _LONG_SIDE_PX), PIL.Image.Resampling.BOX)
        path = scratch / f"{number}.png"
        copy.save(path, "PNG", compress_level=1)
        looked.append(_Looked(name, path, width, height))
    return looked


def _matched(
    looked: Sequence[_Looked], pairs: Sequence[Pair], scratch: Path, ctx: StageContext
) -> dict[Pair, Matches]:
    """Verified matches of pairs that have enough, in pixels of the pictures as sent."""
    if not pairs:
        return {}
    reconstructor = Reconstructor(
        scratch / "database.db", [item.path for item in looked], scratch / "colmap"
    )
    alike: dict[tuple[int, int], list[int]] = {}
    for index, item in enumerate(looked):
        alike.setdefault((item.width, item.height), []).append(index)
    groups = [CameraGroup(tuple(indices), "SIMPLE_PINHOLE") for indices in alike.values()]
    settings = FeatureSettings(_LONG_SIDE_PX, _FEATURES, upsample=False, num_threads=_THREADS)

    def watch(done: int) -> None:
        del done
        ctx.progress(0.0, "Matching pictures, to see which pose is whose")

    try:
        reconstructor.extract(groups, settings, watch)
        reconstructor.match(pairs, watch)
    except ToolError:
        return {}
    found = {}
    for (i, j), places in read_matches(reconstructor.database, len(looked)).items():
        if len(places[0]) >= _FEWEST_MATCHES:
            found[i, j] = _unreduced(places[0], looked[i]), _unreduced(places[1], looked[j])
    return found


def _unreduced(places: Floats, item: _Looked) -> Floats:
    with PIL.Image.open(item.path) as image:
        size = image.size
    unreduced: Floats = places * (np.array([item.width, item.height]) / np.array(size))
    return unreduced


def _distance(
    sources: Sequence[PosedSource], looked: Sequence[_Looked], matches: dict[Pair, Matches]
) -> float:
    """The median over pairs of the median distance of matches from their lines, in diagonals."""
    of = {item.name: item for item in sources}
    found = []
    for (i, j), (here, there) in matches.items():
        first, second = of[looked[i].name], of[looked[j].name]
        distances = epipolar_distances(
            (np.array(first.world_from_camera), np.array(second.world_from_camera)),
            (
                first.lens(looked[i].width, looked[i].height),
                second.lens(looked[j].width, looked[j].height),
            ),
            (here, there),
        )
        found.append(float(np.median(distances)) / np.hypot(looked[i].width, looked[i].height))
    return float(np.median(found))


def epipolar_distances(
    poses: tuple[Floats, Floats], lenses: tuple[Intrinsics, Intrinsics], places: Matches
) -> Floats:
    """How far matches are from where two cameras can see the same point, [M] in pixels.

    poses: world_from_camera [3, 4], OpenGL cameras. places: [M, 2] each. Lenses are taken for
    pinholes. Cameras in the same place give inf: they have no such lines.
    Source: Sampson's approximation, Hartley and Zisserman, Multiple View Geometry, eq. 11.9.
    """
    flip = np.diag([1.0, -1.0, -1.0])
    (r1, t1), (r2, t2) = ((pose[:, :3] @ flip, pose[:, 3]) for pose in poses)
    rotation, moved = r2.T @ r1, r2.T @ (t1 - t2)
    length = float(np.linalg.norm(moved))
    if not 0 < length < np.inf:
        return np.full(len(places[0]), np.inf)
    x, y, z = moved / length
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    k1, k2 = (
        np.array([[lens.fl_x, 0, lens.cx], [0, lens.fl_y, lens.cy], [0, 0, 1]]) for lens in lenses
    )
    fundamental = np.linalg.inv(k2).T @ essential @ np.linalg.inv(k1)
    here, there = (np.column_stack([place, np.ones(len(place))]) for place in places)
    lines, back = here @ fundamental.T, there @ fundamental
    squares = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    distances: Floats = np.abs((there * lines).sum(axis=1)) / np.sqrt(np.maximum(squares, 1e-30))
    return distances
