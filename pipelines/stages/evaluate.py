"""The evaluate stage: pictures of the held-out views beside the truth, and how close they are.

Reads `train/model.zip`, the images with their masks, and the maps of `depth` for how far cameras
look. Held-out views are rendered at the size that was trained on, with the capture's poses and the
mean appearance code, or, where the options ask for it, with what the test-time procedure fitted
(`pipelines.nerf.judging.test_time`); pixels that a mask leaves out are not measured. Where the
capture's light drifts and training levelled it, each half of a picture has the light that the other
half was measured to have. `protocol` says which of this was done. Writes `metrics.json` and
`images/<name>.jpg`: truth | render | error.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pipelines.errors import ExportError
from pipelines.nerf.data.images import ImageData, load_images
from pipelines.nerf.data.light import gain_between, in_the_light_of, levelled
from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.floaters import floater_measures, opacity_of_density
from pipelines.nerf.judging.lpips import Lpips, lpips_if_configured
from pipelines.nerf.judging.metrics import psnr, ssim
from pipelines.nerf.judging.off_path import off_path_cameras, view_targets
from pipelines.nerf.judging.protocol import protocol
from pipelines.nerf.judging.test_time import (
    FittedCodes,
    FittedPoses,
    fit_appearance,
    fit_poses,
    half_columns,
    other_half,
)
from pipelines.nerf.options.evaluate import EvaluateConfig
from pipelines.nerf.renderer import RenderedImage
from pipelines.nerf.space.cameras import Cameras
from pipelines.option_models import StageOptions
from pipelines.options import evaluate_config
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.trained_scene import TrainedScene, as_uint8, nerf_cameras, nerf_errors_as
from pipelines.stage import StageContext
from pipelines.workspace import Workspace

LPIPS_WEIGHTS, LPIPS_SHA256 = "NERFWORKS_LPIPS_WEIGHTS", "NERFWORKS_LPIPS_SHA256"
"""Environment: a file or URL, or several with commas between, and their sums."""
MEASURES = {"psnr": 4, "ssim": 5, "lpips": 5}
"""What is measured, and the decimals kept."""
MAX_PSNR = 100.0

_ERROR_FULL_SCALE = 0.25
_ERROR_STOPS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_ERROR_COLORS = np.array(
    [[0, 0, 4], [87, 16, 110], [188, 55, 84], [249, 142, 9], [252, 255, 164]], np.float64
)
_FIT_COST = 10
"""What a fitted pixel costs in pixels rendered, about: for the estimate of the time left."""
_FLOATER_COST = 20_000
"""What the mass before the training cameras costs, likewise."""


@dataclass(frozen=True)
class _Views:
    """The N held-out views that are measured, at the size that was trained on.

    poses: [N, 3, 4] float64, world; cameras: the same in scene space.
    """

    posed: list[PosedImage]
    images: ImageData
    cameras: Cameras
    poses: NDArray[np.float64]
    long_side: int


@dataclass(frozen=True)
class _Fits:
    """What the test-time procedure found; None for what was not asked for."""

    poses: FittedPoses | None = None
    codes: FittedCodes | None = None


class _Meter:
    """Progress over parts of the stage, each a share of the whole by what it costs."""

    def __init__(self, ctx: StageContext, costs: dict[str, float]) -> None:
        self._ctx = ctx
        self._costs = costs
        self._started = time.monotonic()

    def show(self, part: str, share: float, message: str) -> None:
        """`share` of a part is done, and all parts before it."""
        names = list(self._costs)
        before = sum(self._costs[name] for name in names[: names.index(part)])
        fraction = (before + share * self._costs[part]) / sum(self._costs.values())
        eta = None
        if fraction > 0.0:
            eta = (time.monotonic() - self._started) * (1.0 - fraction) / fraction
        self._ctx.progress(fraction, message, eta)

    def of(self, part: str, message: str) -> Callable[[float], None]:
        return lambda share: self.show(part, share, message)


def run(options: StageOptions, ctx: StageContext) -> dict[str, Any]:
    """Measure. The summary is the content of `metrics.json`; without held-out images it is null."""
    config = evaluate_config(options)
    scene = TrainedScene.load(
        ctx.workspace.stage("train") / "model.zip", config.render, ctx.memory_share
    )
    if next(scene.model.parameters()).device.type == "cpu":
        scene.model.set_engine("fast")  # fits and densities ask the model itself, no renderer
    (ctx.out / "images").mkdir(exist_ok=True)
    lpips, no_lpips = _lpips(config, ctx)
    views = _load_views(scene, config, ctx.workspace.images_root)
    meter = _Meter(ctx, _costs(views, config, scene))
    rows: list[dict[str, Any]] = []
    fits = _Fits()
    if views is not None:
        with nerf_errors_as(ExportError):
            fits = _fit(scene, views, config, ctx.seed, meter)
        poses = views.poses
        if fits.poses is not None:
            poses = fits.poses.moved(poses, scene.scene.scale)
        for index in range(len(views.posed)):
            rows.append(_measure_view(scene, views, index, poses[index], fits, lpips, ctx.out))
            shown = rows[-1]["psnr"]
            text = f"image {index + 1}/{len(views.posed)}"
            text += "" if shown is None else f", {shown:.1f} dB"
            meter.show("images", (index + 1) / len(views.posed), text)
    floaters, no_floaters = _floaters(scene, config, ctx, meter)
    metrics = {
        **summarise(rows),
        "lpips_reason": no_lpips,
        "lpips_backbone": None if lpips is None else lpips.backbone,
        "protocol": protocol(
            scene.extras["train"], config, has_codes(scene), levelled=scene.bend is not None
        ),
        "floaters": floaters,
        "floaters_reason": no_floaters,
    }
    (ctx.out / "metrics.json").write_text(json.dumps(metrics, indent=1), "utf-8")
    ctx.progress(1.0, "measured", 0.0)
    return metrics


def _load_views(scene: TrainedScene, config: EvaluateConfig, root: Path) -> _Views | None:
    """The held-out images, their masks and cameras; None where nothing was held out."""
    posed = scene.test_images(config.max_images)
    if not posed:
        return None
    long_side = int(scene.extras["train"]["data"]["long_side_px"])
    poses = np.asarray([image.world_from_camera for image in posed], np.float64)
    with nerf_errors_as(ExportError):
        images = load_images(
            [root / image.file for image in posed],
            long_side,
            [None if image.mask is None else root / image.mask for image in posed],
        )
        lenses = [scene.lens_of(image) for image in posed]
        cameras = nerf_cameras(lenses, poses, scene.scene).resized(long_side)
    for image, found, wanted in zip(
        posed, images.sizes.tolist(), cameras.size.tolist(), strict=True
    ):
        if found != wanted:
            raise ExportError(
                f"{image.file} is {found[0]}x{found[1]}, its camera {wanted[0]}x{wanted[1]}.",
                code="bad_image",
                hint="The image differs in size from its camera: start the job again.",
            )
    return _Views(posed, images, cameras, poses, long_side)


def has_codes(scene: TrainedScene) -> bool:
    """Whether the model was trained with appearance codes."""
    return scene.model.appearance_dim > 0


def _costs(views: _Views | None, config: EvaluateConfig, scene: TrainedScene) -> dict[str, float]:
    """What each part costs, in pixels rendered."""
    num = 0 if views is None else len(views.posed)
    fit = _FIT_COST * num * config.test_time.rays_per_step
    side = config.floater_long_side_px
    return {
        "poses": fit * config.test_time.pose_steps if config.fit_poses else 0.0,
        "appearance": fit * config.test_time.appearance_steps
        if config.fit_appearance and has_codes(scene)
        else 0.0,
        "images": 0.0 if views is None else float(views.images.offsets[-1]),
        "floaters": _FLOATER_COST + _floater_renders(config) * side**2 if config.floaters else 0.0,
    }


def _floater_renders(config: EvaluateConfig) -> int:
    """Pictures' worth of rays that depth consistency asks for: each view, and twice each pair."""
    return config.floater_views * (1 + 2 * (config.floater_views - 1))


