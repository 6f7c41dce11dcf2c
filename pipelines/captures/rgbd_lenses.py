"""Intrinsics of RGB-D folders: their files, what they are for, and what publishers say.

    intrinsic/intrinsic_color.txt, intrinsic_color.txt, intrinsics_color.txt, camera-intrinsics.txt,
    camera_intrinsics.txt, intrinsics.txt, intrinsic.txt, K.txt     a matrix, or fx fy cx cy
    cam_params.json    camera: w h fx fy cx cy, scale (counts of depth to a metre)

in the capture's folder, or in the one above, where several captures share a file. Pixel centres are
at integers, as OpenCV has them. A file without a size is for the pictures as they are: a principal
point far from their middle says that it is not, and is refused.
Standard library only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial

from pipelines.captures.archive_rules import shown
from pipelines.captures.matrix_files import broken, lens_of, read_matrix
from pipelines.captures.parsing import missing, number, resized
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics

_FILES = (
    "intrinsic/intrinsic_color.txt",
    "intrinsic_color.txt",
    "intrinsics_color.txt",
    "camera-intrinsics.txt",
    "camera_intrinsics.txt",
    "intrinsics.txt",
    "intrinsic.txt",
    "K.txt",
    "cam_params.json",
)
_OF_DEPTH = ("intrinsic_color.txt", "intrinsic_depth.txt")
"""The name of a file for colour, and that of its sibling for depth."""
_SAME_VIEW = 0.02
_MILLIMETRE = 0.001
_PIXEL_CENTRE = 0.5
_MIDDLE = (0.35, 0.65)
"""Where a principal point may be, as a share of the picture's side."""

Lens = Callable[[int, int], Intrinsics]


@dataclass(frozen=True)
class RgbdCamera:
    """The camera of a folder.

    lens: as in `PosedSource`. depth_lens: that of its depth, where it is another. depth_unit:
    metres per count; None where depth shows another view than the pictures, for the reason
    `why_no_depth`.
    """

    lens: Lens
    depth_unit: float | None = _MILLIMETRE
    why_no_depth: str = ""
    warnings: tuple[str, ...] = ()
    depth_lens: Lens | None = None


@dataclass(frozen=True)
class _Published:
    """What the publisher of a data set says of it, for folders that hold no file of it."""

    name: str
    lens: Intrinsics
    depth_unit: float
    depth_lens: Intrinsics | None = None


SEVEN_SCENES = _Published(
    "7-Scenes",
    Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0),
    _MILLIMETRE,
    Intrinsics(640, 480, 585.0, 585.0, 320.0, 240.0),
)
"""Source: the data set's page (depth, 585) and its public readers (colour, 525). Both cameras stand
2 cm apart, which is left out."""
REPLICA = _Published("Replica", Intrinsics(1200, 680, 600.0, 600.0, 600.0, 340.0), 1.0 / 6553.5)
"""Source: cam_params.json, as NICE-SLAM publishes it beside the scenes: 599.5, 339.5."""
REPLICA_SEMANTIC = _Published(
    "Replica", Intrinsics(640, 480, 320.0, 320.0, 320.0, 240.0), _MILLIMETRE
)
"""Source: the renderings of Semantic-NeRF, 90 degrees wide: 319.5, 239.5."""


def find_lens_file(names: Collection[str], root: str) -> str | None:
    """The file of intrinsics of a folder ("" or ending with "/"), or None."""
    above = root[: root[:-1].rfind("/") + 1]
    folders = dict.fromkeys((root, above))
    return next((f + file for f in folders for file in _FILES if f + file in names), None)


def read_camera(archive: CaptureArchive, root: str, published: _Published | None) -> RgbdCamera:
    """The camera of the folder `root`; without a file the published one.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    file = find_lens_file(archive.names, root)
    if file is None:
        if published is None:
            raise missing(
                "There are no intrinsics beside the poses, as a file K.txt with the 3x3 matrix."
            )
        own = published.depth_lens
        of_depth = "" if own is None else f", that of depth {own.fl_x:g}"
        return RgbdCamera(
            partial(resized, published.lens),
            published.depth_unit,
            warnings=(
                "There are no intrinsics beside the poses; those published for "
                f"{published.name} are taken: focal length {published.lens.fl_x:g} at "
                f"{published.lens.width}x{published.lens.height}{of_depth}.",
            ),
            depth_lens=None if own is None else partial(resized, own),
        )
    if file.endswith(".json"):
        return _of_json(archive, file)
    what = f'"{shown(file)}"'
    k = lens_of(read_matrix(archive, file), what)
    why = _other_view(archive, file, k)
    return RgbdCamera(partial(lens_of_picture, k, what), None if why else _MILLIMETRE, why)


def lens_of_picture(
    k: tuple[float, float, float, float], what: str, width: int, height: int
) -> Intrinsics:
    """The lens of a picture of that size, of fx, fy, cx, cy that do not say what size they are for.

    Raises CaptureError poses_malformed where their middle is far from the picture's.
    """
    fx, fy, cx, cy = k
    low, high = _MIDDLE
    if not (low < cx / width < high and low < cy / height < high):
        raise broken(
            f"{what} is for a picture of about {2 * cx:.0f}x{2 * cy:.0f}, and a picture is "
            f"{width}x{height}."
        )
    return Intrinsics(width, height, fx, fy, cx + _PIXEL_CENTRE, cy + _PIXEL_CENTRE)


def _other_view(archive: CaptureArchive, file: str, k: tuple[float, float, float, float]) -> str:
    """Why depth shows another view, by the intrinsics of its own that lie beside; "" if it does
    not, or has none. Sizes are not known here: the principal point stands for them."""
    own = file.replace(*_OF_DEPTH)
    if own == file or own not in archive.names:
        return ""
    depth = lens_of(read_matrix(archive, own), f'"{shown(own)}"')
    if min(*depth, *k) <= 0:
        raise broken(f'"{shown(own)}" or "{shown(file)}" is not of a camera.')
    ratios = [(depth[axis] / depth[axis + 2]) / (k[axis] / k[axis + 2]) for axis in (0, 1)]
    if all(abs(ratio - 1) <= _SAME_VIEW for ratio in ratios):
        return ""
    return f"by {shown(own)} their camera sees another view than the pictures'"


def _of_json(archive: CaptureArchive, file: str) -> RgbdCamera:
    values = archive.read_json(file)
    values = values.get("camera", values) if isinstance(values, dict) else None
    if not isinstance(values, dict):
        raise broken(f'"{shown(file)}" has no camera.')
    w, h, fx, fy, cx, cy = (
        number(values.get(key), f'{key} of "{shown(file)}"')
        for key in ("w", "h", "fx", "fy", "cx", "cy")
    )
    scale = number(values.get("scale", 1.0 / _MILLIMETRE), f'scale of "{shown(file)}"')
    if scale <= 0:
        raise broken(f'scale of "{shown(file)}" is not above 0.')
    lens = Intrinsics(round(w), round(h), fx, fy, cx + _PIXEL_CENTRE, cy + _PIXEL_CENTRE)
    return RgbdCamera(partial(resized, lens), 1.0 / scale)
