"""Held-out metrics of a tiny trained model."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from pipelines.stages.evaluate import picture_name, side_by_side, summarise
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


def test_metrics_are_those_of_the_pictures_shown(job: Workspace) -> None:
    metrics = tiny_job.run(job, "evaluate")["summary"]
    assert metrics == json.loads((job.stage("evaluate") / "metrics.json").read_text())
    assert metrics["num_images"] == len(metrics["per_image"]) == 5
    assert (metrics["width"], metrics["height"]) == (36, 64)
    assert metrics["lpips"] is None
    assert metrics["lpips_reason"]
    assert metrics["psnr"] > 9.0
    assert metrics["psnr"] == pytest.approx(
        np.mean([row["psnr"] for row in metrics["per_image"]]), abs=1e-3
    )
    for row in metrics["per_image"]:
        name = picture_name(row["file"])
        with Image.open(job.stage("evaluate") / "images" / f"{name}.jpg") as opened:
            picture = np.asarray(opened)
        assert picture.shape == (64, 3 * 36, 3)
        truth, shown = picture[:, :36], picture[:, 36:72]
        # The picture is a JPEG of 8 bits, so the numbers agree only roughly.
        assert peak_signal_noise_ratio(truth, shown) == pytest.approx(row["psnr"], abs=0.7)


def test_held_out_images_were_not_trained_on(job: Workspace) -> None:
    metrics = tiny_job.run(job, "evaluate", max_images=2)["summary"]
    cameras = json.loads((job.stage("train") / "cameras.json").read_text())
    split = {image["file"]: image["split"] for image in cameras["images"]}
    assert [split[row["file"]] for row in metrics["per_image"]] == ["test", "test"]


def test_nothing_held_out_gives_empty_metrics_and_no_error() -> None:
    metrics = summarise([])
    assert metrics["psnr"] is None
    assert metrics["num_images"] == 0
    assert metrics["per_image"] == []


def test_the_error_map_is_dark_where_right_and_bright_where_wrong() -> None:
    truth = np.zeros((4, 6, 3), np.float32)
    shown = truth.copy()
    shown[:, 3:] = 0.5
    heat = side_by_side(truth, shown)[:, 12:]
    assert heat[0, 0].max() < 10
    assert heat[0, 5].min() > 150


def test_picture_names_are_flat_and_safe() -> None:
    assert picture_name("images/a/b c.png") == "a_b_c"
    assert picture_name("../x.jpg") == "x"
