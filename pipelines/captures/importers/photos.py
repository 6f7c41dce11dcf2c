"""A zip of photos, in whatever folders: what no other format claims.

Which of its pictures are photos, and which are masks, depth maps or copies, is decided where they
can be decoded: `pipelines.captures.photo_choice`.
"""

from __future__ import annotations

from pipelines.captures.contents import Photos
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.unpack import CaptureArchive


def claims(listing: Listing) -> Claim | None:
    """Any archive with a picture in it."""
    return Claim("", "pictures") if listing.is_archive and listing.pictures else None


def read(archive: CaptureArchive, claim: Claim) -> Photos:
    """All pictures of the archive, in no order."""
    del claim
    return Photos(sorted(archive.images))


IMPORTER = Importer(
    kind="images",
    brings="photos",
    claims=claims,
    read="pipelines.captures.importers.photos:read",
)
