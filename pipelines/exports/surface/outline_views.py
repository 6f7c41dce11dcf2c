"""What a photo says of the outlines of a mesh: where it should end for that camera.

Outlines are where something of the mesh lies behind something else of it. P of them, a pixel each.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.surface.color_edges import PROFILE_PX, STEPS, edge_between
from pipelines.exports.surface.sight import Sight
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.picture_sampling import between_pixels
from pipelines.scene.stereo_views import ColorView

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

_JUMP, _JUMP_PX = 0.02, 10.0
"""Of the depth, or so many pixels' width at it: what is farther by more is behind."""
_GRID = 2
"""Outlines are sought in every so many pixels' ray."""
_AROUND = 3
_SPREAD = 1.6
"""How far around and by which weights an outline's normal is taken, in steps of the grid."""
_LEAST_NORMAL = 1.0
_HALVINGS = 4
_MORE = 1.5
"""A later hypothesis is taken where it is trusted so much more."""
_LEAST_TRUST = 0.05
_AT_ONCE = 16_384


@dataclass(frozen=True)
class Answers:
    """What photos say, R answers, each of a place on the mesh.

    faces: [R]. places: [R, 3], barycentric. across: [R, 3], unit, world, at right angles to the
    ray. offsets, pixels: [R], how far the place should move that way, and how large a pixel is
    there, world units. trust: [R], 0 for none.
    """

    faces: NDArray[np.int64]
    places: Floats
    across: Floats
    offsets: Floats
    pixels: Floats
    trust: Floats

    @staticmethod
    def joined(parts: Sequence[Answers]) -> Answers:
        """All of them."""
        names = Answers.__dataclass_fields__
        return Answers(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def thinned(self, most: int) -> Answers:
        """Every so many-th, to stand for those around it, so that there are not more than that."""
        stride = max(1, -(-len(self.trust) // most))
        kept = Answers(*(getattr(self, name)[::stride] for name in Answers.__dataclass_fields__))
        return replace(kept, trust=stride * kept.trust)


@dataclass(frozen=True)
class _Outlines:
    """u, v: [P] px. z: [P], depth of what ends. normal: [P, 2], unit, px, to what is behind."""

    u: Floats
    v: Floats
    z: Floats
    normal: Floats

    def of(self, kept: Bools | slice) -> _Outlines:
        return _Outlines(self.u[kept], self.v[kept], self.z[kept], self.normal[kept])

    def across(self, steps: Floats) -> tuple[Floats, Floats]:
        """Pixels [P, T], so far along each normal: u and v. steps: [T] px."""
        u = self.u[:, None] + self.normal[:, :1] * steps
        return u, self.v[:, None] + self.normal[:, 1:] * steps

    def moved(self, by: Floats) -> _Outlines:
        """Each along its own normal. by: [P] px."""
        u, v = self.u + by * self.normal[:, 0], self.v + by * self.normal[:, 1]
        return _Outlines(u, v, self.z, self.normal)


class OutlineView:
    """A mesh as a photo's camera sees it. origin: [3], world, of the frame that sight has.

    corner_colors: [F, 3, 3] in [0, 1].
    """

    def __init__(
        self, sight: Sight, corner_colors: NDArray[np.float32], view: ColorView, origin: Floats
    ) -> None:
        self._sight, self._colors, self._view = sight, corner_colors, view
        self._picture = view.picture.astype(np.float32) / np.float32(255.0)
        self._eye = view.world_from_camera[:, 3] - origin
        self._turn = view.world_from_camera[:, :3]
        self._jump = max(_JUMP, _JUMP_PX * _GRID / view.lens.fl_x)

    def answers(self, begins: Sequence[float]) -> Answers:
        """begins: `edge_between`, one hypothesis each; the first one is preferred."""
        outlines = self._ends(self._outlines())
        starts = range(0, max(len(outlines.u), 1), _AT_ONCE)
        parts = [outlines.of(np.s_[start : start + _AT_ONCE]) for start in starts]
        return Answers.joined([self._asked(part, begins) for part in parts])

    def _asked(self, outlines: _Outlines, begins: Sequence[float]) -> Answers:
        us, vs = outlines.across(STEPS)
        shown: Bools = np.logical_and.reduce(self._shown(us, vs), axis=1)
        outlines, us, vs = outlines.of(shown), us[shown], vs[shown]
        z, face, place = self._met(us, vs)
        own = np.einsum("ptk,ptkc->ptc", place, self._colors[face])
        photo = between_pixels(self._picture, us.ravel(), vs.ravel())
        limit = outlines.z[:, None]
        before = (z < limit * (1.0 + self._jump)) & (z > limit * (1.0 - 3.0 * self._jump))
        behind = (z > limit * (1.0 + 0.5 * self._jump)) & np.isfinite(z)
        edge = functools.partial(edge_between, photo.reshape(own.shape), own, before, behind)
        best, trust = edge(begins[0])
        for begin in begins[1:]:
            found, sure = edge(begin)
            better = sure > _MORE * trust
            best, trust = np.where(better, found, best), np.where(better, sure, trust)
        believed = trust > _LEAST_TRUST
        return self._told(outlines.of(believed), best[believed], trust[believed])

    def _told(self, outlines: _Outlines, offsets_px: Floats, trust: Floats) -> Answers:
        """The answers, each for the last ray that still meets what ends."""
        last = outlines.moved(np.full(len(trust), -(0.5**_HALVINGS)))
        _, face, place = self._met(last.u, last.v)
        ray = _ways(self._view.lens, last.u, last.v).astype(np.float64)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.column_stack([last.normal * [1.0, -1.0], np.zeros(len(trust))])
        across -= (across * ray).sum(axis=1, keepdims=True) * ray
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        pixels = last.z.astype(np.float64) / self._view.lens.fl_x
        return Answers(face, place, across @ self._turn.T, offsets_px * pixels, pixels, trust)

    def _outlines(self) -> _Outlines:
        """Where neighbouring rays of the grid meet things one behind the other."""
        height, width = self._view.usable.shape
        columns = np.arange(0.5 * _GRID, width, _GRID)
        rows = np.arange(0.5 * _GRID, height, _GRID)
        z, _, _ = self._met(*np.meshgrid(columns, rows))
        ends = self._has_something_behind(z)
        margin = int(np.ceil(PROFILE_PX / _GRID))
        inner = np.zeros_like(ends)
        inner[margin:-margin, margin:-margin] = True
        y, x = np.nonzero(ends & inner)
        here = z[y, x][:, None]
        side = np.arange(-_AROUND, _AROUND + 1)
        dy, dx = (part.ravel() for part in np.meshgrid(side, side, indexing="ij"))
        weight = np.exp(-(dx**2 + dy**2) / (2.0 * _SPREAD**2))
        around = z[y[:, None] + dy, x[:, None] + dx]
        far = around >= here * (1.0 + 0.5 * self._jump)
        near = ~far & (around > here * (1.0 - self._jump))
        offsets = np.stack([dx, dy], axis=1).astype(np.float64)
        way: Floats = _center(far * weight, offsets) - _center(near * weight, offsets)
        length = np.linalg.norm(way, axis=1)
        found = _Outlines(columns[x], rows[y], z[y, x], way / np.maximum(length, 1e-9)[:, None])
        return found.of(length > _LEAST_NORMAL)

    def _has_something_behind(self, z: NDArray[np.float32]) -> Bools:
        """[H, W]: whether one of the four neighbours is farther by a jump."""
        known, limit = np.isfinite(z), z * np.float32(1.0 + self._jump)
        found = np.zeros(z.shape, np.bool_)
        for one, two in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            both = known[one] & known[two]
            found[one] |= both & (z[two] > limit[one])
            found[two] |= both & (z[one] > limit[two])
        return found

    def _ends(self, outlines: _Outlines) -> _Outlines:
        """The outlines at the first rays along their normals that meet what is behind."""
        limit = outlines.z * (1.0 + 0.5 * self._jump)
        tried = np.arange(-0.5 * _GRID, 2.0 * _GRID + 0.5)
        past = self._met(*outlines.across(tried))[0] > limit[:, None]
        first = past.argmax(axis=1)
        kept = past.any(axis=1) & (first > 0)
        outlines, limit, first = outlines.of(kept), limit[kept], first[kept]
        low, high = tried[first - 1], tried[first]
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            there = outlines.moved(middle)
            beyond = self._met(there.u, there.v)[0] > limit
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        return outlines.moved(high)

    def _shown(self, u: Floats, v: Floats) -> Bools:
        """Whether the photo has pixels."""
        height, width = self._view.usable.shape
        inside = (u >= 0.5) & (v >= 0.5) & (u <= width - 0.5) & (v <= height - 0.5)
        column = np.clip(u, 0, width - 1).astype(int)
        shown: Bools = inside & self._view.usable[np.clip(v, 0, height - 1).astype(int), column]
        return shown

    def _met(
        self, u: Floats, v: Floats
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """What rays through pixels [...] meet: z-depth, infinite for nothing, the face, and where
        in it [..., 3].
        """
        ways = _ways(self._view.lens, u, v).reshape(-1, 3) @ self._turn.T.astype(np.float32)
        z, face, place = self._sight.met(self._eye, ways)
        shape = np.shape(u)
        return z.reshape(shape), face.reshape(shape), place.reshape(*shape, 3)


def _ways(lens: Pinhole, u: Floats, v: Floats) -> NDArray[np.float32]:
    """[..., 3] rays through pixels in camera coordinates, so long that -z = 1."""
    x, y = (u - lens.cx) / lens.fl_x, (lens.cy - v) / lens.fl_y
    ways: NDArray[np.float32] = np.stack([x, y, np.full_like(x, -1.0)], axis=-1).astype(np.float32)
    return ways


def _center(weights: Floats, offsets: Floats) -> Floats:
    """[P, 2]: the mean of offsets [K, 2] by weights [P, K]."""
    center: Floats = weights @ offsets / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    return center
