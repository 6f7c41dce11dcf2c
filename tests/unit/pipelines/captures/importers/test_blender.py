"""Blender's synthetic scenes: all splits, exact poses, transparent becomes white."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.catalogue import IMPORTERS
from pipelines.captures.sniff import sniff
from pipelines.registry import skipped_stages
from tests.unit.pipelines.captures.archives import nerfstudio_files, picture, pose, write_zip
from tests.unit.pipelines.captures.ingesting import (
    Files,
    cameras,
    code_of,
    ingest,
    sources,
    warning_with,
)

ANGLE = 2 * math.atan(0.5 * 64 / 80.0)  # a focal length of 80 px


def rgba(seed: int) -> bytes:
    """A picture 64x48 of noise, its upper left quarter red and transparent."""
    pixels = np.random.default_rng(seed).integers(0, 256, (48, 64, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[:24, :32] = (255, 0, 0, 0)
    stream = io.BytesIO()
    PIL.Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def blender_files(root: str = "", **counts: int) -> Files:
    """A scene; camera n of split number s is at (n, s, 4)."""
    files: Files = {}
    for row, (split, count) in enumerate(counts.items()):
        frames = [
            {
                "file_path": f"./{split}/r_{n}",
                "rotation": 0.01,
                "transform_matrix": pose(float(n), float(row), 4.0),
            }
            for n in range(count)
        ]
        top = {"camera_angle_x": ANGLE, "frames": frames}
        files[f"{root}transforms_{split}.json"] = json.dumps(top)
        files |= {f"{root}{split}/r_{n}.png": rgba(10 * row + n) for n in range(count)}
    return files


def test_all_splits_become_one_posed_capture(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, blender_files(train=3, val=2, test=2))
    file = cameras(ctx)
    assert (summary["kind"], summary["num_posed"], summary["warnings"]) == ("blender", 7, [])
    assert skipped_stages("blender") == {"frames"}
    assert sources(ctx)[2:4] == ["train/r_2.png", "val/r_0.png"]
    places = [[row[3] for row in image.world_from_camera] for image in file.images]
    assert places == [[n, s, 4] for s, count in enumerate((3, 2, 2)) for n in range(count)]
    (lens,) = file.cameras
    assert (lens.model, lens.fl_x, lens.fl_y) == (
        "PINHOLE",
        pytest.approx(80.0),
        pytest.approx(80.0),
    )
    assert (lens.cx, lens.cy, file.metric) == (32.0, 24.0, False)
    assert file.notes["splits"] == {"train": 3, "val": 2, "test": 2}


def test_the_world_is_kept_and_its_up_is_z(tmp_path: Path) -> None:
    files = blender_files(train=4)
    turned: list[list[float]] = [[0.6, 0, 0.8, 1], [0.8, 0, -0.6, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    top = json.loads(str(files["transforms_train.json"]))
    top["frames"][1]["transform_matrix"] = turned
    _, ctx = ingest(tmp_path, files | {"transforms_train.json": json.dumps(top)})
    kept = np.array(cameras(ctx).images[1].world_from_camera)
    np.testing.assert_allclose(kept, turned[:3], atol=1e-12)


def test_what_is_transparent_becomes_white_and_the_notes_say_so(tmp_path: Path) -> None:
    _, ctx = ingest(tmp_path, blender_files(train=4))
    assert cameras(ctx).notes["transparency"] == "blended on white"
    with PIL.Image.open(ctx.out / cameras(ctx).images[0].file) as image:
        assert image.mode == "RGB"
        assert image.getpixel((5, 5)) == (255, 255, 255)
        assert image.getpixel((5, 40)) != (255, 255, 255)


@pytest.mark.parametrize("root", ["", "lego/", "some/where/deep/"])
@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_recognised_by_any_split_in_any_nesting(tmp_path: Path, root: str, split: str) -> None:
    path = write_zip(tmp_path / "c", blender_files(root, **{split: 4}))
    found = sniff(path, "c.zip")
    assert (found.kind, found.claim.root) == ("blender", root)


def test_transforms_json_beside_comes_first(tmp_path: Path) -> None:
    kinds = [importer.kind for importer in IMPORTERS]
    assert kinds.index("nerfstudio") < kinds.index("blender")
    path = write_zip(tmp_path / "c", blender_files(train=4) | nerfstudio_files(4))
    assert sniff(path, "c.zip").kind == "nerfstudio"


def test_depth_and_normals_of_the_renderer_are_left_and_told(tmp_path: Path) -> None:
    files = blender_files(train=4, test=2)
    files |= {f"test/r_{n}_depth_0001.png": picture(kind="PNG") for n in range(2)}
    summary, _ = ingest(tmp_path, files)
    assert summary["num_posed"] == 6
    assert warning_with(summary, "2 pictures in test/", "not listed in any transforms_*.json")


def test_a_split_without_frames_is_no_harm(tmp_path: Path) -> None:
    summary, _ = ingest(tmp_path, blender_files(train=4, val=0))
    assert summary["num_posed"] == 4


@pytest.mark.parametrize(
    ("top", "code"),
    [
        ({"frames": []}, "poses_missing"),
        ({"frames": 3}, "poses_missing"),
        ({"camera_angle_x": None}, "poses_malformed"),
        ({"camera_angle_x": 4.0}, "poses_malformed"),
    ],
)
def test_unusable_scenes_are_refused(tmp_path: Path, top: dict[str, Any], code: str) -> None:
    files = blender_files(train=4)
    known = json.loads(str(files["transforms_train.json"]))
    files["transforms_train.json"] = json.dumps(known | top)
    assert code_of(tmp_path, files) == code


def with_times(times: list[Any]) -> Files:
    files = blender_files(train=len(times))
    top = json.loads(str(files["transforms_train.json"]))
    for frame, time in zip(top["frames"], times, strict=True):
        frame["time"] = time
    return files | {"transforms_train.json": json.dumps(top)}


def test_times_of_a_moving_scene_are_kept_and_told(tmp_path: Path) -> None:
    """D-NeRF's frames, field for field: nobody may take the result for a model of the motion."""
    summary, ctx = ingest(tmp_path, with_times([0.0, 0.25, 0.5, 0.75, 1.0]))
    assert "Motion is not modelled" in warning_with(summary, "5 different times (0 to 1)")
    assert [image.timestamp_s for image in cameras(ctx).images] == [0.0, 0.25, 0.5, 0.75, 1.0]
    notes = cameras(ctx).notes
    assert (notes["times"], notes["motion"]) == ([0.0, 1.0], "not modelled")


