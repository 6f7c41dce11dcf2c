"""Whether somebody walked round a thing or filmed a place, and where in the world the thing is.

A thing was walked round where, in this order,

- the cameras look at one point, the focus (`pipelines.scene.focus`), nearly all of them, and stand
  around it on an arc of some width;
- there is something at that point: what the middle of the pictures shows lies near it. Who walks
  round an empty yard, or along the walls of a room, sees what is on the other side;
- something stands there, in front of what carries it (a table, the ground, a wall), is in most
  pictures, and ends where cameras still look: a facade and clutter on all sides do not.

Surfaces are taken in cells, a fortieth of the cameras' distance wide. The attention that a place
got is the share of cameras which have it within the middle four fifths of their pictures, whatever
is before it: the back of a thing is hidden from half of all cameras. World units, +Z up; `_SHARE`
in a constant's name is of the cameras' mean distance to the focus, which is `distance` below.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy import ndimage

from pipelines.exports.crop import Crop
from pipelines.exports.surface.supports import CELLS, Cells, Plane, cells_of, patch_under, planes_of
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.gaze import Gaze, told_by_cameras

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Kind = Literal["subject", "scene"]

LEAST_NEAR = 0.5
"""Of what the middles of the pictures show, that is within half of the distance of the focus."""
LEAST_STANDING = 0.01
"""Area of what stands there, in squares of the distance."""
MOST_CROWD = 0.5
"""How densely what stands may go on around it."""

_LONG_SIDE_PX = 48
_LEAST_HITS = 0.25
_LOOKED_AT, _ENDS = 0.5, 0.25
_LIFT_SHARE = 0.03
"""So far before what carries it a thing begins: less is the mesh's own noise."""
_LIFT_OF_TOP = 0.2
"""The same, of how far the thing reaches before it: a keyboard beside a box is part of the desk."""
_SMALL = 0.1
"""Of what was looked at of the largest piece, for another to belong to it."""
_HALF = 0.5
_RING = 1.3
_RIM, _SLAB, _AIR = 0.3, 0.12, 0.04
"""Of the thing's longest side: what is kept around it, of what carries it, and above it."""
_SUPPORT_GROWS = 0.75
"""What carries it is kept whole where it reaches no farther beyond the thing than this."""

_KNOWN = 0.9
_AROUND = np.ones((3, 3), bool)

_core: Any = open3d.core
_geometry: Any = open3d.t.geometry


@dataclass(frozen=True)
class Footprints:
    """Squares of a grid over what carries things. axes: [3, 2], its two directions. origin: [3].

    label: [W, H], whose square it is: 0 nobody's.
    """

    axes: Floats
    origin: Floats
    side: float
    label: NDArray[np.int32]

    def of(self, points: Floats) -> NDArray[np.int32]:
        """[P], the label below points [P, 3]; 0 beyond the grid."""
        index = np.floor((points - self.origin) @ self.axes / self.side).astype(np.int64)
        inside = ((index >= 0) & (index < self.label.shape)).all(axis=1)
        found = np.zeros(len(points), np.int32)
        found[inside] = self.label[tuple(index[inside].T)]
        return found


@dataclass(frozen=True)
class Thing:
    """What was walked round, and where it is cut.

    region: an upright box. origin: [3], below its middle, on what carries it. carried_by: what that
    is; None where nothing was found. others: what else stands in the region, to be left out, higher
    than `lift` before what carries both.
    """

    region: Crop
    origin: Floats
    carried_by: Plane | None
    others: Footprints
    lift: float
    slab: float

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """[P], whether points [P, 3] belong to it or to what is kept of what carries it."""
        kept = self.region.contains(points) & ~self.is_other(points)
        if self.carried_by is not None:
            kept &= self.carried_by.height(points) >= -self.slab
        return kept

    def is_other(self, points: Floats) -> NDArray[np.bool_]:
        """[P], whether points [P, 3] belong to something else that stands beside it."""
        other: NDArray[np.bool_] = self.others.of(points) > 0
        if self.carried_by is not None:
            other &= self.carried_by.height(points) > self.lift
        return other


@dataclass(frozen=True)
class Decision:
    """kind: what was filmed. why: in words. measures: the numbers behind it, as far as it came.
    thing: where kind is subject, or where it was asked for all the same and something is there."""

    kind: Kind
    why: str
    measures: dict[str, Any] = field(default_factory=dict)
    thing: Thing | None = None


