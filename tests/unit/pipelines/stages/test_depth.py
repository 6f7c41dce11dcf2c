"""The stages `depth` and `draft` on a tiny capture with exact poses and truth."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.errors import Cancelled, TrainingError
from pipelines.exports import subject
from pipelines.exports.crop import crop_of
from pipelines.exports.formats.glb import read_mesh
from pipelines.exports.options import CropShapeOptions
from pipelines.exports.texture.photos import Photos
from pipelines.manifest import RunHooks
from pipelines.nerf.data.light import exposed
from pipelines.nerf.stereo.engines import TorchEngine
from pipelines.options import OptionsError, resolve_options
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.depth_maps_file import INDEX, DepthMapsFile
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.stereo_views import undistorted_picture
from pipelines.stages import depth
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job

STEREO = {"long_side_px": 64, "num_planes": 64, "window_radius": 2, "complete_planes": False}
"""Without guesses, so that every depth is one that was matched or measured."""


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A capture whose `depth` is complete."""
    workspace = tiny_job.make_capture(tmp_path_factory.mktemp("mapped") / "job", num_images=24)
    tiny_job.run(workspace, "depth", **STEREO)
    return workspace


def test_maps_are_those_of_the_training_images_and_right(mapped: Workspace) -> None:
    capture = CamerasFile.load(mapped.stage("ingest") / "cameras.json")
    truth = {image.file: image for image in capture.images}
    maps = DepthMapsFile(mapped.stage("depth"))
    files = [image.file for image in maps.images]
    assert len(files) == 21
    assert len(set(files)) == 21
    errors, shares = [], []
    for held, found in maps:
        image = truth[held.file]
        exact = depth_image(capture.cameras[image.camera], pose_matrix(image))
        assert held.lens == Pinhole.of(capture.cameras[image.camera], 64)
        known = found.z > 0
        errors.append(np.abs(found.z[known] / exact[known] - 1.0))
        shares.append(known.mean())
        # The photos are few: where a single other one has a place, that alone may agree.
        assert (found.votes[known] >= 1).all()
        assert (found.votes[known] >= 2).mean() > 0.8
    assert np.mean(shares) > 0.3
    assert np.median(np.concatenate(errors)) < 0.02
    assert (np.concatenate(errors) < 0.05).mean() > 0.8


