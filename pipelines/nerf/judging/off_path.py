"""Virtual cameras beside the path of a capture, and how far its cameras look.

Everything follows from the training poses and from what was known of the capture's depth before
anything was trained, so that no floater can move it. Lengths are scene units. Symbols: N cameras in
the order of their path, c_i their centres, a_i their optical axes, F the focus.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.cameras import Cameras

OFF_PATH_SHARE = 0.15
_NUM_WAYS = 32
_MAX_ALONG_UP = 0.99
_MAX_DEPTHS = 2.0
"""A camera does not look at what is farther than so many times the depth that it shows."""
_MIN_SPREAD = 1e-3
"""Least mean sin^2 of the angle between the optical axes and their common direction that gives a
focus: below about 2 degrees they are as good as parallel."""


def focus_point(cameras: Cameras) -> Tensor | None:
    """The point F [3] float64 nearest to all optical axes, or None where they have none.

    It minimises the sum of squared distances to the axes c_i + t a_i: sum (I - a a^T)(F - c) = 0.
    None where the axes are as good as parallel, or F lies behind half of the cameras or more, as
    when they look outwards.
    """
    centers, axes = _centers_and_axes(cameras)
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(system)[0]) < _MIN_SPREAD:
        return None
    focus = torch.linalg.solve(system, (across @ centers[:, :, None]).mean(dim=0)[:, 0])
    ahead = ((focus - centers) * axes).sum(dim=-1) > 0.0
    return focus if float(ahead.double().mean()) > 0.5 else None


@dataclass(frozen=True)
class Targets:
    """What each of N cameras looks at.

    distances: [N] float64, > 0. points: [N, 3] float64: F, or what lies ahead at that distance.
    """

    distances: Tensor
    points: Tensor


def view_targets(cameras: Cameras, depths: Tensor | None = None) -> Targets:
    """What each camera looks at, from poses and, where it is known, from the depth that it shows.

    depths: [N], the median z-depth of each camera's picture, NaN where unknown: as the other
    cameras' then, in the median.
    A camera looks at the focus where its picture has that place, no farther than twice its depth.
    All others, and where there is no focus, look straight ahead: at their depth, but no farther
    than the root mean square distance of the cameras from their mean, which stands in where no
    depth is known.
    Raises NerfError `bad_cameras` where all stand in one place and look nowhere in common.
    """
    centers, axes = _centers_and_axes(cameras)
    known = _completed(depths, len(cameras))
    radius = (centers - centers.mean(dim=0)).square().sum(dim=-1).mean().sqrt()
    distances = known.clamp_max(float(radius))
    points = centers + distances[:, None] * axes
    focus = focus_point(cameras)
    if focus is not None:
        reach = (focus - centers).norm(dim=-1)
        looks = _have_in_frame(cameras, focus) & (reach <= _MAX_DEPTHS * known)
        distances = torch.where(looks, reach, distances)
        points = torch.where(looks[:, None], focus, points)
    if not bool((distances > 1e-9).all()):
        raise NerfError(
            "bad_cameras",
            "Floaters cannot be measured: all cameras stand in one place, so nothing says how "
            "large the scene is.",
            "Turn the floater measures off for this capture.",
        )
    return Targets(distances, points)


def off_path_cameras(
    cameras: Cameras, targets: Targets, count: int, seed: int = 0, *, share: float = OFF_PATH_SHARE
) -> Cameras:
    """`count` virtual cameras beside the path, with the lenses of cameras evenly picked from it.

    Each is moved at right angles to its optical axis by `share` of the distance at which it looks,
    never down (scene -Z), in that of 32 directions, turned by a random angle, which leads farthest
    from the path: the lines from each camera to the next, straight on at both ends. Then it looks
    at the point that it looked at before.
    Same arguments, same cameras.
    """
    if count < 1:
        raise NerfError("bad_cameras", "There must be at least one view off the path.")
    generator = torch.Generator().manual_seed(seed)
    centers, _ = _centers_and_axes(cameras)
    picked = evenly(len(cameras), count) if count <= len(cameras) else None
    rows = picked or [index * len(cameras) // count for index in range(count)]
    poses = []
    for row in rows:
        frame = cameras.scene_from_camera[row, :, :3].detach().cpu().double()
        turn = torch.rand((), generator=generator, dtype=torch.float64)
        angles = (torch.arange(_NUM_WAYS) + turn) * (2.0 * torch.pi / _NUM_WAYS)
        ways = torch.cos(angles)[:, None] * frame[:, 0] + torch.sin(angles)[:, None] * frame[:, 1]
        # Half of the circle is never below; the small term keeps both ends of a level line.
        ways = ways[ways[:, 2] >= -1e-9]
        places = centers[row] + share * targets.distances[row] * ways
        place = places[int(_distance_to_path(places, centers).argmax())]
        poses.append(_looking_at(place, targets.points[row], frame))
    stacked = torch.stack(poses).to(cameras.scene_from_camera)
    return replace(cameras.select(rows), scene_from_camera=stacked)


def evenly(num: int, at_most: int) -> list[int]:
    """At most so many of the indices 0..num-1, evenly spaced with both ends."""
    places = np.linspace(0, num - 1, min(num, at_most)).round()
    return sorted({int(place) for place in places})


def _have_in_frame(cameras: Cameras, place: Tensor) -> Tensor:
    """Which cameras would show a place [3] if nothing stood before it: [N] bool, on the CPU."""
    point = place[None].to(cameras.scene_from_camera)
    shown = [len(cameras.points_in_frame(point, index)[0]) > 0 for index in range(len(cameras))]
    return torch.tensor(shown)


def _completed(depths: Tensor | None, num: int) -> Tensor:
    """Depths [N] float64 on the CPU: unknown ones as the median of the others, infinite without."""
    if depths is None:
        return torch.full((num,), torch.inf, dtype=torch.float64)
    found = depths.detach().cpu().double()
    middle = torch.nanmedian(found).nan_to_num(torch.inf)
    return torch.where(found.isnan(), middle, found)


def _centers_and_axes(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Camera centres and unit optical axes, [N, 3] float64 on the CPU."""
    poses = cameras.scene_from_camera.detach().cpu().double()
    return poses[:, :, 3], -poses[:, :, 2]


