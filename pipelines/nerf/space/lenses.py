"""Lens formulas between the normalised image plane and directions in the camera.

Symbols: plane point (x, y) = (pixel - principal) / focal as the lens shows it; direction (X, Y, Z)
in OpenCV's axes (+X right, +Y down, +Z forward); terms k1, k2, k3, k4, p1, p2; r the distance from
the axis on the plane; theta the angle from the axis. All functions are differentiable and work on
a mixed batch: `model` [R] int64 says per row which formula holds, and `kinds` which of them occur
at all, so that no device has to be asked.

    PINHOLE          (x, y) = (X, Y) / Z
    OPENCV           the same, then shifted along and across the radius by the terms
    OPENCV_FISHEYE   (x, y) = theta (1 + k1 theta^2 + ... + k4 theta^8) (X, Y) / |(X, Y)|
    EQUIRECTANGULAR  (x, y) = (longitude, -latitude) / pi, where longitude = atan2(X, Z) is 0 on the
                     axis and grows to the right, latitude = asin(-Y / |(X, Y, Z)|) grows upwards.
                     A whole panorama has focal (width / 2, height) and its principal point in the
                     middle: the outermost columns look backwards, the top row straight up.
"""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor

PINHOLE, OPENCV, FISHEYE, EQUIRECTANGULAR = range(4)
CAMERA_MODELS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR")
"""Names of the models; the position is the number in `model`."""

MAX_STEPS = 20
"""Of Newton's method, for lenses that nearly fold over within the picture; most need two or three,
see `steps_needed`."""
STEP_TOLERANCE = 1e-8
"""Of plane points and directions: 3e-5 px at a focal length of 3,000 px, and below float32."""
MIN_DETERMINANT = 1e-4
MAX_PLANE = 1e4
"""Plane points farther out than this come of a step next to a fold and mean nothing."""


def distort(
    directions: Tensor, terms: Tensor, model: Tensor, kinds: Collection[int] = range(4)
) -> Tensor:
    """Where the lens shows directions [R, 3] on the plane: [R, 2].

    terms: [R, 6]. model: [R] int64. kinds: the numbers that `model` may hold.
    Source: OpenCV, calib3d and fisheye module documentation; nerfstudio's data conventions.
    """
    depth = directions[:, 2:]
    # A point in the camera's own plane has no image; the guard only keeps it finite.
    safe = torch.where(depth.abs() < 1e-9, torch.full_like(depth, 1e-9), depth)
    shown = directions[:, :2] / safe
    if OPENCV in kinds:
        shown = _distort_plane(shown, terms)
    if FISHEYE in kinds:
        shown = torch.where((model == FISHEYE)[:, None], _distort_fisheye(directions, terms), shown)
    if EQUIRECTANGULAR in kinds:
        panorama = (model == EQUIRECTANGULAR)[:, None]
        shown = torch.where(panorama, _distort_equirectangular(directions), shown)
    return shown


def undistort(
    plane: Tensor,
    terms: Tensor,
    model: Tensor,
    kinds: Collection[int] = range(4),
    steps: int = MAX_STEPS,
) -> Tensor:
    """Directions [R, 3], not normalised, that the lens shows at plane points [R, 2].

    terms: [R, 6]. model: [R] int64. kinds: the numbers that `model` may hold. steps: of Newton's
    method, as `steps_needed` says. A step is left out where the lens formula folds over, so that a
    pixel beyond its valid range gets a finite direction.
    """
    ideal = _undistort_plane(plane, terms, steps) if OPENCV in kinds else plane
    direction = torch.cat([ideal, torch.ones_like(ideal[:, :1])], dim=-1)
    if FISHEYE in kinds:
        fisheye = (model == FISHEYE)[:, None]
        direction = torch.where(fisheye, _undistort_fisheye(plane, terms, steps), direction)
    if EQUIRECTANGULAR in kinds:
        panorama = (model == EQUIRECTANGULAR)[:, None]
        direction = torch.where(panorama, _undistort_equirectangular(plane), direction)
    return direction


def steps_needed(plane: Tensor, terms: Tensor, model: Tensor, kinds: Collection[int]) -> int:
    """The least number of steps with which `undistort` ends where it ends after `MAX_STEPS`.

    plane: [R, 2] float64, points all over the pictures; those that no direction is shown at, beyond
    a fold, do not count. The rest as in `undistort`.
    """
    if OPENCV not in kinds and FISHEYE not in kinds:
        return 0
    ends = undistort(plane, terms, model, kinds)
    back = distort(ends, terms, model, kinds)
    seen = ((back - plane).abs() <= STEP_TOLERANCE).all(dim=-1, keepdim=True)
    for steps in range(MAX_STEPS):
        gap = (undistort(plane, terms, model, kinds, steps) - ends).abs()
        if float(torch.where(seen, gap, 0.0).max()) <= STEP_TOLERANCE:
            return steps
    return MAX_STEPS


