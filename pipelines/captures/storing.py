"""Writing the pictures of an archive one by one; a few that cannot be used are left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from pipelines.captures.parsing import FRAME_FAULTS
from pipelines.captures.pictures import PictureWriter
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.stage import StageContext

MOST_FAILURES = 0.1
"""Share of the pictures that may be unusable: stray damage stays below, a wrong export does not."""


class Named(Protocol):
    """What is to be written: at least the name of a picture in the archive."""

    @property
    def name(self) -> str: ...


Item = TypeVar("Item", bound=Named)
Stored = TypeVar("Stored")


def store_each(
    archive: CaptureArchive,
    items: Sequence[Item],
    store: Callable[[PictureWriter, Item, int], Stored],
    options: IngestOptions,
    ctx: StageContext,
    *,
    upright: bool,
    minimum: int,
    failures: Sequence[CaptureError] = (),
) -> tuple[list[Stored], list[str]]:
    """Have `store` write each item as picture number 1, 2, ...; those it cannot use are left out.

    upright: as in `PictureWriter`. minimum: fewest that must be left. failures: why others, which
    are not among the items, cannot be used; they count with those of `store`.
    Returns what `store` gave, and warnings that name what was left out.
    Raises CaptureError: too_large for too many pictures, too_few_images, and the code of the first
    failure where there are too many of them.
    """
    total = len(items) + len(failures)
    if total > options.max_images:
        raise CaptureError(
            f"The capture has {total} pictures; {options.max_images} are allowed.",
            code="too_large",
            hint="Send fewer pictures, or raise ingest.max_images.",
        )
    stored: list[Stored] = []
    unusable = list(failures)
    writer = PictureWriter(archive, ctx.out, max_pixels=options.max_pixels, upright=upright)
    try:
        for done, item in enumerate(items, start=1):
            number = len(stored) + 1
            try:
                stored.append(store(writer, item, number))
            except CaptureError as error:
                if error.code not in FRAME_FAULTS:
                    raise
                unusable.append(error)
                archive.told([item.name])
                for file in ctx.out.glob(f"*/{number:05d}.*"):
                    file.unlink()
            ctx.progress(done / len(items), f"Picture {done} of {len(items)}")
    finally:
        writer.close()
    _require_few(unusable, total)
    if len(stored) < minimum:
        raise CaptureError(
            f"There are {len(stored)} usable pictures; at least {minimum} are needed.",
            code="too_few_images",
            hint="Send more pictures of the subject, 30 or more for a good result.",
        )
    return stored, [f"Left out: {error.message}" for error in unusable] + writer.warnings


def _require_few(failures: Sequence[CaptureError], total: int) -> None:
    """Raise CaptureError, with the code of the first failure, where too many cannot be used."""
    if len(failures) > MOST_FAILURES * total:
        first = failures[0]
        raise CaptureError(
            f"{len(failures)} of {total} pictures cannot be used. {first.message}",
            code=first.code,
            hint=first.hint,
            details={"failed": [error.message for error in failures[:20]]},
        )