def _distance_to_path(places: Tensor, centers: Tensor) -> Tensor:
    """Distance [P] of each place [P, 3] from the lines that join the centres [N, 3] in order."""
    if len(centers) > 1:
        reach = torch.cdist(centers, centers).amax()
        first, last = centers[0] - centers[1], centers[-1] - centers[-2]
        before = centers[0] + reach * torch.nn.functional.normalize(first, dim=0)
        behind = centers[-1] + reach * torch.nn.functional.normalize(last, dim=0)
        centers = torch.cat([before[None], centers, behind[None]])
    starts, steps = centers, torch.diff(centers, dim=0, append=centers[-1:])
    toward = places[:, None] - starts
    length = steps.square().sum(dim=-1).clamp_min(1e-18)
    share = ((toward * steps).sum(dim=-1) / length).clamp(0.0, 1.0)
    gaps: Tensor = torch.linalg.vector_norm(toward - share[..., None] * steps, dim=-1)
    return gaps.amin(dim=-1)


def _looking_at(place: Tensor, target: Tensor, frame: Tensor) -> Tensor:
    """The pose [3, 4] at `place`, looking at `target`, as upright as the camera `frame` [3, 3]."""
    back = torch.nn.functional.normalize(place - target, dim=0)
    # A camera that now looks along its old +Y has its old +Z above it.
    up = frame[:, 1] if float((frame[:, 1] @ back).abs()) < _MAX_ALONG_UP else frame[:, 2]
    right = torch.nn.functional.normalize(torch.linalg.cross(up, back), dim=0)
    return torch.stack([right, torch.linalg.cross(back, right), back, place], dim=1)