def _fit(
    scene: TrainedScene, views: _Views, config: EvaluateConfig, seed: int, meter: _Meter
) -> _Fits:
    """The test-time procedure, as far as the options ask for it and the model has codes."""
    rows = range(len(views.posed))
    poses, codes, cameras = None, None, views.cameras
    if config.fit_poses:
        poses = fit_poses(
            scene.model,
            cameras,
            _in_the_scenes_light(scene, views),
            rows,
            config.test_time,
            seed=seed,
            progress=meter.of("poses", "fitting held-out poses"),
        )
        cameras = poses.applied_to(cameras)
    if config.fit_appearance and has_codes(scene):
        codes = fit_appearance(
            scene.model,
            cameras,
            views.images,
            rows,
            config.test_time,
            seed=seed,
            progress=meter.of("appearance", "fitting held-out appearance"),
        )
    return _Fits(poses, codes)


def _in_the_scenes_light(scene: TrainedScene, views: _Views) -> ImageData:
    """The held-out images, levelled by what the model shows there where training levelled its own:
    a pose must not make up for an exposure.
    """
    if scene.bend is None:
        return views.images
    sizes = [(width, height) for width, height in views.images.sizes.tolist()]
    found = ImageData.empty(sizes, masked=views.images.valid is not None)
    for index, image in enumerate(views.posed):
        truth, valid = views.images.image(index).numpy(), views.images.mask(index)
        usable = np.ones(truth.shape[:2], np.bool_) if valid is None else valid.numpy()
        rendered = scene.render(scene.lens_of(image), views.poses[index], views.long_side)
        shown = torch.as_tensor(rendered.rgb).detach().cpu().float().clamp(0.0, 1.0).numpy()
        red, green, blue = gain_between(shown, truth, usable, scene.bend).tolist()
        stored = np.rint(255.0 * truth).astype(np.uint8)
        found.put(index, levelled(stored, (red, green, blue, scene.bend)), usable)
    return found


