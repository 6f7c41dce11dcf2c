"""A video, sent by itself: the container's first bytes say so.

`pipelines.captures.clips` checks it, the stage `frames` reads it.
"""

from __future__ import annotations

from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.magic import video_container


def claims(listing: Listing) -> Claim | None:
    """Any container that ffmpeg is allowed to open."""
    if listing.is_archive:
        return None
    container = video_container(listing.heads[""])
    return Claim("", f"a {container} container") if container else None


IMPORTER = Importer(kind="video", brings="film", claims=claims)
