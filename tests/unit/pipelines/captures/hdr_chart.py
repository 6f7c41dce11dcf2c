"""A chart of bright plain walls and colours, filmed in HLG, in PQ, and in SDR by the same phone.

Scene light is relative to a white card in the subject's light (1.0), under BT.709's primaries. The
phone puts that card at 75 % of the HLG signal (BT.2408) and in SDR below a shoulder that ends at
the same highlights. Formulas here are those of ITU-R BT.2100-2 and BT.709-6, written a second time.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from skimage.color import rgb2lab

from pipelines.tools.ffmpeg import ffmpeg_executable

Colors = npt.NDArray[np.float64]

CELL_PX = 64
COLUMNS, ROWS = 6, 4
STRIPE_PX = 16
STRIPES = 0.04
"""A wall's stripes are that much brighter and darker than the wall: marks, plaster, wood."""

NOISE = 0.015
"""Of the sensor, relative: without it contrasts would be whole levels."""

WALLS = (0.5, 0.7, 0.9, 1.107, 1.5, 2.0)
"""Light of the walls; in HLG they are at 0.61, 0.68, 0.73, 0.77, 0.83 and 0.88 of the signal."""
_TINT = np.array([1.0, 0.97, 0.93])

SWATCHES = np.array([
    [.40, .20, .15], [.60, .40, .30], [.15, .20, .35], [.15, .25, .10], [.25, .25, .45],
    [.30, .55, .45], [.70, .25, .05], [.08, .10, .40], [.55, .10, .13], [.10, .05, .15],
    [.35, .50, .05], [.75, .40, .03], [.03, .05, .30], [.06, .30, .07], [.45, .03, .04],
    [.85, .60, .01], [.50, .08, .30], [.01, .24, .38],
])  # fmt: skip

WHITE_IN_HLG = 0.265
"""Scene light of the white card, 1 being the brightest that HLG holds."""

_BT2020_FROM_BT709 = np.array(
    [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
)
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])
TRANSFERS = {"hlg": "arib-std-b67", "pq": "smpte2084"}


def scene() -> Colors:
    """[256, 384, 3], scene light: a row of striped walls, then three rows of colours."""
    cells = np.concatenate([np.array(WALLS)[:, None] * _TINT, SWATCHES]).reshape(ROWS, COLUMNS, 3)
    picture = cells.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
    stripe = np.arange(picture.shape[1]) // STRIPE_PX % 2 * 2 - 1
    picture[:CELL_PX] *= (1 + STRIPES * stripe)[None, :, None]
    noise = np.random.default_rng(0).normal(0.0, NOISE, picture.shape)
    return picture * (1 + noise)


def sdr_signal(light: Colors) -> Colors:
    """What the phone writes in SDR: a shoulder from 0.6 on, then BT.709's curve."""
    shoulder = 0.6 + 0.4 * (1 - np.exp(-(light - 0.6) / 0.4))
    shown = np.where(light <= 0.6, light, shoulder)
    return np.where(shown < 0.018, 4.5 * shown, 1.099 * shown**0.45 - 0.099)


def hlg_signal(light: Colors) -> Colors:
    """What the phone writes in HLG."""
    camera = np.minimum(light @ _BT2020_FROM_BT709.T * WHITE_IN_HLG, 1.0)
    logarithm = 0.17883277 * np.log(np.maximum(12 * camera - 0.28466892, 1e-9)) + 0.55991073
    return np.where(camera <= 1 / 12, np.sqrt(3 * camera), logarithm)


def pq_signal(light: Colors) -> Colors:
    """What the phone writes in PQ: the light of an HLG display of 1,000 cd/m2."""
    camera = np.minimum(light @ _BT2020_FROM_BT709.T * WHITE_IN_HLG, 1.0)
    shown = 1000 * camera * (camera @ _LUMINANCE)[..., None] ** 0.2
    power = (shown / 10_000) ** (2610 / 16384)
    ratio = (3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)
    signal: Colors = ratio ** (2523 / 32)
    return signal


def write_clip(path: Path, kind: str) -> Path:
    """Half a second of the chart. kind: "sdr", "hlg" or "pq"."""
    signal = {"sdr": sdr_signal, "hlg": hlg_signal, "pq": pq_signal}[kind](scene())
    height, width, _ = signal.shape
    frame = np.round(np.clip(signal, 0, 1) * 65535).astype("<u2").tobytes()
    command = [ffmpeg_executable(), "-nostdin", "-hide_banner", "-loglevel", "error", "-y"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb48le", "-s", f"{width}x{height}", "-r", "30"]
    command += ["-i", "pipe:0", "-vf"]
    if kind == "sdr":
        command += ["scale=out_color_matrix=bt709:out_range=limited,format=yuv420p"]
        command += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]
        command += ["-c:v", "libx264", "-crf", "4"]
    else:
        command += ["scale=out_color_matrix=bt2020:out_range=limited,format=yuv420p10le"]
        tags = f"colorprim=bt2020:transfer={TRANSFERS[kind]}:colormatrix=bt2020nc"
        command += ["-c:v", "libx265", "-crf", "4", "-preset", "ultrafast"]
        command += ["-x265-params", f"log-level=error:{tags}", "-color_trc", TRANSFERS[kind]]
    subprocess.run([*command, "-color_range", "tv", str(path)], input=frame * 15, check=True)
    return path


@dataclass(frozen=True)
class Reading:
    """What a picture of the chart shows.

    wall_levels: [6, 3], mean R'G'B' of each wall, [0, 255]. contrast: [6], levels of green between
    its bright and dark stripes. swatches: [18, 3], CIELAB.
    """

    wall_levels: npt.NDArray[np.float64]
    contrast: npt.NDArray[np.float64]
    swatches: npt.NDArray[np.float64]

    def hue_errors_deg(self, other: Reading) -> npt.NDArray[np.float64]:
        """Turn of each swatch's hue against another picture's, [18], in [0, 180]."""
        mine, theirs = (np.arctan2(r.swatches[:, 2], r.swatches[:, 1]) for r in (self, other))
        turn = np.degrees(mine - theirs)
        result: npt.NDArray[np.float64] = np.abs((turn + 180) % 360 - 180)
        return result

    def chroma(self) -> npt.NDArray[np.float64]:
        """[18], distance from grey in CIELAB."""
        result: npt.NDArray[np.float64] = np.hypot(self.swatches[:, 1], self.swatches[:, 2])
        return result


def read_chart(pixels: npt.NDArray[np.uint8]) -> Reading:
    """Measure a decoded picture of the chart, [256, 384, 3], away from all edges."""
    walls = pixels[16 : CELL_PX - 16].astype(np.float64).mean(axis=0)
    stripes = walls.reshape(-1, STRIPE_PX, 3)[:, 4:-4].mean(axis=1).reshape(COLUMNS, 2, 2, 3)
    contrast = np.abs(np.diff(stripes[..., 1].mean(axis=1), axis=-1))[:, 0]
    cells = pixels.reshape(ROWS, CELL_PX, COLUMNS, CELL_PX, 3)[1:, 16:-16, :, 16:-16]
    means = cells.astype(np.float64).mean(axis=(1, 3)).reshape(-1, 3)
    return Reading(
        wall_levels=stripes.mean(axis=(1, 2)),
        contrast=contrast,
        swatches=rgb2lab(means[None] / 255)[0],
    )
