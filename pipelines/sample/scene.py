"""Analytic scenes, and the sample's: a bowl among things at three depths in a painted room.

Everything is known exactly: where a ray hits, in which colour, and how far a point lies from the
nearest surface. World frame: right-handed, +Z up, metres, the floor is z = 0. Of the sample the
subject stands around the origin; `SUBJECT` is the part that its cameras circle around and that
meshes are judged on; `SCENE_SIZE_M`, its longest side, is the size that tolerances refer to. Other
scenes are in `pipelines.sample.scenes`; functions take the sample where none is named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipelines.sample import tracing
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Region:
    """An axis-aligned box in the world, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def size(self) -> float:
        """The longest side, metres."""
        return max(b - a for a, b in zip(self.low, self.high, strict=True))

    def grown(self, by: float) -> Region:
        """The box with all sides moved outwards, metres."""
        low, high = (
            tuple(s + sign * by for s in side)
            for side, sign in ((self.low, -1.0), (self.high, 1.0))
        )
        return Region((low[0], low[1], low[2]), (high[0], high[1], high[2]))

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """points [N, 3] -> [N]."""
        inside: NDArray[np.bool_] = np.all((points >= self.low) & (points <= self.high), axis=1)
        return inside


SUBJECT = Region((-1.1, -1.1, -0.1), (1.1, 1.1, 1.1))
"""The things that the cameras circle around, and the floor below them."""

THINGS = Region((-1.1, -1.1, 0.04), (1.1, 1.1, 1.1))
"""The same without the floor, which fits onto itself under many wrong moves."""

ROOM = Region((-5.0, -4.5, 0.0), (5.0, 4.5, 3.4))
"""All that there is."""

_SAME = 1e-3
"""Of a distance: what is met by so much nearer than a point stands before it."""

_STEP_M = 1e-5
"""Between points whose distances tell a normal."""

SCENE_SIZE_M = SUBJECT.size


@dataclass(frozen=True)
class Primitive:
    """One thing. center: of the solid, world. size: by kind, metres.

    room and box: three half sides. sphere: radius. cylinder: radius and half height. bowl: outer
    and inner radius of a shell whose lower half is kept, open upwards, `center` amid its rim.
    torus: radius of an upright ring around its y axis and of its tube. yaw_deg: turned about +Z.
    patch: size of the colour patches, metres. palette: row of the scene's palettes; the bowl's
    inside and the room's walls take the row after it. detail: strength of the fine paint, of a
    room that of its walls. gloss: share of light mirrored when looked at squarely. glow: brightness
    of what the lamp does not light, 0 for what it does.
    """

    kind: int
    center: tuple[float, float, float]
    size: tuple[float, ...]
    patch: float
    palette: int
    yaw_deg: float = 0.0
    detail: float = 1.0
    gloss: float = 0.0
    glow: float = 0.0

    @property
    def bound(self) -> float:
        """Radius of a sphere around the centre that holds the thing."""
        if self.kind in (tracing.SPHERE, tracing.BOWL):
            return self.size[0]
        if self.kind == tracing.TORUS:
            return sum(self.size)
        return math.sqrt(sum(side * side for side in self.size))


PRIMITIVES: tuple[Primitive, ...] = (
    Primitive(tracing.ROOM, (0.0, 0.0, 1.7), (5.0, 4.5, 1.7), 0.55, 0),
    # The subject: a concave bowl, with a ball, a drum and two crates around it.
    Primitive(tracing.BOWL, (0.0, 0.0, 0.42), (0.42, 0.37), 0.17, 2),
    Primitive(tracing.SPHERE, (0.66, -0.40, 0.19), (0.19,), 0.13, 4),
    Primitive(tracing.CYLINDER, (-0.68, -0.28, 0.27), (0.17, 0.27), 0.15, 5),
    Primitive(tracing.BOX, (0.45, 0.72, 0.22), (0.28, 0.20, 0.22), 0.16, 6, 25.0),
    Primitive(tracing.BOX, (-0.50, 0.68, 0.42), (0.17, 0.17, 0.42), 0.16, 7, -18.0),
    # Farther away, between the subject and the walls.
    Primitive(tracing.SPHERE, (2.5, 1.3, 0.55), (0.55,), 0.28, 5),
    Primitive(tracing.CYLINDER, (0.5, 3.0, 0.9), (0.28, 0.9), 0.28, 4),
    Primitive(tracing.BOX, (-2.6, 1.5, 0.6), (0.45, 0.35, 0.6), 0.30, 6, 30.0),
    Primitive(tracing.BOX, (-1.5, 3.4, 0.4), (0.5, 0.3, 0.4), 0.30, 2, -12.0),
    Primitive(tracing.BOX, (3.4, -1.2, 0.7), (0.3, 0.6, 0.7), 0.30, 7, 10.0),
    Primitive(tracing.CYLINDER, (-3.4, -1.0, 0.8), (0.3, 0.8), 0.30, 3),
)
"""Row 0 is the room; nothing overlaps, things only touch."""

