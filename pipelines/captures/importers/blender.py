"""A synthetic scene as Blender renders it for NeRF: `transforms_train.json` and its siblings.

    transforms_train.json transforms_val.json transforms_test.json    any of them
    train/r_0.png val/r_0.png test/r_0.png                            RGBA

Keys: camera_angle_x (radians) at the top, frames with file_path ("./train/r_0", without suffix) and
transform_matrix (world_from_camera, OpenGL camera). World: Blender's, +Z up, no known unit. All
splits are taken; what is transparent becomes white. Frames of D-NeRF have a `time` from 0 to 1 too:
it is kept, and told, since a scene that moves is taken for one that does not.
Source: the published scenes of NeRF, arXiv:2003.08934, and of D-NeRF, arXiv:2011.13961.
"""

from __future__ import annotations

from pipelines.captures.contents import PosedPictures
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.transforms_json import read_frames, read_transforms, told_of_motion
from pipelines.captures.unpack import CaptureArchive

_SPLITS = ("train", "val", "test")


def _file(split: str) -> str:
    return f"transforms_{split}.json"


def claims(listing: Listing) -> Claim | None:
    """An archive with pictures and one of the three files, the least deep one."""
    found = [
        (root.count("/"), root, _file(split))
        for split in _SPLITS
        for root in listing.roots_of(_file(split))[:1]
    ]
    if not found or not listing.pictures:
        return None
    _, root, file = min(found, key=lambda item: item[:2])
    return Claim(root, file)


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures of all splits that are there.

    Raises CaptureError: poses_missing, poses_malformed.
    """
    listed = []
    counts = {}
    for split in _SPLITS:
        name = claim.root + _file(split)
        if name in archive.names:
            top, frames = read_transforms(archive, name)
            listed += [(top, frame) for frame in frames]
            counts[split] = len(frames)
    found = read_frames(archive, claim.root, "transforms_*.json", listed)
    archive.set_aside(archive.images - found.named, "not listed in any transforms_*.json")
    told, motion = told_of_motion("transforms_*.json", [frame for _, frame in listed])
    return PosedPictures(
        sources=found.sources,
        failures=found.failures,
        metric=False,
        notes={
            "world": "Blender's, +Z up",
            "transparency": "blended on white",
            "splits": counts,
            **motion,
        },
        details={"num_listed": len(listed), "num_missing": found.num_missing},
        warnings=[*found.warnings, *told],
    )


IMPORTER = Importer(
    kind="blender",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.blender:read",
)
