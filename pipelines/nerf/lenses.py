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

NEWTON_STEPS = 10
MIN_DETERMINANT = 1e-4


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
        shown = _shift(shown, terms)[0]
    if FISHEYE in kinds:
        shown = torch.where((model == FISHEYE)[:, None], _distort_fisheye(directions, terms), shown)
    if EQUIRECTANGULAR in kinds:
        panorama = (model == EQUIRECTANGULAR)[:, None]
        shown = torch.where(panorama, _distort_equirectangular(directions), shown)
    return shown


def undistort(
    plane: Tensor, terms: Tensor, model: Tensor, kinds: Collection[int] = range(4)
) -> Tensor:
    """Directions [R, 3], not normalised, that the lens shows at plane points [R, 2].

    terms: [R, 6]. model: [R] int64. kinds: the numbers that `model` may hold. Newton's method; a
    step is left out where the lens formula folds over, so that a pixel beyond its valid range gets
    a finite direction.
    """
    ideal = _undistort_plane(plane, terms) if OPENCV in kinds else plane
    direction = torch.cat([ideal, torch.ones_like(ideal[:, :1])], dim=-1)
    if FISHEYE in kinds:
        fisheye = (model == FISHEYE)[:, None]
        direction = torch.where(fisheye, _undistort_fisheye(plane, terms), direction)
    if EQUIRECTANGULAR in kinds:
        panorama = (model == EQUIRECTANGULAR)[:, None]
        direction = torch.where(panorama, _undistort_equirectangular(plane), direction)
    return direction


def _shift(point: Tensor, terms: Tensor) -> tuple[Tensor, Tensor]:
    """OpenCV's radial and tangential model: ([R, 2], Jacobian [R, 3]: dxx, dxy = dyx, dyy)."""
    x, y = point.unbind(-1)
    k1, k2, k3, k4, p1, p2 = terms.unbind(-1)
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4))  # d radial / d r2
    shown_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    shown_y = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    dxx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = radial + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y
    return torch.stack([shown_x, shown_y], dim=-1), torch.stack([dxx, dxy, dyy], dim=-1)


def _undistort_plane(plane: Tensor, terms: Tensor) -> Tensor:
    point = plane
    for _ in range(NEWTON_STEPS):
        shown, jacobian = _shift(point, terms)
        dxx, dxy, dyy = jacobian.unbind(-1)
        gap_x, gap_y = (shown - plane).unbind(-1)
        determinant = dxx * dyy - dxy * dxy
        usable = (determinant > MIN_DETERMINANT) & (dxx > 0.0)
        inverse = torch.where(usable, 1.0 / determinant.clamp_min(MIN_DETERMINANT), 0.0)
        step = torch.stack([dyy * gap_x - dxy * gap_y, dxx * gap_y - dxy * gap_x], dim=-1)
        point = point - step * inverse[:, None]
    return torch.where(point.isfinite().all(dim=-1, keepdim=True), point, plane)


def _bent_angle(theta: Tensor, terms: Tensor) -> tuple[Tensor, Tensor]:
    """theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) and its derivative."""
    k1, k2, k3, k4 = terms[:, :4].unbind(-1)
    t2 = theta * theta
    bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    return bent, slope


def _distort_fisheye(directions: Tensor, terms: Tensor) -> Tensor:
    radius: Tensor = directions[:, :2].norm(dim=-1)
    theta = torch.atan2(radius, directions[:, 2])
    scale = _bent_angle(theta, terms)[0] / radius.clamp_min(1e-9)
    return directions[:, :2] * scale[:, None]


def _undistort_fisheye(plane: Tensor, terms: Tensor) -> Tensor:
    bent_wanted = plane.norm(dim=-1)
    theta = bent_wanted.clamp_max(torch.pi)
    for _ in range(NEWTON_STEPS):
        bent, slope = _bent_angle(theta, terms)
        step = torch.where(slope > MIN_DETERMINANT, (bent - bent_wanted) / slope, 0.0)
        theta = (theta - step).clamp(0.0, torch.pi)
    across = plane * (torch.sin(theta) / bent_wanted.clamp_min(1e-9))[:, None]
    return torch.cat([across, torch.cos(theta)[:, None]], dim=-1)


def _distort_equirectangular(directions: Tensor) -> Tensor:
    x, y, z = directions.unbind(-1)
    longitude, down = torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())
    return torch.stack([longitude, down], dim=-1) / torch.pi


def _undistort_equirectangular(plane: Tensor) -> Tensor:
    longitude, down = (plane * torch.pi).unbind(-1)
    level = torch.cos(down)
    across, forward = torch.sin(longitude) * level, torch.cos(longitude) * level
    return torch.stack([across, torch.sin(down), forward], dim=-1)
