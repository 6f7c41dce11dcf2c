"""Held-out metrics of a tiny trained model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from pipelines.errors import Cancelled
from pipelines.manifest import RunHooks
from pipelines.nerf.data.light import exposed
from pipelines.nerf.judging.lpips import Lpips
from pipelines.nerf.judging.metrics import psnr, ssim
from pipelines.nerf.judging.test_time import MEASURED_RAYS
from pipelines.nerf.training.checkpoint import load_model, save_model
from pipelines.stages.evaluate import (
    LPIPS_SHA256,
    LPIPS_WEIGHTS,
    measure,
    picture_name,
    side_by_side,
    summarise,
)
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job

TEST_TIME = {"pose_steps": 100, "appearance_steps": 30, "rays_per_step": 256}
FITTED: dict[str, Any] = {"fit_poses": True, "fit_appearance": True, "test_time": TEST_TIME}


def _shown(job: Workspace, file: str) -> tuple[np.ndarray, np.ndarray]:
    """(truth, render) of a saved picture, [64, 36, 3] uint8 each."""
    path = job.stage("evaluate") / "images" / f"{picture_name(file)}.jpg"
    with Image.open(path) as opened:
        picture = np.asarray(opened)
    return picture[:, :36], picture[:, 36:72]


def test_metrics_are_those_of_the_pictures_shown(job: Workspace) -> None:
    metrics = tiny_job.run(job, "evaluate")["summary"]
    assert metrics == json.loads((job.stage("evaluate") / "metrics.json").read_text())
    assert metrics["num_images"] == len(metrics["per_image"]) == 3
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


def test_fitted_poses_and_codes_are_what_is_rendered_and_measured(job: Workspace) -> None:
    metrics = tiny_job.run(job, "evaluate", **FITTED)["summary"]
    assert metrics["protocol"]["fit_poses"] is True
    assert metrics["protocol"]["fit_appearance"] is True
    assert metrics["protocol"]["name"] == "nerfstudio"
    for row in metrics["per_image"]:
        fit, half = row["pose_fit"], row["half_unseen"]
        assert 0.0 < fit["loss_after"] <= fit["loss_before"]
        # A fit that ends worse is undone.
        has_moved = fit["loss_after"] < fit["loss_before"]
        assert (fit["translation"] > 0.0) == (fit["rotation_deg"] > 0.0) == has_moved
        assert fit["rotation_deg"] < 15.0
        truth, shown = _shown(job, row["file"])
        assert peak_signal_noise_ratio(truth, shown) == pytest.approx(row["psnr"], abs=0.7)
        columns = {"left": slice(0, 18), "right": slice(18, 36)}[half["half"]]
        part = peak_signal_noise_ratio(truth[:, columns], shown[:, columns])
        assert part == pytest.approx(half["psnr"], abs=0.7)
    fits = [row["pose_fit"] for row in metrics["per_image"]]
    assert sum(fit["translation"] > 0.0 for fit in fits) > len(fits) / 2
    for name in ("psnr", "ssim"):
        halves = [row["half_unseen"][name] for row in metrics["per_image"]]
        assert metrics["half_unseen"][name] == pytest.approx(np.mean(halves), abs=1e-3)


def _edit_images(job: Workspace, edit: Callable[[dict[str, Any]], None]) -> None:
    """Change what the trained job's `model.zip` says of each image."""
    path = job.stage("train") / "model.zip"
    loaded = load_model(path)
    for image in loaded.extras["cameras"]["images"]:
        edit(image)
    save_model(path, loaded.model, loaded.scene, loaded.extras)


def _turn(image: dict[str, Any]) -> None:
    """Turn a camera by 0.1 radian about the vertical."""
    sine, cosine = np.sin(0.1), np.cos(0.1)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    pose = np.asarray(image["world_from_camera"])
    image["world_from_camera"] = np.column_stack((turn @ pose[:, :3], pose[:, 3])).tolist()


