"""A video: is it whole, can it be decoded, how long and how large is it.

Nothing is copied or converted here. `pipelines.captures.clips` tells which videos a capture has.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipelines.captures.panorama_files import EQUIRECTANGULAR
from pipelines.captures.pauses import Pause, pauses_of, pauses_warning
from pipelines.errors import CaptureError, ToolError
from pipelines.options import IngestOptions
from pipelines.scene.panoramas import is_whole
from pipelines.stage import StageContext
from pipelines.tools.ffmpeg import VideoInfo, probe, run_ffmpeg, untrusted_input

_SCAN_LIMIT_S = 900.0
_DECODE_LIMIT_S = 120.0
_FRAMES_TRIED = 3
_PANORAMA_PX = 1920
"""Equirectangular video is twice as wide as high, and no camera's is narrower."""
_NOT_SET = -(2**63)
_CUT_OFF = ("partial file", "ended prematurely", "moov atom not found")


@dataclass(frozen=True)
class Scan:
    """What the packets of a video say, without decoding.

    times_s: when each frame is shown, increasing, seconds from the start of the file.
    duration_s: end of the last frame. is_cut_off: whether the file ends too early.
    """

    times_s: tuple[float, ...]
    duration_s: float
    is_cut_off: bool


def scan(path: Path, ctx: StageContext, stream: str = "0:V:0") -> Scan:
    """Walk through all packets of a video stream, as `VideoInfo` names it.

    Raises ToolError where that fails.
    """
    times: list[int] = []
    ends: list[int] = []
    unit: list[float] = []
    log: list[str] = []
    pending = bytearray()

    def on_stdout(chunk: bytes) -> None:
        pending.extend(chunk)
        *lines, rest = bytes(pending).split(b"\n")
        pending[:] = rest
        for line in lines:
            if line.startswith(b"#tb 0:"):
                above, below = line.split(b":", 1)[1].split(b"/")
                unit.append(int(above) / int(below))
            elif line and not line.startswith(b"#"):
                _, dts, pts, duration, *_ = line.split(b",")
                times.append(_ticks(pts, dts, default=max(ends, default=0)))
                ends.append(times[-1] + int(duration))

    copied = untrusted_input(path).output(
        "pipe:1", map=stream, c="copy", f="framecrc", **{"an": None, "sn": None, "dn": None}
    )
    run_ffmpeg(
        copied,
        log_level="warning",
        time_limit_s=_SCAN_LIMIT_S,
        is_cancelled=ctx.is_cancelled,
        on_line=log.append,
        on_stdout=on_stdout,
    )
    seconds = unit[0] if unit else 0.0
    # What an edit list hides lies before 0: the rest needs it to be decoded, and nobody sees it.
    times = [time for time in times if time >= 0] or times
    return Scan(
        times_s=tuple(sorted(value * seconds for value in times)),
        duration_s=max(ends, default=0) * seconds,
        is_cut_off=any(sign in line for line in log for sign in _CUT_OFF),
    )


def _ticks(*stamps: bytes, default: int) -> int:
    """The first time stamp that is set; AVI has none for when frames are shown, only their order.

    ffmpeg writes one that is not set as the smallest integer, or as NOPTS.
    """
    for stamp in stamps:
        if b"NOPTS" not in stamp and int(stamp) > _NOT_SET:
            return int(stamp)
    return default


@dataclass(frozen=True)
class Checked:
    """A video that can be used.

    info: with its true length and number of frames. promised_s: of one that is cut off, how long
    its index says that it is, None where it does not say.
    """

    info: VideoInfo
    packets: Scan
    promised_s: float | None = None

    @property
    def start_s(self) -> float:
        """When its first frame is shown."""
        return round(self.packets.times_s[0], 6)

    @property
    def pauses(self) -> tuple[Pause, ...]:
        """Stretches without frames."""
        return pauses_of(self.packets.times_s)

    def details(self) -> dict[str, Any]:
        """For the record."""
        return _details(self.info, self.packets)

    def warnings(self) -> list[str]:
        """What its sender should know."""
        cut_off = [_cut_off(self.info, self.promised_s)] if self.packets.is_cut_off else []
        pauses = [pauses_warning(self.pauses)] if self.pauses else []
        return cut_off + pauses + _warnings(self.info)


