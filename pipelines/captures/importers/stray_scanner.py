"""Stray Scanner's recording: a film, and a pose and depth for each of its frames.

    odometry.csv            timestamp, frame, x, y, z, qx, qy, qz, qw, and of newer versions also
                            fx, fy, cx, cy: a row a frame, by its number
    camera_matrix.csv       intrinsics [3, 3] of the last frame, for rows without their own
    rgb.mp4                 1920x1440, as the sensor lies
    depth/000000.png        16 bits, millimetres along the camera's axis, 0 where unknown
    confidence/000000.png   8 bits, the size of the depth: 0, 1 or 2, as ARKit rates it

A pose is world_from_camera of an OpenCV camera, in ARKit's world (metres, +Y up), turned to +Z up
here. Intrinsics are ARKit's: pixel centres at integers. Only depth of the highest confidence is
kept. No real recording was at hand, but 14 rows of one's odometry.csv and its camera_matrix.csv;
the rest is the app's own description and public source.
Source: github.com/strayrobots/scanner, docs/format.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, SensorDepth
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.magic import video_container
from pipelines.captures.matrix_files import (
    MOST_ROW_BYTES,
    lens_of,
    read_matrix,
    require_few_rows,
)
from pipelines.captures.orders import numbered
from pipelines.captures.parsing import (
    FRAME_FAULTS,
    arkit_notes,
    malformed,
    missing,
    most_failures,
    opengl_camera,
    rotation_of,
    some_of,
    z_up_from_y_up,
)
from pipelines.captures.rgbd_lenses import lens_of_picture
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError

_FILE = "odometry.csv"
_FILM = "rgb.mp4"
_MATRIX = "camera_matrix.csv"
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_LENS = ("fx", "fy", "cx", "cy")
_MILLIMETRE = 0.001
_CONFIDENT = 2
_LIST_BYTES = 64 << 20
_MOST_FRAMES = 10_000_000

Row = Mapping[str, str]


def claims(listing: Listing) -> Claim | None:
    """A list of poses that starts as the app's does, with its film or its depth beside."""
    with_depth = {name[: name.rfind("/") + 1] for name in listing.pictures}
    for root in listing.roots_of(_FILE):
        if not listing.heads[root + _FILE].lstrip().startswith(b"timestamp, frame,"):
            continue
        film = listing.heads.get(root + _FILM)
        if (film and video_container(film)) or f"{root}depth/" in with_depth:
            return Claim(root, f"{_FILE} and a film, or depth")
    return None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The film's frames that have a pose, with depth where they have some.

    Raises CaptureError: poses_missing, poses_malformed, no_images, too_large.
    """
    root = claim.root
    film = root + _FILM
    if film not in archive.names or not video_container(archive.head(film)):
        raise CaptureError(
            f"The recording has no film {_FILM} that could be read.",
            code="no_images",
            hint=f"Export the whole folder of the recording from the app, with {_FILM}.",
        )
    lines = _lines(archive, root + _FILE)
    names = _columns(lines)
    if len(lines) < 2:
        raise missing(f"{_FILE} has no poses.")
    shared = None
    if root + _MATRIX in archive.names:
        shared = lens_of(read_matrix(archive, root + _MATRIX), f'"{_MATRIX}"')
    depths = _depths(archive, root)
    sources: dict[int, PosedSource] = {}
    failures: list[CaptureError] = []
    numbers: set[int] = set()
    for line, row in _rows(names, lines):
        try:
            source = _source(film, row, f"Row {line} of {_FILE}", shared, depths)
            number = source.frame or 0
            if number in numbers:
                raise malformed(f"Row {line} of {_FILE} is a second one of frame {number}.")
            sources[number] = source
        except CaptureError as error:
            if error.code not in FRAME_FAULTS:
                raise
            if len(failures) <= most_failures(len(lines)):
                failures.append(error)
        numbers.add(_frame_number(row))
    if not sources:
        raise failures[0]
    _set_aside(archive, root, sources)
    return PosedPictures(
        sources=[sources[number] for number in sorted(sources)],
        num_film_frames=max(numbers) + 1,
        failures=failures,
        metric=True,
        is_dense=True,
        notes=arkit_notes(),
        details={"num_poses": len(lines) - 1},
        warnings=_without_depth(sources, depths),
    )


def _lines(archive: CaptureArchive, file: str) -> list[tuple[int, str]]:
    """The lines that are not empty, the names of columns first, with their numbers in the file."""
    data = archive.read(file, _LIST_BYTES)
    require_few_rows(data, file)
    # Not `splitlines`, which also splits at what was not counted.
    lines = enumerate(data.decode("utf-8", "replace").split("\n"), start=1)
    found = [(number, line) for number, line in lines if line.strip()]
    for number, line in found:
        if len(line) > MOST_ROW_BYTES:
            raise malformed(f"Row {number} of {_FILE} is too long.")
    return found


def _columns(lines: Sequence[tuple[int, str]]) -> list[str]:
    """The names of columns. Raises CaptureError poses_malformed where some are not there."""
    names = [name.strip() for name in lines[0][1].split(",")] if lines else []
    lacking = [name for name in ("frame", *_POSE) if name not in names]
    if lacking:
        raise malformed(f"{_FILE} has no columns {', '.join(lacking)}.")
    return names


def _rows(names: Sequence[str], lines: Sequence[tuple[int, str]]) -> Iterator[tuple[int, Row]]:
    """The rows, by the names of their columns, with their line in the file."""
    for number, line in lines[1:]:
        yield number, dict(zip(names, (cell.strip() for cell in line.split(",")), strict=False))


def _frame_number(row: Row) -> int:
    """The number of a row's frame, -1 where it has none."""
    text = row.get("frame", "")
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else -1
    return number if number < _MOST_FRAMES else -1


