"""Photos of the whole sphere are told by their XMP, and cut into views."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.panorama_files import photo_projection
from pipelines.options import IngestOptions
from pipelines.sfm.source import camera_groups, read_source
from tests.unit.pipelines.captures.archives import picture
from tests.unit.pipelines.captures.ingesting import Files, code_of, ingest

HEAD = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
)


def attributes(**values: object) -> bytes:
    listed = " ".join(f'GPano:{key}="{value}"' for key, value in values.items())
    return f"{HEAD} {listed}/></rdf:RDF></x:xmpmeta>".encode()


def elements(**values: object) -> bytes:
    listed = "".join(f"<GPano:{key}>{value}</GPano:{key}>" for key, value in values.items())
    return f"{HEAD}>{listed}</rdf:Description></rdf:RDF></x:xmpmeta>".encode()


def panorama(seed: int, xmp: bytes = b"", size: tuple[int, int] = (512, 256)) -> bytes:
    """A JPEG of random patches with that XMP."""
    patches = np.random.default_rng(seed).integers(0, 255, (16, 32, 3), np.uint8)
    buffer = io.BytesIO()
    options = {"xmp": xmp} if xmp else {}
    PIL.Image.fromarray(patches).resize(size).save(buffer, "JPEG", quality=95, **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("xmp", "found"),
    [
        (attributes(ProjectionType="equirectangular"), "equirectangular"),
        (elements(ProjectionType="equirectangular", FullPanoWidthPixels=512), "equirectangular"),
        (
            attributes(
                ProjectionType="equirectangular",
                FullPanoWidthPixels=512,
                CroppedAreaImageWidthPixels=512,
                FullPanoHeightPixels=256,
                CroppedAreaImageHeightPixels=256,
            ),
            "equirectangular",
        ),
        (
            elements(
                ProjectionType="equirectangular",
                FullPanoWidthPixels=1024,
                CroppedAreaImageWidthPixels=512,
            ),
            "",
        ),
        (attributes(ProjectionType="cylindrical"), ""),
        (b"", ""),
        (b"\xff\xfe GPano:ProjectionType=", ""),
    ],
)
def test_a_photo_says_that_it_is_a_whole_sphere(xmp: bytes, found: str) -> None:
    with PIL.Image.open(io.BytesIO(panorama(0, xmp))) as image:
        assert photo_projection(image) == found


def test_photos_of_the_sphere_are_cut_beside_plain_ones(tmp_path: Path) -> None:
    sphere = attributes(ProjectionType="equirectangular")
    files: Files = {f"{n}.jpg": panorama(n, sphere) for n in range(6)}
    files |= {f"{n}.jpg": picture(400, 300, seed=n) for n in range(6, 9)}
    files["9.jpg"] = panorama(9)
    _, ctx = ingest(tmp_path, files)
    listed = json.loads((ctx.out / "capture.json").read_text())["images"]
    assert [image["file"].split("/")[0] for image in listed] == ["panoramas"] * 6 + ["images"] * 4
    assert listed[2]["views"] == [f"images/00003_{view}.jpg" for view in (1, 2, 3, 4)]
    assert len(list((ctx.out / "images").iterdir())) == 6 * 4 + 4
    ctx.out.rename(ctx.workspace.stage("ingest"))
    source = read_source(ctx.workspace)
    groups = camera_groups(source, "SIMPLE_RADIAL")
    assert [(group.lens, group.indices) for group in groups] == [
        ("EQUIRECTANGULAR", (0, 1, 2, 3, 4, 5)),
        ("SIMPLE_RADIAL", (6, 7, 8)),
        ("SIMPLE_RADIAL", (9,)),
    ]


def test_all_photos_are_panoramas_where_the_options_say_so(tmp_path: Path) -> None:
    files: Files = {f"{n}.jpg": panorama(n) for n in range(8)}
    told = IngestOptions(projection="equirectangular", panorama_views=5)
    _, ctx = ingest(tmp_path / "a", files, told)
    assert len(list((ctx.out / "images").iterdir())) == 8 * 5
    sphere = attributes(ProjectionType="equirectangular")
    _, ctx = ingest(
        tmp_path / "b",
        {f"{n}.jpg": panorama(n, sphere) for n in range(8)},
        IngestOptions(projection="flat"),
    )
    assert len(list((ctx.out / "images").iterdir())) == 8
    flat: Files = {f"{n}.jpg": picture(400, 300, seed=n) for n in range(8)}
    assert code_of(tmp_path / "c", flat, told) == "image_undecodable"
