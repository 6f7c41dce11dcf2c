"""Which photo colours which face: large in the picture, sharp, unhindered, and like its neighbours.

Symbols: V vertices, F faces. Source: Waechter, Moehrle, Goesele, "Let there be color! Large-scale
texturing of 3D reconstructions", ECCV 2014, sections 3.1 and 3.2: view selection that prefers its
neighbours' choice, and photos whose colour is unlike that of the others (a hand, a passer-by) do
not count. Here candidates are few per face and the choice is found by repeated local improvement.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.each_view import each_view
from pipelines.exports.surface.sight import Sight
from pipelines.exports.texture.photos import Photos, colors_at, softened

Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.int32]

NOBODY = -1
_CANDIDATES = 6
_LEAST_COSINE = 0.15
_UNLIKE = 0.15
"""Difference of a colour channel to the median of the candidates, beyond which one is not one."""
_ROUNDS = 12
_NEIGHBOURS_WEIGHT = 1.5
"""What a neighbour's choice is worth beside having the best picture, which is worth 1."""


@dataclass
class _Candidates:
    """The best photos of each face so far, [F, K]; score 0 where there is none."""

    view: Ints
    score: NDArray[np.float32]
    color: NDArray[np.float32]

    @classmethod
    def none(cls, num_faces: int) -> _Candidates:
        shape = (num_faces, _CANDIDATES)
        return cls(
            np.full(shape, NOBODY, np.int32),
            np.zeros(shape, np.float32),
            np.zeros((*shape, 3), np.float32),
        )

    def offer(self, faces: NDArray[np.intp], view: int, score: Floats, color: Any) -> None:
        """One more photo for some faces, which takes the place of their worst one."""
        worst = self.score[faces].argmin(axis=1)
        better = score > self.score[faces, worst]
        faces, worst = faces[better], worst[better]
        self.view[faces, worst] = view
        self.score[faces, worst] = score[better]
        self.color[faces, worst] = color[better]


