"""Writing the pictures of an archive one by one; a few that cannot be used are left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from pipelines.captures.parsing import FRAME_FAULTS, MOST_FAILURES
from pipelines.captures.pictures import PictureWriter
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.stage import StageContext

_MOST_TOLD = 50
"""Pictures left out that get a warning each."""


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
    num_passed_over: int = 0,
) -> tuple[list[Stored], list[str]]:
    """Have `store` write each item as picture number 1, 2, ...; those it cannot use are left out.

    upright: as in `PictureWriter`. minimum: fewest that must be left. failures: why others, which
    are not among the items, cannot be used; they count with those of `store`. num_passed_over: how
    many beside the items were passed over where a long capture was thinned: `failures` are of the
    whole capture then, and only the share of them counts that the items are.
    Returns what `store` gave, and warnings that name what was left out.
    Raises CaptureError: too_large for too many pictures, too_few_images, and the code of the first
    failure where there are too many of them.
    """
    total = len(items) + round(_share(len(items), num_passed_over) * len(failures))
    if total > options.max_images:
        raise CaptureError(
            f"The capture has {total} pictures; {options.max_images} are allowed.",
            code="too_large",
            hint="Send fewer pictures, or raise ingest.max_images.",
        )
    stored: list[Stored] = []
    unusable: list[CaptureError] = []
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
    _require_few(failures, unusable, len(items), num_passed_over)
    if len(stored) < minimum:
        raise CaptureError(
            f"There are {len(stored)} usable pictures; at least {minimum} are needed.",
            code="too_few_images",
            hint="Send more pictures of the subject, 30 or more for a good result.",
        )
    unusable = [*failures, *unusable]
    told = [f"Left out: {error.message}" for error in unusable[:_MOST_TOLD]]
    if len(unusable) > _MOST_TOLD:
        told.append(f"Left out: {len(unusable) - _MOST_TOLD} more, {len(unusable)} in all.")
    return stored, told + writer.warnings


def _share(num_items: int, num_passed_over: int) -> float:
    """Of a capture that was thinned, the part that is left; 1 of one that was not, or is empty."""
    return num_items / (num_items + num_passed_over) if num_passed_over else 1.0


def _require_few(
    before: Sequence[CaptureError],
    unusable: Sequence[CaptureError],
    num_items: int,
    num_passed_over: int,
) -> None:
    """Raise CaptureError, with the code of the first failure, where too many cannot be used.

    before: of the whole capture. unusable: of the items.
    """
    scale = _share(num_items, num_passed_over)
    if len(unusable) + scale * len(before) <= MOST_FAILURES * (num_items + scale * len(before)):
        return
    failed = [*before, *unusable]
    whole = num_items + num_passed_over + len(before)
    message = f"{len(failed)} of {whole} pictures cannot be used."
    if num_passed_over:
        message = (
            f"{len(before)} of {whole} pictures cannot be used, and {len(unusable)} of the "
            f"{num_items} that are taken of them."
        )
    raise CaptureError(
        f"{message} {failed[0].message}",
        code=failed[0].code,
        hint=failed[0].hint,
        details={"failed": [error.message for error in failed[:20]]},
    )
