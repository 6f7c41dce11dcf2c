"""Small archives through the stage `ingest`, as every importer's tests want it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.sensor_depth import load_sensor_depth
from pipelines.stage import StageContext
from pipelines.stages.ingest import run
from tests.unit.pipelines.captures.archives import context, write_zip

Files = dict[str, bytes | str]


def ingest(
    tmp_path: Path, files: Mapping[str, bytes | str], options: IngestOptions | None = None
) -> tuple[dict[str, Any], StageContext]:
    """The stage's summary, and its context with what it wrote in `out`."""
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, files)
    return run(options or IngestOptions(), ctx), ctx


def failure(
    tmp_path: Path, files: Mapping[str, bytes | str], options: IngestOptions | None = None
) -> CaptureError:
    """The error that the stage refuses the archive with."""
    with pytest.raises(CaptureError) as caught:
        ingest(tmp_path, files, options)
    assert caught.value.message
    assert str(tmp_path) not in caught.value.message + caught.value.hint
    return caught.value


def code_of(
    tmp_path: Path, files: Mapping[str, bytes | str], options: IngestOptions | None = None
) -> str:
    """The code of that error."""
    return failure(tmp_path, files, options).code


def cameras(ctx: StageContext) -> CamerasFile:
    """The poses that the stage wrote."""
    return CamerasFile.load(ctx.out / "cameras.json")


def poses_as_sent(ctx: StageContext) -> NDArray[np.float64]:
    """The poses that the stage wrote, [N, 3, 4], in the world that they came in."""
    file = cameras(ctx)
    applied = np.array(file.notes.get("applied_transform", np.eye(3, 4).tolist()))
    poses = np.array([image.world_from_camera for image in file.images])
    poses[:, :, 3] -= applied[:, 3]
    sent: NDArray[np.float64] = applied[:, :3].T @ poses
    return sent


def depth_of(ctx: StageContext, index: int) -> NDArray[np.float32]:
    """The depth that the stage wrote beside picture `index`."""
    return load_sensor_depth(ctx.out / str(cameras(ctx).images[index].depth))


def sources(ctx: StageContext) -> list[str]:
    """Names in the archive of the pictures that were taken, in order."""
    record = json.loads((ctx.out / "capture.json").read_text())
    return [image["source"] for image in record["images"]]


def assert_poses(ctx: StageContext, truth: CamerasFile, atol: float = 1e-9) -> None:
    """Every picture has the pose that is true of it, in the world of the truth."""
    by_file = {image.file: pose_matrix(image)[:3] for image in truth.images}
    found = cameras(ctx).images
    assert len(found) == len(sources(ctx)) > 0
    for image, source in zip(found, sources(ctx), strict=True):
        np.testing.assert_allclose(image.world_from_camera, by_file[source], atol=atol)


def assert_lenses(ctx: StageContext, truth: CamerasFile, atol: float) -> None:
    """Every picture has the lens that is true of it, of the same model."""
    of = {image.file: truth.cameras[image.camera] for image in truth.images}
    for image, source in zip(cameras(ctx).images, sources(ctx), strict=True):
        lens, wanted = cameras(ctx).cameras[image.camera], of[source]
        assert lens.model == wanted.model
        for key in ("width", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"):
            assert getattr(lens, key) == pytest.approx(getattr(wanted, key), abs=atol), key


def warning_with(summary: Mapping[str, Any], *words: str) -> str:
    """The one warning that holds all the words."""
    (found,) = [text for text in summary["warnings"] if all(word in text for word in words)]
    return str(found)
