"""The pictures of a capture as stereo wants them, undistorted, grey, small; and their depths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pipelines.nerf.data.light import levelled
from pipelines.nerf.stereo.views import StereoView
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_sampling import sampled
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.lens_places import through
from pipelines.scene.picture_sampling import at_grid, sampling_grid
from pipelines.scene.sensor_depth import load_sensor_depth

_OPENCV_AXES = np.diag([1.0, -1.0, -1.0])
_STANDS = 128
"""Of 255, from which a mask says that something stands there."""


@dataclass(frozen=True)
class ColorView:
    """picture: [H, W, 3] uint8, sRGB, in the mean light. usable: [H, W], where it has something.

    world_from_camera: [3, 4], OpenGL's axes.
    """

    picture: NDArray[np.uint8]
    usable: NDArray[np.bool_]
    lens: Pinhole
    world_from_camera: NDArray[np.float64]

    def reduced(self, factor: int) -> ColorView:
        """The view at 1 / factor of its size; squares that are not whole are not usable."""
        if factor == 1:
            return self
        height, width = (side // factor for side in self.usable.shape)
        shape = (height, factor, width, factor)
        whole = (slice(height * factor), slice(width * factor))
        picture = self.picture[whole].reshape(*shape, 3).mean(axis=(1, 3), dtype=np.float32)
        usable = np.logical_and.reduce(self.usable[whole].reshape(shape), axis=(1, 3))
        lens = self.lens
        smaller = Pinhole(width, height, *(value / factor for value in _lengths(lens)))
        return ColorView(np.rint(picture).astype(np.uint8), usable, smaller, self.world_from_camera)


def color_view(root: Path, image: PosedImage, lens: Intrinsics, long_side_px: int) -> ColorView:
    """An image of a capture in colour, as `stereo_view` has it in grey."""
    pinhole = Pinhole.of(lens, min(long_side_px, max(lens.width, lens.height)))
    picture = undistorted_picture(root, image, lens, pinhole)
    there = np.ones(picture.shape[:2], np.float32)
    usable = _undistorted(_unmasked(there, root, image), lens, pinhole)
    pose = np.asarray(image.world_from_camera, np.float64)
    return ColorView(picture, usable > 0.0, pinhole, pose)


def stereo_view(root: Path, image: PosedImage, lens: Intrinsics, long_side_px: int) -> StereoView:
    """An image of a capture, reduced to `long_side_px` and freed of its lens's distortion.

    root: what the image's paths are relative to. Pixels that the image or its mask does not have
    are negative.
    """
    pinhole = Pinhole.of(lens, min(long_side_px, max(lens.width, lens.height)))
    size = (pinhole.width, pinhole.height)
    with Image.open(root / image.file) as opened:
        opened.draft("L", size)
        grey = opened.convert("L").resize(size, Image.Resampling.BOX)
    picture = np.asarray(grey, np.float32) / np.float32(255.0)
    shown = _undistorted(_unmasked(picture, root, image), lens, pinhole)
    return view_of(image, pinhole, shown)


def view_of(image: PosedImage, pinhole: Pinhole, picture: NDArray[np.float32]) -> StereoView:
    """The view that such a picture [H, W], of the image's place, is seen in."""
    pose = np.asarray(image.world_from_camera, np.float64)
    turned = np.column_stack([pose[:, :3] @ _OPENCV_AXES, pose[:, 3]])
    return StereoView(picture, _lengths(pinhole), turned)


def undistorted_picture(
    root: Path, image: PosedImage, lens: Intrinsics, pinhole: Pinhole
) -> NDArray[np.uint8]:
    """An image of a capture in colour, as that pinhole sees it, [H, W, 3]; black beyond it.

    In the mean light, where the image has a light.
    """
    size = (pinhole.width, pinhole.height)
    with Image.open(root / image.file) as opened:
        opened.draft("RGB", size)
        stored = np.asarray(opened.convert("RGB").resize(size, Image.Resampling.BOX))
    picture = levelled(stored, image.light)
    if _is_as_stored(lens, pinhole):
        return picture
    grid, inside = _warp(lens, pinhole)
    shown: NDArray[np.uint8] = np.rint(at_grid(picture.astype(np.float32), grid)).astype(np.uint8)
    shown[~inside] = 0
    return shown


def unhidden(
    root: Path, image: PosedImage, lens: Intrinsics, pinhole: Pinhole
) -> NDArray[np.bool_] | None:
    """What the image's mask does not hide, as that pinhole sees it, [H, W]; None without a mask.

    root: what the image's paths are relative to.
    """
    if image.mask is None:
        return None
    there = np.ones((pinhole.height, pinhole.width), np.float32)
    shown: NDArray[np.bool_] = _undistorted(_unmasked(there, root, image), lens, pinhole) > 0.0
    return shown