def _measure_view(
    scene: TrainedScene,
    views: _Views,
    index: int,
    pose: NDArray[np.float64],
    fits: _Fits,
    lpips: Lpips | None,
    out: Path,
) -> dict[str, Any]:
    """Render one view, save it beside the truth, and measure it: its row of `metrics.json`."""
    image, truth, valid = views.posed[index], views.images.image(index), views.images.mask(index)
    code = None if fits.codes is None else fits.codes.codes[index]
    rendered = scene.render(scene.lens_of(image), pose, views.long_side, appearance=code)
    shown = torch.as_tensor(rendered.rgb).detach().cpu().float().clamp(0.0, 1.0)
    if scene.bend is not None:
        usable = np.ones(truth.shape[:2], np.bool_) if valid is None else valid.numpy()
        shown = torch.from_numpy(in_the_light_of(shown.numpy(), truth.numpy(), usable, scene.bend))
    picture = side_by_side(truth.numpy(), shown.numpy())
    Image.fromarray(picture).save(out / "images" / f"{picture_name(image.file)}.jpg", quality=90)
    row: dict[str, Any] = {"file": image.file, **measure(shown, truth, valid, lpips)}
    if valid is not None:
        row["valid_share"] = round(float(valid.double().mean()), 4)
    if fits.poses is not None:
        before = views.poses[index]
        cosine = (np.trace(before[:, :3].T @ pose[:, :3]) - 1.0) / 2.0
        row["pose_fit"] = {
            "translation": round(float(np.linalg.norm(pose[:, 3] - before[:, 3])), 6),
            "rotation_deg": round(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), 4),
            "loss_before": fits.poses.loss_before[index],
            "loss_after": fits.poses.loss_after[index],
        }
    if fits.codes is not None:
        half = other_half(fits.codes.halves[index])
        columns = half_columns(truth.shape[1], half)
        part = None if valid is None else valid[:, columns]
        row["half_unseen"] = {
            "half": half,
            **measure(shown[:, columns], truth[:, columns], part, lpips),
        }
    return row | {"width": truth.shape[1], "height": truth.shape[0]}


def measure(
    shown: Tensor, truth: Tensor, valid: Tensor | None, lpips: Lpips | None
) -> dict[str, Any]:
    """PSNR, SSIM and LPIPS of pictures [H, W, 3] in [0, 1], over the valid pixels.

    For LPIPS, which looks at whole pictures, the pixels left out are the truth's in both. What
    cannot be measured, as in a picture too small, is None, and `problem` says why.
    """
    same = shown if valid is None else torch.where(valid[..., None], shown, truth)
    found: dict[str, Any] = {}
    measures: dict[str, Callable[[], float]] = {
        "psnr": lambda: min(psnr(shown, truth, valid), MAX_PSNR),
        "ssim": lambda: ssim(shown, truth, valid),
    }
    if lpips is not None:
        measures["lpips"] = partial(lpips.distance, same, truth)
    for name, decimals in MEASURES.items():
        try:
            found[name] = round(measures[name](), decimals) if name in measures else None
        except NerfError as error:
            found[name], found["problem"] = None, error.message
    return found