def _radial(r2: Tensor, terms: Tensor) -> tuple[Tensor, Tensor]:
    """1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8 and its derivative by r^2, both [R, 1], of [R, 1].

    Horner's scheme for both at once: each line is one operation of the device.
    """
    k1, k2, k3, k4 = terms[:, :4].chunk(4, dim=-1)
    value = torch.addcmul(k3, k4, r2)
    slope = torch.addcmul(value, k4, r2)
    value = torch.addcmul(k2, value, r2)
    slope = torch.addcmul(value, slope, r2)
    value = torch.addcmul(k1, value, r2)
    slope = torch.addcmul(value, slope, r2)
    return 1.0 + value * r2, slope


def _distort_plane(point: Tensor, terms: Tensor) -> Tensor:
    """OpenCV's radial and tangential model, [R, 2] of [R, 2].

    With z the point, q = (p2, p1) and g the radial factor: z (g + 2 q.z) + q r^2.
    """
    tangential = terms[:, 4:].flip(-1)
    r2 = (point * point).sum(dim=-1, keepdim=True)
    along = (tangential * point).sum(dim=-1, keepdim=True)
    gain = _radial(r2, terms)[0] + 2.0 * along
    return point * gain + tangential * r2


def _undistort_plane(plane: Tensor, terms: Tensor, steps: int) -> Tensor:
    """The inverse of `_distort_plane` by Newton's method from the shown point.

    Its Jacobian is a I + z v' + v z' with a = g + 2 q.z and v = g' z + 2 q. Written in few
    operations on two columns, since a device starts each of them for each step of training.
    """
    tangential = terms[:, 4:].flip(-1)
    doubled, negative, point = 2.0 * tangential, -plane, plane
    for _ in range(steps):
        r2 = (point * point).sum(dim=-1, keepdim=True)
        radial, slope = _radial(r2, terms)
        along = (tangential * point).sum(dim=-1, keepdim=True)
        gain = torch.add(radial, along, alpha=2.0)
        gap = torch.addcmul(torch.addcmul(negative, tangential, r2), point, gain)
        across = torch.addcmul(doubled, slope, point)
        diagonal = torch.add(gain, point * across, alpha=2.0)
        (x, y), (across_x, across_y) = point.chunk(2, dim=-1), across.chunk(2, dim=-1)
        mixed = torch.addcmul(x * across_y, y, across_x)
        dxx, dyy = diagonal.chunk(2, dim=-1)
        determinant = torch.addcmul(dxx * dyy, mixed, mixed, value=-1.0)
        step = torch.addcmul(diagonal.flip(-1) * gap, mixed, gap.flip(-1), value=-1.0)
        # Both positive: the lens has not folded over between the axis and here.
        usable = torch.minimum(determinant, dxx) > MIN_DETERMINANT
        step = torch.where(usable, step, 0.0)
        point = torch.addcdiv(point, step, determinant.clamp_min(MIN_DETERMINANT), value=-1.0)
    return torch.where(point.abs() < MAX_PLANE, point, plane)


def _distort_fisheye(directions: Tensor, terms: Tensor) -> Tensor:
    radius: Tensor = directions[:, :2].norm(dim=-1, keepdim=True)
    theta = torch.atan2(radius, directions[:, 2:])
    bent = theta * _radial(theta * theta, terms)[0]
    return directions[:, :2] * (bent / radius.clamp_min(1e-9))


def _undistort_fisheye(plane: Tensor, terms: Tensor, steps: int) -> Tensor:
    wanted: Tensor = plane.norm(dim=-1, keepdim=True)
    theta, negative = wanted.clamp_max(torch.pi), -wanted
    for _ in range(steps):
        theta2 = theta * theta
        radial, slope = _radial(theta2, terms)
        bending = torch.addcmul(radial, theta2, slope, value=2.0)  # d bent angle / d theta
        gap = torch.addcmul(negative, theta, radial)
        gap = torch.where(bending > MIN_DETERMINANT, gap, 0.0)
        theta = torch.addcdiv(theta, gap, bending.clamp_min(MIN_DETERMINANT), value=-1.0)
        theta = theta.clamp(0.0, torch.pi)
    across = plane * (torch.sin(theta) / wanted.clamp_min(1e-9))
    return torch.cat([across, torch.cos(theta)], dim=-1)


def _distort_equirectangular(directions: Tensor) -> Tensor:
    x, y, z = directions.unbind(-1)
    longitude, down = torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())
    return torch.stack([longitude, down], dim=-1) / torch.pi


def _undistort_equirectangular(plane: Tensor) -> Tensor:
    longitude, down = (plane * torch.pi).unbind(-1)
    level = torch.cos(down)
    across, forward = torch.sin(longitude) * level, torch.cos(longitude) * level
    return torch.stack([across, torch.sin(down), forward], dim=-1)