def _cells(row: Row, names: Sequence[str], what: str) -> list[float]:
    """Finite numbers of some columns. Raises CaptureError poses_malformed."""
    values = []
    for name in names:
        try:
            value = float(row.get(name, ""))
        except ValueError:
            raise malformed(f"{name} of {what} is not a number.") from None
        if not abs(value) < float("inf"):
            raise malformed(f"{name} of {what} is not a finite number.")
        values.append(value)
    return values


def _source(
    film: str,
    row: Row,
    what: str,
    shared: tuple[float, float, float, float] | None,
    depths: Mapping[int, SensorDepth],
) -> PosedSource:
    number = _frame_number(row)
    if number < 0:
        raise malformed(f"{what} has no number of a frame.")
    x, y, z, *quaternion = _cells(row, _POSE, what)
    rotation = rotation_of(quaternion, what)
    pose = tuple((*line, place) for line, place in zip(rotation, (x, y, z), strict=True))
    lens = shared
    if all(row.get(name) for name in _LENS):
        fx, fy, cx, cy = _cells(row, _LENS, what)
        lens = (fx, fy, cx, cy)
    if lens is None:
        raise missing(f"{what} has no intrinsics, and there is no {_MATRIX}.")
    time = _cells(row, ("timestamp",), what)[0] if row.get("timestamp") else None
    return PosedSource(
        name=film,
        frame=number,
        lens=partial(lens_of_picture, lens, what),
        world_from_camera=z_up_from_y_up(opengl_camera(pose)),
        timestamp_s=time,
        depth=depths.get(number),
    )


def _depths(archive: CaptureArchive, root: str) -> dict[int, SensorDepth]:
    """Depth by the number of its frame."""

    def files(folder: str) -> dict[int, str]:
        whole = f"{root}{folder}/"
        return numbered(name for name in archive.names if name[: name.rfind("/") + 1] == whole)

    ratings = files("confidence")
    return {
        number: SensorDepth(name, _MILLIMETRE, ratings.get(number), _CONFIDENT)
        for number, name in files("depth").items()
    }


def _set_aside(archive: CaptureArchive, root: str, sources: Mapping[int, PosedSource]) -> None:
    """Say why depth and the rest of the recording are not used."""
    kept = {name for source in sources.values() for name in source.depth_files}
    for folder in ("depth/", "confidence/"):
        archive.set_aside(
            [name for name in archive.names - kept if name.startswith(root + folder)],
            "no frame that is used goes with them",
        )
    archive.told({root + "imu.csv"} & archive.names)


def _without_depth(
    sources: Mapping[int, PosedSource], depths: Mapping[int, SensorDepth]
) -> list[str]:
    """Warnings where some frames have depth or confidence, and others have none."""
    warnings = []
    lost = [str(number) for number, source in sources.items() if source.depth is None]
    if depths and lost:
        warnings.append(f"{len(lost)} of {len(sources)} frames have no depth map: {some_of(lost)}.")
    unrated = [depth.name for depth in depths.values() if depth.confidence is None]
    if unrated:
        warnings.append(
            f"{len(unrated)} of {len(depths)} depth maps have no confidence map, and are used "
            f"whole: {some_of(shown(name) for name in unrated)}."
        )
    return warnings


IMPORTER = Importer(
    kind="stray-scanner",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.stray_scanner:read",
)
