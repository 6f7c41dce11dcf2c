"""Where along its normal a point of a surface looks most alike in the photos that see it.

A fused surface is as exact as the depth it was made of. The photos are finer: a small patch around
a point, laid on the surface's tangent, shows the same in every photo if it lies where the surface
is. So the patch is moved along the normal and compared. The patch's neighbours are not asked here;
who moves a mesh lets offsets agree (`pipelines.exports.surface.refinement`).

Symbols: P points, V views, K compared views of a point, S steps to each side, A samples of a patch.
Lengths are world units, the frame is the world less the pictures' origin. Sources: Furukawa and
Ponce, "Accurate, dense, and robust multi-view stereopsis", PAMI 2010, section 3.1 (patches on
tangents, ZNCC); Delaunoy et al., "Photometric bundle adjustment", CVPR 2014 (vertices along
normals).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.stereo.refinement import search_fast
from pipelines.nerf.stereo.views import StereoView

Floats = NDArray[np.floating]
Search = Callable[..., tuple[NDArray[np.float32], NDArray[np.float32]]]

NUM_VIEWS = 6
_REACH = 3
"""A patch has 7 x 7 samples, a pixel of the best view apart."""
_STEP_PX = 0.5
"""How far a step moves a patch in the view that is seen under the widest angle."""
_LEAST_DEVIATION = 2.0 / 255.0
"""What is plainer than this says nothing."""
_LEAST_COSINE, _LEAST_SINE, _GOOD_SINE, _NEAR_SINE, _LEAST_SCORE = 0.2, 0.05, 0.25, 0.1, 0.05
_RULES = (_LEAST_COSINE, _LEAST_SINE, _GOOD_SINE, _NEAR_SINE, _LEAST_SCORE)
_UNKNOWN = -2.0
_AT_ONCE = 8192
_LEAST_ALIKE, _SURELY_ALIKE = 0.4, 0.8
_SURE_BEND = 0.05
_RIVAL, _RIVAL_STEPS, _RIVAL_TRUST = 0.05, 2, 0.2


@dataclass(frozen=True)
class Pictures:
    """Grey pictures with their cameras, packed: 1 to 255 as photos have it, 0 where there is none.

    pixels: all pictures, one after the other, uint8. sizes: [V, 2] height and width. starts: [V].
    cameras: [V, 3, 4] camera from (world - origin), OpenCV axes. eyes: [V, 3]. lenses: [V, 4].
    """

    pixels: NDArray[np.uint8]
    sizes: NDArray[np.int64]
    starts: NDArray[np.int64]
    cameras: NDArray[np.float32]
    eyes: NDArray[np.float32]
    lenses: NDArray[np.float32]

    @classmethod
    def of(cls, views: Sequence[StereoView], origin: Floats) -> Pictures:
        """Packed from at least one view."""
        packed = [_as_bytes(view.picture).ravel() for view in views]
        turns = np.stack([view.world_from_camera[:, :3].T for view in views])
        eyes = np.stack([view.center - origin for view in views])
        shifts = -np.einsum("vij,vj->vi", turns, eyes)
        lengths = [len(pixels) for pixels in packed]
        return cls(
            pixels=np.concatenate(packed),
            sizes=np.array([view.picture.shape for view in views], np.int64),
            starts=np.cumsum([0, *lengths[:-1]], dtype=np.int64),
            cameras=np.concatenate([turns, shifts[..., None]], axis=2).astype(np.float32),
            eyes=eyes.astype(np.float32),
            lenses=np.array([view.lens for view in views], np.float32),
        )

    def picture(self, index: int) -> NDArray[np.float32]:
        """[H, W], brightness from 1 to 255, 0 where there is none."""
        height, width = self.sizes[index]
        start = self.starts[index]
        pixels = self.pixels[start : start + height * width]
        return pixels.reshape(height, width).astype(np.float32)


@dataclass(frozen=True)
class Offsets:
    """What photos say of P points.

    length: [P], how far along its normal each should move. trust: [P] in [0, 1], how much that is
    to be believed; both 0 where photos say nothing. step: [P], a length that is half a pixel in the
    photos.
    """

    length: NDArray[np.float32]
    trust: NDArray[np.float32]
    step: NDArray[np.float32]


def _as_bytes(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    grey = np.clip(np.rint(255.0 * picture), 1.0, 255.0)
    return np.where(picture < 0.0, 0.0, grey).astype(np.uint8)


def photo_offsets(
    points: Floats,
    normals: Floats,
    seen: NDArray[np.uint8],
    pictures: Pictures,
    num_steps: int,
    search: Search | None = None,
    on_progress: Callable[[float], None] = lambda done: None,
) -> Offsets:
    """How far along its normal each point should move, and how much that is to be believed.

    points, normals: [P, 3]; normals of length 1, outwards. seen: [V, P], 1 where a view sees a
    point. num_steps: to each side, half a pixel each. search: the kernel, or its plain twin.
    on_progress: told the share that is done; may raise.
    Nothing is said where fewer than three photos see the point, where it is plain, nothing is
    alike, or the best place is the last one looked at.
    """
    find = search or search_fast
    counts = (NUM_VIEWS, num_steps, _REACH)
    variance = (255.0 * _LEAST_DEVIATION) ** 2
    scores = np.full((len(points), 2 * num_steps + 1), _UNKNOWN, np.float32)
    steps = np.zeros(len(points), np.float32)
    for start in range(0, len(points), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        shown = np.ascontiguousarray(seen[:, some])
        scores[some], steps[some] = find(
            points[some], normals[some], shown, pictures, _RULES, counts, _STEP_PX, variance
        )
        on_progress(min(1.0, (start + _AT_ONCE) / len(points)))
    return _peaks(scores, steps)


def _peaks(scores: NDArray[np.float32], steps: NDArray[np.float32]) -> Offsets:
    """The best place of each row [P, 2 S + 1], between steps, and how clearly it is one."""
    rows, middle = np.arange(len(scores)), scores.shape[1] // 2
    top = scores.argmax(axis=1)
    inner = np.clip(top, 1, scores.shape[1] - 2)
    before, best, after = (scores[rows, inner + shift] for shift in (-1, 0, 1))
    bend = 2.0 * best - before - after
    peak = (inner == top) & (best >= _LEAST_ALIKE) & (bend > 1e-4)
    peak &= np.minimum(before, after) > _UNKNOWN
    between = 0.5 * (after - before) / np.where(peak, bend, 1.0)
    offset = np.where(peak, (inner - middle + between) * steps, 0.0)
    far = np.abs(np.arange(scores.shape[1])[None] - top[:, None]) > _RIVAL_STEPS
    rival = np.where(far, scores, _UNKNOWN).max(axis=1) > best - _RIVAL
    trust = np.clip((best - _LEAST_ALIKE) / (_SURELY_ALIKE - _LEAST_ALIKE), 0.0, 1.0)
    trust = trust * np.clip(bend / _SURE_BEND, 0.0, 1.0) * np.where(rival, _RIVAL_TRUST, 1.0)
    return Offsets(offset.astype(np.float32), np.where(peak, trust, 0.0).astype(np.float32), steps)


def plain_search(
    points: Floats,
    normals: Floats,
    seen: NDArray[np.uint8],
    pictures: Pictures,
    rules: tuple[float, ...],
    counts: tuple[int, int, int],
    step_px: float,
    least_variance: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How alike photos are with the patch at each step, [P, 2 S + 1]; the steps' length [P].

    rules: least cosine to the normal; least, best, and too small sine between views; least score of
    a further view. counts: K, S and how far a patch reaches in samples. Alike: the mean ZNCC of the
    best view with the better two thirds of the others; -2 where unknown.
    The plain definition: a point at a time.
    """
    num_views, num_steps, reach = counts
    scores = np.full((len(points), 2 * num_steps + 1), _UNKNOWN, np.float32)
    steps = np.zeros(len(points), np.float32)
    for p, (point, normal) in enumerate(zip(points, normals, strict=True)):
        chosen = _chosen(point, normal, np.flatnonzero(seen[:, p]), pictures, rules, num_views)
        if len(chosen) < 3:
            continue
        toward = _unit(pictures.eyes[chosen] - point)
        footprint = np.linalg.norm(pictures.eyes[chosen[0]] - point) / pictures.lenses[chosen[0], 0]
        steps[p] = step_px * footprint / _sines(toward[1:] @ toward[0]).max()
        samples = footprint * _on_tangent(normal, reach)
        for k in range(2 * num_steps + 1):
            places = point + (k - num_steps) * steps[p] * normal + samples
            first, *others = [_shown(pictures, v, places, least_variance) for v in chosen]
            if first is None:
                continue
            alike = sorted(float(first @ other) for other in others if other is not None)[::-1]
            if len(alike) >= 2:
                scores[p, k] = np.mean(alike[: max(2, 2 * len(chosen) // 3)])
    return scores, steps


def _chosen(
    point: Floats,
    normal: Floats,
    candidates: NDArray[np.integer],
    pictures: Pictures,
    rules: tuple[float, ...],
    most: int,
) -> list[int]:
    """The best view of a point, then others at good angles to it and to each other."""
    least_cosine, least_sine, good_sine, near_sine, least_score = rules
    distance = np.linalg.norm(pictures.eyes - point, axis=1)
    toward = (pictures.eyes - point) / distance[:, None]
    cosine = toward @ normal
    quality = cosine * pictures.lenses[:, 0] / distance
    left = [int(v) for v in candidates if cosine[v] >= least_cosine]
    if not left:
        return []
    first = max(left, key=lambda v: quality[v])
    chosen = [first]
    while len(chosen) < most:
        top, which = least_score, -1
        for v in left:
            angle = toward[v] @ toward[first]
            sine = float(_sines(angle))
            if v in chosen or sine < least_sine or angle < 0.5:
                continue
            score = quality[v] / quality[first] * min(1.0, sine / good_sine)
            score *= min(1.0, 2.0 * good_sine / sine)
            for other in chosen[1:]:
                between = float(_sines(toward[v] @ toward[other]))
                score *= 0.3 + 0.7 * min(1.0, between / near_sine)
            if score > top:
                top, which = score, v
        if which < 0:
            break
        chosen.append(which)
    return chosen


def _shown(
    pictures: Pictures, index: int, places: Floats, least_variance: float
) -> NDArray[np.float64] | None:
    """A patch [A, 3] in a view: mean 0, length 1, [A]; None if not all of it shows, or plain."""
    camera = pictures.cameras[index].astype(np.float64)
    local = places @ camera[:, :3].T + camera[:, 3]
    if (local[:, 2] <= 0.0).any():
        return None
    fx, fy, cx, cy = pictures.lenses[index]
    u = fx * local[:, 0] / local[:, 2] + cx - 0.5
    v = fy * local[:, 1] / local[:, 2] + cy - 0.5
    picture = pictures.picture(index)
    height, width = picture.shape
    if not ((u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)).all():
        return None
    i, j = u.astype(int), v.astype(int)
    corners = picture[j, i], picture[j, i + 1], picture[j + 1, i], picture[j + 1, i + 1]
    if min(corner.min() for corner in corners) <= 0.0:
        return None
    top = corners[0] + (u - i) * (corners[1] - corners[0])
    bottom = corners[2] + (u - i) * (corners[3] - corners[2])
    values = top + (v - j) * (bottom - top)
    if values.var() < least_variance:
        return None
    centred: NDArray[np.float64] = values - values.mean()
    return centred / np.linalg.norm(centred)


def _on_tangent(normal: Floats, reach: int) -> NDArray[np.float64]:
    """[A, 3]: a grid on the plane through 0, 1 apart, in the order of its rows."""
    x, y, z = normal
    across = np.array([0.0, z, -y] if abs(x) < 0.6 else [-z, 0.0, x])
    across /= np.linalg.norm(across)
    down = np.cross(normal, across)
    a, b = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    grid: NDArray[np.float64] = a[:, None] * across + b[:, None] * down
    return grid


def _unit(vectors: Floats) -> Floats:
    length: Floats = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / length


def _sines(cosines: Floats) -> Floats:
    sines: Floats = np.sqrt(np.maximum(0.0, 1.0 - cosines**2))
    return sines
