"""The evaluate stage: pictures of the held-out views beside the truth, and how close they are.

Reads `train/model.zip` and the images. Held-out views keep the poses of the capture, are rendered
with the mean appearance code at the size that was trained on, and nothing is fitted to them.
Writes `metrics.json` and `images/<name>.jpg`: truth | render | error.
"""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pipelines.cameras_file import PosedImage
from pipelines.errors import ExportError
from pipelines.nerf.data import load_images
from pipelines.nerf.metrics import psnr, ssim
from pipelines.options import EvaluateOptions
from pipelines.stage import StageContext
from pipelines.trained_scene import TrainedScene, as_uint8, nerf_errors_as

_ERROR_FULL_SCALE = 0.25
_ERROR_STOPS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_ERROR_COLORS = np.array(
    [[0, 0, 4], [87, 16, 110], [188, 55, 84], [249, 142, 9], [252, 255, 164]], np.float64
)
_PROTOCOL = (
    "Held-out images at equal intervals, never trained on; poses as the capture gave them; mean "
    "appearance code; no fitting at test time; PSNR of the mean squared error over all pixels and "
    "channels of an sRGB image in [0, 1]; SSIM with an 11x11 Gaussian window, sigma 1.5; the mean "
    "over images."
)
_NO_LPIPS = "LPIPS needs the weights of a pretrained network, which are not part of this program."


def run(options: EvaluateOptions, ctx: StageContext) -> dict[str, Any]:
    """Measure. The summary is the content of `metrics.json`; without held-out images it is null."""
    scene = TrainedScene.load(ctx.workspace.stage("train") / "model.zip")
    images = _picked(scene.test_images(), options.max_images)
    long_side = int(scene.extras["train"]["data"]["long_side_px"])
    (ctx.out / "images").mkdir(exist_ok=True)
    rows: list[dict[str, Any]] = []
    started = time.monotonic()
    for done, image in enumerate(images, start=1):
        truth, shown = _pair(scene, image, ctx.workspace.images_root, long_side)
        with nerf_errors_as(ExportError):
            row = {
                "file": image.file,
                "psnr": round(min(psnr(shown, truth), 100.0), 4),
                "ssim": round(ssim(shown, truth), 5),
                "width": truth.shape[1],
                "height": truth.shape[0],
            }
        rows.append(row)
        picture = side_by_side(truth.numpy(), shown.numpy())
        Image.fromarray(picture).save(
            ctx.out / "images" / f"{picture_name(image.file)}.jpg", quality=90
        )
        eta = (time.monotonic() - started) / done * (len(images) - done)
        ctx.progress(done / len(images), f"image {done}/{len(images)}, {row['psnr']:.1f} dB", eta)
    metrics = summarise(rows)
    (ctx.out / "metrics.json").write_text(json.dumps(metrics, indent=1), "utf-8")
    return metrics


def _picked(images: list[PosedImage], at_most: int) -> list[PosedImage]:
    """At most so many, evenly picked; 0 for all."""
    if not at_most or len(images) <= at_most:
        return images
    rows = np.unique(np.linspace(0, len(images) - 1, at_most).round().astype(int))
    return [images[row] for row in rows]


def _pair(
    scene: TrainedScene, image: PosedImage, root: Path, long_side: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Truth and render of one image, [H, W, 3] float32 in [0, 1] on the CPU."""
    with nerf_errors_as(ExportError):
        truth = load_images([root / image.file], long_side).image(0)
    pose = np.asarray(image.world_from_camera, np.float64)
    rendered = scene.render(scene.lens_of(image), pose, long_side).rgb
    shown = torch.as_tensor(rendered).detach().cpu().float().clamp(0.0, 1.0)
    if shown.shape != truth.shape:
        raise ExportError(
            f"{image.file} is {truth.shape[1]}x{truth.shape[0]}, its camera "
            f"{shown.shape[1]}x{shown.shape[0]}.",
            code="bad_image",
            hint="The image differs in size from its camera: start the job again.",
        )
    return truth, shown


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The content of `metrics.json` from rows of file, psnr, ssim, width, height."""
    mean = {
        key: round(float(np.mean([row[key] for row in rows])), 4) if rows else None
        for key in ("psnr", "ssim")
    }
    sizes = [(row["width"], row["height"]) for row in rows]
    width, height = max(sizes, key=sizes.count) if sizes else (0, 0)
    return {
        **mean,
        "lpips": None,
        "lpips_reason": _NO_LPIPS,
        "num_images": len(rows),
        "width": width,
        "height": height,
        "protocol": _PROTOCOL,
        "per_image": [{key: row[key] for key in ("file", "psnr", "ssim")} for row in rows],
    }


def side_by_side(truth: NDArray[np.float32], shown: NDArray[np.float32]) -> NDArray[np.uint8]:
    """[H, 3 W, 3] uint8: truth, render, and the mean absolute error, dark to bright at 0.25."""
    error = np.abs(truth - shown).mean(axis=-1) / _ERROR_FULL_SCALE
    heat = np.stack(
        [np.interp(error, _ERROR_STOPS, _ERROR_COLORS[:, channel]) for channel in range(3)], axis=-1
    )
    return np.concatenate(
        (as_uint8(truth), as_uint8(shown), np.rint(heat).astype(np.uint8)), axis=1
    )


def picture_name(file: str) -> str:
    """A flat file name from an image's path: `images/a/b.png` -> `a_b`."""
    stem = re.sub(r"\.[^./]+$", "", file).removeprefix("images/")
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._") or "image"