# Four paints a row, sRGB, neighbours in the row being neighbours on the thing.
PALETTES: Floats = np.array(
    [
        [[0.36, 0.27, 0.20], [0.80, 0.68, 0.50], [0.46, 0.50, 0.42], [0.90, 0.84, 0.72]],
        [[0.24, 0.36, 0.52], [0.74, 0.82, 0.88], [0.46, 0.62, 0.50], [0.92, 0.86, 0.66]],
        [[0.10, 0.22, 0.50], [0.20, 0.52, 0.78], [0.90, 0.92, 0.94], [0.08, 0.30, 0.42]],
        [[0.94, 0.80, 0.40], [0.80, 0.34, 0.16], [0.98, 0.92, 0.74], [0.50, 0.14, 0.12]],
        [[0.72, 0.12, 0.14], [0.96, 0.76, 0.66], [0.48, 0.06, 0.24], [0.98, 0.54, 0.30]],
        [[0.12, 0.40, 0.20], [0.70, 0.84, 0.36], [0.06, 0.22, 0.20], [0.90, 0.94, 0.70]],
        [[0.42, 0.20, 0.52], [0.86, 0.70, 0.90], [0.22, 0.10, 0.36], [0.94, 0.58, 0.74]],
        [[0.86, 0.52, 0.10], [0.30, 0.18, 0.08], [0.98, 0.82, 0.44], [0.60, 0.34, 0.14]],
    ]
)
LIGHT: Floats = np.array([1.4, -2.2, 3.2])
"""A lamp below the ceiling; its shadows are part of the scene's paint."""


@dataclass(frozen=True, eq=False)
class Scene:
    """All that can be filmed at once.

    primitives: row 0 is the room that encloses the others. palettes: [K, 4, 3], four paints a row,
    sRGB. light: [3], a lamp inside the room. subject: what meshes are judged on; its longest side
    is the size that tolerances refer to. things: the same without floor and walls, which fit onto
    themselves under many wrong moves. beyond: how far outside the subject a mesh is judged, metres:
    of a room, whose wrong walls lie outside it. reach: what is farther away, metres, is
    nothing, sky or darkness, and has no depth.
    """

    name: str
    primitives: tuple[Primitive, ...]
    palettes: Floats
    light: Floats
    subject: Region
    things: Region
    beyond: float = 0.0
    reach: float = math.inf

    @cached_property
    def room(self) -> Region:
        """All that there is."""
        center, half = np.array(self.primitives[0].center), np.array(self.primitives[0].size)
        low, high = (tuple(map(float, side)) for side in (center - half, center + half))
        return Region((low[0], low[1], low[2]), (high[0], high[1], high[2]))

    @cached_property
    def table(self) -> Floats:
        """The primitives as the compiled code reads them."""
        return _build_table(self.primitives)


def _build_table(primitives: tuple[Primitive, ...]) -> Floats:
    table = np.zeros((len(primitives), tracing.NUM_COLUMNS))
    for index, thing in enumerate(primitives):
        row = table[index]
        yaw = math.radians(thing.yaw_deg)
        row[tracing.COL_KIND] = thing.kind
        row[tracing.COL_CENTER : tracing.COL_CENTER + 3] = thing.center
        row[tracing.COL_SIZE : tracing.COL_SIZE + len(thing.size)] = thing.size
        row[tracing.COL_COS_YAW], row[tracing.COL_SIN_YAW] = math.cos(yaw), math.sin(yaw)
        row[tracing.COL_BOUND] = thing.bound
        row[tracing.COL_PATCH] = thing.patch
        row[tracing.COL_SEED] = 101 * (index + 1)
        row[tracing.COL_PALETTE] = thing.palette
        row[tracing.COL_DETAIL] = thing.detail
        row[tracing.COL_GLOSS] = thing.gloss
        row[tracing.COL_GLOW] = thing.glow
    return table


SAMPLE = Scene("bowl", PRIMITIVES, PALETTES, LIGHT, SUBJECT, THINGS)
"""The bowl among things: what `make demo` films."""


@dataclass(frozen=True)
class Hits:
    """What rays hit.

    t: [N] distance, metres. color: [N, 3] sRGB in [0, 1]. normal: [N, 3] unit, towards the ray's
    side. primitive: [N] row of the scene's primitives.
    """

    t: Floats
    color: Floats
    normal: Floats
    primitive: NDArray[np.int64]


