"""What of a job's mesh a flight has to heed: walls that it must not go through.

Poses do not tell photos from a room's corners from photos around a thing: in both, cameras look at
one point, from around it. The mesh does. What lies between a place among the photos and one further
out, with its outside turned to where one comes from, is a wall; what is left by its inside was the
thing that is filmed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.surface.sight import Sight
from pipelines.exports.surface.surface_file import KeptSurface, load_surface

Floats = NDArray[np.float64]

_MOST_LAYERS = 8
"""Faces left by their inside before the rest of a way counts as free."""
_STEP = 1e-3
"""How much further, in voxels, one goes on behind a face."""


class Walls:
    """The surface of a mesh, as `surface.npz` has it, in the world of cameras.json."""

    def __init__(self, surface: KeptSurface) -> None:
        vertices = np.asarray(surface.vertices, np.float64)
        first, second, third = (vertices[surface.faces[:, i]] for i in range(3))
        self._outside = np.cross(second - first, third - first)
        self._step = _STEP * float(np.median(surface.voxel))
        self._origin = np.asarray(surface.origin, np.float64)
        self._sight = Sight(surface.vertices, surface.faces)

    @classmethod
    def of(cls, folder: Path) -> Walls | None:
        """Those of a mesh's folder; None where it has no surface."""
        surface = load_surface(folder)
        return None if surface is None or len(surface.faces) == 0 else cls(surface)

    def hide(self, eyes: Floats, places: Floats) -> NDArray[np.bool_]:
        """[N] whether something lies between eyes and places, both [N, 3]."""
        return ~self._sight.reached(eyes - self._origin, places - self._origin)

    def distance(self, places: Floats, ways: Floats) -> Floats:
        """[N] how far places [N, 3] are from the first face along unit directions [N, 3] that turns
        its outside to who comes; infinite where there is none.
        """
        eyes = places - self._origin
        gone, found = np.zeros(len(eyes)), np.full(len(eyes), np.inf)
        going = np.arange(len(eyes))
        for _ in range(_MOST_LAYERS):
            if len(going) == 0:
                break
            way = ways[going]
            met, face, _where = self._sight.met(eyes[going] + gone[going, None] * way, way)
            gone[going] += met
            facing = (self._outside[face] * way).sum(axis=1) < 0.0
            is_wall = np.isfinite(met) & facing
            found[going[is_wall]] = gone[going[is_wall]]
            going = going[np.isfinite(met) & ~facing]
            gone[going] += self._step
        return found
