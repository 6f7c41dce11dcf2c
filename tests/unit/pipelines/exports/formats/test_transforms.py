"""transforms.json, read back by our own importer, and held against nerfstudio's rules."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.errors import ExportError
from pipelines.exports.formats.transforms import write_transforms
from pipelines.options import IngestOptions
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from pipelines.stages import ingest
from tests.unit.pipelines.captures.archives import context, picture, write_zip
from tests.unit.pipelines.exports.posed import FISHEYE, OPENCV, PINHOLE, posed

LENSES = [
    Intrinsics(64, 48, 51.25, 50.5, 31.75, 24.125),
    Intrinsics(48, 64, 61.0, 60.5, 24.7, 32.2, "OPENCV", 0.05, -0.08, 0.01, 0.0, -1e-3, 2e-4),
    Intrinsics(64, 64, 33.0, 33.1, 32.2, 31.7, "OPENCV_FISHEYE", 0.02, -0.01, 0.003, -0.0007),
]


def written(cameras: CamerasFile, folder: Path) -> dict[str, Any]:
    write_transforms(folder / "transforms.json", cameras)
    content: dict[str, Any] = json.loads((folder / "transforms.json").read_text("utf-8"))
    return content


def imported(cameras: CamerasFile, folder: Path) -> CamerasFile:
    """What `ingest` makes of a zip of the file and its pictures."""
    files: dict[str, bytes | str] = {"transforms.json": json.dumps(written(cameras, folder))}
    for image in cameras.images:
        lens = cameras.cameras[image.camera]
        files[image.file] = picture(lens.width, lens.height)
        if image.mask is not None:
            stream = io.BytesIO()
            PIL.Image.new("L", (lens.width, lens.height), 255).save(stream, "PNG")
            files[image.mask] = stream.getvalue()
    ctx = context(folder)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, files)
    ingest.run(IngestOptions(), ctx)
    return CamerasFile.load(ctx.out / "cameras.json")


@pytest.mark.parametrize(
    "lenses", [[LENSES[0]], [LENSES[1]], [LENSES[2]], LENSES[:2]], ids=lambda lenses: len(lenses)
)
def test_our_importer_reads_the_same_cameras(tmp_path: Path, lenses: list[Intrinsics]) -> None:
    metric = lenses != [LENSES[1]]
    cameras = dataclasses.replace(posed(*lenses, masks=True), metric=metric)
    back = imported(cameras, tmp_path)
    assert back.metric is metric
    assert len(back.images) == len(cameras.images)
    for image, found in zip(cameras.images, back.images, strict=True):
        np.testing.assert_allclose(found.world_from_camera, image.world_from_camera, atol=1e-12)
        assert found.timestamp_s == image.timestamp_s
        assert found.mask is not None
        wanted, lens = cameras.cameras[image.camera], back.cameras[found.camera]
        if len(lenses) > 1:  # one model for the whole file: a pinhole is an OPENCV of no terms
            wanted = dataclasses.replace(wanted, model="OPENCV")
        assert lens == wanted


def test_the_held_out_images_are_named(tmp_path: Path) -> None:
    content = written(posed(PINHOLE), tmp_path)
    held_out = [f"images/{number:05d}.jpg" for number in (4, 8, 12)]
    assert content["val_filenames"] == content["test_filenames"] == held_out
    files = {frame["file_path"] for frame in content["frames"]}
    assert set(content["train_filenames"]) == files - set(held_out)


def test_an_intrinsic_is_global_or_on_every_frame(tmp_path: Path) -> None:
    keys = {"w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"}
    one = written(posed(OPENCV), tmp_path)
    assert keys <= one.keys()
    assert not any(keys & frame.keys() for frame in one["frames"])
    two = written(posed(OPENCV, PINHOLE), tmp_path)
    assert not keys & two.keys()
    assert all(keys <= frame.keys() for frame in two["frames"])
    assert (one["camera_model"], two["camera_model"]) == ("OPENCV", "OPENCV")
    assert type(one["w"]) is int


def test_masks_stand_on_all_frames_or_on_none(tmp_path: Path) -> None:
    some = posed(PINHOLE, masks=True)
    bare = dataclasses.replace(some.images[0], mask=None)
    some = dataclasses.replace(some, images=(bare, *some.images[1:]))
    assert not any("mask_path" in frame for frame in written(some, tmp_path)["frames"])


def test_the_way_back_to_the_original_world_is_passed_on(tmp_path: Path) -> None:
    rows = [[1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
    notes = {"applied_transform": rows, "applied_scale": 0.25, "camera_optimizer": "off"}
    content = written(dataclasses.replace(posed(PINHOLE), notes=notes), tmp_path)
    assert (content["applied_transform"], content["applied_scale"]) == (rows, 0.25)
    assert content["orientation_override"] == "none"
    assert "camera_optimizer" not in content


def test_lenses_that_no_such_file_holds_together_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="one camera model") as caught:
        write_transforms(tmp_path / "transforms.json", posed(OPENCV, FISHEYE))
    assert caught.value.code == "format_cannot_hold"
    assert not list(tmp_path.iterdir())
