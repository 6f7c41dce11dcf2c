"""From a reconstruction's arbitrary frame to ours: gravity along -Z, centred, cameras in [-1, 1]^3.

Symbols: N cameras; `world_from_camera` is [N, 3, 4] in OpenGL axes (+X right, +Y up, looks along
-Z) unless a name says `opencv` (+X right, +Y down, looks along +Z). X, Y, Z below are a camera's
axes in the world: the columns of its rotation. Everything is float64.

A phone is held so that its picture is upright: the X axes of its cameras are level, however far
it is tipped up or down. The direction most orthogonal to all X axes is therefore vertical, even
where every camera looks down. That is nerfstudio's `vertical` (cameras/camera_utils.py,
auto_orient_and_center_poses), here with weights that make a few rolled cameras harmless.

Photos that have lost their EXIF lie on their side as the sensor stored them. Then their Y axes are
level and the X axes are not, and one end of these is up: `sideways`. A phone that is turned while
it films, whose file says one thing of all frames, leaves some of the one kind and some of the
other: `either_way`.

X axes that are all parallel say little: pictures of a floor, taken straight down one beside the
other, are those of a wall. There what the devices measured tells, which is asked first, and how far
cameras are tipped the planes that they see (`pipelines.scene.pitch`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipelines.scene.focus import find_focus
from pipelines.scene.pitch import level_with_planes
from pipelines.scene.straightening import straightened

Array = npt.NDArray[np.float64]

_MIN_TURN = 0.17
"""Below this root mean square of the second axis (about 10 degrees), X axes are parallel."""
_FEWEST_MEASURED, _LEAST_MEASURED = 3, 0.25
"""Cameras that must have measured which way is up, at least, and their share."""
_SAME_UP_DEG, _MOST_SAME = 10.0, 0.75
"""How near one another measured directions are that are the same, and how many of them must be."""
_NOT_LEVEL = 0.12
"""Mean of |sine| of the X axes' heights, above which a phone was not held upright (7 degrees);
people's hands have some 0.05."""
_CLEARLY_LEVEL = 0.5
"""Of that, what the Y axes of pictures on their side have at most."""
_NEITHER_LEVEL, _LEAST_OF_EACH = 0.07, 0.2
"""Mean height of the leveller one of each camera's two axes, by what all X axes say, from which up
may be another; and the share of the cameras that must be held each way then."""
_STARTS, _STARTS_TRIED = 1000, 10
"""Directions of a half sphere, 4 degrees apart, and how many of the best are refined."""
_ALL_ROUND_DEG = 200.0
"""Where X axes are parallel: so much of a circle no upright camera is tipped through."""
_MANY_UPSIDE_DOWN = 0.25
"""Share of cameras, their X axes parallel, that are upside down against the others where a drone
flies to and fro; fewer are pictures of a wall that lost how they were held."""
_TOLD_BY_HANDS = ("vertical", "sideways", "either_way")
"""What is as exact as people hold their cameras level."""
_MIN_SIGN = 0.1
"""A mean camera axis this short along the vertical says nothing about which end is up."""


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation. rotation: [3, 3], det +1. translation: [3]."""

    rotation: Array
    translation: Array
    scale: float

    def apply_to_points(self, points: Array) -> Array:
        """points: [..., 3] in the old frame, to the new frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_directions(self, directions: Array) -> Array:
        """directions: [..., 3], turned only."""
        return directions @ self.rotation.T

    def apply_to_cameras(self, world_from_camera: Array) -> Array:
        """[N, 3, 4] to [N, 3, 4]: centres are moved, rotations stay orthonormal."""
        rotation = self.rotation @ world_from_camera[:, :, :3]
        centers = self.apply_to_points(world_from_camera[:, :, 3])
        return np.concatenate([rotation, centers[:, :, None]], axis=2)


@dataclass(frozen=True)
class Normalisation:
    """How the world was turned and centred. up_from: measured, either_way, vertical, sideways,
    planes, camera_up or none.

    centered_on: focus (the point that the cameras look at) or centers (their mean).
    straightened_deg: by how much up was turned to what is level in the scene.
    """

    similarity: Similarity
    up_from: str
    centered_on: str
    straightened_deg: float = 0.0


def opengl_from_opencv(world_from_camera_opencv: Array) -> Array:
    """[N, 3, 4] with OpenCV camera axes to the same poses with OpenGL camera axes."""
    flipped: Array = world_from_camera_opencv * np.array([1.0, -1.0, -1.0, 1.0])
    return flipped