def raycast(origins: Floats, directions: Floats, scene: Scene = SAMPLE) -> Hits:
    """First hits of rays that start inside the room and outside the things.

    origins: [N, 3], world. directions: [N, 3], unit. Every such ray hits something.
    Raises ValueError for other shapes, directions that are not unit, or origins outside the room.
    """
    origins = np.ascontiguousarray(origins, dtype=np.float64)
    directions = np.ascontiguousarray(directions, dtype=np.float64)
    if origins.ndim != 2 or origins.shape[1] != 3 or origins.shape != directions.shape:
        raise ValueError(
            f"origins {origins.shape} and directions {directions.shape} must both be [N, 3]"
        )
    if not np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6):
        raise ValueError("directions must be unit vectors: divide them by their norm")
    if not scene.room.contains(origins).all():
        raise ValueError("origins must lie inside the room")
    out = np.empty((len(origins), 7))
    rows = np.empty(len(origins), dtype=np.int64)
    tracing.trace_rays(origins, directions, scene.table, scene.palettes, scene.light, out, rows)
    return Hits(out[:, 0], out[:, 4:7], out[:, 1:4], rows)


def render(
    camera: Intrinsics, world_from_camera: Floats, scene: Scene = SAMPLE, gain: float = 1.0
) -> NDArray[np.uint8]:
    """A picture of the scene, uint8 [H, W, 3], sRGB, anti-aliased.

    camera: a PINHOLE. world_from_camera: [3, 4], OpenGL axes. gain: factor on linear light, as a
    phone's exposure changes it. Releases the GIL while it works.
    Raises ValueError for a lens with distortion.
    """
    if camera.model != "PINHOLE":
        raise ValueError(f"the sample is filmed with PINHOLE cameras, not {camera.model}")
    picture = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    lens = np.array([camera.fl_x, camera.fl_y, camera.cx, camera.cy])
    pose = np.ascontiguousarray(world_from_camera, dtype=np.float64)
    # sRGB is about linear light to the power of 1 / 2.2, so a factor there is one here, too.
    tracing.render_pinhole(
        pose, lens, scene.table, scene.palettes, scene.light, gain ** (1 / 2.2), picture
    )
    return picture


