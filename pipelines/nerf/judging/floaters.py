"""How much floats where nothing should be: two measures on renders off the path.

Depth inconsistency: the share of surface points of one off-path view that another off-path view
sees through. Near mass: how opaque the space right in front of the training cameras is. Both are
0 in a scene of solid surfaces that keeps its distance; docs/evaluation.md gives the formulas and
what floaters of known size do to them.

Nothing here renders: the caller hands in what does. Lengths are scene units unless they say world.
Symbols: N training cameras, V off-path views, R rays, A and B two off-path views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.off_path import Targets, evenly
from pipelines.nerf.space.cameras import Cameras

SURFACE_ACCUMULATION = 0.5
"""A pixel shows a surface where its ray ends with a larger chance: there is a median depth."""
DEPTH_TOLERANCE = 0.05
PROBE_SHARE = 0.01
NEAR_SHARE = 0.3
NEAR_QUANTILE = 0.1
LATTICE = 16
MAX_NEAR_CAMERAS = 64

# 1 / p and 1 / p^2 with p^3 = p + 1: their multiples fill the unit square evenly (Roberts, 2018).
_SHIFTS = (0.7548776662466927, 0.5698402909980532)


class DepthPicture(Protocol):
    """What rays see: `renderer.RenderedImage` is one."""

    @property
    def depth(self) -> NDArray[np.float32]:
        """[R] median distance along the ray, world units."""

    @property
    def accumulation(self) -> NDArray[np.float32]:
        """[R] in [0, 1], the chance that the ray ends."""


RenderRays = Callable[[Tensor, Tensor], DepthPicture]
"""(origins [R, 3], unit directions [R, 3]), scene units -> picture: `Renderer.render_rays`."""
SurfaceDepth = Callable[[Tensor, Tensor], Tensor]
"""The same rays -> [R] median distances in scene units, infinite where a ray meets no surface."""
OpacityBefore = Callable[[Tensor, Tensor, float], Tensor]
"""(origins [R, 3], unit directions [R, 3], t) -> [R] in [0, 1]: the chance to end before t."""


@dataclass(frozen=True)
class FloaterReport:
    """Both measures, each in [0, 1], more for more floaters.

    depth_inconsistency: None where no two off-path views see the same place.
    details: JSON-able: `near_distance_world`, the bounds used, and the parts of both measures:
        `inconsistency_per_view` (by the view that shows the surface), `near_mass_per_camera` (in
        the order of `near_cameras`), `num_points`.
    """

    depth_inconsistency: float | None
    near_mass: float
    details: dict[str, Any]


def floater_measures(
    render_rays: RenderRays,
    cameras_off_path: Cameras,
    training_cameras: Cameras,
    targets: Targets,
    opacity_before: OpacityBefore,
    scene_scale: float,
) -> FloaterReport:
    """Measure a trained scene.

    render_rays, opacity_before: see the types; `opacity_of_density` makes the second from a
        density. Both get tensors on the cameras' device.
    cameras_off_path: V >= 2; each pixel gives one surface point, so that long sides of 64 px do.
    targets: of the training cameras.
    scene_scale: scene units per world unit (`SceneTransform.scale`).
    Raises NerfError `bad_cameras` for fewer than two off-path views.
    """
    depth_of = surface_depth(render_rays, scene_scale)
    seen_through, counted = inconsistent_points(cameras_off_path, depth_of)
    distance = near_distance(targets)
    picked = evenly(len(training_cameras), MAX_NEAR_CAMERAS)
    mass = near_mass(training_cameras.select(picked), opacity_before, distance)
    per_view = [
        round(float(part / whole), 6) if whole else None
        for part, whole in zip(seen_through.sum(dim=0), counted.sum(dim=0), strict=True)
    ]
    num_points = int(counted.sum())
    return FloaterReport(
        depth_inconsistency=float(seen_through.sum()) / num_points if num_points else None,
        near_mass=float(mass.mean()),
        details={
            "num_points": num_points,
            "inconsistency_per_view": per_view,
            "depth_tolerance": DEPTH_TOLERANCE,
            "near_distance_world": distance / scene_scale,
            "near_cameras": picked,
            "near_mass_per_camera": [round(value, 6) for value in mass.tolist()],
        },
    )


def surface_depth(render_rays: RenderRays, scene_scale: float) -> SurfaceDepth:
    """Median depths in scene units from a renderer that gives world units.

    A ray meets a surface where it ends with a chance above 0.5: else it has no median.
    """

    def depth_of(origins: Tensor, directions: Tensor) -> Tensor:
        picture = render_rays(origins, directions)
        depth = torch.as_tensor(picture.depth, dtype=torch.float32) * scene_scale
        solid = torch.as_tensor(picture.accumulation) > SURFACE_ACCUMULATION
        met = torch.where(solid & (depth > 0.0), depth, torch.full_like(depth, torch.inf))
        return met.to(origins.device)

    return depth_of


def inconsistent_points(
    cameras: Cameras, depth_of: SurfaceDepth, tolerance: float = DEPTH_TOLERANCE
) -> tuple[Tensor, Tensor]:
    """Of the surface points of view B, how many lie in the space that view A sees through.

    A point X that a pixel of B shows counts in A where A has it in its frame. A sees through it
    where |X - A| < (1 - tolerance) times the depth of A's own ray through X, and the same holds
    for X', 1 % of B's depth behind X: what A shows there is a surface clearly behind both. What is
    hidden from A lies behind A's surface, not before it, so that honest occlusion never counts. X'
    is there for soft or rounded outlines: A may look past X on the rim of a thing, hardly past X'.
    Returns (seen_through, counted), both [V, V] int64 by [A, B], 0 on the diagonal.
    """
    num = len(cameras)
    if num < 2:
        raise NerfError(
            "bad_cameras",
            f"Depth consistency compares views off the path, and there is {num}.",
            "Ask for at least two.",
        )
    points = [_surface_points(cameras, index, depth_of) for index in range(num)]
    seen_through = torch.zeros(num, num, dtype=torch.int64)
    counted = torch.zeros(num, num, dtype=torch.int64)
    for a in range(num):
        for b in range(num):
            if a == b:
                continue
            surface, behind = points[b]
            visible = _in_frame(cameras, a, surface)
            counted[a, b] = int(visible.sum())
            center = cameras.scene_from_camera[a, :, 3]
            free = _before_surface(center, surface[visible], depth_of, tolerance)
            free &= _before_surface(center, behind[visible], depth_of, tolerance)
            seen_through[a, b] = int(free.sum())
    return seen_through, counted


def near_mass(
    cameras: Cameras, opacity_before: OpacityBefore, distance: float, lattice: int = LATTICE
) -> Tensor:
    """Mean opacity within `distance` of each camera: [N] in [0, 1].

    lattice: the rays of a camera go through lattice x lattice points, evenly over its picture;
    each camera's are shifted within a cell, so that what falls between the rays of one camera does
    not do so in all.
    """
    device = cameras.size.device
    steps = torch.arange(lattice, dtype=torch.float32, device=device)
    cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
    masses = []
    for index in range(len(cameras)):
        shift = torch.tensor([0.5 + index * ratio for ratio in _SHIFTS], device=device) % 1.0
        rows = torch.full((len(cells),), index, dtype=torch.int64, device=device)
        pixels = (cells + shift) / lattice * cameras.size[index]
        rays = cameras.generate_rays(rows, pixels)
        masses.append(opacity_before(rays.origins, rays.directions, distance).double().mean())
    return torch.stack(masses).cpu()


def opacity_of_density(
    density: Callable[[Tensor], Tensor], *, near: float = 0.0, num_samples: int = 64
) -> OpacityBefore:
    """The opacity between `near` and t along rays, from a density.

    density: positions [P, 3] in scene space -> [P] per scene unit, such as `Model.density`.
    1 - exp(-sum of density times length) over equal intervals, each with its midpoint's density.
    Source: NeRF, arXiv:2003.08934, eq. 3.
    """

    def opacity_before(origins: Tensor, directions: Tensor, t: float) -> Tensor:
        if t <= near:
            return torch.zeros_like(origins[:, 0])
        length = (t - near) / num_samples
        steps = torch.arange(num_samples, dtype=origins.dtype, device=origins.device)
        t_mid = near + (steps + 0.5) * length
        places = origins[:, None] + directions[:, None] * t_mid[:, None]
        with torch.no_grad():
            values = density(places.reshape(-1, 3)).reshape(len(origins), num_samples)
        return -torch.expm1(-values.sum(dim=-1) * length)

    return opacity_before


def near_distance(targets: Targets) -> float:
    """The depth of the space in front of the cameras that should be empty, scene units.

    0.3 of the 10th percentile of how far they look: the closest cameras set it, as a walk towards
    the subject must not count the subject itself; a percentile, as one odd pose must not shrink it.
    """
    return NEAR_SHARE * float(torch.quantile(targets.distances, NEAR_QUANTILE))


def _surface_points(cameras: Cameras, index: int, depth_of: SurfaceDepth) -> tuple[Tensor, Tensor]:
    """The points [P, 3] that the pixels with a surface show, and those 1 % of the depth behind."""
    rays = cameras.image_rays(index)
    depth = depth_of(rays.origins, rays.directions)
    solid = torch.isfinite(depth)
    origins, reach = rays.origins[solid], rays.directions[solid] * depth[solid, None]
    return origins + reach, origins + (1.0 + PROBE_SHARE) * reach


def _before_surface(
    center: Tensor, points: Tensor, depth_of: SurfaceDepth, tolerance: float
) -> Tensor:
    """Which points [P, 3] lie clearly nearer than what is seen from `center` along their ray."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool, device=points.device)
    toward = points - center
    distance = toward.norm(dim=-1)
    depth = depth_of(center.expand_as(points), toward / distance[:, None])
    return torch.lt(distance, (1.0 - tolerance) * depth)


def _in_frame(cameras: Cameras, index: int, points: Tensor) -> Tensor:
    """Which points [P, 3] a camera would show if nothing stood before them: [P] bool."""
    shown = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    shown[cameras.points_in_frame(points, index)[0]] = True
    return shown