def test_a_fitted_code_brings_the_renders_closer_to_the_images(job: Workspace) -> None:
    options: dict[str, Any] = {"floaters": False, "test_time": TEST_TIME}
    as_given = tiny_job.run(job, "evaluate", **options)["summary"]
    assert "half_unseen" not in as_given["per_image"][0]
    assert as_given["half_unseen"] is None
    coded = tiny_job.run(job, "evaluate", **options, fit_appearance=True)["summary"]
    assert "pose_fit" not in coded["per_image"][0]
    assert coded["psnr"] > as_given["psnr"]
    for row, before in zip(coded["per_image"], as_given["per_image"], strict=True):
        assert row["psnr"] != before["psnr"]


def test_a_fitted_pose_brings_the_renders_closer_to_the_images(job: Workspace) -> None:
    _edit_images(job, _turn)
    options: dict[str, Any] = {"floaters": False, "test_time": {**TEST_TIME, "pose_lr": 5e-3}}
    as_given = tiny_job.run(job, "evaluate", **options)["summary"]
    posed = tiny_job.run(job, "evaluate", **options, fit_poses=True)["summary"]
    assert posed["psnr"] > as_given["psnr"] + 0.5
    # The fit reports its loss on random pixels: what is rendered agrees with it, as far as a mean
    # over that many draws can.
    for row, before in zip(posed["per_image"], as_given["per_image"], strict=True):
        fit = row["pose_fit"]
        truth, shown = _shown(job, row["file"])
        errors = ((truth / 255.0 - shown / 255.0) ** 2).mean(axis=-1)
        spread = errors.std() / errors.mean() / MEASURED_RAYS**0.5
        assert spread < 0.06
        assert fit["loss_after"] == pytest.approx(10.0 ** (-row["psnr"] / 10.0), rel=4.0 * spread)
        unposed = 10.0 ** (-before["psnr"] / 10.0)
        assert fit["loss_before"] == pytest.approx(unposed, rel=4.0 * spread)


def test_a_pose_does_not_make_up_for_an_exposure(job: Workspace) -> None:
    """Held-out photos taken half as bright: fitted and judged as if they were not."""
    options: dict[str, Any] = {"floaters": False, "test_time": {**TEST_TIME, "pose_lr": 5e-3}}
    _edit_images(job, _turn)
    as_bright = tiny_job.run(job, "evaluate", **options, fit_poses=True)["summary"]
    for row in as_bright["per_image"]:
        path = job.images_root / row["file"]
        with Image.open(path) as opened:
            dark = exposed(np.asarray(opened) / 255.0, 0.5, 0.9)
        Image.fromarray(np.rint(255.0 * dark).astype(np.uint8)).save(path)

    def lit(image: dict[str, Any]) -> None:
        image["light"] = [1.0, 1.0, 1.0, 0.9] if image["split"] == "train" else None

    _edit_images(job, lit)
    posed = tiny_job.run(job, "evaluate", **options, fit_poses=True)["summary"]
    assert posed["psnr"] > as_bright["psnr"] - 1.5
    for row, before in zip(posed["per_image"], as_bright["per_image"], strict=True):
        ratio = row["pose_fit"]["loss_before"] / before["pose_fit"]["loss_before"]
        assert 0.5 < ratio < 1.5


def test_a_cancel_ends_the_fit_at_the_next_step(job: Workspace) -> None:
    seen: list[tuple[float, str]] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: seen.append((fraction, message)),
        is_cancelled=lambda: len(seen) >= 50,
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(job, "evaluate", hooks, **FITTED)
    assert seen[-1][1] == "fitting held-out poses"
    assert len(seen) == 50


