"""OpenSfM's reconstruction, or what OpenDroneMap makes of it, beside the pictures.

    reconstruction.json          a list of reconstructions, in opensfm/ or anywhere
    cameras.json, shots.geojson  OpenDroneMap's outputs, where that file is not there
    images/<name of the shot>

Cameras: projection_type and normalised numbers. Lengths are in units of the picture's longer side,
the principal point (c_x, c_y) counts from its middle: pixel = side * c + size / 2, the centre of
the top-left pixel at (0.5, 0.5). perspective has focal k1 k2; brown focal_x focal_y c_x c_y k1 k2
k3 p1 p2; radial and simple_radial the same without the rest; fisheye k1 k2 and fisheye_opencv k1 to
k4 of the angle. Others are refused by name.

A shot of reconstruction.json has rotation (axis times angle) and translation of camera_from_world,
OpenCV camera; its world is a plane tangent to the earth, +Z up, metres where GPS was used. A shot
of shots.geojson has the same rotation, and for translation the camera's place in map coordinates.
Of several reconstructions the one with most pictures is read; its points are kept.
Source: OpenSfM, opensfm/io.py and src/geometry; OpenDroneMap, opendm/shots.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, Rows, SparsePoints
from pipelines.captures.importer import Claim, Importer, Listing, folders_above
from pipelines.captures.listed_pictures import match_pictures
from pipelines.captures.parsing import (
    each_frame,
    malformed,
    missing,
    number,
    numbers,
    pose_of_opencv,
    resized,
    some_of,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.natural_order import natural_key

_FILE = "reconstruction.json"
_SHOTS = "shots.geojson"
_CAMERAS = "cameras.json"
_LIST = re.compile(rb"(\xef\xbb\xbf)?\s*\[\s*\{")
"""How a list of reconstructions starts."""
_MOST_BYTES = 256 << 20
_MOST_MODELS = 1000
_MOST_DOP = 100.0
"""Dilution of precision above which a shot's GPS is none: OpenSfM writes 999999 where there is."""
_FEW = 3

