"""Depth maps of a capture in files: what the stage `depth` writes and later ones read.

`maps.json` names each image with its map's lens; `maps/000000.npz` holds the map. Maps are those of
undistorted cameras in the images' places, in the world frame; depth is along the camera's axis.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.data.light import Light
from pipelines.nerf.stereo.maps import DepthMap
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.depth_views import Pinhole

INDEX = "maps.json"
_FOLDER = "maps"
_FARTHEST = 10_000.0
"""Medians of a map. What is farther is unknown: where a plane goes to its horizon depth has no end,
and the half precision of the files has, at 65,504."""


@dataclass(frozen=True)
class MappedImage:
    """An image that has a map. file: as in `cameras.json`. lens: of the map. light: of the image,
    where its capture's light drifts.
    """

    file: str
    lens: Pinhole
    light: Light | None = None


class DepthMapsWriter:
    """Writes maps one by one; `close` makes them a set that can be read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / _FOLDER).mkdir(parents=True, exist_ok=True)
        self._images: list[MappedImage] = []

    def append(self, file: str, lens: Pinhole, found: DepthMap, light: Light | None = None) -> None:
        """The map of one more image. Half precision, relative to the map's median: 0.05 %, up to
        `_FARTHEST` of it."""
        known = np.isfinite(found.z) & (found.z > 0)
        unit = float(np.median(found.z[known])) if known.any() else 1.0
        path = self._folder / _FOLDER / f"{len(self._images):06d}.npz"
        relative = found.z / np.float32(unit)
        relative = np.where(relative <= _FARTHEST, relative, 0.0).astype(np.float16)
        np.savez_compressed(path, z=relative, unit=np.float64(unit), votes=found.votes)
        self._images.append(MappedImage(file, lens, light))

    def close(self, *, measured: bool = False) -> None:
        """Write the index. measured: whether a sensor had a part in the maps."""
        rows = [
            {"file": item.file, "lens": asdict(item.lens), "light": item.light}
            for item in self._images
        ]
        index = {"measured": measured, "images": rows}
        (self._folder / INDEX).write_text(json.dumps(index, indent=1), "utf-8")


class DepthMapsFile:
    """The maps that a folder holds, read one at a time. Raises ValueError for a broken index.

    measured: whether a sensor had a part in them.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            index = json.loads((folder / INDEX).read_text("utf-8"))
            self.measured = bool(index["measured"])
            self.images = [
                MappedImage(row["file"], Pinhole(**row["lens"]), _light(row.get("light")))
                for row in index["images"]
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{folder / INDEX} is no list of depth maps: {error}") from error

    def __len__(self) -> int:
        return len(self.images)

    def lit(self, images: Sequence[PosedImage]) -> list[PosedImage]:
        """The images with their light."""
        lights = {item.file: item.light for item in self.images}
        return [replace(image, light=lights.get(image.file)) for image in images]

    def read(self, index: int) -> DepthMap:
        """The map of `images[index]`."""
        with np.load(self._folder / _FOLDER / f"{index:06d}.npz", allow_pickle=False) as held:
            z: NDArray[np.float32] = held["z"].astype(np.float32) * np.float32(held["unit"])
            return DepthMap(z, held["votes"])

    def __iter__(self) -> Iterator[tuple[MappedImage, DepthMap]]:
        for index, image in enumerate(self.images):
            yield image, self.read(index)


def _light(values: Sequence[float] | None) -> Light | None:
    if values is None:
        return None
    red, green, blue, bend = (float(value) for value in values)
    return red, green, blue, bend
