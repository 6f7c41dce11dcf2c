"""Cameras: pixels <-> rays, lens distortion, and the way from world to scene space.

Frames and units are those of README.md: camera axes are OpenGL (+X right, +Y up, looks along -Z),
the centre of the top-left pixel is (0.5, 0.5), rays have unit directions in scene space. Lenses:
PINHOLE, OPENCV (radial k1..k4 as powers r^2..r^8, tangential p1, p2), OPENCV_FISHEYE (angular
k1..k4 as powers theta^2..theta^8) and EQUIRECTANGULAR (columns are longitudes, rows latitudes; the
middle looks along -Z). `lenses` has their formulas; one batch may mix them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.lenses import (
    CAMERA_MODELS,
    EQUIRECTANGULAR,
    FISHEYE,
    MAX_STEPS,
    OPENCV,
    PINHOLE,
    distort,
    steps_needed,
    undistort,
)
from pipelines.nerf.space.rays import Rays

MAX_ANGLE_ERROR = 0.005
"""Between the way to a point and the ray of its pixel, as a chord of the unit sphere."""
MAX_SKEW = 1e-3
"""Largest departure of R R^T from the identity that still counts as rounding."""
MAX_PANORAMA = 1.01
"""Share of the sphere that an equirectangular picture may cover: all of it, and rounding."""
LENS_GRID = 13
"""Points along each side of a picture at which its lens is tried out, corners included."""
REMEMBERED_PX = 1_000_000
"""Pictures of at most so many have the rays of their lens remembered, at 12 bytes each."""


def reduced_size(width: int, height: int, long_side: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `long_side`; never larger than it was."""
    scale = min(1.0, long_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def panorama_intrinsics(width: int, height: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """(focal, principal) in px of an EQUIRECTANGULAR picture that shows the whole sphere."""
    return (width / 2, float(height)), (width / 2, height / 2)


_USUAL_PERCENT, _FAR = 90, 3.0
"""Cameras so many times as far from the middle one as that share of them are apart from the
others."""


@dataclass(frozen=True)
class SceneTransform:
    """scene = scale * (world - center). Rotation is the identity.

    center: world units. scale: scene units per world unit, > 0. A distance t in the scene is
    t / scale in the world. All in float64: a geo-referenced world has offsets of 10^6 that float32
    cannot hold.
    """

    center: tuple[float, float, float]
    scale: float

    @classmethod
    def fit(cls, camera_centers: ArrayLike, *, scale_poses: bool = True) -> SceneTransform:
        """Centred on the mean camera, with all cameras in [-1, 1]^3 where `scale_poses`.

        But for some in a hundred that are farther from all others than thrice what nine in ten
        are: one picture of the whole, or one wrong pose, would leave no detail to the rest.

        camera_centers: [N, 3], world units. Raises NerfError `bad_cameras` unless finite.
        """
        centers = np.asarray(camera_centers, dtype=np.float64).reshape(-1, 3)
        if len(centers) == 0 or not np.isfinite(centers).all():
            raise NerfError(
                "bad_cameras", "There is no camera centre, or one is not finite.", "Check poses."
            )
        away = np.abs(centers - np.median(centers, axis=0)).max(axis=1)
        centers = centers[away <= _FAR * np.percentile(away, _USUAL_PERCENT)]
        center = centers.mean(axis=0)
        reach = float(np.abs(centers - center).max())
        scale = 1.0 / reach if scale_poses and reach > 0.0 else 1.0
        return cls(center=(float(center[0]), float(center[1]), float(center[2])), scale=scale)

    def scene_from_world(self, points: ArrayLike) -> NDArray[np.float64]:
        """World points [..., 3] in scene units."""
        centered: NDArray[np.float64] = np.asarray(points, np.float64) - np.asarray(self.center)
        centered *= self.scale
        return centered

    def world_from_scene(self, points: ArrayLike) -> NDArray[np.float64]:
        """Scene points [..., 3] in world units."""
        centered: NDArray[np.float64] = np.asarray(points, np.float64) / self.scale
        centered += np.asarray(self.center)
        return centered


@dataclass(frozen=True)
class Cameras:
    """A batch of N cameras, in scene space.

    scene_from_camera: [N, 3, 4] float32, rotation and camera centre.
    focal: [N, 2] float32, px. principal: [N, 2] float32, px. size: [N, 2] int64, width and height.
    distortion: [N, 6] float32: k1, k2, k3, k4, p1, p2.
    model: [N] int64, positions in `CAMERA_MODELS`. kinds: the lens formulas that occur, without
    OPENCV where all its terms are 0; held here so that no device has to be asked.
    times: [N] float32 in [0, 1], when each picture was taken, or None in a scene that stands still.
    inverse_steps: of Newton's method, as many as the worst of the lenses needs within its picture.
    """

    scene_from_camera: Tensor
    focal: Tensor
    principal: Tensor
    size: Tensor
    distortion: Tensor
    model: Tensor
    kinds: tuple[int, ...]
    times: Tensor | None = None
    inverse_steps: int = MAX_STEPS

    @classmethod
    def from_arrays(
        cls,
        *,
        world_from_camera: ArrayLike,
        scene: SceneTransform,
        widths: ArrayLike,
        heights: ArrayLike,
        focal: ArrayLike,
        principal: ArrayLike,
        models: Sequence[str] | None = None,
        distortion: ArrayLike | None = None,
        times: ArrayLike | None = None,
    ) -> Cameras:
        """Cameras from plain numbers, brought to scene space in float64.

        world_from_camera: [N, 3, 4], world units. widths, heights: [N]. focal, principal: [N, 2],
        px; see `panorama_intrinsics`. models: N of `CAMERA_MODELS`, default PINHOLE.
        distortion: [N, 6]: k1, k2, k3, k4, p1, p2. times: [N] in [0, 1].
        Raises NerfError `bad_cameras` naming what is wrong.
        """
        poses = _checked_poses(world_from_camera)
        num = len(poses)
        poses[:, :, 3] = scene.scene_from_world(poses[:, :, 3])
        names = ["PINHOLE"] * num if models is None else list(models)
        _require(len(names) == num, "models has another length than world_from_camera")
        for name in names:
            _require(name in CAMERA_MODELS, f"model {name} is none of {', '.join(CAMERA_MODELS)}")
        model = np.array([CAMERA_MODELS.index(name) for name in names])
        terms = np.zeros((num, 6)) if distortion is None else np.array(distortion, np.float64)
        terms[(model == PINHOLE) | (model == EQUIRECTANGULAR)] = 0.0
        size = np.stack([np.asarray(widths), np.asarray(heights)], axis=-1).astype(np.int64)
        focal_px, principal_px = np.array(focal, np.float64), np.array(principal, np.float64)
        for label, array, width in (
            ("focal", focal_px, 2),
            ("principal", principal_px, 2),
            ("distortion", terms, 6),
            ("widths and heights", size, 2),
        ):
            _require(array.shape == (num, width), f"{label} is not [N, {width}]")
            _require(bool(np.isfinite(array).all()), f"{label} is not finite")
        _require(bool((size > 0).all() and (focal_px > 0).all()), "a size or focal is not positive")
        _check_panoramas(model, size, focal_px, principal_px)
        plain = (model == OPENCV) & (terms == 0.0).all(axis=-1)
        formulas = np.where(plain, PINHOLE, model)
        return cls(
            scene_from_camera=torch.from_numpy(poses).float(),
            focal=torch.from_numpy(focal_px).float(),
            principal=torch.from_numpy(principal_px).float(),
            size=torch.from_numpy(size),
            distortion=torch.from_numpy(terms).float(),
            model=torch.from_numpy(model),
            kinds=tuple(np.unique(formulas).tolist()),
            times=None if times is None else torch.from_numpy(_checked_times(times, num)).float(),
            inverse_steps=_inverse_steps(formulas, terms, size, focal_px, principal_px),
        )

    def __len__(self) -> int:
        return self.scene_from_camera.shape[0]

    @property
    def distorted(self) -> bool:
        """Whether any lens needs more than the pinhole formula."""
        return self.kinds != (PINHOLE,)

    def select(self, indices: Sequence[int]) -> Cameras:
        """The cameras at these positions, in this order."""
        rows = torch.tensor(list(indices), dtype=torch.int64)
        return self._map(lambda values: values[rows])

    def to(self, device: torch.device | str) -> Cameras:
        """The cameras on another device."""
        return self._map(lambda values: values.to(device))

    def _map(self, change: Callable[[Tensor], Tensor]) -> Cameras:
        changed: dict[str, Any] = {
            name: change(value) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **changed)

    def resized(self, long_side: int) -> Cameras:
        """The same views with images of at most that long side, in pixels."""
        sizes = [reduced_size(int(w), int(h), long_side) for w, h in self.size.tolist()]
        size = torch.tensor(sizes, dtype=torch.int64, device=self.size.device)
        ratio = (size.double() / self.size.double()).float()
        return replace(self, size=size, focal=self.focal * ratio, principal=self.principal * ratio)

    def generate_rays(
        self, camera_indices: Tensor, pixels: Tensor, *, with_pixel_area: bool = False
    ) -> Rays:
        """The rays through pixels.

        camera_indices: [R] int64. pixels: [R, 2], x and y, pixel centres at .5.
        with_pixel_area: also give each pixel's solid angle (three times the work).
        """
        directions = self._directions(camera_indices, pixels)
        area = self._pixel_area(camera_indices, pixels, directions) if with_pixel_area else None
        return self._rays(camera_indices, directions, area)

    def image_rays(self, index: int, *, with_pixel_area: bool = False) -> Rays:
        """The rays through all pixel centres of one camera, row by row: R = height * width.

        Quicker than `generate_rays` of the same pixels, and the more so for a picture of the same
        lens as the one before. with_pixel_area: as there.
        """
        width, height = (int(side) for side in self.size[index].tolist())
        area = None
        indices = torch.full((width * height,), index, device=self.size.device)
        directions = self._picture_directions(index)
        if with_pixel_area:
            pixels = _pixel_centres(width, height).to(directions)
            area = self._pixel_area(indices, pixels, self._directions(indices, pixels))
        return self._rays(indices, directions, area)

    def project(self, points: Tensor, camera_indices: Tensor) -> tuple[Tensor, Tensor]:
        """Where points appear.

        points: [P, 3], scene units. camera_indices: [P] int64.
        Returns (pixels [P, 2], z_depth [P]); z_depth is along the optical axis, scene units, not
        positive behind the camera, where only the pixels of a fisheye and of a panorama mean
        anything.
        """
        pose = self.scene_from_camera[camera_indices]
        local = (pose[:, :, :3].transpose(1, 2) @ (points - pose[:, :, 3])[..., None]).squeeze(-1)
        local = _flipped(local)
        terms, model = self.distortion[camera_indices], self.model[camera_indices]
        plane = distort(local, terms, model, self.kinds)
        return plane * self.focal[camera_indices] + self.principal[camera_indices], local[:, 2]

    def points_in_frame(
        self, points: Tensor, index: int, margin_px: float = 0.0
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Of points [P, 3] those that camera `index` has in its frame, hidden or not.

        Returns which [Q] int64, their pixels [Q, 2] and z-depths [Q]. margin_px: of the frame, left
        out.
        """
        rows = torch.full((len(points),), index, dtype=torch.int64, device=points.device)
        pixels, z_depth = self.project(points, rows)
        inside = (pixels >= margin_px) & (pixels < self.size[index] - margin_px)
        which = torch.nonzero(inside.all(dim=-1)).squeeze(-1)
        # A point behind the camera, or beyond where the lens formula folds back, has a pixel too:
        # one whose ray leads elsewhere.
        ways = self.generate_rays(rows[which], pixels[which]).directions
        toward = points[which] - self.scene_from_camera[index, :, 3]
        error = (ways - torch.nn.functional.normalize(toward, dim=-1)).norm(dim=-1)
        which = which[error < MAX_ANGLE_ERROR]
        return which, pixels[which], z_depth[which]

    def _rays(self, camera_indices: Tensor, directions: Tensor, area: Tensor | None) -> Rays:
        return Rays(
            origins=self.scene_from_camera[camera_indices, :, 3],
            directions=directions,
            camera_indices=camera_indices,
            pixel_area=area,
            times=None if self.times is None else self.times[camera_indices],
        )

    def _pixel_area(self, camera_indices: Tensor, pixels: Tensor, directions: Tensor) -> Tensor:
        """Solid angles [R] of pixels with those directions."""
        steps = torch.eye(2, dtype=pixels.dtype, device=pixels.device)
        right = self._directions(camera_indices, pixels + steps[0]) - directions
        down = self._directions(camera_indices, pixels + steps[1]) - directions
        area: Tensor = torch.linalg.cross(right, down).norm(dim=-1)
        return area

    def _picture_directions(self, index: int) -> Tensor:
        """Unit directions [H * W, 3] in scene space through all pixel centres of one camera."""
        model, terms = int(self.model[index]), tuple(self.distortion[index].tolist())
        plain = model == OPENCV and not any(terms)
        lens = _Lens(
            PINHOLE if plain else model,
            terms,
            tuple(self.focal[index].tolist()),
            tuple(self.principal[index].tolist()),
            tuple(self.size[index].tolist()),
            self.inverse_steps,
        )
        few = lens.size[0] * lens.size[1] <= REMEMBERED_PX
        local = (_ways_of_lens if few else _ways_of_lens.__wrapped__)(lens)
        rotation = self.scene_from_camera[index, :, :3]
        return torch.nn.functional.normalize(local.to(rotation) @ rotation.T, dim=-1)

    def _directions(self, camera_indices: Tensor, pixels: Tensor) -> Tensor:
        """Unit directions [R, 3] in scene space."""
        plane = (pixels - self.principal[camera_indices]) / self.focal[camera_indices]
        if self.distorted:
            terms, model = self.distortion[camera_indices], self.model[camera_indices]
            local = undistort(plane, terms, model, self.kinds, self.inverse_steps)
        else:
            local = torch.cat([plane, torch.ones_like(plane[:, :1])], dim=-1)
        local = _flipped(local)
        turned = (self.scene_from_camera[camera_indices, :, :3] @ local[..., None]).squeeze(-1)
        return torch.nn.functional.normalize(turned, dim=-1)


class _Lens(NamedTuple):
    """What tells where the pixels of a picture look, in its camera. As `Cameras` has them."""

    formula: int
    distortion: tuple[float, ...]
    focal: tuple[float, ...]
    principal: tuple[float, ...]
    size: tuple[int, ...]
    inverse_steps: int


@lru_cache(maxsize=2)
def _ways_of_lens(lens: _Lens) -> Tensor:
    """Directions [H * W, 3], not normalised, of all pixel centres in OpenGL's camera axes.

    Remembered, since the pictures of a capture are looked through one by one with the same lens.
    Nobody may change it.
    """
    width, height = lens.size
    focal, principal = (torch.tensor(values) for values in (lens.focal, lens.principal))
    plane = (_pixel_centres(width, height) - principal) / focal
    terms, model = torch.tensor([lens.distortion]), torch.tensor([lens.formula])
    local = undistort(plane, terms, model, (lens.formula,), lens.inverse_steps)
    return _flipped(local)


def _pixel_centres(width: int, height: int) -> Tensor:
    """[H * W, 2], row by row."""
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)


def _flipped(local: Tensor) -> Tensor:
    """OpenGL's axes [..., 3] to OpenCV's, in which lens formulas are written, and back."""
    x, y, z = local.unbind(-1)
    return torch.stack([x, -y, -z], dim=-1)


def _require(condition: bool, problem: str) -> None:
    if not condition:
        raise NerfError("bad_cameras", f"The cameras cannot be used: {problem}.", "Check poses.")


def _checked_poses(world_from_camera: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy [N, 3, 4]."""
    poses = np.array(world_from_camera, dtype=np.float64)
    num = len(poses)
    _require(poses.shape == (num, 3, 4) and num > 0, "world_from_camera is not [N, 3, 4]")
    _require(bool(np.isfinite(poses).all()), "world_from_camera is not finite")
    turns = poses[:, :, :3]
    skewed = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() > MAX_SKEW
    mirrored = (np.linalg.det(turns) <= 0.0).any()
    _require(not (skewed or mirrored), "world_from_camera holds more than a rotation")
    return poses


def _checked_times(times: ArrayLike, num: int) -> NDArray[np.float64]:
    """A float64 copy [N]."""
    seen = np.array(times, dtype=np.float64)
    _require(seen.shape == (num,), "times is not [N]")
    _require(bool(((seen >= 0.0) & (seen <= 1.0)).all()), "times leaves [0, 1]")
    return seen


def _inverse_steps(
    model: NDArray[np.int64],
    terms: NDArray[np.float64],
    size: NDArray[np.int64],
    focal: NDArray[np.float64],
    principal: NDArray[np.float64],
) -> int:
    """Steps that the lenses need all over their pictures, a pixel beyond the edge included."""
    rows = (model == OPENCV) | (model == FISHEYE)
    if not rows.any():
        return 0
    first, last = (-principal - 1.0) / focal, (size - principal + 1.0) / focal
    lenses = np.unique(np.column_stack([model, terms, first, last])[rows], axis=0)
    return _steps_of_lenses(lenses.tobytes())


@lru_cache(maxsize=256)
def _steps_of_lenses(packed: bytes) -> int:
    """Remembered, since the pictures of a path are drawn one by one with the same lens.

    packed: rows of float64: model, 6 terms, first and last plane point.
    """
    lenses = np.frombuffer(packed).reshape(-1, 11)
    share = np.linspace(0.0, 1.0, LENS_GRID)
    shares = np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2)
    low, high = lenses[:, None, 7:9], lenses[:, None, 9:]
    plane = torch.from_numpy(low + shares * (high - low)).reshape(-1, 2)
    each = torch.from_numpy(lenses.copy()).repeat_interleave(len(shares), dim=0)
    kinds = np.unique(lenses[:, 0].astype(np.int64)).tolist()
    return steps_needed(plane, each[:, 1:7], each[:, 0].long(), kinds)


def _check_panoramas(
    model: NDArray[np.int64],
    size: NDArray[np.int64],
    focal: NDArray[np.float64],
    principal: NDArray[np.float64],
) -> None:
    """Refuse equirectangular pictures whose focal makes them wrap around more than once."""
    rows = model == EQUIRECTANGULAR
    around = size[rows, 0] / (2.0 * focal[rows, 0])
    above, below = principal[rows, 1], size[rows, 1] - principal[rows, 1]
    upright = 2.0 * np.maximum(above, below) / focal[rows, 1]
    _require(
        bool((around <= MAX_PANORAMA).all() and (upright <= MAX_PANORAMA).all()),
        "an EQUIRECTANGULAR picture covers more than the sphere; a whole one has focal "
        "(width / 2, height) px",
    )
