"""A COLMAP model beside its pictures: text or binary, in `sparse/0/` or any other folder.

    sparse/0/cameras.bin images.bin points3D.bin    or the same as .txt
    images/...                                      where images.* names them, folders and all

Of several models the one with most pictures in the archive is read, the least deep of equals. The
world is structure from motion's: no known unit, and its vertical is found from the cameras, unless
it stands already. Its points are kept. How files are read: `pipelines.captures.colmap_model`.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from pipelines.captures.archive_rules import shown
from pipelines.captures.colmap_folders import (
    MODEL_FILES,
    SUFFIXES,
    folders_of,
    useful_folder,
)
from pipelines.captures.colmap_model import Image, Lens, read_cameras, read_images, read_points
from pipelines.captures.contents import PosedPictures, PosedSource, SparsePoints
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.listed_pictures import match_pictures
from pipelines.captures.named_files import NamedFiles, folder_of
from pipelines.captures.parsing import (
    each_frame,
    malformed,
    missing,
    pose_of_opencv,
    resized,
    rotation_of,
)
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.scene.natural_order import natural_key

_MOST_MODELS = 200

Read = TypeVar("Read")


def claims(listing: Listing) -> Claim | None:
    """An archive with a file of cameras beside one of images, the least deep ones.

    Beside pictures one of these must be of use: what another program left behind there, about other
    pictures or broken, takes nobody's photos for posed ones.
    """
    found = useful_folder(listing)
    if found is None:
        return None
    folder, suffix = found
    return Claim(folder, f"cameras{suffix} beside images{suffix}")


@dataclass(frozen=True)
class _Model:
    """folder: that it lies in. suffix: of its files. num_there: images whose pictures are there.
    images: none where another model has more of them there."""

    folder: str
    suffix: str
    images: list[Image]
    num_images: int
    num_there: int

    @property
    def rank(self) -> tuple[int, int]:
        return self.num_there, self.num_images

    def file(self, what: str) -> str:
        return f"{self.folder}{what}{self.suffix}"

    def __str__(self) -> str:
        return f'"{shown(self.file("images"))}" ({self.num_images} images)'


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures of the best model, with its points.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    del claim
    with tempfile.TemporaryDirectory(prefix="colmap-") as scratch:
        unpacked = _Unpacked(archive, Path(scratch) / "model")
        models, faults = _models(archive, unpacked)
        if not models:
            raise faults[0]
        best = max(models, key=lambda model: model.rank)
        cameras = unpacked.read(best.file("cameras"), read_cameras)
        points, lost = _points(archive, unpacked, best)
    file = best.file("images")
    by_name: dict[str, Image] = {}
    for image in best.images:
        by_name.setdefault(image.name, image)
    if not by_name:
        raise missing(f'"{shown(file)}" lists no images.')
    matched = match_pictures(
        archive, shown(file), [image.name for image in best.images], best.folder
    )
    sources, failures = each_frame(
        archive,
        {name: by_name[path] for path, name in matched.found.items()},
        lambda name, image: _source(name, image, cameras, file),
    )
    others = [model for model in models if model is not best]
    _passed_over(archive, models)
    return PosedPictures(
        sources=sorted(sources, key=lambda source: natural_key(source.name)),
        failures=failures,
        metric=False,
        up="unknown",
        points=points,
        notes={"world": "structure from motion's, by COLMAP", "model": best.folder},
        details={
            "num_listed": len(best.images),
            "num_missing": len(matched.absent),
            "num_models": len(models),
            "num_points": 0 if points is None else len(points.places),
        },
        warnings=[
            *matched.warnings,
            *(
                f"Of {len(models)} models {best} is read, which has most of the pictures; {other} "
                "was not used."
                for other in others
            ),
            *(f"A model cannot be read: {fault.message}" for fault in faults),
            *lost,
        ],
    )


class _Unpacked:
    """Files of the archive, one at a time, where they can be read as they stream by."""

    def __init__(self, archive: CaptureArchive, path: Path) -> None:
        self._archive = archive
        self._path = path

    def read(self, name: str, parse: Callable[[Path, str], Read]) -> Read:
        """What `parse(path, name for messages)` makes of a file."""
        self._archive.extract(name, self._path)
        return parse(self._path, shown(name))


def _models(
    archive: CaptureArchive, unpacked: _Unpacked
) -> tuple[list[_Model], list[CaptureError]]:
    """The models that can be read, the least deep first, binary before text; and why others cannot.

    Of a folder with both, text is only read where binary cannot be. The images of one model alone,
    the best, are kept.
    """
    best = (-1, -1)
    found: dict[str, _Model] = {}
    faults: list[CaptureError] = []
    places = [
        (folder, suffix) for suffix in SUFFIXES for folder in folders_of(archive.names, suffix)
    ]
    places.sort(key=lambda place: (place[0].count("/"), place))
    for folder, suffix in places[:_MOST_MODELS]:
        if folder in found:
            continue
        try:
            images = unpacked.read(f"{folder}images{suffix}", read_images)
        except CaptureError as error:
            if error.code != "poses_malformed":
                raise
            faults.append(error)
            continue
        names = [image.name for image in images]
        files = NamedFiles(archive.images, folder_of(archive.images, names, folder))
        exact, loose = files.find(names)
        model = _Model(folder, suffix, images, len(images), len(exact) + len(loose))
        if model.rank > best:
            found = {place: replace(other, images=[]) for place, other in found.items()}
            best = model.rank
        else:
            model = replace(model, images=[])
        found[folder] = model
    if len(places) > _MOST_MODELS:
        told = f"of {len(places)} the first {_MOST_MODELS} are looked at."
        faults.append(malformed(told, "Send one model with its pictures."))
    return list(found.values()), faults


def _points(
    archive: CaptureArchive, unpacked: _Unpacked, model: _Model
) -> tuple[SparsePoints | None, list[str]]:
    """The model's points, None where there are none; and why they cannot be used."""
    name = model.file("points3D")
    if name not in archive.names:
        return None, []
    try:
        return unpacked.read(name, read_points), []
    except CaptureError as error:
        if error.code != "poses_malformed":
            raise
        return None, [f"The model's points are not used. {error.message}"]


def _source(name: str, image: Image, cameras: Mapping[int, Lens], file: str) -> PosedSource:
    what = f'"{shown(name)}"'
    w, x, y, z = image.quaternion
    values = (*image.quaternion, *image.translation)
    if not all(map(math.isfinite, values)):
        raise malformed(f"The pose of {what} in {shown(file)} is not finite.")
    lens = cameras.get(image.camera)
    if lens is None:
        raise malformed(
            f"{what} was taken by camera {image.camera}, which the model does not have."
        )
    if isinstance(lens, str):
        raise malformed(
            f"The camera {image.camera} of {what} {lens}.",
            "Undistort the pictures (colmap image_undistorter), and send those with their model.",
        )
    rotation = rotation_of((x, y, z, w), what)
    return PosedSource(
        name=name,
        lens=partial(resized, lens),
        world_from_camera=pose_of_opencv(rotation, image.translation),
    )


def _passed_over(archive: CaptureArchive, models: Sequence[_Model]) -> None:
    """Ask for no word on files that repeat the model, in the other form or by rigs and frames, and
    on those of models that a warning of their own tells of."""
    for model in models:
        archive.told(f"{model.folder}{what}{suffix}" for what in MODEL_FILES for suffix in SUFFIXES)


IMPORTER = Importer(
    kind="colmap",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.colmap:read",
)
