"""Ways from HDR video to SDR, on a chart: `python -m tests.benchmarks.tone_mapping FOLDER`.

The chart is filmed in HLG, PQ and SDR (`tests/unit/pipelines/captures/hdr_chart.py`). Each way is a
chain of ffmpeg filters on the HDR clips. Prints the table of docs/video.md and writes pictures side
by side. Needs an ffmpeg with zscale, which only the ways that were not chosen use.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import PIL.Image
import PIL.ImageDraw

from pipelines.captures.hdr import TRANSFERS, pq_light, sdr_filters, write_pq_table
from pipelines.tools.ffmpeg import ffmpeg_executable
from tests.unit.pipelines.captures.hdr_chart import read_chart, scene, write_clip

Pixels = npt.NDArray[np.uint8]
Colors = npt.NDArray[np.float64]

_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])
_BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
)
_TABLE_SIDE = 65


def bt2446_a(signal: Colors) -> Colors:
    """BT.2446-1 method A from a PQ signal of 1,000 cd/m2 to the signal of BT.709."""
    root = np.clip(pq_light(signal) / 1000, 0, 1) ** (1 / 2.4)
    luma = np.maximum(root @ _LUMINANCE, 1e-9)
    above, below = 1 + 32 * (1000 / 10_000) ** (1 / 2.4), 1 + 32 * (100 / 10_000) ** (1 / 2.4)
    seen = np.log(1 + (above - 1) * luma) / np.log(above)
    bent = np.where(seen < 0.9909, -1.1510 * seen**2 + 2.7811 * seen - 0.6302, 0.5 * seen + 0.5)
    bent = np.where(seen <= 0.7399, 1.077 * seen, bent)
    out = (below**bent - 1) / (below - 1)
    scale = out / (1.1 * luma)
    blue = scale * (root[..., 2] - luma) / 1.8814
    red = scale * (root[..., 0] - luma) / 1.4746
    out = out - np.maximum(0.1 * red, 0)
    r, b = out + 1.4746 * red, out + 1.8814 * blue
    g = (out - 0.2627 * r - 0.0593 * b) / 0.6780
    linear = np.clip(np.stack([r, g, b], axis=-1), 0, 1) ** 2.4 @ _BT709_FROM_BT2020.T
    shown: Colors = np.clip(linear, 0, 1) ** (1 / 2.4)
    return shown


def write_table(path: Path, function: Callable[[Colors], Colors]) -> None:
    """A function of colours as a table for `lut3d`."""
    steps = np.linspace(0.0, 1.0, _TABLE_SIDE)
    blue, green, red = np.meshgrid(steps, steps, steps, indexing="ij")
    table = function(np.stack([red, green, blue], axis=-1)).reshape(-1, 3)
    with path.open("w", encoding="ascii") as file:
        file.write(f"LUT_3D_SIZE {_TABLE_SIDE}\n")
        np.savetxt(file, table, fmt="%.6f")


def chains(folder: Path, kind: str) -> dict[str, list[str]]:
    """Filters by the name of the way, from the HDR clip to R'G'B' of BT.709."""
    write_pq_table(folder / "pq.cube")
    write_table(folder / "bt2446.cube", bt2446_a)
    tags = f"setparams=colorspace=bt2020nc:color_primaries=bt2020:color_trc={TRANSFERS[kind]}"
    linear = [tags, "zscale=t=linear:npl=203", "format=gbrpf32le", "zscale=p=bt709"]
    coded = ["zscale=t=iec61966-2-1:m=gbr:r=full"]
    as_pq = [tags, "zscale=t=smpte2084:m=gbr:r=full:npl=1000", "format=gbrp16"]
    return {
        "clipped above white": [*linear, "tonemap=clip", *coded],
        "Moebius, 203 cd/m2": [*linear, "tonemap=mobius:param=0.7:desat=0", *coded],
        "Reinhard, 203 cd/m2": [*linear, "tonemap=reinhard:desat=0", *coded],
        "Hable, 203 cd/m2": [*linear, "tonemap=hable:desat=0", *coded],
        "BT.2446 method A": [*as_pq, f"lut3d=file={folder / 'bt2446.cube'}:interp=tetrahedral"],
        "as HLG on an SDR screen": sdr_filters(kind, folder / "pq.cube"),
    }


def first_frame(clip: Path, filters: list[str]) -> Pixels:
    """A frame of the clip as R'G'B', of the chart's size."""
    height, width, _ = scene().shape
    command = [ffmpeg_executable(), "-nostdin", "-loglevel", "error", "-i", str(clip)]
    command += ["-vf", ",".join([*filters, "format=gbrp", "format=rgb24"]), "-frames:v", "1"]
    done = subprocess.run(
        [*command, "-f", "rawvideo", "pipe:1"], check=True, capture_output=True, timeout=120
    )
    return np.frombuffer(done.stdout, np.uint8).reshape(height, width, 3)


def labelled(pictures: dict[str, Pixels]) -> PIL.Image.Image:
    """Pictures in rows of three, each under its name."""
    height, width, _ = next(iter(pictures.values())).shape
    rows = (len(pictures) + 2) // 3
    sheet = PIL.Image.new("RGB", (3 * width, rows * (height + 20)), (0, 0, 0))
    draw = PIL.ImageDraw.Draw(sheet)
    for place, (name, pixels) in enumerate(pictures.items()):
        corner = (place % 3 * width, place // 3 * (height + 20))
        draw.text((corner[0] + 4, corner[1] + 4), name, fill=(255, 255, 255))
        sheet.paste(PIL.Image.fromarray(pixels), (corner[0], corner[1] + 20))
    return sheet


def main(folder: Path) -> None:
    """Print the table, and write `hdr_hlg.png` and `hdr_pq.png` into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    twin_pixels = first_frame(
        write_clip(folder / "sdr.mp4", "sdr"), ["scale=in_color_matrix=bt709"]
    )
    twin = read_chart(twin_pixels)
    print("| clip, way | contrast of the six walls | at 0.77 | hue: mean, most | chroma | dE |")
    print("|---|---|---|---|---|---|")

    def row(name: str, pixels: Pixels) -> None:
        seen = read_chart(pixels)
        turned = seen.hue_errors_deg(twin)
        contrast = ", ".join(f"{value:.1f}" for value in seen.contrast)
        wall = ", ".join(f"{value:.0f}" for value in seen.wall_levels[3])
        chroma = (seen.chroma() / twin.chroma()).mean()
        apart = np.linalg.norm(seen.swatches - twin.swatches, axis=1).mean()
        print(
            f"| {name} | {contrast} | {wall} | {turned.mean():.1f}, {turned.max():.1f} "
            f"| {chroma:.2f} | {apart:.1f} |"
        )

    row("the phone's SDR", twin_pixels)
    for kind in TRANSFERS:
        clip = write_clip(folder / f"{kind}.mp4", kind)
        pictures = {"the phone's SDR": twin_pixels}
        for name, filters in chains(folder, kind).items():
            pictures[name] = first_frame(clip, filters)
            row(f"{kind.upper()}, {name}", pictures[name])
        labelled(pictures).save(folder / f"hdr_{kind}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
