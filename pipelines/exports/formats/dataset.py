"""A capture's pictures, masks and depth in an archive, in nerfstudio's layout.

Pictures are those that the cameras name, byte for byte. nerfstudio wants a mask or depth for every
frame or for none: frames without get a white mask, or a map of zeros, which is depth that nobody
knows. Depth is 16-bit PNG along the camera's axis.
"""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from pipelines.errors import ExportError
from pipelines.exports.formats.archive import entry
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.registered_depth import registered_depth
from pipelines.scene.sensor_depth import load_sensor_depth

_CHUNK_BYTES = 1 << 20
_MOST_COUNTS = 65535
_MILLIMETRE = 0.001


@dataclass(frozen=True)
class Packed:
    """What lies in an archive. cameras: with the paths of masks and depth there. depth_unit: world
    units a count of the depth files, None without any. num_masks, num_depths: the capture's own."""

    cameras: CamerasFile
    depth_unit: float | None = None
    num_masks: int = 0
    num_depths: int = 0


def num_bytes(cameras: CamerasFile, root: Path) -> int:
    """How large the pictures below `root` are, with what belongs to them.

    Raises ExportError (inputs_missing) where one is not there.
    """
    paths = [
        root / path
        for image in cameras.images
        for path in (image.file, image.mask, image.depth)
        if path is not None
    ]
    lost = [path.name for path in paths if not path.is_file()]
    if lost:
        raise ExportError(
            f"{len(lost)} files of the capture are not there, {lost[0]} among them.",
            code="inputs_missing",
            hint="Run ingest and frames again.",
        )
    return sum(path.stat().st_size for path in paths)


def pack(
    archive: zipfile.ZipFile,
    cameras: CamerasFile,
    root: Path,
    on_image: Callable[[int], None],
) -> Packed:
    """Write the pictures below `root`, and masks and depth where any has some.

    on_image: called with the number of pictures done.
    """
    images = cameras.images
    has_masks = any(image.mask is not None for image in images)
    unit = _depth_unit(cameras, root)
    written = []
    for index, image in enumerate(images):
        stem = image.file.rpartition("/")[2].rpartition(".")[0]
        lens = cameras.cameras[image.camera]
        store_file(archive, image.file, root / image.file)
        mask = f"masks/{stem}.png" if has_masks else None
        depth = f"depth/{stem}.png" if unit is not None else None
        if mask is not None and image.mask is not None:
            store_file(archive, mask, root / image.mask)
        elif mask is not None:
            _store_png(archive, mask, Image.new("L", (lens.width, lens.height), 255))
        if depth is not None and unit is not None:
            counts = np.zeros((lens.height, lens.width), np.uint16)
            if image.depth is not None:
                z = registered_depth(root, image, lens).astype(np.float64)
                counts = np.clip(np.rint(z / unit), 0, _MOST_COUNTS).astype(np.uint16)
            _store_png(archive, depth, Image.fromarray(counts))
        written.append(replace(image, mask=mask, depth=depth, depth_lens=None))
        on_image(index + 1)
    return Packed(
        cameras=replace(cameras, images=tuple(written)),
        depth_unit=unit,
        num_masks=sum(image.mask is not None for image in images),
        num_depths=sum(image.depth is not None for image in images),
    )


def store_file(archive: zipfile.ZipFile, name: str, path: Path) -> None:
    """A file as it is: what is packed here hardly shrinks."""
    with path.open("rb") as source, archive.open(entry(name, compressed=False), "w") as target:
        shutil.copyfileobj(source, target, _CHUNK_BYTES)


def _store_png(archive: zipfile.ZipFile, name: str, picture: Image.Image) -> None:
    stream = io.BytesIO()
    picture.save(stream, "PNG")
    archive.writestr(entry(name, compressed=False), stream.getvalue())


def _depth_unit(cameras: CamerasFile, root: Path) -> float | None:
    """World units a count, the same for all maps; None where there is none.

    A millimetre where the world is metric and all of it fits, else as fine as 16 bits hold.
    """
    paths = [root / image.depth for image in cameras.images if image.depth is not None]
    if not paths:
        return None
    farthest = max(float(load_sensor_depth(path).max(initial=0.0)) for path in paths)
    if cameras.metric and farthest <= _MOST_COUNTS * _MILLIMETRE:
        return _MILLIMETRE
    return max(farthest, 1e-12) / _MOST_COUNTS
