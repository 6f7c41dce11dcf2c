"""Each format written from the analytic scene, field for field, comes back to exact cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipelines.captures.sniff import sniff
from pipelines.options import IngestOptions
from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import CamerasFile
from pipelines.stages.ingest import run
from tests.app_writers import (
    write_kiri,
    write_llff,
    write_nerfcapture,
    write_replica,
    write_rgbd_list,
    write_scanner_app,
    write_scannet,
    write_seven_scenes,
    write_stray_scanner,
)
from tests.unit.pipelines.captures.archives import context
from tests.unit.pipelines.captures.depth_agreement import disagreement

Write = Callable[..., CamerasFile]


@pytest.mark.parametrize(
    ("kind", "write"),
    [
        ("3dscannerapp", write_scanner_app),
        ("rgbd", write_seven_scenes),
        ("rgbd", write_scannet),
        ("rgbd", write_replica),
        ("rgbd", write_rgbd_list),
        ("nerfstudio", write_nerfcapture),
        ("nerfstudio", write_kiri),
        ("stray-scanner", write_stray_scanner),
        ("llff", write_llff),
        ("llff", partial(write_llff, as_text=False)),
    ],
)
def test_poses_lenses_and_depth_are_those_of_the_scene(
    tmp_path: Path, kind: str, write: Write
) -> None:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    truth = write(ctx.workspace.capture_file)
    assert sniff(ctx.workspace.capture_file, "capture").kind == kind
    run(IngestOptions(), ctx)
    found = CamerasFile.load(ctx.out / "cameras.json")
    record = json.loads((ctx.out / "capture.json").read_text())
    assert [image["source"] for image in record["images"]] == [image.file for image in truth.images]
    assert found.metric == truth.metric
    for ours, true in zip(found.images, truth.images, strict=True):
        np.testing.assert_allclose(pose_matrix(ours), pose_matrix(true), atol=2e-6)
        lens, exact = found.cameras[ours.camera], truth.cameras[true.camera]
        assert (lens.width, lens.height) == (exact.width, exact.height)
        np.testing.assert_allclose(
            [lens.fl_x, lens.fl_y, lens.cx, lens.cy],
            [exact.fl_x, exact.fl_y, exact.cx, exact.cy],
            rtol=1e-6,
        )
    if any(image.depth for image in found.images):
        assert disagreement(found, ctx.out, 1) < 0.01
