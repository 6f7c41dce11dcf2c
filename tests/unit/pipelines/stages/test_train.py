"""The train stage on a tiny capture: what it leaves, how it resumes, how it fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.errors import Cancelled, TrainingError
from pipelines.manifest import RunHooks
from pipelines.nerf.options.train import TrainConfig, default_train_config
from pipelines.nerf.training.checkpoint import load_checkpoint, load_model
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stages.train import decided, engine_warnings
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


def test_summary_says_what_was_trained(trained_job: Workspace) -> None:
    summary = trained_job.manifest("train")["summary"]
    assert summary["num_steps"] == 400
    assert summary["num_train"] + summary["num_test"] == tiny_job.NUM_IMAGES
    assert summary["num_test"] == 3
    assert (summary["width"], summary["height"]) == (36, 64)
    assert summary["train_psnr"] > 9.0
    assert set(summary["losses"]) >= {"rgb", "interlevel", "distortion", "camera"}
    assert summary["camera_deltas"]["max_translation"] > 0.0
    assert (summary["device"], summary["engine"], summary["warnings"]) == ("cpu", "fast", [])


@pytest.mark.skipif(
    torch.cuda.is_available(), reason="a GPU that does not work is NOT tested: this one does"
)
def test_a_gpu_that_trained_without_its_engine_is_told() -> None:
    config, gpu = TrainConfig(), torch.device("cuda")
    (warning,) = engine_warnings(config, gpu, "plain")
    assert warning["code"] == "slow_engine"
    assert warning["details"]["problem"] in warning["message"]
    assert engine_warnings(config, gpu, "fast") == []
    assert engine_warnings(config, torch.device("cpu"), "plain") == []
    assert engine_warnings(replace(config, engine="plain"), gpu, "plain") == []


def test_plain_lines_are_for_captures_whose_plain_surfaces_no_map_knows(
    trained_job: Workspace,
) -> None:
    config = default_train_config("nerfacto")
    assert config.flat.when == "unknown"
    assert decided(config, 0.5).flat == replace(config.flat, when="always")
    assert decided(config, 0.3).flat == replace(config.flat, when="never")
    for told in ("always", "never"):
        asked = replace(config, flat=replace(config.flat, when=told))
        assert decided(asked, None) == asked
    summary = trained_job.manifest("train")["summary"]  # of a job without depth maps
    assert (summary["plain_unknown"], summary["plain_lines"]) == (1.0, True)


def test_model_holds_all_that_rendering_needs(trained_job: Workspace, tmp_path: Path) -> None:
    alone = tmp_path / "model.zip"
    alone.write_bytes((trained_job.stage("train") / "model.zip").read_bytes())
    scene = TrainedScene.load(alone)
    assert len(scene.training_images()) == 17
    assert len(scene.test_images()) == 3
    image = scene.test_images()[0]
    picture = scene.render(scene.lens_of(image), np.asarray(image.world_from_camera), 32)
    assert picture.rgb.shape == (32, 18, 3)
    assert scene.cameras == CamerasFile.load(trained_job.stage("train") / "cameras.json")


def test_cameras_carry_the_corrections_of_training_images_only(trained_job: Workspace) -> None:
    before = CamerasFile.load(trained_job.stage("ingest") / "cameras.json")
    after = CamerasFile.load(trained_job.stage("train") / "cameras.json")
    raw = {image.file: np.asarray(image.world_from_camera) for image in before.images}
    loaded = load_model(trained_job.stage("train") / "model.zip")
    delta = loaded.model.cameras_delta
    trained_on = [raw[image.file] for image in after.images if image.split != "test"]
    delta.keep_frame(torch.from_numpy(np.stack(trained_on)))
    assert not torch.allclose(delta.corrections(), delta.tangent, atol=1e-5)
    deltas = delta.corrections().detach().numpy()
    row = 0
    for image in after.images:
        pose = np.asarray(image.world_from_camera)
        if image.split == "test":
            np.testing.assert_array_equal(pose, raw[image.file])
            continue
        moved = (pose[:, 3] - raw[image.file][:, 3]) * loaded.scene.scale
        np.testing.assert_allclose(moved, deltas[row, :3], atol=1e-6)
        np.testing.assert_allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-6)
        row += 1
    assert row == 17
    assert after.cameras == before.cameras
    assert "training" in after.notes


def test_previews_are_small_pictures_of_training(trained_job: Workspace) -> None:
    names = sorted(path.name for path in (trained_job.stage("train") / "previews").iterdir())
    assert names == ["step_000200.jpg", "step_000400.jpg"]
    with Image.open(trained_job.stage("train") / "previews" / names[0]) as picture:
        assert picture.size == (36, 64)


def test_a_cancel_ends_training_at_the_next_step(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=8)
    messages: list[str] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: messages.append(message),
        is_cancelled=lambda: any(message.startswith("step 3/") for message in messages),
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(workspace, "train", hooks)
    assert messages[-1].startswith("step 3/400, ")
    assert messages[-1].endswith(" dB")
    assert not workspace.stage("train").exists()


def test_a_worker_that_shuts_down_leaves_a_checkpoint_of_the_step_that_it_stopped_at(
    tmp_path: Path,
) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=8)
    messages: list[str] = []
    saved: list[int] = []

    def stops() -> bool:
        return any(message.startswith("step 2/") for message in messages)

    def on_checkpoint() -> None:
        kept = workspace.checkpoint("train") / "training.pt"
        saved.append(int(load_checkpoint(kept)["step"]))

    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: messages.append(message),
        is_cancelled=stops,
        is_shutdown=stops,
        on_checkpoint=on_checkpoint,
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(workspace, "train", hooks)
    assert messages[-1].startswith("step 2/400, ")
    assert saved == [3]


def test_a_lost_run_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job")
    _leave_checkpoint(workspace)
    steps: list[int] = []
    saved: list[bool] = []

    def on_progress(fraction: float, message: str, eta_s: float | None) -> None:
        if message.startswith("step"):
            steps.append(int(message.split()[1].split("/")[0]))

    hooks = RunHooks(on_progress=on_progress, on_checkpoint=lambda: saved.append(True))
    manifest = tiny_job.run_with(workspace, "train", hooks, max_steps=30)
    assert steps[0] == 21
    assert manifest["summary"]["num_steps"] == 30
    assert saved


def _leave_checkpoint(workspace: Workspace) -> None:
    """Run 20 steps and keep their checkpoint, as a worker that dies right after saving does."""
    copy = workspace.root / "kept"

    def keep() -> None:
        copy.mkdir(exist_ok=True)
        for path in workspace.checkpoint("train").iterdir():
            (copy / path.name).write_bytes(path.read_bytes())

    tiny_job.run_with(workspace, "train", RunHooks(on_checkpoint=keep), max_steps=20)
    workspace.checkpoint("train").mkdir(parents=True, exist_ok=True)
    for path in copy.iterdir():
        path.rename(workspace.checkpoint("train") / path.name)


def test_a_damaged_checkpoint_costs_time_and_not_the_job(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job")
    workspace.checkpoint("train").mkdir(parents=True)
    (workspace.checkpoint("train") / "training.pt").write_bytes(b"half a file")
    assert tiny_job.run(workspace, "train", max_steps=3)["summary"]["num_steps"] == 3


def test_too_few_images_are_an_error_with_advice(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=3)
    with pytest.raises(TrainingError, match="3 posed images") as caught:
        tiny_job.run(workspace, "train")
    assert caught.value.code == "too_few_images"
    assert caught.value.hint


def test_an_image_that_does_not_decode_is_named(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=6)
    (workspace.stage("ingest") / "images" / "frame_00002.png").write_bytes(b"not a picture")
    with pytest.raises(TrainingError, match=r"frame_00002\.png") as caught:
        tiny_job.run(workspace, "train")
    assert caught.value.code == "bad_image"
