"""A format is one file and one line of the catalogue; all else follows from it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.captures import catalogue
from pipelines.captures.contents import PosedPictures, PosedSource
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.sniff import sniff
from pipelines.captures.unpack import CaptureArchive
from pipelines.registry import skipped_stages
from pipelines.scene.cameras_file import Intrinsics
from tests.unit.pipelines.captures.archives import (
    llff_files,
    nerfstudio_files,
    picture,
    polycam_files,
    record3d_files,
    rgbd_files,
    scanner_app_files,
    write_zip,
)
from tests.unit.pipelines.captures.importers.test_blender import blender_files
from tests.unit.pipelines.captures.ingesting import Files, cameras, ingest, warning_with


def claims(listing: Listing) -> Claim | None:
    """A format of this test's own: `rail.json` holds the places of a camera on a rail."""
    roots = listing.roots_of("rail.json")
    return Claim(roots[0], "rail.json") if roots else None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """Pictures `<n>.jpg`, each at (places[n], 0, 0)."""
    places = archive.read_json(claim.root + "rail.json")
    return PosedPictures(
        sources=[
            PosedSource(
                name=f"{claim.root}{n}.jpg",
                lens=lambda width, height: Intrinsics(
                    width, height, 60.0, 60.0, width / 2, height / 2
                ),
                world_from_camera=((1, 0, 0, x), (0, 1, 0, 0), (0, 0, 1, 0)),
            )
            for n, x in enumerate(places)
        ],
        metric=True,
    )


RAIL = Importer(kind="rail", brings="poses", claims=claims, read=f"{__name__}:read")


def test_a_new_format_is_one_file_and_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files: Files = {f"my/scan/{n}.jpg": picture(seed=n) for n in range(5)}
    files |= {"my/scan/rail.json": json.dumps([0, 1, 2, 4]), "my/readme.txt": "x"}
    path = write_zip(tmp_path / "c", files)
    assert sniff(path, "c.zip").kind == "images"
    monkeypatch.setattr(catalogue, "IMPORTERS", (RAIL, *catalogue.IMPORTERS))
    assert sniff(path, "c.zip").kind == "rail"
    assert skipped_stages("rail") == {"frames"}
    summary, ctx = ingest(tmp_path / "job", files)
    file = cameras(ctx)
    assert (summary["kind"], file.source, file.metric) == ("rail", "rail", True)
    assert [image.world_from_camera[0][3] for image in file.images] == [0, 1, 2, 4]
    assert warning_with(summary, "1 picture (my/scan/4.jpg)", "1 text file (my/readme.txt)")


def test_precedence_is_the_order_of_the_catalogue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_zip(tmp_path / "c", polycam_files() | nerfstudio_files() | record3d_files())
    order = [importer.kind for importer in catalogue.IMPORTERS]
    assert sniff(path, "c").kind == min(("polycam", "nerfstudio", "record3d"), key=order.index)
    monkeypatch.setattr(catalogue, "IMPORTERS", catalogue.IMPORTERS[::-1])
    assert sniff(path, "c").kind == "images"


@pytest.mark.parametrize(
    ("kind", "files"),
    [
        ("nerfstudio", nerfstudio_files()),
        ("blender", blender_files(train=4)),
        ("record3d", {name.removeprefix("EXR_RGBD/"): d for name, d in record3d_files().items()}),
        ("polycam", polycam_files()),
        (
            "3dscannerapp",
            {name.removeprefix("All_Data/"): d for name, d in scanner_app_files(4).items()},
        ),
    ],
)
def test_bare_numbers_beside_a_format_that_names_its_pictures_take_nothing_from_it(
    tmp_path: Path, kind: str, files: Files
) -> None:
    """Converters leave LLFF's file and lists of poses beside what they were made from."""
    others = {**llff_files(4), **rgbd_files(4, "list"), **rgbd_files(4), **rgbd_files(4, "beside")}
    path = write_zip(tmp_path / "c", others | files)
    assert sniff(path, "c").kind == kind
    assert sniff(write_zip(tmp_path / "d", others), "c").kind == "llff"


def test_every_kind_has_its_stages_and_a_reader_where_it_needs_one() -> None:
    assert len(set(catalogue.KINDS)) == len(catalogue.IMPORTERS)
    for importer in catalogue.IMPORTERS:
        assert (
            skipped_stages(importer.kind)
            == {
                "film": frozenset(),
                "photos": {"frames"},
                "poses": {"frames"},
            }[importer.brings]
        )
        if importer.brings != "film":
            assert callable(catalogue.load_reader(importer))
    with pytest.raises(KeyError):
        catalogue.importer_of("nothing")


def test_the_least_deep_of_several_captures_is_read_and_the_others_are_told(
    tmp_path: Path,
) -> None:
    files = {f"b/{name}": data for name, data in nerfstudio_files(5).items()}
    files |= {f"a/deep/{name}": data for name, data in nerfstudio_files(4).items()}
    summary, ctx = ingest(tmp_path, files)
    assert len(cameras(ctx).images) == 5
    assert warning_with(summary, "4 pictures in a/deep/images/")
    assert warning_with(summary, "a/deep/transforms.json", "camera poses of nerfstudio")