def find_up(
    world_from_camera: Array, measured: Sequence[Sequence[float] | None] = ()
) -> tuple[Array, str]:
    """The direction away from gravity, [3] unit, and how it was found: measured, either_way,
    vertical, sideways or camera_up.

    measured: N, that direction [3] in each camera's axes where its device told it; or none at all.
    Raises ValueError where there are no cameras.
    """
    if len(world_from_camera) == 0:
        raise ValueError("no cameras to find the vertical from")
    if (told := _agreed(world_from_camera, measured)) is not None:
        return told, "measured"
    if (mixed := _up_of_either_way(world_from_camera)) is not None:
        return mixed, "either_way"
    if (beside := _up_of_pictures_on_their_side(world_from_camera)) is not None:
        return beside, "sideways"
    x_axes = world_from_camera[:, :, 0]
    mean_up: Array = world_from_camera[:, :, 1].mean(axis=0)
    if (up := _level_to(x_axes)) is not None:
        return up * _sign_of_up(up, world_from_camera), "vertical"
    _, _, rows = np.linalg.svd(x_axes, full_matrices=False)
    level = mean_up - rows[0] * float(mean_up @ rows[0])
    if _share_upside_down(world_from_camera[:, :, 1]) >= _MANY_UPSIDE_DOWN:
        level = world_from_camera[:, :, 2].mean(axis=0)  # nobody takes a wall so: all look down
    length = float(np.linalg.norm(level))
    if length < _MIN_SIGN:
        return np.array([0.0, 0.0, 1.0]), "camera_up"
    return level / length, "camera_up"


def _up_of_either_way(world_from_camera: Array) -> Array | None:
    """The direction, [3] unit, to which of each camera the X axis or the Y axis is level, of some
    the one and of some the other; None where all X axes or all Y axes do as well.

    Its end is that of the cameras that are held upright.
    """
    axes = world_from_camera[:, :, :2]

    def off(up: Array) -> float:
        return float(np.abs(up @ axes).min(axis=1).mean())

    usual = _level_to(axes[:, :, 0])
    if usual is None or off(usual) < _NEITHER_LEVEL:
        return None
    starts = _half_sphere(_STARTS)
    order = np.argsort([off(start) for start in starts], kind="stable")
    found: list[Array] = []
    for up in starts[order[:_STARTS_TRIED]]:
        for _ in range(5):
            rows = np.arange(len(axes))
            up = _most_orthogonal(axes[rows, :, np.abs(up @ axes).argmin(axis=1)], up)
        found.append(up)
    best = min(found, key=off)
    is_upright = np.abs(best @ axes).argmin(axis=1) == 0
    share = float(is_upright.mean())
    if off(best) > _CLEARLY_LEVEL * off(usual) or min(share, 1.0 - share) < _LEAST_OF_EACH:
        return None
    end: float = _sign_of_up(best, world_from_camera[is_upright])
    return best * end


def _half_sphere(num: int) -> Array:
    """[num, 3] unit directions, evenly over the half sphere of z > 0 (Fibonacci's spiral)."""
    place = np.arange(num) + 0.5
    height, turn = 1.0 - place / num, np.pi * (1.0 + np.sqrt(5.0)) * place
    flat = np.sqrt(1.0 - height**2)
    directions: Array = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return directions


def _up_of_pictures_on_their_side(world_from_camera: Array) -> Array | None:
    """The direction, [3] unit, where the cameras' Y axes are level and their X axes are not; None
    where that is not clear.

    Its end is the one from which they look down, or else the pictures' left, as photos are stored
    of a phone that is held upright.
    """
    x_axes, y_axes = world_from_camera[:, :, 0], world_from_camera[:, :, 1]
    up, other = _level_to(y_axes), _level_to(x_axes)
    if up is None:
        return None
    if other is None:
        held = x_axes @ x_axes.mean(axis=0) > 0.0  # not upside down
        if _turned_through_deg(y_axes[held]) < _ALL_ROUND_DEG:
            return None
    else:
        off = float(np.abs(x_axes @ other).mean())
        if off < _NOT_LEVEL or float(np.abs(y_axes @ up).mean()) > _CLEARLY_LEVEL * off:
            return None
    backwards = float(world_from_camera[:, :, 2].mean(axis=0) @ up)
    end = backwards if abs(backwards) >= _MIN_SIGN else -float(x_axes.mean(axis=0) @ up)
    return up if end >= 0.0 else -up


def _level_to(axes: Array) -> Array | None:
    """The direction [3] that axes [N, 3] are most orthogonal to; None where they are parallel."""
    squares, directions = np.linalg.eigh(axes.T @ axes / len(axes))
    if squares[1] < _MIN_TURN**2:
        return None
    return _most_orthogonal(axes, directions[:, 0])


def _turned_through_deg(axes: Array) -> float:
    """How much of a circle directions [N, 3] in a plane have gone through: all but the widest
    gap."""
    _, _, rows = np.linalg.svd(axes, full_matrices=False)
    angles = np.sort(np.degrees(np.arctan2(axes @ rows[1], axes @ rows[0])))
    if len(angles) == 0:
        return 0.0
    gaps = np.diff(angles, append=angles[0] + 360.0)
    return 360.0 - float(gaps.max())


