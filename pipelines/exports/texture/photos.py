"""The photos of a capture as a source of colour: where a point of a surface appears in which.

Points and vertices are in the frame of the photos' cameras: the world less an origin. Pixels are
those of the stored photo, lens distortion and all; the centre of the top-left one is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from pipelines.exports.void import Void
from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.data.light import light_table
from pipelines.nerf.space.cameras import SceneTransform
from pipelines.nerf.space.lenses import EQUIRECTANGULAR
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.picture_sampling import between_pixels, points_in_frame
from pipelines.scene.trained_scene import nerf_cameras

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

_MARGIN_PX = 1.0
_GLANCE_SIDE = 640
_SHARPNESS_SIDE, _NEAR_PX, _FAR_PX, _EVERY_PX = 1600, 2, 8, 3
_EDGES, _LEAST_STEP = 0.03, 2.0
"""Of all steps over so many pixels, the share that are edges; and levels of 255 that one has."""
_BLUR_PX = 1.5
_USABLE = 128


class Photos:
    """N posed photos, of which nothing is painted that shows nothing.

    frame: in which points are given: the world less an origin. void: of some of the photos, what
    shows that nothing stands there.
    """

    def __init__(
        self,
        root: Path,
        images: Sequence[PosedImage],
        lenses: Sequence[Intrinsics],
        void: Iterable[Void] = (),
    ) -> None:
        poses = np.asarray([image.world_from_camera for image in images], np.float64)
        self._root = root
        self._images = list(images)
        self.frame = SceneTransform.fit(poses[:, :, 3], scale_poses=False)
        self._cameras = nerf_cameras(lenses, poses, self.frame)
        # What a photo was cut out by says it to the pixel.
        uncut = (index for index, image in enumerate(images) if image.cut is None)
        index_of = {images[index].file: index for index in uncut}
        self._void = {
            index_of[one.file]: self._as_stored(index_of[one.file], one)
            for one in void
            if one.file in index_of and one.is_void.any()
        }

    def _as_stored(self, index: int, void: Void) -> Bools:
        """[h, w]: what is void in the photo as it is stored, lens distortion and all, small."""
        camera = self._cameras.select([index]).resized(max(void.is_void.shape))
        lens = void.lens
        mask = void.is_void.astype(np.float32)
        maps = DepthMaps.from_arrays([mask], [(lens.fl_x, lens.fl_y, lens.cx, lens.cy)], 1.0)
        width, height = camera.size[0].tolist()
        seen: Bools = (maps.distances(camera.image_rays(0), camera) > 0.0).numpy()
        return seen.reshape(int(height), int(width))

    def __len__(self) -> int:
        return len(self._images)

    def size(self, index: int) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = self._cameras.size[index].tolist()
        return int(width), int(height)

    def eye(self, index: int) -> Floats:
        """[3], where the camera is."""
        eye: Floats = self._cameras.scene_from_camera[index, :, 3].numpy().astype(np.float64)
        return eye

    def pixels(self, index: int, points: Floats) -> tuple[NDArray[np.float64], Bools]:
        """Where points [P, 3] appear: pixels [P, 2], 0 beyond the photo, and whether in it [P]."""
        which, found, _ = points_in_frame(points, self._cameras, index, _MARGIN_PX)
        pixels, shown = np.zeros((len(points), 2)), np.zeros(len(points), np.bool_)
        pixels[which], shown[which] = found, True
        return pixels, shown

    def load(self, index: int) -> Image.Image:
        """The photo, RGB, in the mean light."""
        with Image.open(self._root / self._images[index].file) as opened:
            return self._levelled(index, opened.convert("RGB"))

    def rays(
        self, index: int, side: int = _GLANCE_SIDE
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where the camera is [3], and unit directions [H * W, 3] of all pixels of its `glance`."""
        rays = self._cameras.select([index]).resized(side).image_rays(0)
        return self.eye(index).astype(np.float32), rays.directions.numpy()

    def pixel_angle(self, index: int) -> float:
        """Between the rays of neighbouring pixels, radians."""
        angle = 1.0 / float(self._cameras.focal[index].mean())
        # An equirectangular plane is in half turns, not in radians.
        whole = int(self._cameras.model[index]) == EQUIRECTANGULAR
        return angle * math.pi if whole else angle

    def glance_size(self, index: int, side: int = _GLANCE_SIDE) -> tuple[int, int]:
        """Width and height of what `glance` gives."""
        width, height = self.size(index)
        shrink = min(1.0, side / max(width, height))
        return max(1, round(width * shrink)), max(1, round(height * shrink))

    def glance(
        self, index: int, side: int = _GLANCE_SIDE
    ) -> tuple[Image.Image, NDArray[np.float64]]:
        """The photo, RGB, at most `side` px long, and its size as a share [2] of the whole's."""
        width, height = self.size(index)
        small = self.glance_size(index, side)
        with Image.open(self._root / self._images[index].file) as opened:
            opened.draft("RGB", small)
            glance = opened.convert("RGB").resize(small, Image.Resampling.BOX)
        return self._levelled(index, glance), np.array([small[0] / width, small[1] / height])

    def sharpness(self, index: int) -> float:
        """That of the photo, as large as it tells shaking by a thousandth of its side."""
        with Image.open(self._root / self._images[index].file) as opened:
            opened.draft("L", (_SHARPNESS_SIDE, _SHARPNESS_SIDE))
            grey = opened.convert("L")
        grey.thumbnail((_SHARPNESS_SIDE, _SHARPNESS_SIDE), Image.Resampling.BILINEAR)
        return sharpness(np.asarray(grey, np.float32))

    def _levelled(self, index: int, photo: Image.Image) -> Image.Image:
        light = self._images[index].light
        return photo if light is None else photo.point(light_table(light).T.reshape(-1).tolist())

    def usable(self, index: int, pixels: Floats) -> Bools:
        """Whether the photo's mask, what it was cut out by, and what of it is void let pixels
        [P, 2] count; all of them without any."""
        image = self._images[index]
        kept: Bools = np.ones(len(pixels), np.bool_)
        for mask in (image.mask, image.cut):
            if mask is None:
                continue
            with Image.open(self._root / mask) as opened:
                shown = np.asarray(opened.convert("L")) >= _USABLE
            columns, rows = np.clip(pixels, 0, np.array(shown.shape[::-1]) - 1).astype(int).T
            kept &= shown[rows, columns]
        void = self._void.get(index)
        if void is not None:
            share = np.array(void.shape[::-1]) / self.size(index)
            columns, rows = np.clip(pixels * share, 0, np.array(void.shape[::-1]) - 1).astype(int).T
            kept &= ~void[rows, columns]
        return kept


