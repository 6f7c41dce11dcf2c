"""A VisualSFM model (`*.nvm`) beside its pictures.

    NVM_V3
    <number of cameras>   <name> <f> <quaternion w x y z> <place x y z> <r> 0
    <number of points>    <x y z> <red green blue> <number of images> and of each image
                          <index in the list> <feature> <u v, pixels>

The quaternion is camera_from_world's, OpenCV camera; f in pixels; the principal point is the middle
of the picture. r undoes the distortion, m (1 + r m^2) is the ideal place of a measured m, in units
of f: our k1 to k4 are fitted to the inverse, over the picture. The world is structure from
motion's. Of several models the one with most cameras is read. The file does not say how large the
pictures were: where a point was seen outside of one, a smaller copy came along, and is refused.
(u, v) count from the picture's middle; other programs let them count from its corner, and write no
negative ones.
Source: VisualSFM's documentation, "The NVM Format".
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipelines.captures.archive_rules import shown
from pipelines.captures.colmap_model import MOST_IMAGES, MOST_POINTS
from pipelines.captures.contents import PosedPictures, PosedSource, SparsePoints
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.listed_pictures import match_pictures
from pipelines.captures.parsing import each_frame, malformed, missing, pose_of_opencv, rotation_of
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.natural_order import natural_key

_MARK = b"NVM_V3"
_MOST_BYTES = 256 << 20
_LONGEST_LINE = 1 << 20
_MIN_TRACK = 3
_CAMERA_NUMBERS = 10


def claims(listing: Listing) -> Claim | None:
    """An archive with such a file, the least deep one."""
    found = [
        (name.count("/"), name)
        for name, head in listing.heads.items()
        if head.startswith(_MARK) and listing.is_archive
    ]
    if not found:
        return None
    folder, _, file = min(found)[1].rpartition("/")
    return Claim(f"{folder}/" if folder else "", file)


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures of the largest model, with its points.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    file = shown(claim.root + claim.why)
    data = archive.read(claim.root + claim.why, _MOST_BYTES)
    models = list(_models(data, file))
    if not models:
        raise missing(f"{file} has no cameras.")
    best = max(models, key=lambda model: len(model.cameras))
    paths = [camera.name for camera in best.cameras]
    matched = match_pictures(archive, file, paths, claim.root)
    cameras = {camera.name: camera for camera in reversed(best.cameras)}
    sources, failures = each_frame(
        archive,
        {name: cameras[path] for path, name in matched.found.items()},
        lambda name, camera: camera.source(name),
    )
    warnings = list(matched.warnings)
    if len(models) > 1:
        counts = [str(len(model.cameras)) for model in models if model is not best]
        warnings.append(
            f"{file} has {len(models)} models; the one with {len(best.cameras)} cameras is read, "
            f"those with {', '.join(counts)} lie in worlds of their own."
        )
    return PosedPictures(
        sources=sorted(sources, key=lambda source: natural_key(source.name)),
        failures=failures,
        metric=False,
        up="unknown",
        points=best.points if best.points.places else None,
        notes={"world": "structure from motion's, by VisualSFM"},
        details={
            "num_listed": len(best.cameras),
            "num_missing": len(matched.absent),
            "num_points": len(best.points.places),
        },
        warnings=warnings,
    )


@dataclass(frozen=True)
class _Camera:
    """needs: the width and height that a picture must have to show all points that it saw."""

    name: str
    focal: float
    quaternion: tuple[float, ...]
    place: tuple[float, ...]
    r: float
    needs: tuple[float, float] = (0.0, 0.0)

    def source(self, name: str) -> PosedSource:
        """As a picture with a pose. Raises CaptureError poses_malformed."""
        w, x, y, z = self.quaternion
        rotation = rotation_of((x, y, z, w), f'"{shown(name)}"')
        translation = [
            -sum(a * b for a, b in zip(row, self.place, strict=True)) for row in rotation
        ]
        return PosedSource(
            name=name, lens=self._lens, world_from_camera=pose_of_opencv(rotation, translation)
        )

    def _lens(self, width: int, height: int) -> Intrinsics:
        if self.needs[0] > width + 1 or self.needs[1] > height + 1:
            raise malformed(
                f'"{shown(self.name)}" is {width}x{height}, and points of the model lie '
                "outside of it: the model was made of a larger one.",
                "Send the pictures that the model was made of, at their full size.",
            )
        lens = Intrinsics(width, height, self.focal, self.focal, width / 2, height / 2)
        if self.r == 0.0 or not self.focal > 0.0:
            return lens
        # Imported where it runs: the API reads this file too.
        from pipelines.captures.radial import inverse_terms

        try:
            k1, k2, k3, k4 = inverse_terms(self.r, math.hypot(width, height) / 2 / self.focal)
        except ValueError as error:
            raise malformed(f'The lens of "{shown(self.name)}" is none: {error}.') from error
        return replace(lens, model="OPENCV", k1=k1, k2=k2, k3=k3, k4=k4)


@dataclass(frozen=True)
class _Model:
    cameras: list[_Camera]
    points: SparsePoints


class _Span:
    """Where a camera saw points, in pixels: the least and the largest u and v."""

    def __init__(self) -> None:
        self.low = (0.0, 0.0)
        self.high = (0.0, 0.0)

    def take(self, u: float, v: float) -> None:
        self.low = (min(self.low[0], u), min(self.low[1], v))
        self.high = (max(self.high[0], u), max(self.high[1], v))

    def needs(self, centred: bool) -> tuple[float, float]:
        """The size of a picture with all of them. centred: whether they count from its middle."""
        if not centred:
            return self.high
        return (2 * max(-self.low[0], self.high[0]), 2 * max(-self.low[1], self.high[1]))


def _lines(data: bytes, file: str) -> Lines:
    """The lines that say something, with their numbers; one at a time, as a file has millions."""
    stream = io.TextIOWrapper(io.BytesIO(data), "utf-8", errors="replace", newline="\n")
    number = 0
    while line := stream.readline(_LONGEST_LINE):
        number += 1
        if len(line) == _LONGEST_LINE:
            raise malformed(f"Line {number} of {file} is endless.")
        if line.strip() and not line.startswith("#"):
            yield number, line


def _models(data: bytes, file: str) -> Iterator[_Model]:
    """The models of a file with at least one camera, up to the count of 0 that ends it."""
    lines = _lines(data, file)
    next(lines, None)
    total = 0
    while (count := _count(lines, file)) > 0:
        total += count
        if total > MOST_IMAGES:
            raise malformed(f"{file} has more than {MOST_IMAGES} cameras.")
        cameras = [_camera(*_line(lines, file), file) for _ in range(count)]
        places, colors = [], []
        spans = [_Span() for _ in cameras]
        for _ in range(_count(lines, file)):
            number, line = _line(lines, file)
            words = line.split()
            try:
                place = [float(word) for word in words[:3]]
                color = [int(word) for word in words[3:6]]
                seen = int(words[6])
                for start in range(7, 7 + 4 * seen, 4):
                    index, _, u, v = words[start : start + 4]
                    spans[int(index)].take(float(u), float(v))
            except (ValueError, IndexError) as error:
                raise malformed(f"Line {number} of {file} is no point.") from error
            if seen >= _MIN_TRACK:
                places.append(place)
                colors.append(color)
                if len(places) > MOST_POINTS:
                    raise malformed(f"{file} has more than {MOST_POINTS} points.")
        centred = any(min(span.low) < 0.0 for span in spans)
        pairs = zip(cameras, spans, strict=True)
        cameras = [replace(camera, needs=span.needs(centred)) for camera, span in pairs]
        yield _Model(cameras, SparsePoints(places, colors))


Lines = Iterator[tuple[int, str]]


def _line(lines: Lines, file: str) -> tuple[int, str]:
    found = next(lines, None)
    if found is None:
        raise malformed(f"{file} is cut off: it ends before its list does.")
    return found


def _count(lines: Lines, file: str) -> int:
    """The count that a list starts with; 0 at the end of the file."""
    number, line = next(lines, (0, "0"))
    try:
        return max(0, int(line))
    except ValueError as error:
        raise malformed(f"Line {number} of {file} is no count.") from error


def _camera(number: int, line: str, file: str) -> _Camera:
    name, *words = line.rsplit(maxsplit=_CAMERA_NUMBERS)
    try:
        values = [float(word) for word in words]
        f, w, x, y, z, *place, r, _ = values
        if len(place) != 3 or not all(abs(value) < 1e12 for value in values):
            raise ValueError
    except ValueError as error:
        raise malformed(f"Line {number} of {file} is no camera.") from error
    return _Camera(name.strip(), f, (w, x, y, z), tuple(place), r)


IMPORTER = Importer(
    kind="visualsfm",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.visualsfm:read",
)
