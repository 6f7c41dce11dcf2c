"""Virtual cameras beside the path of a capture, and how far its cameras look.

Everything follows from the training poses alone, so that no floater can move it. Lengths are scene
units. Symbols: N cameras in the order of their path, c_i their centres, a_i their optical axes, F
the focus.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.cameras import Cameras

OFF_PATH_SHARE = 0.15
_NUM_WAYS = 32
_MAX_ALONG_UP = 0.99
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


def view_distances(cameras: Cameras) -> Tensor:
    """How far each camera looks: [N] float64, > 0, from poses alone, so that no floater moves it.

    The distance to the focus, for cameras that have it ahead; for all others, and where there is
    no focus, the root mean square distance of the cameras from their mean.
    Raises NerfError `bad_cameras` where all stand in one place and look nowhere in common.
    """
    centers, axes = _centers_and_axes(cameras)
    radius = (centers - centers.mean(dim=0)).square().sum(dim=-1).mean().sqrt()
    distances = radius.expand(len(cameras))
    focus = focus_point(cameras)
    if focus is not None:
        toward = focus - centers
        ahead = (toward * axes).sum(dim=-1) > 0.0
        distances = torch.where(ahead, toward.norm(dim=-1), distances)
    if not bool((distances > 1e-9).all()):
        raise NerfError(
            "bad_cameras",
            "Floaters cannot be measured: all cameras stand in one place, so nothing says how "
            "large the scene is.",
            "Turn the floater measures off for this capture.",
        )
    return distances


def off_path_cameras(
    cameras: Cameras, count: int, seed: int = 0, *, share: float = OFF_PATH_SHARE
) -> Cameras:
    """`count` virtual cameras beside the path, with the lenses of cameras evenly picked from it.

    Each is moved at right angles to its optical axis by `share` of its view distance, never down
    (scene -Z), in that of 32 directions, turned by a random angle, which leads farthest from the
    path: the lines from each camera to the next, straight on at both ends. Then it looks at the
    focus, or where there is none, at the point that it looked at before.
    Same arguments, same cameras.
    """
    if count < 1:
        raise NerfError("bad_cameras", "There must be at least one view off the path.")
    generator = torch.Generator().manual_seed(seed)
    distances, focus = view_distances(cameras), focus_point(cameras)
    centers, axes = _centers_and_axes(cameras)
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
        places = centers[row] + share * distances[row] * ways
        place = places[int(_distance_to_path(places, centers).argmax())]
        target = focus if focus is not None else centers[row] + distances[row] * axes[row]
        poses.append(_looking_at(place, target, frame))
    stacked = torch.stack(poses).to(cameras.scene_from_camera)
    return replace(cameras.select(rows), scene_from_camera=stacked)


def evenly(num: int, at_most: int) -> list[int]:
    """At most so many of the indices 0..num-1, evenly spaced with both ends."""
    places = np.linspace(0, num - 1, min(num, at_most)).round()
    return sorted({int(place) for place in places})


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