def softened(photo: Image.Image) -> Image.Image:
    """The photo without what a pose that is a pixel off would change."""
    return photo.filter(ImageFilter.GaussianBlur(_BLUR_PX))


def colors_at(photo: Image.Image, pixels: Floats) -> NDArray[np.float32]:
    """Colours [P, 3] in [0, 1] at pixels [P, 2], between pixels by bilinear interpolation."""
    picture = np.asarray(photo, np.float32) / np.float32(255.0)
    return between_pixels(picture, pixels[:, 0], pixels[:, 1])


def sharpness(grey: NDArray[np.float32]) -> float:
    """How abrupt the edges of a picture [H, W] are, whatever it shows and however many it has.

    The steps over two pixels within the strongest ones over eight, as a share of these, root mean
    squares: about 1 for edges of a pixel or two, 0.7 of that where it was shaken by eight. Noise,
    which is weaker than edges, hardly counts. The lesser of across and down: a shaken picture is
    sharp one way. 1 for a picture of one colour.
    """
    found = 1.0
    for axis in (0, 1):
        lines = np.moveaxis(grey, axis, 0)[:, ::_EVERY_PX]
        reach = len(lines) - _FAR_PX
        if reach < 1:
            continue
        far = np.square(lines[_FAR_PX:] - lines[:reach])
        strong = far >= max(float(np.quantile(far, 1.0 - _EDGES)), _LEAST_STEP**2)
        if strong.any():
            near = np.square(lines[_NEAR_PX:] - lines[:-_NEAR_PX])
            within = sum(near[start : start + reach] for start in range(0, _FAR_PX, _NEAR_PX))
            found = min(found, math.sqrt(float(within[strong].sum() / far[strong].sum())))
    return found