def cut_away(
    root: Path, image: PosedImage, lens: Intrinsics, pinhole: Pinhole
) -> NDArray[np.bool_] | None:
    """Where nothing stands in an image by what it was cut out by, as that pinhole sees it, [H, W];
    nowhere beyond the image. None for one that was not cut out. root: as there.
    """
    if image.cut is None:
        return None
    size = (pinhole.width, pinhole.height)
    with Image.open(root / image.cut) as opened:
        stands = np.asarray(opened.convert("L").resize(size, Image.Resampling.BOX)) >= _STANDS
    shown = _undistorted(stands.astype(np.float32), lens, pinhole)
    return (shown >= 0.0) & (shown < 0.5)


def sensor_depth(
    root: Path, image: PosedImage, lens: Intrinsics, pinhole: Pinhole
) -> NDArray[np.float32] | None:
    """What the capture's depth sensor saw, as that pinhole has it: [H, W] along the axis, world
    units, 0 where unknown. None for an image without depth.
    """
    if image.depth is None:
        return None
    z = load_sensor_depth(root / image.depth)
    height, width = z.shape
    u, v = _image_pixels(image.depth_lens or lens, pinhole)
    return sampled(z, u * (width / lens.width) - 0.5, v * (height / lens.height) - 0.5)


def _unmasked(picture: NDArray[np.float32], root: Path, image: PosedImage) -> NDArray[np.float32]:
    """The picture [H, W], -1 where the image's mask is."""
    if image.mask is None:
        return picture
    height, width = picture.shape
    with Image.open(root / image.mask) as opened:
        mask = opened.convert("L").resize((width, height), Image.Resampling.NEAREST)
    return np.where(np.asarray(mask) >= 128, picture, np.float32(-1.0))


def _undistorted(
    picture: NDArray[np.float32], lens: Intrinsics, pinhole: Pinhole
) -> NDArray[np.float32]:
    """The picture [H, W] as the pinhole would show it; negative where it has nothing."""
    if _is_as_stored(lens, pinhole):
        return picture
    grid, usable = _warp(lens, pinhole)
    there = picture >= 0.0
    values = at_grid(picture[..., None], grid)[..., 0]
    if not there.all():
        usable = usable & (at_grid((~there[..., None]).astype(np.float32), grid)[..., 0] == 0.0)
    return np.where(usable, values, np.float32(-1.0))


@lru_cache(maxsize=2)
def _warp(lens: Intrinsics, pinhole: Pinhole) -> tuple[Tensor, NDArray[np.bool_]]:
    """Where in a stored picture of the pinhole's size each of its pixels is, for `at_grid`, and
    whether it is in the picture, [H, W]."""
    width, height = pinhole.width, pinhole.height
    u, v = _image_pixels(lens, pinhole)
    u, v = u * (width / lens.width), v * (height / lens.height)
    inside = (u >= 0.5) & (v >= 0.5) & (u <= width - 0.5) & (v <= height - 0.5)
    return sampling_grid(u, v, width, height), inside


def _lengths(lens: Pinhole) -> tuple[float, float, float, float]:
    """fl_x, fl_y, cx, cy, px."""
    return lens.fl_x, lens.fl_y, lens.cx, lens.cy


def _is_as_stored(lens: Intrinsics, pinhole: Pinhole) -> bool:
    """Whether the stored picture, reduced, is what the pinhole shows: of a lens without distortion
    that is wider than pinholes are, it is not."""
    if _is_distorted(lens):
        return False
    x, y = pinhole.width / lens.width, pinhole.height / lens.height
    stored = (lens.fl_x * x, lens.fl_y * y, lens.cx * x, lens.cy * y)
    return bool(np.allclose(stored, _lengths(pinhole), rtol=1e-6))


def _is_distorted(lens: Intrinsics) -> bool:
    return lens.model != "PINHOLE" and not (lens.model == "OPENCV" and not any(_terms(lens)))


def _terms(lens: Intrinsics) -> tuple[float, ...]:
    return (lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2)


@lru_cache(maxsize=2)  # most captures have one lens, or one for depth besides: solved once for all
def _image_pixels(
    lens: Intrinsics, pinhole: Pinhole
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where in the stored image each of the pinhole's pixels is: u and v, [H, W] each, px."""
    ways = pinhole.directions() * np.array([1.0, -1.0, -1.0])
    places = through(lens, ways.reshape(-1, 3)).reshape(*ways.shape[:2], 2)
    return places[..., 0], places[..., 1]
