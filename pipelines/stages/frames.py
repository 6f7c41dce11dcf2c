"""Stage `frames`: the sharpest frame of each even time window of a film, of halves or thirds of it
where the picture moves far meanwhile.

Writes `images/frame_00001.jpg`, ... (upright, SDR, reduced) and `frames.json`: `{width, height,
num_source_frames, warnings, clips: [{name, offset_s, duration_s, width, height, num_frames,
num_source_frames, crop, burned_in}], frames: [{file, clip, timestamp_s, source_frame_index,
sharpness, speed, gain_ev}]}`. Frames of a 360-degree clip lie in `panoramas/`, and the views cut
from each in `images/`: its row lists them as `views`. Times of several clips run on from one to the
next: `offset_s` is where a clip's own begin. speed: how fast the picture moved in the frame's
window, the median, long sides per second, or null. gain_ev: stops by which exposure changed since
the clip's first frame, as far as that was seen. crop: where bars beside a clip were cut away, what
was left of its upright pictures, [x, y, width, height], else null. burned_in: the share of its
frames that something else was laid over; rows then name each frame's `mask`, black there.

Each clip is decoded once, and again without its bars; of each window only the best frame
so far of each of its SLOTS is held.
"""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipelines.captures.archive_rules import shown
from pipelines.captures.burned_in import find_burned_in
from pipelines.captures.clips import Clip, clip_file
from pipelines.captures.common_parts import burned_in_warning, write_mask
from pipelines.captures.hdr import TRANSFERS
from pipelines.captures.minimum import MIN_IMAGES
from pipelines.captures.motion import MotionMeter
from pipelines.captures.panorama_files import FOLDER as PANORAMAS
from pipelines.captures.panorama_files import write_views
from pipelines.captures.pauses import Pause, without_pauses
from pipelines.captures.record import CaptureRecord
from pipelines.captures.turntable import TURNTABLE_NOTE, cut_turntable
from pipelines.captures.video_frames import (
    Crop,
    DecodePlan,
    Frame,
    decode,
    reduced_size,
)
from pipelines.errors import CaptureError
from pipelines.options import FramesOptions
from pipelines.stage import StageContext

FRAMES_JSON = "frames.json"
PANORAMA_SIZE = 2
"""Panoramas are so many times as large as other frames: a view of 90 degrees is a third of one."""
PANORAMA_SHARE = 2
"""For so many frames that other films would give there is one panorama: it shows four views."""
MIN_PER_CLIP = 8
"""Frames that a short clip gets beside long ones, as far as it has so many."""
MAX_PARTS = 3
"""Most frames of a window: films move unevenly, and frames that share nothing have no poses."""
SLOTS = 6
"""Of a window: halves and thirds are made of whole ones."""
MIN_SHARPNESS = 0.3
"""Of the window's sharpest frame, for another of it to be of use."""
MAX_GROWTH = 2
"""So many frames for each window that has passed are there at most."""


