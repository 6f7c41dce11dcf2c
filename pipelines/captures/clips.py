"""The clips of a capture that is a film: the upload itself, or the videos of an archive.

`ingest` checks each and lists them in `capture.json` (`CaptureRecord.clips`); `frames` opens them
one after the other (`clip_file`). A clip's name is that of its file in the archive, "" where the
upload is the clip.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pipelines.captures.archive_rules import ArchiveLimits, shown
from pipelines.captures.film_copies import film_copies
from pipelines.captures.importers.video import Checked, check
from pipelines.captures.leftovers import as_details, leftover_warnings, leftovers
from pipelines.captures.magic import video_container
from pipelines.captures.minimum import MIN_IMAGES
from pipelines.captures.pauses import Pause, without_pauses
from pipelines.captures.record import Found
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.scene.natural_order import natural_key
from pipelines.stage import StageContext

_CLIP_FILE = ".clip"
_CHECKED_BEFORE = ArchiveLimits(max_unpacked_bytes=2**62)
"""For an archive that `ingest` has read by its own limits."""


@dataclass(frozen=True)
class Clip:
    """One clip.

    name: see the module. start_s: time of its first frame. video: as `VideoInfo`. num_views: how
    many views are cut from each frame; 0 where frames are not panoramas. pauses: see
    `captures.pauses`, by its own times.
    """

    name: str
    start_s: float
    video: dict[str, Any]
    num_views: int = 0
    pauses: Sequence[Pause] = ()

    @property
    def num_frames(self) -> int:
        """Frames in the file."""
        return int(self.video["num_frames"])

    @property
    def end_s(self) -> float:
        """When its last frame ends; its times begin at `start_s`."""
        return float(self.video["duration_s"])

    @property
    def length_s(self) -> float:
        """How long it is shown, its pauses left out."""
        return max(without_pauses(self.end_s, self.pauses) - self.start_s, 1e-6)


def read_film(path: Path, options: IngestOptions, ctx: StageContext) -> Found:
    """An upload that is a video. Raises CaptureError as `video.check` does, and video_too_long."""
    checked = check(path, options, ctx, minimum=MIN_IMAGES)
    _check_length([checked], options)
    clip = _clip("", checked, options)
    return Found(
        video=clip.video,
        clips=[asdict(clip)],
        details=checked.details(),
        warnings=checked.warnings(),
    )


def read_films(path: Path, options: IngestOptions, ctx: StageContext) -> Found:
    """An archive of videos, in the natural order of their names.

    A clip that cannot be used, and one that is a copy of another, is left out and told; the error
    of the first where none is left. Raises CaptureError as `read_film` does, too_few_images.
    """
    found: dict[str, Checked] = {}
    unusable: dict[str, CaptureError] = {}
    target = ctx.out / _CLIP_FILE
    with CaptureArchive(
        path, ArchiveLimits(max_unpacked_bytes=options.max_unpacked_bytes)
    ) as archive:
        names = _clip_names(archive)
        for done, name in enumerate(names):
            archive.copy(name, target)
            try:
                part = _part_of(ctx, done, len(names))
                found[name] = check(target, options, part, minimum=1)
            except CaptureError as error:
                unusable[name] = error
            finally:
                target.unlink(missing_ok=True)
        num_bytes = {name: archive.num_bytes(name) for name in found}
        for name, whole in film_copies(found, num_bytes, archive.copy, target, ctx).items():
            how = "smaller copy" if _is_smaller(found.pop(name), found[whole]) else "copy"
            archive.set_aside([name], f"a {how} of {shown(whole)}")
        archive.told([*found, *unusable])
        left = leftovers(archive)
    if not found:
        raise next(iter(unusable.values()))
    _check_length(list(found.values()), options)
    clips = [_clip(name, checked, options) for name, checked in found.items()]
    num_frames = sum(clip.num_frames for clip in clips)
    if num_frames < MIN_IMAGES:
        raise CaptureError(
            f"The videos have {num_frames} frames together; at least {MIN_IMAGES} are needed.",
            code="too_few_images",
            hint="Film for 10 seconds or more, moving around the subject.",
        )
    several = len(clips) > 1
    return Found(
        video=_as_one(clips),
        clips=[asdict(clip) for clip in clips],
        details={
            "num_clips": len(clips),
            "duration_s": round(sum(clip.end_s for clip in clips), 6),
            "clips": [{"name": name, **checked.details()} for name, checked in found.items()],
            **as_details(left),
        },
        warnings=[
            *(f'Left out: "{shown(name)}". {e.message}' for name, e in unusable.items()),
            *(
                f'"{shown(name)}": {warning}' if several else warning
                for name, checked in found.items()
                for warning in checked.warnings()
            ),
            *leftover_warnings(left),
        ],
    )


@contextmanager
def clip_file(capture: Path, clip: Clip, scratch: Path) -> Iterator[Path]:
    """Where a clip lies: the upload itself, or a copy in the folder `scratch` for as long."""
    if not clip.name:
        yield capture
        return
    target = scratch / _CLIP_FILE
    try:
        with CaptureArchive(capture, _CHECKED_BEFORE) as archive:
            archive.extract(clip.name, target)
        yield target
    finally:
        target.unlink(missing_ok=True)


def _part_of(ctx: StageContext, done: int, num: int) -> StageContext:
    """A context whose progress is that of the next of `num` clips."""

    def on_progress(fraction: float, message: str, eta_s: float | None) -> None:
        del eta_s
        ctx.on_progress((done + fraction) / num, f"Video {done + 1} of {num}: {message}", None)

    return replace(ctx, on_progress=on_progress)


def _clip_names(archive: CaptureArchive) -> list[str]:
    """The videos, each once: the same bytes under two names are one clip."""
    seen: set[tuple[int, int]] = set()
    names = []
    for name in sorted(archive.names, key=natural_key):
        if video_container(archive.head(name)) is None:
            continue
        content = (archive.num_bytes(name), archive.checksum(name))
        if content in seen:
            archive.set_aside([name], "the same video is there twice")
        else:
            names.append(name)
        seen.add(content)
    return names


def _clip(name: str, checked: Checked, options: IngestOptions) -> Clip:
    num_views = options.panorama_views if checked.info.projection else 0
    return Clip(name, checked.start_s, checked.info.as_dict(), num_views, checked.pauses)


def _is_smaller(clip: Checked, other: Checked) -> bool:
    return clip.info.width * clip.info.height < other.info.width * other.info.height


def _check_length(clips: Sequence[Checked], options: IngestOptions) -> None:
    duration_s = sum(without_pauses(clip.info.duration_s or 0.0, clip.pauses) for clip in clips)
    if duration_s <= options.max_duration_s:
        return
    what = "The video is" if len(clips) == 1 else "The videos are together"
    raise CaptureError(
        f"{what} {duration_s:.0f} s long; {options.max_duration_s:.0f} s are allowed.",
        code="video_too_long",
        hint="Cut the video, or raise ingest.max_duration_s.",
    )


def _as_one(clips: Sequence[Clip]) -> dict[str, Any]:
    """What is told of all clips together: the longest one's form, and their sums."""
    longest = max(clips, key=lambda clip: clip.length_s)
    return {
        **longest.video,
        "num_frames": sum(clip.num_frames for clip in clips),
        "duration_s": round(sum(clip.end_s for clip in clips), 6),
    }