def find_subject(
    vertices: Floats,
    faces: NDArray[np.integer[Any]],
    gaze: Gaze,
    fallback: tuple[Floats, float] | None = None,
) -> Decision:
    """What was filmed, by a mesh and the cameras.

    fallback: where to look for a thing, and how far cameras are from there, where the cameras look
    at no point: then the kind is scene, but what stands there is told.
    """
    told = told_by_cameras(gaze)
    measures, why = dict(told.measures), told.why
    if told.where is not None:
        focus, distance = told.where
        if why is None:
            near = _near_share(vertices, faces, gaze, focus)
            measures["near"] = round(near, 3)
            if near < LEAST_NEAR:
                why = f"Only {near:.0%} of what the middles of the pictures show is where they all "
                why += "look."
    elif fallback is not None:
        focus, distance = fallback
    if why is not None and fallback is None:
        return Decision("scene", why, measures)
    cells = cells_of(vertices, faces, focus, distance)
    thing = None if len(cells) == 0 else _standing(cells, gaze, focus, distance, measures)
    if thing is None and why is None:
        why = "Nothing stands where the cameras look that ends where they do."
    if why is not None:
        return Decision("scene", why, measures, thing)
    return Decision("subject", "The cameras stand around a thing and look at it.", measures, thing)


def _near_share(
    vertices: Floats, faces: NDArray[np.integer[Any]], gaze: Gaze, focus: Floats
) -> float:
    """Of the rays through the middle ninth of the pictures that meet the mesh, or of a quarter of
    all where fewer do, the share that ends near the focus: a hole says nothing of what is there."""
    scene = _geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor((vertices - focus).astype(np.float32)), _core.Tensor(faces.astype(np.uint32))
    )
    num_rays = num_hits = num_near = 0
    for pose, lens in zip(gaze.poses, gaze.lenses, strict=True):
        small = Pinhole.of(lens.intrinsics(), _LONG_SIDE_PX)
        third = small.height // 3, small.width // 3
        rays = small.directions()[third[0] : -third[0] or None, third[1] : -third[1] or None]
        rays = rays.reshape(-1, 3) @ pose[:, :3].T
        eye = pose[:, 3] - focus
        cast = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=1)
        found = scene.cast_rays(_core.Tensor(cast.astype(np.float32)))["t_hit"].numpy()
        hit = np.isfinite(found)
        ends = eye + rays[hit] * found[hit, None]
        near = np.linalg.norm(ends, axis=1) <= 0.5 * np.linalg.norm(eye)
        num_rays, num_hits = num_rays + len(rays), num_hits + int(hit.sum())
        num_near += int(near.sum())
    return num_near / max(num_hits, _LEAST_HITS * num_rays)


def _standing(
    cells: Cells, gaze: Gaze, focus: Floats, distance: float, measures: dict[str, Any]
) -> Thing | None:
    """What stands where cameras look and ends there, or None."""
    attention = gaze.attention(cells.places)
    planes = planes_of(cells, attention, gaze.poses[:, :, 3], distance)
    carrier = planes.carrier
    stands = np.ones(len(cells), bool)
    lift = _LIFT_SHARE * distance
    for wall in planes.walls:
        stands &= np.abs(wall.height(cells.places)) > lift
    if carrier is not None:
        height = carrier.height(cells.places)
        looked_at = height[stands & (height > lift) & (attention >= _LOOKED_AT)]
        if len(looked_at):
            lift = max(lift, _LIFT_OF_TOP * float(np.percentile(looked_at, 95)))
        stands &= height > lift
    measures["carried_by"] = None if carrier is None else carrier.told()
    axes = np.eye(3)[:, :2] if carrier is None else carrier.axes()
    seen = stands & (attention >= _ENDS)
    pieces = _pieces(cells, seen, axes)
    label = pieces.of(cells.places) * seen
    count = int(pieces.label.max(initial=0)) + 1
    area = np.bincount(label, cells.areas, count)
    looked = np.bincount(label, cells.areas * (attention >= _LOOKED_AT), count)
    area[0] = looked[0] = 0.0
    whole = (looked > _HALF * area) & (looked >= _SMALL * looked.max())
    mine = whole[label]
    standing = float(area[whole].sum()) / distance**2
    measures["standing"] = round(standing, 4)
    if standing < LEAST_STANDING:
        return None
    crowd = _crowd(cells, mine, stands, axes)
    measures["crowd"] = round(crowd, 3)
    if crowd > MOST_CROWD:
        return None
    around = _pieces(cells, stands, axes)
    own = np.zeros(int(around.label.max()) + 1, bool)
    own[around.of(cells.places[mine])] = True
    others = replace(around, label=np.where(own[around.label], 0, around.label))
    region, origin = _region(cells, mine, carrier)
    return Thing(region, origin, carrier, others, lift, _SLAB * 2.0 * float(region.half.max()))