def _lpips(config: EvaluateConfig, ctx: StageContext) -> tuple[Lpips | None, str | None]:
    """The metric, or why there is none: weights that cannot be had cost LPIPS, not the job.

    Where the weights lie is set by who runs the worker, not by who sends a job, who could make it
    read any file or address.
    """
    sources, digests = (
        [part.strip() for part in os.environ.get(name, "").split(",") if part.strip()]
        for name in (LPIPS_WEIGHTS, LPIPS_SHA256)
    )
    cache = Path(torch.hub.get_dir()) / "nerfworks"
    try:
        return lpips_if_configured(config.lpips_backbone, sources, digests, cache)
    except NerfError as error:
        ctx.logger.warning("no LPIPS: %s %s", error.message, error.hint)
        return None, f"LPIPS was not measured: {error.message}"


def _floaters(
    scene: TrainedScene, config: EvaluateConfig, ctx: StageContext, meter: _Meter
) -> tuple[dict[str, Any] | None, str | None]:
    """Both measures, or why there are none."""
    if not config.floaters:
        return None, "Floaters were not measured: evaluate.floaters is off."
    posed = scene.training_images()
    lenses = [scene.lens_of(image) for image in posed]
    renderer, model = scene.renderer, scene.model
    num_calls, calls = _floater_renders(config), 0

    def render_rays(origins: Tensor, directions: Tensor) -> RenderedImage:
        nonlocal calls
        calls += 1
        meter.show("floaters", min(calls / num_calls, 1.0), "measuring floaters")
        return renderer.render_rays(origins, directions)

    def density(positions: Tensor) -> Tensor:
        meter.show("floaters", 1.0, "measuring floaters")
        return model.density(positions)

    try:
        cameras = nerf_cameras(lenses, [image.world_from_camera for image in posed], scene.scene)
        cameras = cameras.resized(config.floater_long_side_px)
        depths = _median_depths(ctx.workspace, [image.file for image in posed])
        targets = view_targets(cameras, None if depths is None else depths * scene.scene.scale)
        found = floater_measures(
            render_rays,
            off_path_cameras(cameras, targets, config.floater_views, ctx.seed),
            cameras.to(next(model.parameters()).device),
            targets,
            opacity_of_density(density, near=model.config.near),
            scene.scene.scale,
        )
    except NerfError as error:
        return None, f"Floaters were not measured: {error.message}"
    consistency = found.depth_inconsistency
    return {
        "depth_inconsistency": None if consistency is None else round(consistency, 6),
        "near_mass": round(found.near_mass, 6),
        **found.details,
    }, None


def _median_depths(workspace: Workspace, files: list[str]) -> Tensor | None:
    """The median z-depth [N] of the maps of the stage `depth`, world units, NaN where nothing is
    known; None where it made none.
    """
    if not workspace.is_complete("depth"):
        return None
    medians = {
        item.file: float(np.median(found.z[found.z > 0]))
        for item, found in DepthMapsFile(workspace.stage("depth"))
        if found.z.any()
    }
    told = [medians.get(file, np.nan) for file in files]
    return torch.tensor(told, dtype=torch.float64) if medians else None


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means and rows for `metrics.json`, from what `_measure_view` gives.

    A mean is over the images that have the value, and None where none has.
    """
    halves = [row["half_unseen"] for row in rows if "half_unseen" in row]
    sizes = [(row["width"], row["height"]) for row in rows]
    width, height = max(sizes, key=sizes.count) if sizes else (0, 0)
    return {
        **_means(rows),
        "half_unseen": _means(halves) if halves else None,
        "num_images": len(rows),
        "width": width,
        "height": height,
        "per_image": [
            {key: value for key, value in row.items() if key not in ("width", "height")}
            for row in rows
        ],
    }


def _means(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    means: dict[str, float | None] = {}
    for name in MEASURES:
        values = [row[name] for row in rows if row.get(name) is not None]
        means[name] = round(float(np.mean(values)), 4) if values else None
    return means


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
