"""The pictures of the capture report, as SVG and inline JPEG: no script, nothing from outside.

Charts have no text in them: they stretch with the page, and text beside them stays readable on a
phone.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from PIL import Image

from pipelines.filming.around import NUM_SECTORS, Around

Floats = npt.NDArray[np.float64]

GOOD, LOST, INK, FAINT = "#1f9d61", "#d64545", "#1d2733", "#c9d1da"
_MAP_PX = 640
_MARGIN = 0.18
_MAX_PATH = 600


def inline_jpeg(picture: Image.Image, long_side_px: int) -> str:
    """A picture as a data URL, reduced."""
    small = picture.convert("RGB")
    small.thumbnail((long_side_px, long_side_px))
    out = io.BytesIO()
    small.save(out, "JPEG", quality=70, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(out.getvalue()).decode()


@dataclass(frozen=True)
class Curve:
    """A line over the capture. values: one a picture, None where unknown. limit: a level to mark.

    top: of the scale; bottom: likewise.
    """

    values: Sequence[float | None]
    bottom: float
    top: float
    limit: float | None = None


def chart(places: Sequence[float], lost: Sequence[bool], curve: Curve) -> str:
    """A curve over `places` in [0, 1], with the pictures that are lost shaded."""
    height = 100.0
    span = max(curve.top - curve.bottom, 1e-9)

    def level(value: float) -> float:
        return height - 4 - (height - 8) * min(max((value - curve.bottom) / span, 0.0), 1.0)

    parts = [_bands(places, lost, height)]
    if curve.limit is not None and curve.bottom <= curve.limit <= curve.top:
        y = level(curve.limit)
        parts.append(
            f'<line x1="0" x2="1000" y1="{y:.1f}" y2="{y:.1f}" stroke="{LOST}" '
            'stroke-dasharray="4 4" vector-effect="non-scaling-stroke"/>'
        )
    run: list[str] = []
    lines: list[list[str]] = []
    for place, value in zip(places, curve.values, strict=True):
        if value is None:
            run = []
            continue
        if not run:
            lines.append(run)
        run.append(f"{1000 * place:.1f},{level(value):.1f}")
    for line in lines:
        if len(line) == 1:  # a line of no length is drawn as a dot, by its round ends
            line.append(line[0])
        parts.append(
            f'<polyline points="{" ".join(line)}" fill="none" stroke="{INK}" stroke-width="1.6" '
            'stroke-linecap="round" stroke-linejoin="round" vector-effect="non-scaling-stroke"/>'
        )
    return (
        f'<svg class="chart" viewBox="0 0 1000 {height:.0f}" preserveAspectRatio="none" '
        f'aria-hidden="true">{"".join(parts)}</svg>'
    )


def ribbon(places: Sequence[float], placed: Sequence[bool | None]) -> str:
    """One stroke a picture: green with a pose, red without, grey where nobody knows."""
    edges = _edges(places)
    colors = {True: GOOD, False: LOST, None: FAINT}
    parts = "".join(
        f'<rect x="{1000 * left:.1f}" width="{1000 * (right - left) + 0.4:.1f}" y="0" height="20" '
        f'fill="{colors[one]}"/>'
        for left, right, one in zip(edges, edges[1:], placed, strict=False)
    )
    return (
        '<svg class="ribbon" viewBox="0 0 1000 20" preserveAspectRatio="none" '
        f'aria-hidden="true">{parts}</svg>'
    )


def _edges(places: Sequence[float]) -> list[float]:
    middles = [(a + b) / 2 for a, b in pairwise(places)]
    return [0.0, *middles, 1.0]


def _bands(places: Sequence[float], lost: Sequence[bool], height: float) -> str:
    edges = _edges(places)
    return "".join(
        f'<rect x="{1000 * left:.1f}" width="{1000 * (right - left) + 0.4:.1f}" y="0" '
        f'height="{height:.0f}" fill="{LOST}" fill-opacity=".14"/>'
        for left, right, is_lost in zip(edges, edges[1:], lost, strict=False)
        if is_lost
    )


def top_view(
    poses: Floats,
    posed: Sequence[int],
    points: Floats,
    colors: npt.NDArray[np.uint8],
    focus: Floats | None,
) -> str:
    """The capture from above: sparse points, the path, where each camera looks.

    poses: [N, 3, 4], N >= 1, world +Z up. posed: [N], their places in the capture: the path is
    drawn where they follow each other. points: [P, 3] with colors: [P, 3].
    """
    step = max(1, math.ceil(len(poses) / _MAX_PATH))
    poses, posed = poses[::step], list(posed)[::step]
    seen = poses[:, :2, 3] if focus is None else np.vstack([poses[:, :2, 3], focus[None, :2]])
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    half = max(float(np.ptp(seen, axis=0).max()) / 2, 1e-6) * (1 + 2 * _MARGIN)
    if focus is None and len(points) >= 10:
        near = np.percentile(np.abs(points[:, :2] - middle).max(axis=1), 60)
        half = max(half, min(float(near), 4 * half))
    scale = _MAP_PX / 2 / half

    def place(at: Floats) -> tuple[float, float]:
        return (
            _MAP_PX / 2 + scale * float(at[0] - middle[0]),
            _MAP_PX / 2 - scale * float(at[1] - middle[1]),
        )

    parts = [
        f'<image width="{_MAP_PX}" height="{_MAP_PX}" href="{_cloud(points, colors, place)}"/>'
    ]
    parts += _path([place(pose[:2, 3]) for pose in poses], posed, step)
    for pose in poses:
        x, y = place(pose[:2, 3])
        ahead = -pose[:2, 2]
        length = 22.0
        parts.append(
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + length * ahead[0]:.1f}" '
            f'y2="{y - length * ahead[1]:.1f}" stroke="{GOOD}" stroke-width="1.5"/>'
        )
    for pose in poses:
        x, y = place(pose[:2, 3])
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.6" fill="{GOOD}"/>')
    x, y = place(poses[0][:2, 3])
    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="8" fill="none" stroke="{INK}" ')
    parts.append('stroke-width="2.5"/>')
    if focus is not None:
        x, y = place(focus[:2])
        parts.append(
            f'<path d="M{x - 9:.1f} {y:.1f}h18M{x:.1f} {y - 9:.1f}v18" stroke="{INK}" '
            'stroke-width="2.5"/>'
        )
    return (
        f'<svg class="map" viewBox="0 0 {_MAP_PX} {_MAP_PX}" role="img" '
        f'aria-label="The capture from above">{"".join(parts)}</svg>'
    )


def _path(places: list[tuple[float, float]], posed: Sequence[int], step: int) -> list[str]:
    """The way of the camera; it is broken where pictures between have no pose."""
    parts = []
    for i in range(1, len(places)):
        (x, y), (to_x, to_y) = places[i - 1], places[i]
        gap = posed[i] - posed[i - 1] > step
        style = f'stroke="{LOST}" stroke-dasharray="5 5"' if gap else f'stroke="{INK}"'
        parts.append(
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" {style} '
            'stroke-width="1.4" stroke-opacity=".65"/>'
        )
    return parts


def _cloud(points: Floats, colors: npt.NDArray[np.uint8], place: object) -> str:
    """The sparse points from above, the highest last, as a picture."""
    canvas = np.full((_MAP_PX, _MAP_PX, 3), 255, np.uint8)
    order = np.argsort(points[:, 2]) if len(points) else np.zeros(0, np.int64)
    assert callable(place)
    for index in order:
        x, y = place(points[index, :2])
        if 1 <= x < _MAP_PX - 2 and 1 <= y < _MAP_PX - 2:
            canvas[int(y) : int(y) + 3, int(x) : int(x) + 3] = 96 + colors[index] * (150 / 255)
    out = io.BytesIO()
    Image.fromarray(canvas).quantize(64).save(out, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def directions(around: Around) -> str:
    """Where the cameras stood as seen from the subject: angle by azimuth, radius by elevation.

    The rim is green where the subject was seen from, red elsewhere.
    """
    size, rim, inner = 320, 148, 128
    middle = size / 2
    parts = [
        f'<circle cx="{middle}" cy="{middle}" r="{radius}" fill="none" stroke="{FAINT}"/>'
        for radius in (inner / 3, inner * 2 / 3, inner)
    ]
    for sector, covered in enumerate(around.covered):
        begin, end = (math.radians(360.0 / NUM_SECTORS * (sector + edge)) for edge in (0.06, 0.94))
        corners = [
            (middle + radius * math.cos(angle), middle - radius * math.sin(angle))
            for radius, angle in ((inner + 4, begin), (rim, begin), (rim, end), (inner + 4, end))
        ]
        outline = "L".join(f"{x:.1f} {y:.1f}" for x, y in corners)
        parts.append(f'<path d="M{outline}Z" fill="{GOOD if covered else LOST}"')
        parts.append(f' fill-opacity="{1.0 if covered else 0.35}"/>')
    for azimuth, elevation in zip(around.azimuth, around.elevation, strict=True):
        radius = inner * (90.0 - min(max(elevation, 0.0), 90.0)) / 90.0
        angle = math.radians(azimuth)
        x, y = middle + radius * math.cos(angle), middle - radius * math.sin(angle)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.4" fill="{INK}" fill-opacity=".7"/>')
    return (
        f'<svg class="rose" viewBox="0 0 {size} {size}" role="img" '
        f'aria-label="Directions that the subject was seen from">{"".join(parts)}</svg>'
    )