def _crowd(cells: Cells, mine: NDArray[np.bool_], stands: NDArray[np.bool_], axes: Floats) -> float:
    """How much stands in a ring around the thing, for its size, beside what stands within."""
    flat = cells.places @ axes
    middle = (flat[mine].min(axis=0) + flat[mine].max(axis=0)) / 2.0
    away = np.linalg.norm(flat - middle, axis=1)
    radius = float(away[mine].max())
    ring = stands & (away > radius) & (away < _RING * radius)
    return float(cells.areas[ring].sum() / cells.areas[mine].sum()) / (_RING**2 - 1.0)


def _pieces(cells: Cells, which: NDArray[np.bool_], axes: Floats) -> Footprints:
    """Some of the cells in connected pieces, as seen from above what carries them."""
    flat = cells.places @ axes
    low = flat.min(axis=0) - cells.side
    shape = np.floor((flat.max(axis=0) - low) / cells.side).astype(int) + 2
    taken = np.zeros(shape, bool)
    taken[tuple(np.floor((flat[which] - low) / cells.side).astype(int).T)] = True
    # Across two empty squares pieces are still one: cells of a thin handle have gaps.
    label, _ = ndimage.label(ndimage.binary_dilation(taken, _AROUND), _AROUND)
    return Footprints(axes, axes @ low, cells.side, label.astype(np.int32))


def _region(cells: Cells, mine: NDArray[np.bool_], carrier: Plane | None) -> tuple[Crop, Floats]:
    """The box around the thing and a piece of what carries it, and the point below its middle."""
    places = cells.places[mine]
    if carrier is not None and not carrier.is_level:
        turn = float(np.arctan2(carrier.normal[1], carrier.normal[0]))
    else:
        turn = _least_turn(places[:, :2])
    axes = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    # Cells are told by the middle of what is in them.
    low = (places @ axes).min(axis=0) - cells.side
    high = (places @ axes).max(axis=0) + cells.side
    longest = float((high - low).max())
    rim, slab = _RIM * longest, _SLAB * longest
    if carrier is None:
        low, high = low - _AIR * longest, high + _AIR * longest
        foot = low[2]
    elif carrier.is_level:
        held = patch_under(carrier, cells, places)
        patch = cells.places[held] @ axes
        # A piece that goes on where nobody looked for cells has no end.
        known = bool((cells.reach[held] < _KNOWN * cells.side * CELLS).all())
        ending = patch[:, :2] if known else patch[:0, :2]
        low[:2], high[:2] = _with_rim(low[:2], high[:2], ending, rim, cells.side)
        within = ((patch[:, :2] >= low[:2]) & (patch[:, :2] <= high[:2])).all(axis=1)
        bottom = float(patch[within, 2].min()) if within.any() else float(low[2])
        low[2] = min(bottom, low[2]) - slab
        high[2] += _AIR * longest
    else:
        # A wall: the box goes a little into it, and around the thing on it.
        depth = places @ axes[:, 0]
        wall = float(
            (cells.places[np.abs(carrier.height(cells.places)) < cells.side] @ axes[:, 0]).min()
        )
        low[0], high[0] = min(depth.min(), wall) - slab, high[0] + _AIR * longest
        low[1:], high[1:] = low[1:] - rim, high[1:] + rim
    center = axes @ ((low + high) / 2.0)
    origin = center.copy()
    if carrier is not None and carrier.is_level:
        origin[2] = carrier.level_at(center)
    else:
        origin[2] = low[2] if carrier is not None else foot
    return Crop(center, axes, (high - low) / 2.0), origin


def _with_rim(
    low: Floats, high: Floats, patch: Floats, rim: float, side: float
) -> tuple[Floats, Floats]:
    """What is kept of what carries a thing: all of it where it ends soon, else a rim.

    low, high: [2], of the thing. patch: [C, 2], of what carries it. Returns low and high.
    """
    if len(patch):
        start = np.minimum(patch.min(axis=0) - side, low)
        end = np.maximum(patch.max(axis=0) + side, high)
        most = rim * _SUPPORT_GROWS / _RIM
        if ((low - start) <= most).all() and ((end - high) <= most).all():
            return start, end
    return low - rim, high + rim


def _least_turn(flat: Floats) -> float:
    """The angle of the smallest rectangle around points [P, 2], radians in [0, pi / 2)."""
    angles = np.radians(np.arange(0.0, 90.0, 1.0))
    across = np.stack([np.cos(angles), np.sin(angles)], axis=0)
    along = np.stack([-np.sin(angles), np.cos(angles)], axis=0)
    areas = np.ptp(flat @ across, axis=0) * np.ptp(flat @ along, axis=0)
    return float(angles[int(areas.argmin())])