def pixel_rays(
    camera: Intrinsics, world_from_camera: Floats, pixels: Floats
) -> tuple[Floats, Floats]:
    """Rays through pixels [N, 2] (x, y; the top-left pixel's centre is (0.5, 0.5)).

    Returns origins and unit directions, [N, 3] each, world.
    """
    x = (pixels[:, 0] - camera.cx) / camera.fl_x
    y = -(pixels[:, 1] - camera.cy) / camera.fl_y
    directions = np.stack([x, y, -np.ones_like(x)], axis=1) @ world_from_camera[:, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to(world_from_camera[:, 3], directions.shape).copy(), directions


def depth_image(camera: Intrinsics, world_from_camera: Floats, scene: Scene = SAMPLE) -> Floats:
    """Exact z-depth at the pixel centres, [H, W], metres; 0 where nothing stands."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    origins, directions = pixel_rays(camera, world_from_camera, pixels)
    forward = -world_from_camera[:, 2]
    distance = raycast(origins, directions, scene).t
    z_depth: Floats = np.where(distance < scene.reach, distance, 0.0) * (directions @ forward)
    return z_depth.reshape(camera.height, camera.width)


def pose_matrix(image: PosedImage) -> Floats:
    """world_from_camera of an image as an array [3, 4]."""
    return np.array(image.world_from_camera, dtype=np.float64)


def seen_surface(
    truth: CamerasFile,
    region: Region = SUBJECT,
    num_points: int = 20_000,
    scene: Scene = SAMPLE,
) -> Floats:
    """True surface points that the cameras saw, [num_points or fewer, 3], world, metres.

    Rays through pixels spread evenly over all pictures, cut to `region`, thinned evenly.
    """
    per_image = max(64, 8 * num_points // max(len(truth.images), 1))
    parts: list[Floats] = []
    for index, image in enumerate(truth.images):
        camera = truth.cameras[image.camera]
        step = math.sqrt(camera.width * camera.height / per_image)
        # Another offset in every picture, so that the pixels do not line up on the surface.
        shift = (index * 0.618) % 1.0 * step
        x, y = np.meshgrid(
            np.arange(shift, camera.width, step), np.arange(shift, camera.height, step)
        )
        origins, directions = pixel_rays(
            camera, pose_matrix(image), np.stack([x.ravel(), y.ravel()], axis=1)
        )
        points = origins + raycast(origins, directions, scene).t[:, None] * directions
        parts.append(points[region.contains(points)])
    points = np.concatenate(parts) if parts else np.empty((0, 3))
    keep = np.unique(np.linspace(0, len(points) - 1, min(num_points, len(points))).astype(int))
    thinned: Floats = points[keep]
    return thinned


def in_picture(points: Floats, camera: Intrinsics, pose: Floats) -> NDArray[np.bool_]:
    """Which points [N, 3] a camera at a pose [3, 4] has in its picture, hidden or not, [N]."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = np.maximum(-local[:, 2], 1e-9)
    x = camera.cx + camera.fl_x * local[:, 0] / depth
    y = camera.cy - camera.fl_y * local[:, 1] / depth
    inside: NDArray[np.bool_] = (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
    return inside & (local[:, 2] < 0)


def in_sight(points: Floats, truth: CamerasFile, scene: Scene = SAMPLE) -> NDArray[np.bool_]:
    """Which points of the true surface [N, 3] are in a picture and not hidden there, [N]."""
    seen = np.zeros(len(points), np.bool_)
    for image in truth.images:
        camera, pose = truth.cameras[image.camera], pose_matrix(image)
        asked = np.flatnonzero(~seen & in_picture(points, camera, pose))
        ways = points[asked] - pose[:, 3]
        length = np.linalg.norm(ways, axis=1)
        origins = np.broadcast_to(pose[:, 3], ways.shape).copy()
        met = raycast(origins, ways / length[:, None], scene).t
        seen[asked[met > (1.0 - _SAME) * length]] = True
    return seen


def surface_distance(points: Floats, scene: Scene = SAMPLE) -> Floats:
    """Distance of points [N, 3] to the nearest true surface, [N], metres, >= 0.

    Exact, but for what lies inside or beneath things, which counts as surface though none sees it:
    soles coincide with the floor, and where things overlap a part of one is within the other.
    """
    best = np.full(len(points), np.inf)
    for thing in scene.primitives:
        best = np.minimum(best, np.abs(_distance_to(thing, points)))
    return best


def surface_normals(points: Floats, scene: Scene = SAMPLE) -> Floats:
    """What the true surface's normals are near points [N, 3], [N, 3] unit, into the open.

    The gradient of the distance to what is solid, from differences; on both sides of a surface it
    is the same.
    """
    gradient = np.stack(
        [
            _open_distance(points + step, scene) - _open_distance(points - step, scene)
            for step in _STEP_M * np.eye(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    unit: Floats = gradient / np.maximum(length, 1e-12)
    return unit


def _open_distance(points: Floats, scene: Scene) -> Floats:
    """Distance of points [N, 3] to what is solid, [N], metres; negative within it."""
    best = np.full(len(points), np.inf)
    for thing in scene.primitives:
        best = np.minimum(best, _distance_to(thing, points))
    return best


def _distance_to(thing: Primitive, points: Floats) -> Floats:
    """[N], metres, from the surface of one thing; negative within it, and outside of a room."""
    yaw = math.radians(thing.yaw_deg)
    c, s = math.cos(yaw), math.sin(yaw)
    local = (points - thing.center) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    size = np.array(thing.size)
    if thing.kind == tracing.SPHERE:
        return np.asarray(np.linalg.norm(local, axis=1) - size[0])
    if thing.kind in (tracing.BOX, tracing.ROOM):
        distance = _box_distance(np.abs(local), size)
        return -distance if thing.kind == tracing.ROOM else distance
    rho, z = np.hypot(local[:, 0], local[:, 1]), local[:, 2]
    if thing.kind == tracing.CYLINDER:
        return _box_distance(np.stack([rho, np.abs(z)], axis=1), size)
    if thing.kind == tracing.TORUS:
        ring = np.hypot(local[:, 0], z) - size[0]
        return np.asarray(np.hypot(ring, local[:, 1]) - size[1])
    rim = np.hypot(rho - np.clip(rho, size[1], size[0]), z)
    radius = np.hypot(rho, z)
    shells = np.minimum(np.abs(radius - size[0]), np.abs(radius - size[1]))
    distance = np.where(z <= 0.0, np.minimum(shells, rim), rim)
    solid = (z <= 0.0) & (radius >= size[1]) & (radius <= size[0])
    signed: Floats = np.where(solid, -distance, distance)
    return signed


def _box_distance(folded: Floats, half: Floats) -> Floats:
    """Distance to a box's surface, negative inside; folded: coordinates by absolute value."""
    beyond = folded - half
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    inside = np.minimum(beyond.max(axis=1), 0.0)
    return np.asarray(outside + inside)