def _share_upside_down(y_axes: Array) -> float:
    """How many of parallel Y axes [N, 3] point against the others, at most a half."""
    _, _, rows = np.linalg.svd(y_axes, full_matrices=False)
    share = float((y_axes @ rows[0] < 0.0).mean())
    return min(share, 1.0 - share)


def _agreed(world_from_camera: Array, measured: Sequence[Sequence[float] | None]) -> Array | None:
    """The direction, [3] unit, that most of the measured ones are in the world; None where too few
    are known or they differ, as those of another camera's axes do once cameras turn."""
    told = np.array(
        [
            pose[:, :3] @ up
            for pose, up in zip(world_from_camera, measured, strict=bool(measured))
            if up is not None
        ]
    )
    if len(told) < max(_FEWEST_MEASURED, _LEAST_MEASURED * len(world_from_camera)):
        return None
    near = np.cos(np.radians(_SAME_UP_DEG))
    same = told @ told.T >= near
    same = same[same.sum(axis=1).argmax()]
    if same.mean() < _MOST_SAME:
        return None
    mean: Array = told[same].mean(axis=0)
    return mean / np.linalg.norm(mean)


def _most_orthogonal(axes: Array, start: Array) -> Array:
    """The unit vector u that minimises sum |axis . u|, by reweighted least squares.

    axes: [N, 3] unit. start: [3] unit, the least squares answer. The absolute value, not the
    square, so that a few cameras rolled by 90 degrees do not tilt the rest.
    """
    up = start
    for _ in range(20):
        weights = 1.0 / np.maximum(np.abs(axes @ up), 1e-3)
        _, _, rows = np.linalg.svd(axes * np.sqrt(weights)[:, None], full_matrices=False)
        if abs(float(rows[2] @ up)) > 1.0 - 1e-12:
            break
        up = rows[2]
    return np.asarray(up, np.float64)


def _sign_of_up(up: Array, world_from_camera: Array) -> float:
    """+1 or -1: cameras' own up decides; where they look straight down, their gaze does."""
    along_up = float(world_from_camera[:, :, 1].mean(axis=0) @ up)
    if abs(along_up) >= _MIN_SIGN:
        return 1.0 if along_up > 0 else -1.0
    backwards = float(world_from_camera[:, :, 2].mean(axis=0) @ up)
    return 1.0 if backwards >= 0 else -1.0


def rotation_to_z(up: Array) -> Array:
    """The smallest rotation [3, 3] that turns the unit vector `up` [3] to +Z."""
    target = np.array([0.0, 0.0, 1.0])
    cosine = float(up @ target)
    if cosine < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.cross(up, target)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation: Array = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    return rotation


def normalise(
    world_from_camera: Array,
    *,
    orient: bool = True,
    measured: Sequence[Sequence[float] | None] = (),
    points: Array | None = None,
) -> Normalisation:
    """The similarity that puts a reconstruction of unknown frame and scale into ours.

    world_from_camera: [N, 3, 4], OpenGL axes. measured: as in `find_up`. points: [P, 3], what they
    see, asked where the cameras only tell what is level, and for what is level in the scene where
    hands tell. Afterwards gravity points along -Z (if
    `orient`), the origin is the focus, or else the mean of the camera centres, and the
    largest absolute coordinate of a camera centre is 1. Cameras in one single point keep their
    scale.
    """
    up, up_from, turned_deg = np.array([0.0, 0.0, 1.0]), "none", 0.0
    if orient:
        up, up_from = find_up(world_from_camera, measured)
    if points is not None and up_from == "camera_up":
        side = np.linalg.svd(world_from_camera[:, :, 0], full_matrices=False)[2][0]
        by_planes = level_with_planes(points, world_from_camera[:, :, 3], side, up)
        if by_planes is not None:
            up, up_from = by_planes, "planes"
    elif points is not None and up_from in _TOLD_BY_HANDS:
        level = straightened(points, world_from_camera, up)
        if level is not None:
            up, turned_deg = level, float(np.degrees(np.arccos(np.clip(level @ up, -1.0, 1.0))))
    rotation = rotation_to_z(up)
    focus = find_focus(world_from_camera)
    centers = world_from_camera[:, :, 3]
    center = centers.mean(axis=0) if focus is None else focus
    reach = float(np.abs((centers - center) @ rotation.T).max(initial=0.0))
    scale = 1.0 / reach if reach > 1e-12 else 1.0
    similarity = Similarity(rotation=rotation, translation=-scale * rotation @ center, scale=scale)
    centered_on = "centers" if focus is None else "focus"
    return Normalisation(similarity, up_from, centered_on, turned_deg)
