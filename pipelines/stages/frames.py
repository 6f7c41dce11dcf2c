"""Stage `frames`: the sharpest frame of each even time window of a video.

Writes `images/frame_00001.jpg`, ... (upright, SDR, reduced) and `frames.json`:
`{width, height, num_source_frames, frames: [{file, timestamp_s, source_frame_index, sharpness}]}`.
The video is decoded once; of each window only the best frame so far is held.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.captures.hdr import TRANSFERS
from pipelines.captures.minimum import MIN_IMAGES
from pipelines.captures.record import CaptureRecord
from pipelines.captures.video_frames import (
    DecodePlan,
    Frame,
    decode,
    reduced_size,
)
from pipelines.errors import CaptureError
from pipelines.options import FramesOptions
from pipelines.stage import StageContext

FRAMES_JSON = "frames.json"


@dataclass
class _Windows:
    """Keeps the sharpest frame of each window and writes it once the window has passed.

    num_windows: 0 to keep every frame. start_s, length_s: of a window's grid.
    """

    out: Path
    jpeg_quality: int
    num_windows: int
    start_s: float
    length_s: float
    rows: list[dict[str, Any]] = field(default_factory=list)
    num_seen: int = 0
    _best: Frame | None = None
    _best_sharpness: float = -1.0
    _window: int = -1

    def take(self, frame: Frame) -> None:
        """Look at the next frame, in order of time."""
        self.num_seen += 1
        window = self._window_of(frame)
        sharpness = frame.sharpness()
        if window != self._window:
            self.flush()
            self._window = window
        if self._best is None or sharpness > self._best_sharpness:
            self._best, self._best_sharpness = frame, sharpness

    def flush(self) -> None:
        """Write the best frame of the window that ends."""
        frame = self._best
        if frame is None:
            return
        file = f"images/frame_{len(self.rows) + 1:05d}.jpg"
        frame.save(self.out / file, self.jpeg_quality)
        self.rows.append(
            {
                "file": file,
                "timestamp_s": round(frame.time_s, 6) if math.isfinite(frame.time_s) else None,
                "source_frame_index": frame.index,
                "sharpness": round(self._best_sharpness, 3),
            }
        )
        self._best, self._best_sharpness = None, -1.0

    def _window_of(self, frame: Frame) -> int:
        if self.num_windows == 0 or not math.isfinite(frame.time_s):
            return frame.index
        cell = int((frame.time_s - self.start_s) / self.length_s)
        return min(max(cell, 0), self.num_windows - 1)


def run(options: FramesOptions, ctx: StageContext) -> dict[str, Any]:
    """Choose and write the frames. Returns the summary for the report.

    Raises CaptureError: video_undecodable, too_few_images; ToolError; Cancelled.
    """
    record = CaptureRecord.load(ctx.workspace.stage("ingest"))
    if record.video is None:
        raise CaptureError(
            f"A capture of kind {record.kind} has no video to take frames from.",
            code="no_video_stream",
            hint="Skip the stage `frames` for this capture.",
        )
    video = record.video
    warnings: list[str] = []
    start_s = float(record.details.get("start_s", 0.0))
    length_s = max(float(video["duration_s"]) - start_s, 1e-6)
    keep_all = int(video["num_frames"]) <= options.num_frames
    windows = _Windows(
        out=ctx.out,
        jpeg_quality=options.jpeg_quality,
        num_windows=0 if keep_all else options.num_frames,
        start_s=start_s,
        length_s=length_s / options.num_frames,
    )
    width, height = reduced_size(video["width"], video["height"], options.long_side_px)
    plan = DecodePlan(
        width=width,
        height=height,
        hdr=str(video["hdr"]),
        matrix=video.get("matrix"),
        start_s=start_s,
        step_s=_step(video, options, length_s),
    )
    (ctx.out / "images").mkdir(parents=True, exist_ok=True)
    num_decoded = _decode(plan, windows, ctx, start_s, length_s)
    _check(windows, num_decoded, int(video["num_frames"]), warnings)
    _write(ctx.out, plan, windows, num_decoded, warnings)
    for warning in warnings:
        ctx.logger.warning("%s", warning)
    ctx.progress(1.0, f"{len(windows.rows)} frames kept of {num_decoded}")
    return {
        "num_frames": len(windows.rows),
        "num_source_frames": num_decoded,
        "num_candidates": windows.num_seen,
        "width": width,
        "height": height,
        "tone_mapped": video["hdr"] in TRANSFERS,
        "warnings": warnings,
    }


def _step(video: dict[str, Any], options: FramesOptions, length_s: float) -> float:
    """Length of the cells of which at most one frame is looked at; 0 where all frames are."""
    wanted = options.num_frames * options.candidates_per_frame
    return length_s / wanted if int(video["num_frames"]) > wanted else 0.0


def _decode(
    plan: DecodePlan, windows: _Windows, ctx: StageContext, start_s: float, length_s: float
) -> int:
    begun = time.monotonic()

    def on_frame(frame: Frame) -> None:
        windows.take(frame)
        fraction = (frame.time_s - start_s) / length_s if math.isfinite(frame.time_s) else 0.0
        elapsed_s = time.monotonic() - begun
        eta_s = elapsed_s * (1 - fraction) / fraction if fraction > 0.02 else None
        ctx.progress(min(fraction, 0.999), f"{len(windows.rows)} frames kept", eta_s)

    num_decoded = decode(ctx.workspace.capture_file, plan, ctx, on_frame)
    windows.flush()
    return num_decoded


def _check(windows: _Windows, num_decoded: int, num_expected: int, warnings: list[str]) -> None:
    if num_decoded == 0:
        raise CaptureError(
            "Not one frame of the video can be decoded.",
            code="video_undecodable",
            hint="Check that it plays, or export it again as MP4 with H.264 or HEVC.",
        )
    if len(windows.rows) < MIN_IMAGES:
        raise CaptureError(
            f"The video gave {len(windows.rows)} frames; at least {MIN_IMAGES} are needed.",
            code="too_few_images",
            hint="Film for 10 seconds or more, moving around the subject.",
        )
    if num_decoded < 0.9 * num_expected:
        warnings.append(
            f"{num_decoded} of {num_expected} frames could be decoded; the video is damaged."
        )


def _write(
    out: Path, plan: DecodePlan, windows: _Windows, num_decoded: int, warnings: list[str]
) -> None:
    payload = {
        "width": plan.width,
        "height": plan.height,
        "num_source_frames": num_decoded,
        "warnings": warnings,
        "frames": windows.rows,
    }
    (out / FRAMES_JSON).write_text(json.dumps(payload, indent=1), "utf-8")