_TERMS = {
    "perspective": ("OPENCV", ("k1", "k2")),
    "simple_radial": ("OPENCV", ("k1",)),
    "radial": ("OPENCV", ("k1", "k2")),
    "brown": ("OPENCV", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2")),
    "fisheye_opencv": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
"""Our model and the terms that it takes, by projection_type."""
_SCALARS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3", "transition")

Values = Mapping[str, Any]


def claims(listing: Listing) -> Claim | None:
    """An archive with a list in `reconstruction.json`, or with OpenDroneMap's two files."""
    for root in listing.roots_of(_FILE):
        if _LIST.match(listing.heads[root + _FILE]):
            return Claim(root, _FILE)
    for root in listing.roots_of(_SHOTS):
        name = root + _SHOTS
        if b"FeatureCollection" in listing.heads[name] and _cameras_above(name, listing.heads):
            return Claim(root, _SHOTS)
    return None


def _cameras_above(shots: str, names: Collection[str]) -> str | None:
    """OpenDroneMap's file of cameras: beside that of shots, or in the nearest folder above."""
    found = [folder + _CAMERAS for folder in folders_above(shots) if folder + _CAMERAS in names]
    return found[-1] if found else None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures of the best reconstruction, with its points.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    name = claim.root + claim.why
    parse = _reconstructions if claim.why == _FILE else _shots
    models = parse(archive, name)
    if not any(model.shots for model in models):
        raise missing(f"{shown(name)} has no shots.")
    pictures = {picture.rpartition("/")[2].casefold() for picture in archive.images}
    best = max(
        models,
        key=lambda model: (
            sum(path.rpartition("/")[2].casefold() in pictures for path in model.shots),
            len(model.shots),
        ),
    )
    matched = match_pictures(archive, shown(name), list(best.shots), claim.root)
    faults: list[CaptureError] = []
    sources, failures = each_frame(
        archive,
        {picture: path for path, picture in matched.found.items()},
        lambda picture, path: _source(picture, path, best),
    )
    points = _points(best.points, faults)
    others = [len(model.shots) for model in models if model is not best]
    warnings = list(matched.warnings)
    if others:
        warnings.append(
            f"{shown(name)} has {len(models)} reconstructions; the one with {len(best.shots)} "
            f"shots is read, those with {', '.join(map(str, others))} lie in worlds of their own."
        )
    warnings += [f"The points are not used. {fault.message}" for fault in faults]
    return PosedPictures(
        sources=sorted(sources, key=lambda source: natural_key(source.name)),
        failures=failures,
        metric=best.metric,
        up="assumed",
        points=points,
        notes={"world": best.world, **({"reference_lla": best.origin} if best.origin else {})},
        details={
            "num_listed": len(best.shots),
            "num_missing": len(matched.absent),
            "num_points": 0 if points is None else len(points.places),
        },
        warnings=warnings,
    )


@dataclass(frozen=True)
class _Model:
    """A reconstruction. shots: by the names of pictures. is_placed: whether a shot's translation is
    the camera's place. origin: latitude, longitude, altitude that its world starts from, or {}."""

    file: str
    cameras: Values
    shots: Values
    points: Values
    metric: bool
    world: str
    is_placed: bool = False
    origin: Mapping[str, float] | None = None


def _reconstructions(archive: CaptureArchive, name: str) -> list[_Model]:
    raw = archive.read_json(name, _MOST_BYTES)
    if not isinstance(raw, list) or not raw:
        raise missing(f"{shown(name)} has no reconstructions.")
    if len(raw) > _MOST_MODELS:
        raise malformed(f"{shown(name)} has {len(raw)} reconstructions; {_MOST_MODELS} are read.")
    models = []
    for index, entry in enumerate(raw):
        entry = entry if isinstance(entry, dict) else {"shots": None}
        parts = [entry.get(key, {}) for key in ("cameras", "shots", "points")]
        if not all(isinstance(part, dict) for part in parts):
            raise malformed(f"Reconstruction {index} of {shown(name)} is none.")
        cameras, shots, points = parts
        metric = sum(_has_gps(shot) for shot in shots.values()) >= _FEW
        models.append(
            _Model(
                name,
                cameras,
                shots,
                points,
                metric,
                "OpenSfM's, +Z up" + (", metres by GPS" if metric else ", of no known unit"),
                origin=_origin(entry.get("reference_lla")) if metric else None,
            )
        )
    return models


def _origin(value: Any) -> dict[str, float] | None:
    keys = ("latitude", "longitude", "altitude")
    if not isinstance(value, dict) or not all(key in value for key in keys):
        return None
    return {key: number(value[key], f"{key} of reference_lla") for key in keys}


def _has_gps(shot: Any) -> bool:
    dop = shot.get("gps_dop") if isinstance(shot, dict) else None
    return isinstance(dop, int | float) and 0 <= dop <= _MOST_DOP and "gps_position" in shot


def _shots(archive: CaptureArchive, name: str) -> list[_Model]:
    """The one model of OpenDroneMap's files, in map coordinates, metres."""
    cameras_file = _cameras_above(name, archive.names)
    if cameras_file is None:
        raise missing(f"There is no {_CAMERAS} beside {shown(name)}, or in a folder above.")
    cameras = archive.read_json(cameras_file)
    collection = archive.read_json(name)
    features = collection.get("features") if isinstance(collection, dict) else None
    if not isinstance(cameras, dict) or not isinstance(features, list):
        raise malformed(f"{shown(name)} or {shown(cameras_file)} is not OpenDroneMap's.")
    shots = {}
    for index, feature in enumerate(features):
        values = feature.get("properties") if isinstance(feature, dict) else None
        file = values.get("filename") if isinstance(values, dict) else None
        if not isinstance(file, str) or not file:
            raise malformed(f"Feature {index} of {shown(name)} names no picture.")
        shots[file] = values
    world = "map coordinates of OpenDroneMap, +Z up, metres"
    return [_Model(name, cameras, shots, {}, True, world, is_placed=True)]


def _source(picture: str, path: str, model: _Model) -> PosedSource:
    what = f'"{shown(picture)}"'
    shot = model.shots[path]
    if not isinstance(shot, dict):
        raise malformed(f"The shot of {what} is none.")
    rotation = _rotation(numbers(shot.get("rotation"), 3, f"The rotation of {what}"))
    place = numbers(shot.get("translation"), 3, f"The translation of {what}")
    if model.is_placed:  # pose_of_opencv wants -rotation @ place
        place = [-sum(r * x for r, x in zip(row, place, strict=True)) for row in rotation]
    camera = model.cameras.get(str(shot.get("camera")))
    if not isinstance(camera, dict):
        raise malformed(
            f'{what} was taken by "{shown(str(shot.get("camera")))}", a camera that '
            f"{shown(model.file)} does not have."
        )
    return PosedSource(
        name=picture,
        lens=partial(resized, _lens(camera, f"the camera of {what}")),
        world_from_camera=pose_of_opencv(rotation, place),
    )


def _rotation(vector: Sequence[float]) -> Rows:
    """The rotation about a vector, by its length in radians. Rows [3, 3]. Source: Rodrigues."""
    angle = math.sqrt(sum(value * value for value in vector))
    if not angle < 1e3:
        raise malformed(f"A rotation of {angle:.3g} radians is none.")
    if angle < 1e-12:
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    x, y, z = (value / angle for value in vector)
    c, s = math.cos(angle), math.sin(angle)
    d = 1.0 - c
    return (
        (c + x * x * d, x * y * d - z * s, x * z * d + y * s),
        (y * x * d + z * s, c + y * y * d, y * z * d - x * s),
        (z * x * d - y * s, z * y * d + x * s, c + z * z * d),
    )


def _lens(camera: Values, what: str) -> Intrinsics:
    kind = camera.get("projection_type")
    if not isinstance(kind, str) or kind not in _TERMS:
        raise malformed(
            f'The projection of {what} is "{shown(str(kind))}"; {", ".join(_TERMS)} can be used.',
            "Undistort the pictures (opensfm undistort), and send those with their model.",
        )
    model, terms = _TERMS[kind]
    values = {key: number(camera[key], f"{key} of {what}") for key in _SCALARS if camera.get(key)}
    unknown = [key for key in values if key not in terms]
    if unknown:
        raise malformed(f"The terms {some_of(unknown)} of {what} are none of {kind}.")
    width = round(number(camera.get("width"), f"width of {what}"))
    height = round(number(camera.get("height"), f"height of {what}"))
    side = max(width, height)

    def length(*keys: str) -> float:
        key = next((key for key in keys if key in camera), None)
        if key is None:
            raise malformed(f"There is no {keys[0]} for {what}.")
        return number(camera[key], f"{key} of {what}") * side

    return Intrinsics(
        width=width,
        height=height,
        fl_x=length("focal_x", "focal"),
        fl_y=length("focal_y", "focal"),
        cx=number(camera.get("c_x", 0.0), f"c_x of {what}") * side + width / 2,
        cy=number(camera.get("c_y", 0.0), f"c_y of {what}") * side + height / 2,
        model=model,
        **values,
    )


def _points(points: Values, faults: list[CaptureError]) -> SparsePoints | None:
    """The points; None where there are none, or where one is no point, which goes into `faults`."""
    places, colors = [], []
    for key, value in points.items():
        try:
            point = value if isinstance(value, dict) else {}
            places.append(numbers(point.get("coordinates"), 3, f"Point {shown(key)}"))
            color = numbers(point.get("color", [127, 127, 127]), 3, f"The colour of {shown(key)}")
        except CaptureError as error:
            faults.append(error)
            return None
        colors.append([round(min(max(value, 0.0), 255.0)) for value in color])
    return SparsePoints(places, colors) if places else None


IMPORTER = Importer(
    kind="opensfm",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.opensfm:read",
)