def check(path: Path, options: IngestOptions, ctx: StageContext, *, minimum: int) -> Checked:
    """Check the video at `path`. minimum: fewest frames.

    Raises CaptureError: video_truncated, no_video_stream, video_undecodable, too_large,
    too_few_images, projection_unsupported.
    """
    ctx.progress(0.0, "Reading the video's index")
    info = probe(path)
    _check_size(info, options)
    info = _with_projection(info, options)
    ctx.progress(0.1, "Looking for the end of the video")
    try:
        packets = scan(path, ctx, info.stream)
    except ToolError as error:
        if error.code == "tool_timeout":
            raise
        raise _undecodable(error) from error
    num_frames = len(packets.times_s)
    if packets.is_cut_off and num_frames < max(minimum, 1):
        raise CaptureError(
            f"The video is cut off: {num_frames} frames of it are there, and at least {minimum} "
            "are needed.",
            code="video_truncated",
            hint="Upload the file again; it was not copied or recorded to its end.",
        )
    ctx.progress(0.7, "Decoding the first frames")
    _try_decoding(path, ctx, info.stream)
    if num_frames < max(minimum, 1):
        raise CaptureError(
            f"The video has {num_frames} frames; at least {minimum} are needed.",
            code="too_few_images",
            hint="Film for 10 seconds or more, moving around the subject.",
        )
    duration_s = packets.duration_s
    fps = info.fps or (num_frames / duration_s if duration_s > 0 else None)
    promised_s = info.duration_s if packets.is_cut_off else None
    info = replace(info, num_frames=num_frames, duration_s=round(duration_s, 6), fps=fps)
    return Checked(info, packets, promised_s)


def _check_size(info: VideoInfo, options: IngestOptions) -> None:
    if info.width * info.height > options.max_pixels:
        raise CaptureError(
            f"The video's frames are {info.width}x{info.height}; "
            f"{options.max_pixels} pixels are allowed.",
            code="too_large",
            hint="Export the video at 4K or less.",
        )


def _with_projection(info: VideoInfo, options: IngestOptions) -> VideoInfo:
    """The video with the projection that counts: what it says, or what the options say."""
    projection = {"auto": info.projection, "flat": ""}.get(options.projection, options.projection)
    if projection not in ("", EQUIRECTANGULAR):
        raise CaptureError(
            f"The video is a 360-degree one of a kind that is not read ({projection}).",
            code="projection_unsupported",
            hint="Export it from the camera's app as an equirectangular video (twice as wide as "
            "high), or as plain (flat, perspective) clips.",
        )
    if projection and not is_whole(info.width, info.height):
        raise CaptureError(
            f"The video is said to show the whole sphere, and is {info.width}x{info.height} "
            "instead of twice as wide as high: half a sphere, or two pictures for two eyes.",
            code="projection_unsupported",
            hint="Export the whole sphere for one eye, or set ingest.projection to flat.",
        )
    return replace(info, projection=projection)


def _details(info: VideoInfo, packets: Scan) -> dict[str, object]:
    gaps = [b - a for a, b in zip(packets.times_s, packets.times_s[1:], strict=False)]
    middle = sorted(gaps)[len(gaps) // 2]
    variable = middle > 0 and any(abs(gap - middle) > 0.3 * middle for gap in gaps)
    return {
        "width": info.width,
        "height": info.height,
        "fps": info.fps,
        "duration_s": info.duration_s,
        "codec": info.codec,
        "rotation_deg": info.rotation_deg,
        "hdr": info.hdr,
        "projection": info.projection,
        "variable_frame_rate": variable,
        "start_s": round(packets.times_s[0], 6),
    }


def _cut_off(info: VideoInfo, promised_s: float | None) -> str:
    there_s = info.duration_s or 0.0
    share = f" of {promised_s:.1f} s ({100 * there_s / promised_s:.0f} %)" if promised_s else ""
    return (
        f"The video is cut off: its first {there_s:.1f} s{share} are there, and used. It was not "
        "copied or recorded to its end; send it whole if you have it."
    )


def _warnings(info: VideoInfo) -> list[str]:
    warnings = []
    if max(info.width, info.height) < 480:
        warnings.append(f"The video is small ({info.width}x{info.height}): details will be few.")
    is_wide = info.width == 2 * info.height and info.width >= _PANORAMA_PX
    if is_wide and not info.projection:
        warnings.append(
            "The video is twice as wide as high, as 360-degree videos are, and does not say that "
            "it is one. If it is, its poses will be wrong: set ingest.projection to "
            "equirectangular."
        )
    if info.hdr == "dolby":
        warnings.append("The video is Dolby Vision without a compatible layer: colours may be off.")
    return warnings


def _try_decoding(path: Path, ctx: StageContext, stream: str) -> None:
    """Decode the first frames. Raises CaptureError video_undecodable."""
    seen: list[bytes] = []
    decoded = untrusted_input(path).output(
        "pipe:1",
        map=stream,
        f="framecrc",
        **{"frames:v": _FRAMES_TRIED, "an": None, "sn": None, "dn": None},
    )
    try:
        run_ffmpeg(
            decoded,
            time_limit_s=_DECODE_LIMIT_S,
            is_cancelled=ctx.is_cancelled,
            on_stdout=seen.append,
        )
    except ToolError as error:
        if error.code == "tool_timeout":
            raise
        raise _undecodable(error) from error
    if not re.search(rb"^0,", b"".join(seen), re.MULTILINE):
        raise _undecodable(None)


def _undecodable(error: ToolError | None) -> CaptureError:
    return CaptureError(
        "The video's pictures cannot be decoded.",
        code="video_undecodable",
        hint="Check that it plays, or export it again as MP4 with H.264 or HEVC.",
        details=error.details if error else None,
    )
