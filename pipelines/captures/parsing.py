"""What importers parse with: numbers out of JSON, poses, lenses, errors that name the culprit.

Standard library only. Poses are rows [3, 4], `world_from_camera`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedSource, Rows
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics

_ASPECT_SLACK = 0.02
FRAME_FAULTS = frozenset({"poses_malformed", "poses_missing", "image_undecodable"})
"""Codes of errors that one frame may have without the capture being of no use."""

MOST_FAILURES = 0.1
"""Share of the frames that may be unusable: stray damage stays below, a wrong export does not."""

Frame = TypeVar("Frame")


def most_failures(num_frames: int) -> int:
    """How many errors of that many frames are kept: more are too many anyhow, and are the same."""
    return max(1000, round(2 * MOST_FAILURES * num_frames))


def malformed(message: str, hint: str = "Export the capture again from the app.") -> CaptureError:
    """The error for poses or intrinsics that make no sense."""
    return CaptureError(message, code="poses_malformed", hint=hint)


def missing(
    message: str,
    hint: str = "Export the capture with its poses, or send the pictures alone to have them found.",
) -> CaptureError:
    """The error for poses that are not there."""
    return CaptureError(message, code="poses_missing", hint=hint)


def number(value: Any, what: str) -> float:
    """A finite number from JSON. Raises CaptureError poses_malformed naming `what`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise malformed(f"{what} is not a number.")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise malformed(f"{what} is not a finite number.")
    return result


def numbers(values: Any, count: int, what: str) -> list[float]:
    """A list of `count` finite numbers from JSON; errors as `number`."""
    if not isinstance(values, list) or len(values) != count:
        raise malformed(f"{what} is not a list of {count} numbers.")
    return [number(value, what) for value in values]


def pose_rows(rows: Any, what: str) -> Rows:
    """The upper rows [3, 4] of a 3x4 or 4x4 matrix from JSON; errors as `number`."""
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise malformed(f"{what} is not a 4x4 matrix.")
    return tuple(tuple(numbers(row, 4, f"A row of {what}")) for row in rows[:3])


def z_up_from_y_up(rows: Rows) -> Rows:
    """A pose in ARKit's gravity frame (+Y up), in ours (+Z up): x' = z, y' = x, z' = y."""
    return (rows[2], rows[0], rows[1])


def arkit_notes() -> dict[str, Any]:
    """Notes of a world whose poses `z_up_from_y_up` has turned, and what that was."""
    turn = [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]
    return {"world": "ARKit, turned to +Z up", "applied_transform": turn}


def rotation_of(quaternion: Sequence[float], what: str) -> Rows:
    """The rotation of a quaternion (x, y, z, w) of any length but zero. Rows [3, 3].

    Raises CaptureError poses_malformed.
    """
    length = math.sqrt(sum(value * value for value in quaternion))
    if not 0.5 < length < 2.0:
        raise malformed(f"The pose of {what} has no rotation.")
    x, y, z, w = (value / length for value in quaternion)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def pose_of_opencv(camera_from_world: Rows, translation: Sequence[float]) -> Rows:
    """Our pose, of a rotation [3, 3] and a translation that turn the world into an OpenCV camera.

    So photogrammetry programs write it: x_camera = rotation @ x_world + translation, +Y down, looks
    along +Z. Rows [3, 4].
    """
    r, t = camera_from_world, translation
    return tuple(
        (r[0][i], -r[1][i], -r[2][i], -(r[0][i] * t[0] + r[1][i] * t[1] + r[2][i] * t[2]))
        for i in range(3)
    )


def opengl_camera(rows: Rows) -> Rows:
    """A pose of an OpenCV camera (+Y down, looks along +Z), of the OpenGL camera that it is."""
    return tuple((x, -y, -z, place) for x, y, z, place in rows)


def each_frame(
    archive: CaptureArchive,
    frames: Mapping[str, Frame],
    parse: Callable[[str, Frame], PosedSource | None],
) -> tuple[list[PosedSource], list[CaptureError]]:
    """What `parse` makes of each frame, and the errors of those that it cannot use.

    frames: what is known of each picture, by its name in the archive. What `parse` returns None for
    is no frame, and nothing is told.
    """
    sources: list[PosedSource] = []
    failures: list[CaptureError] = []
    for name, frame in frames.items():
        try:
            source = parse(name, frame)
            if source is not None:
                sources.append(source)
        except CaptureError as error:
            if error.code not in FRAME_FAULTS:
                raise
            failures.append(error)
            archive.told([name])
    return sources, failures


def resized(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The intrinsics for the picture's real size.

    Raises CaptureError poses_malformed where the aspect differs: the picture was turned or cut.
    """
    if lens.width < 1 or lens.height < 1:
        raise malformed("The intrinsics are for a picture without pixels.")
    scale_x, scale_y = width / lens.width, height / lens.height
    if abs(scale_x / scale_y - 1) > _ASPECT_SLACK:
        raise malformed(
            f"A picture is {width}x{height}, but its intrinsics are for {lens.width}x{lens.height}."
        )
    return replace(
        lens,
        width=width,
        height=height,
        fl_x=lens.fl_x * scale_x,
        fl_y=lens.fl_y * scale_y,
        cx=lens.cx * scale_x,
        cy=lens.cy * scale_y,
    )


def some_of(names: Iterable[str], most: int = 5) -> str:
    """A few names for a message."""
    listed = sorted(names)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(shown(name) for name in listed[:most]) + more
