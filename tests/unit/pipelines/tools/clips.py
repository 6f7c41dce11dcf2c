"""Small real videos for the tests, made by the ffmpeg that the product uses."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

import numpy as np
import PIL.Image

from pipelines.tools.ffmpeg import ffmpeg_executable

SOURCE = "testsrc2=s=320x180:r=30:d=2"


def ffmpeg(*arguments: str | Path) -> None:
    command = [ffmpeg_executable(), "-nostdin", "-hide_banner", "-loglevel", "error", "-y"]
    subprocess.run([*command, *map(str, arguments)], check=True, capture_output=True)


def make_clip(path: Path, source: str = SOURCE, *options: str) -> Path:
    ffmpeg("-f", "lavfi", "-i", source, "-pix_fmt", "yuv420p", *options, path)
    return path


def rotated(clip: Path, path: Path, degrees: int) -> Path:
    """The same clip with a display matrix that asks players to turn it clockwise."""
    ffmpeg("-display_rotation", str(-degrees), "-i", clip, "-c", "copy", path)
    return path


def spherical(clip: Path) -> Path:
    """The MP4 with Google's Spherical Video V1 metadata in its track; moov lies at the end."""
    xml = (
        b'<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-'
        b'syntax-ns#" xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
        b"<GSpherical:Spherical>true</GSpherical:Spherical>"
        b"<GSpherical:Stitched>true</GSpherical:Stitched>"
        b"<GSpherical:StitchingSoftware>test</GSpherical:StitchingSoftware>"
        b"<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType>"
        b"</rdf:SphericalVideo>"
    )
    body = bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + xml
    box = struct.pack(">I", 8 + len(body)) + b"uuid" + body
    data = bytearray(clip.read_bytes())
    assert data.index(b"mdat") < data.index(b"moov"), "offsets into mdat must not move"
    track = data.index(b"trak") - 4
    end = track + struct.unpack_from(">I", data, track)[0]
    for start in (track, data.index(b"moov") - 4):
        struct.pack_into(">I", data, start, struct.unpack_from(">I", data, start)[0] + len(box))
    data[end:end] = box
    clip.write_bytes(data)
    return clip


def marked_pictures(folder: Path, count: int, blurred: set[int]) -> None:
    """Pictures 320x192 of a texture, picture n with its number as 8 black or white squares."""
    texture = np.random.default_rng(0).integers(60, 200, (96, 160), np.uint8)
    folder.mkdir()
    for n in range(count):
        base = PIL.Image.fromarray(np.roll(texture, n, axis=1)).resize((320, 192), 0)
        if n in blurred:
            base = base.resize((20, 12), PIL.Image.Resampling.BOX).resize((320, 192))
        pixels = np.array(base)
        for bit in range(8):
            pixels[:32, bit * 40 : bit * 40 + 40] = 255 if n >> bit & 1 else 0
        PIL.Image.fromarray(pixels).save(folder / f"{n:04d}.png")


def number_in(path: Path) -> int:
    """The number that `marked_pictures` wrote into a picture."""
    with PIL.Image.open(path) as image:
        pixels = np.asarray(image.convert("L").resize((320, 192)))
    return sum(
        int(pixels[8:24, bit * 40 + 12 : bit * 40 + 28].mean() > 128) << bit for bit in range(8)
    )


HDR = {"hlg": "arib-std-b67", "pq": "smpte2084"}


def make_hdr_clip(
    path: Path, kind: str, color: str = "0x3060c0", only_transfer: bool = False
) -> Path:
    """A 10-bit BT.2020 HEVC clip of one SDR colour, graded as `kind`."""
    transfer = HDR[kind]
    sdr = "colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1:range=tv"
    grade = (
        f"scale=out_color_matrix=bt709,format=yuv444p,setparams={sdr},"
        "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt2020,"
        f"zscale=t={transfer}:m=bt2020nc:r=limited:npl=203,format=yuv420p10le"
    )
    tags = f"transfer={transfer}"
    if only_transfer:
        grade += ",setparams=colorspace=unknown:color_primaries=unknown"
    else:
        tags += ":colorprim=bt2020:colormatrix=bt2020nc"
    ffmpeg(
        "-f", "lavfi", "-i", f"color=c={color}:s=320x180:r=30:d=0.5,format=gbrp", "-vf", grade,
        "-c:v", "libx265", "-preset", "ultrafast", "-x265-params", f"log-level=error:{tags}",
        "-color_trc", transfer, "-tag:v", "hvc1", path,
    )  # fmt: skip
    return path