class Surface:
    """What the choice asks of a mesh. vertices: [V, 3]. faces: [F, 3]. normals: [V, 3]."""

    def __init__(self, vertices: Floats, faces: Ints, normals: Floats) -> None:
        self.vertices, self.faces = vertices, faces
        corners = vertices[faces]
        self.centers: Floats = corners.mean(axis=1)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice = np.linalg.norm(across, axis=1)
        self.twice_area: Floats = twice
        self.face_normals: Floats = across / np.maximum(twice, 1e-30)[:, None]
        lift = 0.5 * np.sqrt(0.5 * twice)
        self._lifted_centers = self.centers + lift[:, None] * self.face_normals
        # Each by the least of its own faces': outer shells are many times as coarse as inner ones.
        own = np.full(len(vertices), np.inf)
        np.minimum.at(own, faces.reshape(-1), np.repeat(lift, 3))
        own[~np.isfinite(own)] = 0.0
        self._lifted_vertices = vertices + own[:, None] * normals
        self._sight = Sight(vertices, faces)

    def unhindered(self, eye: Floats, faces: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of some faces an eye sees whole: their middle and their three corners."""
        seen = np.zeros(len(self.vertices), np.bool_)
        seen[self.faces[faces]] = True
        seen[seen] = self._sight.reached(eye, self._lifted_vertices[seen])
        whole = _all_of(seen, self.faces[faces])
        whole[whole] = self._sight.reached(eye, self._lifted_centers[faces[whole]])
        return whole

    def met(
        self, eye: NDArray[np.float32], ways: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """What rays meet, as `Sight.met`."""
        return self._sight.met(eye, ways)


def _all_of(flags: NDArray[np.bool_], faces: Ints) -> NDArray[np.bool_]:
    """Which faces [F, 3] have all three of their vertices flagged; flags: [V]."""
    one, two, three = faces.T
    flagged: NDArray[np.bool_] = flags[one] & flags[two] & flags[three]
    return flagged


def choose_photos(
    surface: Surface, photos: Photos, on_progress: Callable[[float], None] = lambda done: None
) -> Ints:
    """The photo of each face, [F]; `NOBODY` where none shows it whole. on_progress: may raise."""
    candidates = _Candidates.none(len(surface.faces))
    looks = each_view(functools.partial(_look, surface, photos), range(len(photos)))
    for index, (faces, score, color) in enumerate(looks):
        candidates.offer(faces, index, score, color)
        on_progress((index + 1) / len(photos))
    _drop_unlike(candidates)
    return _settled(candidates, neighbours_of(surface.faces))


def _look(
    surface: Surface, photos: Photos, index: int
) -> tuple[NDArray[np.intp], Floats, NDArray[np.float32]]:
    """The faces that a photo shows [N], how well [N], and in what colour [N, 3]."""
    eye = photos.eye(index)
    toward = eye - surface.centers
    distance = np.maximum(np.sqrt(np.einsum("fd,fd->f", toward, toward)), 1e-30)
    facing = np.einsum("fd,fd->f", toward, surface.face_normals) > _LEAST_COSINE * distance
    pixels, inside = photos.pixels(index, surface.vertices)
    faces = np.flatnonzero(facing & _all_of(inside, surface.faces))
    faces = faces[surface.unhindered(eye, faces)]
    if len(faces) == 0:
        return faces, np.zeros(0), np.zeros((0, 3), np.float32)
    corners = pixels[surface.faces[faces]]
    middle = corners.mean(axis=1)
    kept = photos.usable(index, middle)
    faces, corners, middle = faces[kept], corners[kept], middle[kept]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    glance, share = photos.glance(index)
    score = area * photos.sharpness(index)
    return faces, score, colors_at(softened(glance), middle * share)


def _drop_unlike(candidates: _Candidates) -> None:
    """Take away photos whose colour is unlike the median of at least three; never all of them."""
    there = candidates.score > 0.0
    colors = np.where(there[..., None], candidates.color, np.nan)
    enough = there.sum(axis=1) >= 3
    median = np.zeros((len(colors), 1, 3), np.float32)
    median[enough, 0] = np.nanmedian(colors[enough], axis=1)
    unlike = np.abs(candidates.color - median).max(axis=-1) > _UNLIKE
    drop = unlike & there & enough[:, None]
    drop &= ~(drop | ~there).all(axis=1)[:, None]
    candidates.score[drop] = 0.0
    candidates.view[drop] = NOBODY


def neighbours_of(faces: Ints) -> Ints:
    """[F, 3]: the face across each edge (0-1, 1-2, 2-0), -1 at a border.

    Of an edge with more than two faces, two are neighbours.
    """
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    keys = edges[:, 0].astype(np.int64) * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = keys[order][1:] == keys[order][:-1]
    first, second = order[:-1][same], order[1:][same]
    across = np.full(len(keys), -1, np.int32)
    across[first], across[second] = second % len(faces), first % len(faces)
    return np.ascontiguousarray(across.reshape(3, -1).T)


def _settled(candidates: _Candidates, neighbours: Ints) -> Ints:
    """Each face's choice, by turns improved for half of the faces."""
    best = candidates.score.max(axis=1, keepdims=True)
    own = np.where(candidates.score > 0.0, candidates.score / np.maximum(best, 1e-30), -np.inf)
    rows = np.arange(len(own))
    label = candidates.view[rows, own.argmax(axis=1)]
    generator = np.random.default_rng(0)
    for _ in range(_ROUNDS):
        around = np.where(neighbours >= 0, label[neighbours], NOBODY)
        like = (around[:, None, :] == candidates.view[:, :, None]).mean(axis=-1)
        wanted = candidates.view[rows, (own + _NEIGHBOURS_WEIGHT * like).argmax(axis=1)]
        turn = generator.random(len(label)) < 0.5
        label = np.where(turn, wanted, label)
    label[best[:, 0] <= 0.0] = NOBODY
    settled: Ints = label.astype(np.int32)
    return settled