@dataclass
class _Windows:
    """Keeps the sharpest frames of each window of a clip and writes them once it has passed.

    rows: of all clips so far, to which the clip's are added. clip: its number. offset_s: what its
    times are counted from. num_windows: 0 to keep every frame. start_s, length_s: of a window's
    grid, by the clip's own times. max_step: long sides by which the picture may move from one
    frame to the next, as far as MAX_PARTS and MAX_GROWTH allow; 0 for one frame a window.
    num_views: cut from each frame, which is a panorama then. pauses: of the clip, of which no
    window is.
    """

    out: Path
    jpeg_quality: int
    rows: list[dict[str, Any]]
    clip: int
    offset_s: float
    num_windows: int
    start_s: float
    length_s: float
    max_step: float = 0.0
    num_views: int = 0
    pauses: Sequence[Pause] = ()
    num_seen: int = 0
    num_kept: int = 0
    repeated: list[int] = field(default_factory=list)
    """Places in `rows` of frames that show what the one chosen before shows."""
    _last: Frame | None = None
    """The frame chosen last that does not."""
    _best: dict[int, tuple[float, Frame]] = field(default_factory=dict)
    """Of each slot of the window: sharpness and frame."""
    _window: int = -1
    _meter: MotionMeter = field(default_factory=MotionMeter)
    _speeds: list[float] = field(default_factory=list)
    _gain_ev: float = 0.0

    def take(self, frame: Frame) -> None:
        """Look at the next frame, in order of time."""
        self.num_seen += 1
        window, slot = divmod(self._slot_of(frame), SLOTS)
        sharpness = frame.sharpness()
        if window != self._window:
            self.flush()
            self._window = window
        step = self._meter.take(frame)
        if step is not None and step.speed is not None:
            self._speeds.append(step.speed)
        if step is not None and step.gain_ev is not None:
            self._gain_ev += step.gain_ev
        if slot not in self._best or sharpness > self._best[slot][0]:
            self._best[slot] = sharpness, frame

    def flush(self) -> None:
        """Write the best frames of the window that ends."""
        num_parts = self._num_parts()
        sharp_enough = MIN_SHARPNESS * max((each for each, _ in self._best.values()), default=0.0)
        for part in range(num_parts):
            slots = range(part * SLOTS // num_parts, (part + 1) * SLOTS // num_parts)
            found = [self._best[slot] for slot in slots if slot in self._best]
            sharpness, frame = max(found, key=lambda each: each[0], default=(0.0, None))
            if frame is None or sharpness < sharp_enough:
                continue
            if self._last is not None and frame.repeats(self._last):
                self.repeated.append(len(self.rows))
            else:
                self._last = frame
            self._write(sharpness, frame)
        self._best.clear()
        self._speeds.clear()

    def drop_repeated(self) -> int:
        """Delete frames that repeat others, at the end; returns how many.

        None of panoramas, and none where hardly any other would be left: what a camera that stood
        still has filmed is for structure from motion to judge.
        """
        num_left = self.num_kept - len(self.repeated)
        if not self.repeated or self.num_views or num_left < MIN_IMAGES:
            return 0
        for place in reversed(self.repeated):
            (self.out / self.rows.pop(place)["file"]).unlink()
        for number, row in enumerate(self.rows, start=1):
            file = f"images/frame_{number:05d}.jpg"
            if not row.get("views"):
                (self.out / row["file"]).rename(self.out / file)
                row["file"] = file
        self.num_kept = num_left
        return len(self.repeated)

    def _num_parts(self) -> int:
        """How many frames the window gives: by how far the picture moved in it."""
        if not self._speeds or self.max_step == 0 or self.num_windows == 0:
            return 1
        travel = statistics.fmean(self._speeds) * self.length_s
        allowed = MAX_GROWTH * (self._window + 1) - self.num_kept
        return max(1, min(math.ceil(travel / self.max_step), MAX_PARTS, allowed))

    def _write(self, sharpness: float, frame: Frame) -> None:
        self.num_kept += 1
        stem = f"frame_{len(self.rows) + 1:05d}"
        file = f"{PANORAMAS if self.num_views else 'images'}/{stem}.jpg"
        frame.save(self.out / file, self.jpeg_quality)
        self.rows.append(
            {
                "file": file,
                "clip": self.clip,
                "timestamp_s": round(self.offset_s + frame.time_s, 6)
                if math.isfinite(frame.time_s)
                else None,
                "source_frame_index": frame.index,
                "sharpness": round(sharpness, 3),
                "speed": round(statistics.median(self._speeds), 4) if self._speeds else None,
                "gain_ev": round(self._gain_ev, 3),
            }
        )
        if self.num_views:
            views = write_views(self.out / file, self.out, stem, self.num_views)
            self.rows[-1]["views"] = views

    def _slot_of(self, frame: Frame) -> int:
        """Its number, counted over all windows."""
        if self.num_windows == 0 or not math.isfinite(frame.time_s):
            return frame.index * SLOTS
        shown_s = without_pauses(frame.time_s, self.pauses)
        cell = int((shown_s - self.start_s) / self.length_s * SLOTS)
        return min(max(cell, 0), self.num_windows * SLOTS - 1)


def run(options: FramesOptions, ctx: StageContext) -> dict[str, Any]:
    """Choose and write the frames. Returns the summary for the report.

    Raises CaptureError: video_undecodable, too_few_images; ToolError; Cancelled.
    """
    record = CaptureRecord.load(ctx.workspace.stage("ingest"))
    clips = [Clip(**clip) for clip in record.clips]
    if not clips:
        raise CaptureError(
            f"A capture of kind {record.kind} has no video to take frames from.",
            code="no_video_stream",
            hint="Skip the stage `frames` for this capture.",
        )
    for folder in ("images", *([PANORAMAS] if any(clip.num_views for clip in clips) else [])):
        (ctx.out / folder).mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    read: list[_Read] = []
    whole_s = sum(clip.end_s for clip in clips)
    for number, (clip, share) in enumerate(
        zip(clips, shared_frames(clips, options.num_frames), strict=True)
    ):
        offset_s = sum(before.end_s for before in clips[:number])
        scale = _Scale(ctx, offset_s, whole_s)
        read.append(_read_clip(clip, number, share, rows, options, scale))
    num_decoded = sum(one.num_decoded for one in read)
    warnings = _check(rows, clips, read)
    _write(ctx.out, clips, read, rows, warnings)
    for warning in warnings:
        ctx.logger.warning("%s", warning)
    ctx.progress(1.0, f"{len(rows)} frames kept of {num_decoded}")
    return {
        "num_frames": len(rows),
        "num_source_frames": num_decoded,
        "num_candidates": sum(one.num_seen for one in read),
        "num_clips": len(clips),
        "width": read[0].plan.width,
        "height": read[0].plan.height,
        "tone_mapped": any(clip.video["hdr"] in TRANSFERS for clip in clips),
        "warnings": warnings,
    }


def shared_frames(clips: Sequence[Clip], wanted: int) -> list[int]:
    """How many frames each clip gives, by its length, MIN_PER_CLIP or all it has at least.

    Their sum is `wanted`, but for what clips have not, and for what the least takes of many clips;
    a panorama counts for PANORAMA_SHARE.
    """
    worth = [PANORAMA_SHARE if clip.num_views else 1 for clip in clips]
    most = [clip.num_frames * each for clip, each in zip(clips, worth, strict=True)]
    least = [min(MIN_PER_CLIP * each, has) for each, has in zip(worth, most, strict=True)]
    shares = [0.0] * len(clips)
    open_, left = set(range(len(clips))), float(wanted)
    while open_:
        length_s = sum(clips[i].length_s for i in open_)
        for i in open_:
            shares[i] = left * clips[i].length_s / length_s
        # What is bounded is settled first, those that get too little before those that have less.
        bounded = {i for i in open_ if shares[i] < least[i]} or {
            i for i in open_ if shares[i] > most[i]
        }
        if not bounded:
            break
        for i in bounded:
            shares[i] = float(min(max(shares[i], least[i]), most[i]))
            left -= shares[i]
        left = max(left, 0.0)
        open_ -= bounded
    ends = [round(sum(shares[: i + 1])) for i in range(len(clips))]
    starts = [0, *ends[:-1]]
    return [(end - start) // w for start, end, w in zip(starts, ends, worth, strict=True)]


@dataclass(frozen=True)
class _Scale:
    """Progress over all clips, which follow one another by their times."""

    ctx: StageContext
    offset_s: float
    whole_s: float
    begun: float = field(default_factory=time.monotonic)

    def report(self, time_s: float, num_kept: int) -> None:
        """Tell how far a clip has been read, by its own time."""
        known = time_s if math.isfinite(time_s) else 0.0
        fraction = (self.offset_s + known) / max(self.whole_s, 1e-6)
        here = known / max(self.whole_s, 1e-6)
        elapsed_s = time.monotonic() - self.begun
        eta_s = elapsed_s * (1 - fraction) / here if here > 0.02 else None
        self.ctx.progress(min(fraction, 0.999), f"{num_kept} frames kept", eta_s)


@dataclass(frozen=True)
class _Read:
    """What came of a clip. burned_in: the share of its frames that is masked."""

    plan: DecodePlan
    offset_s: float
    num_decoded: int
    num_seen: int
    num_kept: int
    num_repeated: int
    burned_in: float = 0.0
    turned: bool = False


def _read_clip(
    clip: Clip,
    number: int,
    share: int,
    rows: list[dict[str, Any]],
    options: FramesOptions,
    scale: _Scale,
) -> _Read:
    """Add a clip's best frames to the rows, without bars, and with masks of what else lies over
    them. share: how many."""
    num_before = len(rows)
    read = _decode_clip(clip, number, share, rows, options, scale)
    if not options.find_burned_in or clip.num_views:
        return read
    ctx, plan, own = scale.ctx, read.plan, rows[num_before:]
    cuts = cut_turntable(ctx.out, [row["file"] for row in own], options.jpeg_quality, ctx)
    for row in own:
        if row["file"] in cuts:
            row["cut"] = cuts[row["file"]]
    if cuts:
        return replace(read, turned=True)
    found = find_burned_in([ctx.out / row["file"] for row in own], ctx)
    if found is None:
        return read
    if found.crop is not None:
        for row in own:
            (ctx.out / row["file"]).unlink()
        del rows[num_before:]
        whole = (clip.video["width"], clip.video["height"])
        crop = found.crop.enlarged((plan.width, plan.height), whole)
        read = _decode_clip(clip, number, share, rows, options, scale, crop)
        own = rows[num_before:]
        found = find_burned_in([ctx.out / row["file"] for row in own], ctx)
    if found is None:
        return read
    for row in own:
        row["mask"] = write_mask(ctx.out, row["file"], found.mask)
    return replace(read, burned_in=found.share)


def _decode_clip(
    clip: Clip,
    number: int,
    share: int,
    rows: list[dict[str, Any]],
    options: FramesOptions,
    scale: _Scale,
    crop: Crop | None = None,
) -> _Read:
    """Decode a clip, or a part of its pictures, and add its best frames to the rows."""
    ctx = scale.ctx
    long_side_px = options.long_side_px * (PANORAMA_SIZE if clip.num_views else 1)
    taken = crop or Crop(0, 0, clip.video["width"], clip.video["height"])
    width, height = reduced_size(taken.width, taken.height, long_side_px)
    windows = _Windows(
        out=ctx.out,
        jpeg_quality=options.jpeg_quality,
        rows=rows,
        clip=number,
        offset_s=scale.offset_s,
        num_windows=0 if clip.num_frames <= share else share,
        start_s=clip.start_s,
        length_s=clip.length_s / share,
        max_step=0.0 if clip.num_views else options.max_step,
        num_views=clip.num_views,
        pauses=clip.pauses,
    )
    plan = DecodePlan(
        width=width,
        height=height,
        hdr=str(clip.video["hdr"]),
        matrix=clip.video.get("matrix"),
        start_s=clip.start_s,
        step_s=_step(clip, share * options.candidates_per_frame),
        crop=crop,
        whole=(clip.video["width"], clip.video["height"]),
        stream=clip.video.get("stream", "0:V:0"),
        pauses=clip.pauses,
    )

    def on_frame(frame: Frame) -> None:
        windows.take(frame)
        scale.report(frame.time_s, len(rows))

    with clip_file(ctx.workspace.capture_file, clip, ctx.out) as file:
        num_decoded = decode(file, plan, ctx, on_frame)
    windows.flush()
    num_repeated = windows.drop_repeated()
    return _Read(
        plan,
        scale.offset_s,
        num_decoded,
        windows.num_seen,
        windows.num_kept,
        num_repeated,
    )


def _step(clip: Clip, wanted: int) -> float:
    """Length of the cells of which at most one frame is looked at; 0 where all frames are."""
    return clip.length_s / wanted if clip.num_frames > wanted else 0.0


def _check(rows: list[dict[str, Any]], clips: Sequence[Clip], read: Sequence[_Read]) -> list[str]:
    """Warnings. Raises CaptureError where the film is not enough."""
    num_decoded = sum(one.num_decoded for one in read)
    if num_decoded == 0:
        raise CaptureError(
            "Not one frame of the video can be decoded.",
            code="video_undecodable",
            hint="Check that it plays, or export it again as MP4 with H.264 or HEVC.",
        )
    if len(rows) < MIN_IMAGES:
        raise CaptureError(
            f"The video gave {len(rows)} frames; at least {MIN_IMAGES} are needed.",
            code="too_few_images",
            hint="Film for 10 seconds or more, moving around the subject.",
        )
    return [
        warning
        for clip, one in zip(clips, read, strict=True)
        for warning in _warnings(clip, one, f' of "{shown(clip.name)}"' if len(clips) > 1 else "")
    ]


def _warnings(clip: Clip, read: _Read, where: str) -> list[str]:
    """What the sender should know of a clip. where: of which, if there are several."""
    warnings = []
    if read.num_decoded < 0.9 * clip.num_frames:
        warnings.append(
            f"{read.num_decoded} of {clip.num_frames} frames{where} could be decoded; the video is "
            "damaged."
        )
    if read.num_repeated:
        warnings.append(
            f"{read.num_repeated} frames{where} show what the one before shows, and were left out: "
            "the camera stood still, or the video repeats its frames."
        )
    if read.plan.crop is not None:
        left = math.prod(read.plan.crop.size) / (clip.video["width"] * clip.video["height"])
        warnings.append(
            f"Bars beside the pictures{where}, {1 - left:.0%} of the frame, were cut away."
        )
    if read.turned:
        warnings.append(f"In the video{where}: {TURNTABLE_NOTE}" if where else TURNTABLE_NOTE)
    if read.burned_in:
        warnings.append(burned_in_warning(read.burned_in, where))
    return warnings


def _write(
    out: Path,
    clips: Sequence[Clip],
    read: Sequence[_Read],
    rows: list[dict[str, Any]],
    warnings: list[str],
) -> None:
    payload = {
        "width": read[0].plan.width,
        "height": read[0].plan.height,
        "num_source_frames": sum(one.num_decoded for one in read),
        "warnings": warnings,
        "clips": [
            {
                "name": clip.name,
                "offset_s": round(one.offset_s, 6),
                "duration_s": clip.end_s,
                "width": one.plan.width,
                "height": one.plan.height,
                "num_frames": one.num_kept,
                "num_source_frames": one.num_decoded,
                "crop": one.plan.crop and list(one.plan.crop),
                "burned_in": round(one.burned_in, 4),
            }
            for clip, one in zip(clips, read, strict=True)
        ],
        "frames": rows,
    }
    (out / FRAMES_JSON).write_text(json.dumps(payload, indent=1), "utf-8")