def test_one_moment_is_no_motion(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, with_times([0.5] * 5))
    assert summary["warnings"] == []
    assert "motion" not in cameras(ctx).notes


@pytest.mark.parametrize(
    "time", [None, "later", float("nan"), True, [0.5], pytest.param(10**400, id="10**400")]
)
def test_a_time_that_is_none_costs_its_frame(tmp_path: Path, time: Any) -> None:
    summary, _ = ingest(tmp_path, with_times([n / 10 for n in range(10)] + [time]))
    assert summary["num_posed"] in (10, 11)
    assert warning_with(summary, "Motion is not modelled")


def test_splits_that_list_the_same_pictures_count_once(tmp_path: Path) -> None:
    """By their bytes, or by their pixels where one was packed anew; with one pose."""
    files = blender_files(train=6)
    frames = json.loads(files["transforms_train.json"])["frames"]
    for split in ("val", "test"):
        for frame in frames:
            name = frame["file_path"].removeprefix("./train/")
            files[f"{split}/{name}.png"] = files[f"train/{name}.png"]
        again = [
            {**frame, "file_path": frame["file_path"].replace("train", split)} for frame in frames
        ]
        files[f"transforms_{split}.json"] = json.dumps({"camera_angle_x": ANGLE, "frames": again})
    stream, whole = io.BytesIO(), files["test/r_0.png"]
    assert isinstance(whole, bytes)
    PIL.Image.open(io.BytesIO(whole)).save(stream, "PNG", compress_level=1)
    files["test/r_0.png"] = stream.getvalue()
    summary, ctx = ingest(tmp_path, files)
    assert sources(ctx) == [f"train/r_{n}.png" for n in range(6)]
    assert warning_with(summary, "6 pictures in val/", "6 pictures in test/", "with the same pose")


def test_the_same_picture_with_another_pose_counts(tmp_path: Path) -> None:
    files = blender_files(train=5, val=5)
    files |= {f"val/r_{n}.png": files[f"train/r_{n}.png"] for n in range(5)}
    _, ctx = ingest(tmp_path, files)
    assert len(sources(ctx)) == 10