def test_progress_covers_fits_images_and_floaters_in_order(job: Workspace) -> None:
    seen: list[tuple[float, str, float | None]] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: seen.append((fraction, message, eta_s))
    )
    tiny_job.run_with(job, "evaluate", hooks, max_images=2, **FITTED)
    fractions = [fraction for fraction, _, _ in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    kinds = [message.split(" ")[0] + message.split(" ")[-1] for _, message, _ in seen]
    order = list(dict.fromkeys(kind for kind in kinds if not kind.startswith("image")))
    assert order[:2] == ["fittingposes", "fittingappearance"]
    assert any(message.startswith("image 2/2, ") for _, message, _ in seen)
    assert any(message == "measuring floaters" for _, message, _ in seen)
    assert all(eta is None or eta >= 0.0 for _, _, eta in seen)


def test_floaters_are_measured_unless_turned_off(job: Workspace) -> None:
    metrics = tiny_job.run(job, "evaluate", max_images=1)["summary"]
    assert metrics["floaters_reason"] is None
    found = metrics["floaters"]
    assert 0.0 <= found["depth_inconsistency"] <= 1.0
    assert 0.0 <= found["near_mass"] <= 1.0
    assert found["near_mass"] == pytest.approx(np.mean(found["near_mass_per_camera"]), abs=1e-5)
    metrics = tiny_job.run(job, "evaluate", max_images=1, floaters=False)["summary"]
    assert metrics["floaters"] is None
    assert "evaluate.floaters" in metrics["floaters_reason"]


def test_how_far_cameras_look_follows_the_depth_maps(job: Workspace) -> None:
    """The sample's cameras look at a focus, unless maps are full of nearer things."""

    def distance() -> float:
        metrics = tiny_job.run(job, "evaluate", max_images=1)["summary"]
        return float(metrics["floaters"]["near_distance_world"])

    by_poses = distance()
    tiny_job.run(job, "depth")
    assert distance() == by_poses
    medians = []
    for path in sorted((job.stage("depth") / "maps").iterdir()):
        with np.load(path) as held:
            values = dict(held)
        values["unit"] = 0.1 * values["unit"]
        np.savez_compressed(path, **values)
        z = values["z"].astype(np.float64) * float(values["unit"])
        medians.append(np.median(z[z > 0]))
    assert len(medians) == job.manifest("train")["summary"]["num_train"]
    assert distance() == pytest.approx(0.3 * np.quantile(medians, 0.1), rel=1e-3)


def _set_masks(job: Workspace, mask: np.ndarray) -> None:
    """Give every image of the trained job this mask, as a capture with masks would have."""
    folder = job.images_root / "masks"
    folder.mkdir(exist_ok=True)
    Image.fromarray(mask).save(folder / "mask.png")
    _edit_images(job, lambda image: image.update(mask="masks/mask.png"))


def test_masked_pixels_are_neither_measured_nor_fitted(job: Workspace) -> None:
    whole = tiny_job.run(job, "evaluate", max_images=2, floaters=False)["summary"]
    mask = np.full((64, 36), 255, np.uint8)
    mask[40:] = 0
    _set_masks(job, mask)
    options = {**FITTED, "max_images": 2, "floaters": False}
    masked = tiny_job.run(job, "evaluate", **options)["summary"]
    for row in masked["per_image"]:
        assert row["valid_share"] == pytest.approx(40 / 64, abs=1e-4)
        path = job.images_root / row["file"]
        with Image.open(path) as opened:
            picture = np.asarray(opened).copy()
        picture[40:] = (255, 0, 255)
        Image.fromarray(picture).save(path)
    again = tiny_job.run(job, "evaluate", **options)["summary"]
    # SSIM looks around each pixel, so that it sees past the mask's edge.
    for before, after in zip(masked["per_image"], again["per_image"], strict=True):
        assert after["psnr"] == before["psnr"]
        assert after["pose_fit"] == before["pose_fit"]
        assert after["half_unseen"]["psnr"] == before["half_unseen"]["psnr"]
    assert "valid_share" not in whole["per_image"][0]


def _write_weights(folder: Path) -> tuple[Path, str, Lpips]:
    torch.manual_seed(0)
    metric = Lpips("alex")
    for parameter in metric.parameters():
        torch.nn.init.normal_(parameter, std=0.05).abs_()
    path = folder / "weights.safetensors"
    tensors = {name: value.contiguous() for name, value in metric.state_dict().items()}
    safetensors.torch.save_file(tensors, path)
    return path, hashlib.sha256(path.read_bytes()).hexdigest(), metric


def test_lpips_is_measured_with_the_configured_weights(
    job: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, sha256, metric = _write_weights(tmp_path)
    monkeypatch.setenv(LPIPS_WEIGHTS, str(path))
    monkeypatch.setenv(LPIPS_SHA256, sha256)
    metrics = tiny_job.run(job, "evaluate", max_images=1, floaters=False)["summary"]
    assert metrics["lpips_reason"] is None
    assert metrics["lpips_backbone"] == "alex"
    (row,) = metrics["per_image"]
    assert metrics["lpips"] == pytest.approx(row["lpips"], abs=1e-4)
    truth, shown = (torch.from_numpy(part / 255.0).float() for part in _shown(job, row["file"]))
    # The picture is a JPEG, so the number agrees only roughly.
    assert metric.distance(shown, truth) == pytest.approx(row["lpips"], rel=0.3)
    assert row["lpips"] > 0.0


def test_weights_that_cannot_be_had_cost_lpips_and_not_the_job(
    job: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _, _ = _write_weights(tmp_path)
    monkeypatch.setenv(LPIPS_WEIGHTS, str(path))
    monkeypatch.setenv(LPIPS_SHA256, "0" * 64)
    metrics = tiny_job.run(job, "evaluate", max_images=1, floaters=False)["summary"]
    assert metrics["lpips"] is None
    assert metrics["per_image"][0]["lpips"] is None
    assert "sha256" in metrics["lpips_reason"]
    assert metrics["psnr"] > 9.0


def test_what_is_measured_is_what_the_metrics_say_of_the_valid_pixels() -> None:
    random = torch.Generator().manual_seed(0)
    truth = torch.rand(40, 50, 3, generator=random)
    shown = (truth + 0.1 * torch.rand(40, 50, 3, generator=random)).clamp(0.0, 1.0)
    valid = torch.rand(40, 50, generator=random) < 0.7
    found = measure(shown, truth, valid, None)
    assert found == {
        "psnr": round(psnr(shown, truth, valid), 4),
        "ssim": round(ssim(shown, truth, valid), 5),
        "lpips": None,
    }
    assert measure(truth, truth, None, None)["psnr"] == 100.0


def test_lpips_does_not_see_what_the_mask_leaves_out() -> None:
    torch.manual_seed(1)
    metric = Lpips("alex")
    truth, shown = torch.rand(2, 40, 50, 3).unbind(0)
    valid = torch.ones(40, 50, dtype=torch.bool)
    valid[:, 20:] = False
    other = shown.clone()
    other[:, 20:] = 0.0
    first, second = (measure(item, truth, valid, metric)["lpips"] for item in (shown, other))
    assert first == second
    assert first != measure(other, truth, None, metric)["lpips"]
    nothing = truth.clone()
    nothing[:, 20:] = 0.0
    assert measure(nothing, truth, valid, metric)["lpips"] == 0.0


def test_what_cannot_be_measured_is_null_with_the_problem() -> None:
    small = torch.rand(8, 30, 3)
    found = measure(small, small * 0.5, None, None)
    assert found["psnr"] is not None
    assert found["ssim"] is None
    assert "11 x 11" in found["problem"]
    rows = [
        {"file": "a", "psnr": 20.0, "ssim": None, "lpips": None, "width": 30, "height": 8},
        {"file": "b", "psnr": 30.0, "ssim": 0.5, "lpips": None, "width": 40, "height": 40},
    ]
    metrics = summarise(rows)
    assert (metrics["psnr"], metrics["ssim"], metrics["lpips"]) == (25.0, 0.5, None)


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
