"""Agisoft Metashape's camera export (XML) beside the pictures.

    document/chunk/sensors/sensor      type, resolution, calibration (adjusted before initial)
    document/chunk/components          each with a transform of its own
    document/chunk/cameras/(group/)camera   label, sensor_id, component_id, transform (4x4)
    document/chunk/transform           rotation translation scale, where there are no components
    document/chunk/reference           WKT of the coordinate system

A camera's transform is world_from_camera in its component, OpenCV camera. A rig's other cameras
have master_id in its place: their sensor's rotation and location turn them into their master. What
brings a component into the chunk's coordinates is scale * rotation @ x + translation; these are
metres, and where the reference is no local system, geocentric: then east, north and up at the
cameras become our axes, in double precision. Without any transform the world is structure from
motion's.

Lens (f cx cy b1 b2 k1..k4 p1 p2): pixel = size / 2 + c + f * distorted, the centre of the top-left
pixel at (0.5, 0.5). Agisoft's p1 is OpenCV's p2 and the other way round; b1 adds to the horizontal
focal length; type fisheye has the same terms of the angle. What has no equal (b2, a skew, p3, p4)
is left out, and told in pixels. A label is a picture's name, often without its suffix.
Source: Metashape Professional user manual, appendix "Camera models".
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from xml.etree.ElementTree import Element

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, Rows, Up
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.listed_pictures import match_pictures
from pipelines.captures.parsing import each_frame, malformed, missing, resized, some_of
from pipelines.captures.safe_xml import parse_xml
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.natural_order import natural_key

_HEAD = re.compile(
    rb"(\xef\xbb\xbf)?\s*(<\?xml[^>]*\?>\s*)?"
    rb"(<document\s+version=\"[0-9.]+\"[^>]*>\s*<chunk[\s/>]|<!DOCTYPE\s+document)"
)
_MODELS = {"frame": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
_TERMS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_OFF = frozenset({"0", "false", "False"})
_SEMI_AXES_M = (6_378_137.0, 6_378_137.0, 6_356_752.314)
"""WGS 84's."""
_EARTH_M = (6.2e6, 6.5e6)
"""How far from the earth's middle its surface is."""
_TOLD_PX = 0.5
_MOST_PIXELS = 1e9

Matrix = tuple[tuple[float, ...], ...]


def claims(listing: Listing) -> Claim | None:
    """An archive with such a file, the least deep one."""
    found = [
        (name.count("/"), name)
        for name, head in listing.heads.items()
        if name.lower().endswith(".xml") and _HEAD.match(head)
    ]
    if not found:
        return None
    folder, _, file = min(found)[1].rpartition("/")
    return Claim(f"{folder}/" if folder else "", file)


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures of the aligned cameras of one world.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    name = claim.root + claim.why
    file = shown(name)
    chunk, warnings = _chunk(parse_xml(archive.read(name), file), file)
    export = _Export(chunk)
    cameras, told = export.usable(file)
    chosen, others = export.of_one_world(cameras)
    matched = match_pictures(archive, file, [camera.path for camera in chosen], claim.root)
    by_path = {camera.path: camera for camera in reversed(chosen)}
    sources, failures = each_frame(
        archive,
        {picture: by_path[path] for path, picture in matched.found.items()},
        export.source,
    )
    metric = export.worlds.get(chosen[0].component) is not None
    notes: dict[str, object] = {"world": "Metashape's", "coordinate_system": export.reference}
    up: Up = "assumed" if metric else "unknown"
    if metric and export.is_geocentric(sources):
        sources, notes["applied_transform"] = _east_north_up(sources)
        up = "known"
    return PosedPictures(
        sources=sorted(sources, key=lambda source: natural_key(source.name)),
        failures=failures,
        metric=metric,
        up=up,
        notes=notes,
        details={
            "num_listed": len(chosen),
            "num_missing": len(matched.absent),
            "num_sensors": len(export.sensors),
        },
        warnings=[*warnings, *told, *others, *matched.warnings, *export.warnings],
    )


