"""A zip of photos, in whatever folders: what no other format claims.

Which of its pictures are photos, and which are masks, depth maps or copies, is decided where they
can be decoded: `pipelines.captures.photo_choice`.
"""

from __future__ import annotations

from pipelines.captures.colmap_folders import MODEL_FILES, fault_of, model_folders
from pipelines.captures.contents import Photos
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.magic import video_container
from pipelines.captures.unpack import CaptureArchive


def claims(listing: Listing) -> Claim | None:
    """Any archive with a picture in it."""
    return Claim("", "pictures") if listing.is_archive and listing.pictures else None


def read(archive: CaptureArchive, claim: Claim) -> Photos:
    """All pictures of the archive, in no order.

    Why models beside them are not used is said, and what the films are that phones pack with each
    photo, under its name.
    """
    del claim
    listing = Listing(
        {name: archive.head(name) for name in archive.names},
        copy=archive.copy,
        num_bytes={name: archive.num_bytes(name) for name in archive.names},
    )
    for folder, suffix in model_folders(listing):
        files = {f"{folder}{what}{suffix}" for what in MODEL_FILES} & archive.names
        archive.set_aside(files, f"a COLMAP model that {fault_of(listing, folder, suffix)}")
    stems = {name.rpartition(".")[0].lower() for name in archive.images}
    films = [name for name, head in listing.heads.items() if video_container(head) is not None]
    archive.set_aside(
        (name for name in films if name.rpartition(".")[0].lower() in stems),
        "the short films that phones take with a photo",
    )
    return Photos(sorted(archive.images))


IMPORTER = Importer(
    kind="images",
    brings="photos",
    claims=claims,
    read="pipelines.captures.importers.photos:read",
)