def test_a_device_with_pytorch_finds_the_same_as_the_kernels(
    mapped: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a GPU runs, on the CPU: the whole stage."""
    engine = TorchEngine(torch.device("cpu"))
    monkeypatch.setattr(depth, "choose_engine", lambda views, config: engine)
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=24)
    known_before, right_before = how_right(mapped)
    summary = tiny_job.run(workspace, "depth", **STEREO)["summary"]
    known, right = how_right(workspace)
    assert known == pytest.approx(known_before, abs=0.005)
    assert right == pytest.approx(right_before, abs=0.005)
    for ours, theirs in zip(_all_depths(workspace), _all_depths(mapped), strict=True):
        assert ((ours > 0) != (theirs > 0)).mean() < 0.01
        both = (ours > 0) & (theirs > 0)
        assert np.quantile(np.abs(ours[both] / theirs[both] - 1.0), 0.98) < 2e-3
    assert summary["device"] == mapped.manifest("depth")["summary"]["device"] == "cpu"


def test_plain_surfaces_are_completed(mapped: Workspace, tmp_path: Path) -> None:
    known_before, right_before = how_right(mapped)
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=24)
    summary = tiny_job.run(workspace, "depth", **STEREO | {"complete_planes": True})["summary"]
    known, right = how_right(workspace)
    assert known > known_before + 0.03
    assert known * right > known_before * right_before + 0.03
    assert right > right_before - 0.02
    assert summary["matched_share"] == mapped.manifest("depth")["summary"]["known_share"]
    assert summary["known_share"] == pytest.approx(known, abs=1e-3)


def test_what_is_held_out_takes_no_part(mapped: Workspace, tmp_path: Path) -> None:
    """A held-out picture of noise changes no map; a training picture does."""
    options = tiny_job.options_of("depth", **STEREO)
    assert options["held_out"]["eval_fraction"] == 0.1
    names = {image.file for image in DepthMapsFile(mapped.stage("depth")).images}
    before = _all_depths(mapped)
    for held_out in (True, False):
        workspace = tiny_job.make_capture(tmp_path / str(held_out), num_images=24)
        images = CamerasFile.load(workspace.stage("ingest") / "cameras.json").images
        spoiled = next(image.file for image in images if (image.file in names) != held_out)
        noise = np.random.default_rng(0).integers(0, 255, (64, 36, 3)).astype(np.uint8)
        Image.fromarray(noise).save(workspace.stage("ingest") / spoiled)
        tiny_job.run(workspace, "depth", **STEREO)
        same = [np.array_equal(a, b) for a, b in zip(before, _all_depths(workspace), strict=True)]
        assert all(same) == held_out


def _all_depths(workspace: Workspace) -> list[np.ndarray]:
    return [found.z for _, found in DepthMapsFile(workspace.stage("depth"))]


def test_what_is_held_out_is_said_once() -> None:
    resolved = resolve_options("preview", {"train": {"data": {"eval_mode": "interval"}}})
    assert resolved["depth"]["held_out"]["eval_mode"] == "interval"
    assert resolve_options("preview", resolved) == resolved, "a job's options make the same job"
    with pytest.raises(OptionsError, match=r"as in train\.data"):
        resolve_options("preview", {"depth": {"held_out": {"eval_mode": "none"}}})


def test_the_report_says_how_much_is_known(mapped: Workspace) -> None:
    report = json.loads((mapped.stage("depth") / "report.json").read_text("utf-8"))
    assert report == mapped.manifest("depth")["summary"]
    assert report["num_maps"] == 21
    assert 0.0 <= report["least_known_share"] <= report["known_share"] <= 1.0
    assert report["mean_votes"] >= 2.0
    with Image.open(mapped.stage("depth") / "depth.jpg") as picture:
        assert picture.size == (6 * (36 + 4), 2 * 64)


def test_the_draft_is_a_mesh_where_the_scene_is(mapped: Workspace) -> None:
    summary = tiny_job.run(mapped, "draft", resolution=64)["summary"]
    assert summary["num_faces"] > 500
    assert (mapped.stage("draft") / "draft.glb").read_bytes()[:4] == b"glTF"
    with Image.open(mapped.stage("draft") / "draft.jpg") as picture:
        shown = np.asarray(picture.convert("RGB")).astype(int)
    assert (np.abs(shown - 128).max(axis=-1) > 8).mean() > 0.2, "a picture of nothing"
    assert summary["num_views"] == 21


def test_a_subject_asked_for_is_cut_out_of_the_draft(
    mapped: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rough = {"resolution": 96, "texture": "none"}
    whole = tiny_job.run(mapped, "draft", far_distance=2.0, **rough)["summary"]
    assert whole["subject"] is None
    told = tiny_job.run(mapped, "draft", extent="subject", **rough)["summary"]
    assert told["subject"]["kind"] == "subject", told["subject"]
    assert 100 < told["num_faces"] < 0.9 * whole["num_faces"]
    box = crop_of(CropShapeOptions(shape="box", **told["subject"]["region"]))
    assert box is not None
    drafted = read_mesh(mapped.stage("draft") / "draft.glb")
    assert box.distance(drafted.vertices).max() < 1e-4
    assert len(drafted.faces) == told["num_faces"]
    monkeypatch.setattr(subject, "LEAST_STANDING", 1e9)
    none = tiny_job.run(mapped, "draft", extent="subject", **rough)["summary"]
    assert (none["num_faces"], none["subject"]["region"]) == (whole["num_faces"], None)
    assert "No subject was found" in caplog.text


def test_without_maps_there_is_no_draft_and_training_goes_on(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=8)
    assert tiny_job.run(workspace, "depth", source="off")["summary"]["num_maps"] == 0
    drafted = tiny_job.run(workspace, "draft")
    assert drafted["summary"] == {"num_faces": 0, "why": "there are no depth maps"}
    assert "depth" not in tiny_job.run(workspace, "train", max_steps=2)["summary"]["losses"]


def test_training_learns_from_the_maps_unless_told_not_to(mapped: Workspace) -> None:
    learned = tiny_job.run(mapped, "train", max_steps=3)["summary"]
    assert learned["losses"]["depth"] > 0.0
    unused = tiny_job.run(mapped, "train", max_steps=3, depth={"weight": 0.0})["summary"]
    assert "depth" not in unused["losses"]


def test_maps_that_know_held_out_images_are_refused(mapped: Workspace) -> None:
    with pytest.raises(TrainingError, match="not those of the images") as caught:
        tiny_job.run(mapped, "train", max_steps=2, data={"eval_mode": "interval"})
    assert caught.value.code == "depth_maps_outdated"


def with_depth(workspace: Workspace, factor: float = 1.0) -> None:
    """Give every image of the capture its exact depth, at half its size, times a factor."""
    folder = workspace.stage("ingest")
    (folder / "depth").mkdir()
    capture = CamerasFile.load(folder / "cameras.json")
    images = []
    for index, image in enumerate(capture.images):
        lens = Pinhole.of(capture.cameras[image.camera], 32).intrinsics()
        z = depth_image(lens, pose_matrix(image)) * factor
        name = f"depth/{index + 1:05d}.npz"
        np.savez_compressed(folder / name, z=z.astype(np.float32))
        images.append(dataclasses.replace(image, depth=name))
    dataclasses.replace(capture, images=tuple(images)).save(folder / "cameras.json")


def how_right(workspace: Workspace) -> tuple[float, float]:
    """Share of the pixels that are known, and of these within 5 %."""
    capture = CamerasFile.load(workspace.stage("ingest") / "cameras.json")
    truth = {image.file: image for image in capture.images}
    known, right = [], []
    for held, found in DepthMapsFile(workspace.stage("depth")):
        image = truth[held.file]
        exact = depth_image(capture.cameras[image.camera], pose_matrix(image))
        known.append(found.z > 0)
        right.append(np.abs(found.z / exact - 1.0) < 0.05)
    return float(np.mean(known)), float(np.stack(right)[np.stack(known)].mean())


def test_a_painted_room_has_no_sky_and_no_dark(mapped: Workspace) -> None:
    summary = mapped.manifest("depth")["summary"]
    assert (summary["sky"]["share"], summary["dark"]["share"]) == (0.0, 0.0)


@pytest.mark.parametrize("source", ["auto", "sensor"])
def test_the_depth_that_a_capture_brings_fills_the_maps(
    mapped: Workspace, tmp_path: Path, source: str
) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=24)
    with_depth(workspace)
    summary = tiny_job.run(workspace, "depth", source=source, **STEREO)["summary"]
    assert summary["source"] == {"auto": "stereo and sensor", "sensor": "sensor"}[source]
    assert summary["num_sensor_maps"] == summary["num_maps"] == 21
    known, right = how_right(workspace)
    known_before, right_before = how_right(mapped)
    assert known > known_before + 0.2
    # Stereo's own errors stay where it knows something; the sensor here has none.
    assert right > max(right_before, {"auto": 0.9, "sensor": 0.95}[source])


def test_a_sensor_in_another_unit_is_scaled_and_told(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=24)
    with_depth(workspace, factor=1.2)
    summary = tiny_job.run(workspace, "depth", **STEREO)["summary"]
    assert summary["sensor_scale"] == pytest.approx(1.0 / 1.2, rel=0.02)
    assert how_right(workspace)[1] > 0.9


def test_stereo_alone_does_not_look_at_the_sensor(mapped: Workspace, tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=24)
    with_depth(workspace)
    tiny_job.run(workspace, "depth", source="stereo", **STEREO)
    both = zip(_all_depths(mapped), _all_depths(workspace), strict=True)
    assert all(np.array_equal(a, b) for a, b in both)


def test_a_sensor_that_is_not_there_is_refused(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=8)
    with pytest.raises(TrainingError, match="brings no depth") as caught:
        tiny_job.run(workspace, "depth", source="sensor")
    assert caught.value.code == "no_sensor_depth"


def test_a_cancel_ends_the_search_between_two_views(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", num_images=12)
    messages: list[str] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: messages.append(message),
        is_cancelled=lambda: any(message.startswith("depth 2/") for message in messages),
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(workspace, "depth", hooks, **STEREO)
    assert messages[-1].startswith("depth 2/")
    assert not workspace.stage("depth").exists()


def test_a_list_of_maps_that_makes_no_sense_is_named(tmp_path: Path) -> None:
    (tmp_path / INDEX).write_text('{"images": [{"file": "a.jpg"}]}', "utf-8")
    with pytest.raises(ValueError, match=r"maps\.json is no list of depth maps"):
        DepthMapsFile(tmp_path)


def drifting(root: Path, bend: float = 0.5) -> tuple[Workspace, dict[str, np.ndarray]]:
    """A capture whose exposure drifts, and each picture's gains."""
    workspace = tiny_job.make_capture(root, num_images=24)
    folder = workspace.stage("ingest")
    gains = {}
    for index, path in enumerate(sorted((folder / "images").iterdir())):
        gain = np.exp(0.3 * np.sin(index / 3.0) * np.array([1.0, 0.9, 0.7]))
        with Image.open(path) as opened:
            lit = exposed(np.asarray(opened) / 255.0, gain, bend)
        Image.fromarray(np.rint(255.0 * lit).astype(np.uint8)).save(path)
        gains[f"images/{path.name}"] = gain
    return workspace, gains


def test_pictures_of_a_drifting_exposure_are_levelled(mapped: Workspace, tmp_path: Path) -> None:
    assert mapped.manifest("depth")["summary"]["light"]["levelled"] is False
    assert all(image.light is None for image in DepthMapsFile(mapped.stage("depth")).images)
    workspace, gains = drifting(tmp_path / "job")
    told = tiny_job.run(workspace, "depth", **STEREO)["summary"]["light"]
    assert told["levelled"]
    maps = DepthMapsFile(workspace.stage("depth"))
    found = np.log([image.light[:3] for image in maps.images if image.light is not None])
    true = np.log([gains[image.file] for image in maps.images])
    assert len(found) == len(maps) == 21
    assert np.abs((found - found.mean(axis=0)) - (true - true.mean(axis=0))).max() < 0.1

    tiny_job.run(workspace, "train", max_steps=3)
    cameras = CamerasFile.load(workspace.stage("train") / "cameras.json")
    assert {image.split for image in cameras.images if image.light is not None} == {"train"}
    assert {image.split for image in cameras.images if image.light is None} == {"test"}
    metrics = tiny_job.run(workspace, "evaluate", floaters=False)["summary"]
    assert metrics["protocol"]["light"] == "halves"
    assert "exposure drifts" in metrics["protocol"]["description"]

    off = tiny_job.run(workspace, "depth", level_light="off", **STEREO)["summary"]
    assert off["light"] is None
    tiny_job.run(workspace, "train", max_steps=3)
    metrics = tiny_job.run(workspace, "evaluate", floaters=False)["summary"]
    assert metrics["protocol"]["light"] == "as it is"


def test_levelled_pictures_are_of_one_light_for_all_who_look(tmp_path: Path) -> None:
    """The mean colour of what the draft shows, and of a photo that paints, differ no more."""
    workspace, _ = drifting(tmp_path / "job")
    tiny_job.run(workspace, "depth", **STEREO)
    capture = CamerasFile.load(workspace.stage("ingest") / "cameras.json")
    maps, root = DepthMapsFile(workspace.stage("depth")), workspace.images_root
    plain = tiny_job.make_capture(tmp_path / "plain", num_images=24).images_root
    lit = [image for image in maps.lit(capture.images) if image.light is not None]
    lenses = [capture.cameras[image.camera] for image in lit]
    photos = Photos(root, lit, lenses)
    ratios: dict[str, list[float]] = {"as stored": [], "drafted": [], "painted": []}
    for index, image in enumerate(lit):
        with Image.open(plain / image.file) as opened:
            true = np.asarray(opened).mean()
        with Image.open(root / image.file) as opened:
            ratios["as stored"].append(np.asarray(opened).mean() / true)
        pinhole = Pinhole.of(lenses[index], 64)
        drafted = undistorted_picture(root, image, lenses[index], pinhole)
        ratios["drafted"].append(drafted.mean() / true)
        assert np.array_equal(np.asarray(photos.load(index)), np.asarray(photos.glance(index)[0]))
        ratios["painted"].append(np.asarray(photos.load(index)).mean() / true)
    spread = {name: np.std(np.log(values)) for name, values in ratios.items()}
    assert spread["as stored"] > 0.1
    assert spread["drafted"] < 0.25 * spread["as stored"]
    assert spread["painted"] < 0.25 * spread["as stored"]


def test_maps_of_an_older_job_have_no_light(mapped: Workspace, tmp_path: Path) -> None:
    index = json.loads((mapped.stage("depth") / INDEX).read_text("utf-8"))
    for row in index["images"]:
        del row["light"]
    (tmp_path / INDEX).write_text(json.dumps(index), "utf-8")
    assert {image.light for image in DepthMapsFile(tmp_path).images} == {None}
