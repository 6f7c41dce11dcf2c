"""Several clips of one subject in a .zip, or one that was packed: a film in parts.

Photos beside clips are a set of photos still: phones pack a short film with each of them. So clips
are read where there are fewer pictures than a set of photos needs, as previews are.
`pipelines.captures.clips` checks them, the stage `frames` reads them.
"""

from __future__ import annotations

from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.magic import video_container
from pipelines.captures.minimum import MIN_IMAGES


def claims(listing: Listing) -> Claim | None:
    """An archive with a video in it, and too few pictures to be photos."""
    if not listing.is_archive or len(listing.pictures) >= MIN_IMAGES:
        return None
    num = sum(video_container(head) is not None for head in listing.heads.values())
    return Claim("", f"{num} video{'s' if num > 1 else ''}") if num else None


IMPORTER = Importer(kind="videos", brings="film", claims=claims)