def _chunk(document: Element, file: str) -> tuple[Element, list[str]]:
    """The chunk with most cameras, and a warning where there are others."""
    chunks = [chunk for chunk in document.iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise missing(f"{file} has no cameras.")
    counts = [sum(1 for _ in chunk.iterfind("cameras//camera")) for chunk in chunks]
    best = max(range(len(chunks)), key=counts.__getitem__)
    if len(chunks) == 1:
        return chunks[0], []
    return chunks[best], [
        f'{file} has {len(chunks)} chunks; "{shown(chunks[best].get("label", ""))}" is read, which '
        f"has most cameras ({counts[best]})."
    ]


@dataclass(frozen=True)
class _Camera:
    """One camera. path: of its picture. number, sensor, component, master: ids, "" for none."""

    path: str
    number: str
    sensor: str
    component: str
    master: str
    is_on: bool
    transform: Element | None


@dataclass(frozen=True)
class _World:
    """x -> scale * rotation @ x + translation."""

    rotation: Matrix
    translation: Sequence[float]
    scale: float

    def moved(self, pose: Rows) -> Rows:
        """A pose of the component, in the chunk's coordinates."""
        turned = _product(self.rotation, pose)
        return tuple(
            (*row[:3], self.scale * row[3] + t)
            for row, t in zip(turned, self.translation, strict=True)
        )


class _Export:
    """A chunk: sensors by id, cameras, worlds by the ids of components ("" for the chunk's own)."""

    def __init__(self, chunk: Element) -> None:
        self.sensors = {item.get("id", ""): item for item in chunk.iterfind("sensors/sensor")}
        self.worlds = _worlds(chunk)
        self.reference = (chunk.findtext("reference") or "").strip()[:500]
        self._cameras = _cameras(chunk)
        self._by_number = {camera.number: camera for camera in self._cameras}
        self._lenses: dict[str, Intrinsics] = {}
        self._left_px: dict[str, float] = {}
        self._initial: set[str] = set()

    def usable(self, file: str) -> tuple[list[_Camera], list[str]]:
        """The cameras that are on and have a pose, and what is to be told of the others.

        Raises CaptureError poses_missing where there is none.
        """
        off = [camera.path for camera in self._cameras if not camera.is_on]
        lost = [camera.path for camera in self._cameras if camera.is_on and not self._posed(camera)]
        used = [camera for camera in self._cameras if camera.is_on and self._posed(camera)]
        if not used:
            raise missing(
                f"{file} has {len(self._cameras)} cameras, and none is both aligned and on.",
                "Align the photos, and export the cameras again; or send the pictures alone.",
            )
        told = []
        if lost:
            told.append(f"{len(lost)} cameras in {file} are not aligned: {some_of(lost)}.")
        if off:
            told.append(f"{len(off)} cameras in {file} are switched off: {some_of(off)}.")
        return used, told

    def of_one_world(self, cameras: Sequence[_Camera]) -> tuple[list[_Camera], list[str]]:
        """Those that lie in one world, the largest, and what is to be told of the others.

        Components that have a transform each lie in the chunk's coordinates together.
        """
        groups: dict[str, list[_Camera]] = {}
        for camera in cameras:
            is_placed = self.worlds.get(camera.component) is not None
            groups.setdefault("placed" if is_placed else f"of {camera.component}", []).append(
                camera
            )
        best = max(groups.values(), key=len)
        others = [camera.path for group in groups.values() if group is not best for camera in group]
        if not others:
            return best, []
        return best, [
            f"{len(others)} cameras lie in components of their own, whose place is not known, and "
            f"are left out: {some_of(others)}."
        ]

    def is_geocentric(self, sources: Sequence[PosedSource]) -> bool:
        """Whether the world starts at the middle of the earth."""
        if not sources or not self.reference or self.reference.startswith("LOCAL_CS"):
            return False
        low, high = _EARTH_M
        return low < math.hypot(*_middle(sources)) < high

    def source(self, picture: str, camera: _Camera) -> PosedSource:
        """A camera's picture. Raises CaptureError poses_malformed."""
        pose = self._pose(camera, f'"{shown(picture)}"')
        world = self.worlds.get(camera.component)
        rows = pose if world is None else world.moved(pose)
        lens = self._lens(camera.sensor, f'"{shown(picture)}"')
        return PosedSource(
            name=picture,
            lens=partial(resized, lens),
            world_from_camera=tuple((row[0], -row[1], -row[2], row[3]) for row in rows),
        )

    @property
    def warnings(self) -> list[str]:
        """What is to be told of the lenses that were asked for."""
        told = []
        left = {number: px for number, px in self._left_px.items() if px > _TOLD_PX}
        if left:
            told.append(
                f"{len(left)} of {len(self._lenses)} lenses have a skew or higher terms (b2, p3, "
                f"p4) that have no equal here: up to {max(left.values()):.1f} px at a corner."
            )
        if self._initial:
            told.append(
                f"{len(self._initial)} of {len(self._lenses)} sensors were not calibrated by the "
                f"alignment; what they started from is taken: {some_of(self._initial)}."
            )
        return told

    def _posed(self, camera: _Camera) -> bool:
        return camera.transform is not None or self._master(camera) is not None

    def _master(self, camera: _Camera) -> _Camera | None:
        """The camera of a rig that this one is held by, where it is another one with a pose."""
        master = self._by_number.get(camera.master)
        return None if master is None or master is camera or master.transform is None else master

    def _pose(self, camera: _Camera, what: str) -> Rows:
        """world_from_camera [3, 4] in the camera's component, OpenCV camera."""
        if camera.transform is not None:
            return _pose_of(_numbers(camera.transform, 16, f"the transform of {what}"))
        master = self._master(camera)
        sensor = self.sensors.get(camera.sensor)
        rotation = None if sensor is None else sensor.find("rotation")
        location = None if sensor is None else sensor.find("location")
        if master is None or master.transform is None or rotation is None or location is None:
            raise malformed(f"The rig that holds {what} does not say where.")
        held = _numbers(rotation, 9, f"the rotation of {what} in its rig")
        place = _numbers(location, 3, f"the location of {what} in its rig")
        pose = _pose_of(_numbers(master.transform, 16, f"the transform of {what}'s master"))
        rows = tuple((*held[3 * n : 3 * n + 3], place[n]) for n in range(3))
        turned = _product(tuple(row[:3] for row in pose), rows)
        return tuple((*a[:3], a[3] + b[3]) for a, b in zip(turned, pose, strict=True))

    def _lens(self, number: str, what: str) -> Intrinsics:
        if number not in self._lenses:
            sensor = self.sensors.get(number)
            if sensor is None:
                raise malformed(
                    f'{what} was taken by sensor "{shown(number)}", which is not there.'
                )
            found = _lens(sensor, what)
            self._lenses[number] = found.lens
            self._left_px[number] = found.left_px
            if not found.is_adjusted:
                self._initial.add(sensor.get("label") or number)
        return self._lenses[number]


def _cameras(chunk: Element) -> list[_Camera]:
    """All cameras with a label. Where two have the same, their groups' labels are its folders."""
    found = chunk.find("cameras")
    listed = [] if found is None else _in_groups(found, "")
    labels = Counter(element.get("label", "").strip() for _, element in listed)
    return [
        _Camera(
            path=f"{folder}{label}" if labels[label] > 1 else label,
            number=element.get("id", ""),
            sensor=element.get("sensor_id", ""),
            component=element.get("component_id", ""),
            master=element.get("master_id", ""),
            is_on=element.get("enabled") not in _OFF,
            transform=element.find("transform"),
        )
        for folder, element in listed
        if (label := element.get("label", "").strip())
    ]


def _in_groups(parent: Element, folder: str) -> list[tuple[str, Element]]:
    """(folder, camera) of all cameras below an element."""
    found = []
    for element in parent:
        if element.tag == "camera":
            found.append((folder, element))
        elif element.tag == "group":
            label = element.get("label", "").strip().strip("/")
            found += _in_groups(element, f"{folder}{label}/" if label else folder)
    return found


def _worlds(chunk: Element) -> dict[str, _World]:
    """What brings components into the chunk's coordinates, by their ids, as far as it is known."""
    elements = {item.get("id", ""): item for item in chunk.iterfind("components/component")}
    worlds = {number: world for number, item in elements.items() if (world := _world(item))}
    own = _world(chunk)
    if own is not None:
        worlds.setdefault("", own)
        if len(elements) == 1:  # the chunk's transform is that of its one component
            worlds.setdefault(next(iter(elements)), own)
    return worlds


def _world(element: Element) -> _World | None:
    transform = element.find("transform")
    parts = (
        []
        if transform is None
        else [transform.find(name) for name in ("rotation", "translation", "scale")]
    )
    if not parts or any(part is None for part in parts):
        return None
    rotation, translation, scale = (part for part in parts if part is not None)
    what = "of a component or chunk"
    r = _numbers(rotation, 9, f"the rotation {what}")
    t = _numbers(translation, 3, f"the translation {what}")
    (s,) = _numbers(scale, 1, f"the scale {what}")
    if s <= 0:
        raise malformed(f"The scale {what} is {s:g}.")
    return _World((tuple(r[:3]), tuple(r[3:6]), tuple(r[6:])), t, s)


def _numbers(element: Element, count: int, what: str) -> list[float]:
    """The numbers in an element's text. Raises CaptureError poses_malformed."""
    words = (element.text or "").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise malformed(f"{what[0].upper()}{what[1:]} is not {count} finite numbers.")
    return values


def _pose_of(values: Sequence[float]) -> Rows:
    """The upper rows of a 4x4 matrix, row-major."""
    return tuple(tuple(values[4 * n : 4 * n + 4]) for n in range(3))


def _product(a: Matrix, b: Rows) -> Rows:
    """a [3, 3] times b [3, N]."""
    columns = list(zip(*b, strict=True))
    return tuple(
        tuple(sum(x * y for x, y in zip(row, column, strict=True)) for column in columns)
        for row in a
    )


@dataclass(frozen=True)
class _Found:
    """A sensor's lens. left_px: how far terms without an equal move a corner of the picture."""

    lens: Intrinsics
    left_px: float
    is_adjusted: bool


def _lens(sensor: Element, what: str) -> _Found:
    """Raises CaptureError poses_malformed for a sensor that has none, or none that we have."""
    kind = sensor.get("type", "frame")
    if kind not in _MODELS:
        raise malformed(
            f'The sensor of {what} is of type "{shown(kind)}"; frame and fisheye can be used.',
            "Export undistorted photos from Metashape, and their cameras.",
        )
    calibrations = {item.get("class", ""): item for item in sensor.iterfind("calibration")}
    calibration = calibrations.get("adjusted")
    is_adjusted = calibration is not None
    if calibration is None:
        calibration = next(iter(calibrations.values()), None)
    size = sensor.find("resolution")
    if calibration is not None and calibration.find("resolution") is not None:
        size = calibration.find("resolution")
    if size is None:
        raise malformed(f"The sensor of {what} has no resolution.")
    try:
        width, height = int(size.get("width", "")), int(size.get("height", ""))
    except ValueError as error:
        raise malformed(f"The resolution of the sensor of {what} is none.") from error
    terms = dict.fromkeys(_TERMS, 0.0)
    if calibration is None:
        terms["f"] = _stated_focal(sensor, what)
    else:
        for name in _TERMS:
            element = calibration.find(name)
            if element is not None:
                (terms[name],) = _numbers(element, 1, f"{name} of the sensor of {what}")
    if not (0 < width < _MOST_PIXELS and 0 < height < _MOST_PIXELS):
        raise malformed(f"The resolution of the sensor of {what} is none.")
    if not 1.0 <= abs(terms["f"]) < _MOST_PIXELS:
        raise malformed(f"The sensor of {what} has no focal length f in pixels.")
    lens = Intrinsics(
        width=width,
        height=height,
        fl_x=terms["f"] + terms["b1"],
        fl_y=terms["f"],
        cx=width / 2 + terms["cx"],
        cy=height / 2 + terms["cy"],
        model=_MODELS[kind],
        **{name: terms[name] for name in ("k1", "k2", "k3", "k4")},
        p1=0.0 if kind == "fisheye" else terms["p2"],
        p2=0.0 if kind == "fisheye" else terms["p1"],
    )
    if kind == "frame" and not any(terms[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2")):
        lens = replace(lens, model="PINHOLE")
    return _Found(lens, _left_px(terms, kind, width, height), is_adjusted)


def _stated_focal(sensor: Element, what: str) -> float:
    """The focal length in pixels of a sensor without a calibration, by what the camera says."""
    values = {}
    for item in sensor.iterfind("property"):
        try:
            values[item.get("name", "")] = float(item.get("value", ""))
        except ValueError:
            continue
    focal, pixel = values.get("focal_length", 0.0), values.get("pixel_width", 0.0)
    if not (focal > 0 and pixel > 0):
        raise malformed(f"The sensor of {what} has neither a calibration nor a focal length.")
    return focal / pixel


def _left_px(terms: Mapping[str, float], kind: str, width: int, height: int) -> float:
    """How far b2, p3 and p4, and a fisheye's p1 and p2, move the corner of a picture, pixels."""
    x, y = width / 2 / terms["f"], height / 2 / terms["f"]
    square = x * x + y * y
    tangential = math.hypot(
        terms["p1"] * (square + 2 * x * x) + 2 * terms["p2"] * x * y,
        terms["p2"] * (square + 2 * y * y) + 2 * terms["p1"] * x * y,
    )
    higher = abs(terms["p3"] * square + terms["p4"] * square**2)
    left = tangential * (higher + (1.0 if kind == "fisheye" else 0.0))
    return abs(terms["b2"]) * y + abs(terms["f"]) * left


def _middle(sources: Sequence[PosedSource]) -> list[float]:
    """The mean place of the cameras."""
    return [sum(s.world_from_camera[n][3] for s in sources) / len(sources) for n in range(3)]


def _east_north_up(sources: Sequence[PosedSource]) -> tuple[list[PosedSource], Matrix]:
    """Geocentric poses in the axes east, north and up at their middle; and the move, [3, 4]."""
    origin = _middle(sources)
    up = _unit([x / a**2 for x, a in zip(origin, _SEMI_AXES_M, strict=True)])
    east = _unit([-up[1], up[0], 0.0]) if math.hypot(*up[:2]) > 1e-9 else [1.0, 0.0, 0.0]
    north = [
        up[1] * east[2] - up[2] * east[1],
        up[2] * east[0] - up[0] * east[2],
        up[0] * east[1] - up[1] * east[0],
    ]
    axes = (tuple(east), tuple(north), tuple(up))
    moved = []
    for source in sources:
        near = tuple(
            (*row[:3], row[3] - at)
            for row, at in zip(source.world_from_camera, origin, strict=True)
        )
        moved.append(replace(source, world_from_camera=_product(axes, near)))
    shift = [-sum(x * y for x, y in zip(axis, origin, strict=True)) for axis in axes]
    return moved, tuple((*axis, t) for axis, t in zip(axes, shift, strict=True))


def _unit(vector: Sequence[float]) -> list[float]:
    length = math.hypot(*vector)
    return [value / length for value in vector]


IMPORTER = Importer(
    kind="metashape",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.metashape:read",
)
