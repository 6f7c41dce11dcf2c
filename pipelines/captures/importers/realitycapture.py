"""RealityCapture's, now RealityScan's, "Internal/External camera parameters" (CSV) beside the
pictures.

    #cameras 24                                                   not always there
    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2    in any order, those from px on
    IMG_1.jpg,1.5,...                                             may be absent

RealityScan 2 has yaw, f_35mm, px_norm and py_norm in place of heading, f, px and py, taken to mean
the same.

Degrees: world_from_camera = Rz(-heading) Rx(pitch) Ry(roll), OpenGL camera, +Z up, place (x, y,
alt). f is that of a camera whose longer side is 36 mm; (px, py) is the principal point, from the
picture's middle, in units of its longer side; k1..k4 are radial, t1 and t2 our p1 and p2. The unit
is not known. No real export was at hand: the reading is that of nerfstudio and of brush.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, Rows
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.listed_pictures import match_pictures
from pipelines.captures.parsing import each_frame, malformed, missing
from pipelines.captures.unpack import CaptureArchive
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.natural_order import natural_key

_HEAD = re.compile(rb"(\xef\xbb\xbf)?(#cameras[^\r\n]*[\r\n]+)?#name\s*,([^\r\n]*)", re.IGNORECASE)
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_CALLED = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""RealityScan 2's names of columns."""
_FILM_MM = 36.0


def claims(listing: Listing) -> Claim | None:
    """An archive with such a table, the least deep one."""
    found = [
        (name.count("/"), name)
        for name, head in listing.heads.items()
        if listing.is_archive and _is_table(head)
    ]
    if not found:
        return None
    folder, _, file = min(found)[1].rpartition("/")
    return Claim(f"{folder}/" if folder else "", file)


def _is_table(head: bytes) -> bool:
    """Whether a file starts with names of columns that say where cameras are; the table itself may
    still lack others."""
    found = _HEAD.match(head)
    columns = {word.strip().lower() for word in re.split(rb"[,;\t]", found[3])} if found else set()
    return columns >= {b"x", b"y"} and not columns.isdisjoint({b"z", b"alt"})


@dataclass(frozen=True)
class _Row:
    """line: where it stands in the file. values: by the names of columns, as text."""

    line: int
    values: Mapping[str, str]


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures that the table lists. Raises CaptureError: poses_missing, poses_malformed."""
    name = claim.root + claim.why
    file = shown(name)
    rows = _rows(archive.read(name), file)
    if not rows:
        raise missing(f"{file} lists no cameras.")
    paths = [row.values["name"] for row in rows]
    matched = match_pictures(archive, file, paths, claim.root)
    by_path = {row.values["name"]: row for row in reversed(rows)}
    sources, failures = each_frame(
        archive,
        {picture: by_path[path] for path, picture in matched.found.items()},
        lambda picture, row: _source(picture, row, file),
    )
    return PosedPictures(
        sources=sorted(sources, key=lambda source: natural_key(source.name)),
        failures=failures,
        metric=False,
        up="assumed",
        notes={"world": "RealityCapture's, +Z up, of no known unit"},
        details={"num_listed": len(rows), "num_missing": len(matched.absent)},
        warnings=matched.warnings,
    )


def _rows(data: bytes, file: str) -> list[_Row]:
    text = data.decode("utf-8-sig", "replace")
    found = []
    header: list[str] | None = None
    try:
        reader = csv.reader(io.StringIO(text, newline=""))
        for words in reader:
            if not any(word.strip() for word in words):
                continue
            if header is None:
                if words[0].strip().lower().startswith("#cameras"):
                    continue
                header = _header(words, file)
            elif len(words) != len(header):
                raise malformed(
                    f"Line {reader.line_num} of {file} has {len(words)} columns, not {len(header)}."
                )
            else:
                values = dict(zip(header, (word.strip() for word in words), strict=True))
                found.append(_Row(reader.line_num, values))
    except csv.Error as error:
        raise malformed(f"{file} is no table: {error}.") from error
    return [row for row in found if row.values["name"]]


def _header(words: list[str], file: str) -> list[str]:
    named = [word.strip().lstrip("#").lower() for word in words]
    header = [_CALLED.get(name, name) if _CALLED.get(name) not in named else name for name in named]
    lacking = [name for name in _NEEDED if name not in header]
    if lacking:
        raise missing(
            f"{file} lacks the columns {', '.join(lacking)}.",
            'Export "Internal/External camera parameters" from RealityCapture or RealityScan.',
        )
    return header


def _source(picture: str, row: _Row, file: str) -> PosedSource:
    def value(name: str) -> float:
        text = row.values.get(name, "0") if name in _OPTIONAL else row.values[name]
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise malformed(f"{name} in line {row.line} of {file} is no finite number.")
        return number

    values = {name: value(name) for name in (*_NEEDED[1:], *_OPTIONAL)}
    place = (values["x"], values["y"], values["alt"])
    rotation = _rotation(values["heading"], values["pitch"], values["roll"])
    return PosedSource(
        name=picture,
        lens=partial(_lens, values),
        world_from_camera=tuple((*r, at) for r, at in zip(rotation, place, strict=True)),
    )


def _rotation(heading_deg: float, pitch_deg: float, roll_deg: float) -> Rows:
    """Rz(-heading) Rx(pitch) Ry(roll), rows [3, 3]."""
    z, x, y = (math.radians(value) for value in (-heading_deg, pitch_deg, roll_deg))
    cz, sz, cx, sx, cy, sy = (f(a) for a in (z, x, y) for f in (math.cos, math.sin))
    return (
        (cz * cy - sz * sx * sy, -sz * cx, cz * sy + sz * sx * cy),
        (sz * cy + cz * sx * sy, cz * cx, sz * sy - cz * sx * cy),
        (-cx * sy, sx, cx * cy),
    )


def _lens(values: Mapping[str, float], width: int, height: int) -> Intrinsics:
    side = max(width, height)
    terms = {name: values[name] for name in ("k1", "k2", "k3", "k4")}
    terms |= {"p1": values["t1"], "p2": values["t2"]}
    return Intrinsics(
        width=width,
        height=height,
        fl_x=values["f"] * side / _FILM_MM,
        fl_y=values["f"] * side / _FILM_MM,
        cx=values["px"] * side + width / 2,
        cy=values["py"] * side + height / 2,
        model="OPENCV" if any(terms.values()) else "PINHOLE",
        **terms,
    )


IMPORTER = Importer(
    kind="realitycapture",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.realitycapture:read",
)
