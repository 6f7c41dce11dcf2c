"""Where nothing stands: no depth, no hole, and training lets light through; in the sky, in the
dark, and on the blank ground of cut-out pictures alike, be it told by its colour or by masks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.captures.record import CaptureRecord
from pipelines.options import AssessOptions
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.sample.scenes import exhibit, monument
from pipelines.sample.takes import Take
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stages.assess import load_views
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job

STEREO = {"long_side_px": 128, "num_planes": 48, "num_neighbours": 4}
NUM, NUM_SHOWN = 16, 14
"""Pictures, and those of them that training sees."""
TAKES = {
    "sky": monument.TAKE,
    "dark": exhibit.TAKE,
    "blank": exhibit.TAKE,
    "masks": exhibit.TAKE,
}
CUT_OUT = ("blank", "masks")
NOBODY_LOOKS = {"find_sky": False, "find_dark": False, "find_blank": False}


@dataclasses.dataclass(frozen=True)
class Filmed:
    """A take at twice the usual size, and which kind of nothing it shows."""

    kind: str
    take: Take
    workspace: Workspace

    @property
    def told_as(self) -> str:
        """What the stage calls it."""
        return "blank" if self.kind in CUT_OUT else self.kind

    def exact(self, lens: Pinhole, pose: np.ndarray) -> np.ndarray:
        """True depth, [H, W], 0 where nothing stands."""
        depth: np.ndarray = depth_image(lens.intrinsics(), pose, self.take.scene)
        return depth


def filmed(root: Path, kind: str) -> Workspace:
    """The capture; pictures of a cut-out thing are transparent around it, and laid on white, or
    have masks: then the ground may have any colour, and here it has no single one."""
    workspace = tiny_job.make_capture(root, NUM, TAKES[kind], 128)
    if kind not in CUT_OUT:
        return workspace
    folder = workspace.stage("ingest")
    capture = CamerasFile.load(folder / "cameras.json")
    (folder / "cuts").mkdir()
    images = []
    for number, image in enumerate(capture.images):
        depth = depth_image(capture.cameras[0], pose_matrix(image), TAKES[kind].scene)
        ground = np.full(depth.shape, 255.0)
        if kind == "masks":
            ground[:] = np.linspace(180.0, 255.0, depth.shape[1])
            cut = f"cuts/{number:05d}.png"
            Image.fromarray(((depth > 0) * 255).astype(np.uint8)).save(folder / cut)
            image = dataclasses.replace(image, cut=cut)
        with Image.open(folder / image.file) as opened:
            picture = np.where((depth == 0)[..., None], ground[..., None], np.asarray(opened))
        Image.fromarray(picture.astype(np.uint8)).save(folder / image.file)
        images.append(image)
    dataclasses.replace(capture, images=tuple(images)).save(folder / "cameras.json")
    return workspace


@pytest.fixture(scope="module", params=TAKES)
def mapped(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    """A figure in a square, under the sky; a ruin before black, and cut out of its pictures."""
    root, take = tmp_path_factory.mktemp(request.param) / "job", TAKES[request.param]
    workspace = filmed(root, request.param)
    tiny_job.run(workspace, "depth", **STEREO)
    return Filmed(request.param, take, workspace)


@pytest.fixture(scope="module")
def trained(mapped: Filmed) -> Filmed:
    # Enough: untold, what is nothing is a wall by then, all of it.
    tiny_job.run(mapped.workspace, "train", max_steps=200)
    return mapped


def void_and_known(film: Filmed) -> tuple[float, float, float]:
    """Of what is nothing, shares that are told and that have a depth; of all else, that is told."""
    capture = CamerasFile.load(film.workspace.stage("ingest") / "cameras.json")
    truth = {image.file: image for image in capture.images}
    told, known, wrong = [], [], []
    for held, found in DepthMapsFile(film.workspace.stage("depth")):
        exact = depth_image(capture.cameras[0], pose_matrix(truth[held.file]), film.take.scene)
        told.append(found.is_void[exact == 0])
        known.append(found.z[exact == 0] > 0)
        wrong.append(found.is_void[exact > 0])
    shares = [float(np.concatenate(item).mean()) for item in (told, known, wrong)]
    return shares[0], shares[1], shares[2]


def test_what_is_nothing_has_no_depth(mapped: Filmed) -> None:
    summary = mapped.workspace.manifest("depth")["summary"]
    for kind in ("sky", "dark", "blank"):
        assert (summary.get(kind, {}).get("share", 0.0) > 0.2) == (kind == mapped.told_as)
    assert (summary.get("blank", {}).get("by") == "masks") == (mapped.kind == "masks")
    # By day nobody looks for the dark, and what was cut out has neither sky nor dark.
    assert ("dark" in summary) == (mapped.kind == "dark")
    assert ("sky" in summary) == (mapped.kind not in CUT_OUT)
    assert summary[mapped.told_as]["num_views"] >= NUM_SHOWN - 1
    told, known, wrong = void_and_known(mapped)
    assert told > 0.8
    assert known < 0.05
    assert wrong < 0.01


def test_unasked_it_is_filled_by_what_is_beside_it(mapped: Filmed, tmp_path: Path) -> None:
    left = filmed(tmp_path / "job", mapped.kind)
    summary = tiny_job.run(left, "depth", **STEREO, **NOBODY_LOOKS)["summary"]
    assert not {"sky", "dark", "blank"} & set(summary)
    told, known, _ = void_and_known(dataclasses.replace(mapped, workspace=left))
    assert told == 0.0
    assert known > void_and_known(mapped)[1] + 0.05


def test_held_out_photos_of_it_have_no_hole(trained: Filmed) -> None:
    views = load_views(trained.workspace, AssessOptions(long_side_px=64))
    assert views.held_out
    assert views.void is not None
    lens = views.posed[0].camera
    camera = CamerasFile.load(trained.workspace.stage("ingest") / "cameras.json").cameras[lens]
    for index, image in enumerate(views.posed):
        exact = trained.exact(Pinhole.of(camera, 64), pose_matrix(image))
        valid = views.valid(index)
        assert valid is not None
        assert valid.shape == exact.shape
        assert valid[exact == 0].mean() < 0.15
        assert valid[exact > 0].mean() > 0.97


def test_a_photo_of_which_nothing_else_counts_is_looked_at_whole(trained: Filmed) -> None:
    views = load_views(trained.workspace, AssessOptions(long_side_px=64))
    height, width = views.photo(0).shape[:2]
    everywhere = [np.ones((height, width), bool)] * len(views.posed)
    assert dataclasses.replace(views, void=everywhere).valid(0) is None
    upper = np.zeros((height, width), bool)
    upper[: height // 2] = True
    every = torch.from_numpy(np.concatenate([upper.ravel()] * len(views.posed)))
    masked = dataclasses.replace(views.images, valid=every)
    valid = dataclasses.replace(views, images=masked, void=[upper] * len(views.posed)).valid(0)
    assert valid is not None
    assert (valid == upper).all()


def test_training_lets_light_through_there(trained: Filmed) -> None:
    scene = TrainedScene.load(trained.workspace.stage("train") / "model.zip")
    image = scene.training_images()[5]
    lens = Pinhole.of(scene.lens_of(image), 64)
    pose = np.asarray(image.world_from_camera, np.float64)
    exact = trained.exact(lens, pose)
    solid = scene.depth_view(lens, pose).z_depth > 0
    assert solid[exact == 0].mean() < 0.1
    near = (exact > 0) & (exact < 4.0)
    assert solid[near].mean() > 0.8


def test_depth_knows_by_their_exposure_that_photos_were_taken_by_day(tmp_path: Path) -> None:
    workspace = tiny_job.make_capture(tmp_path / "job", 8, monument.TAKE, 128)
    folder = workspace.stage("ingest")
    record = CaptureRecord.load(folder)
    for image in record.images:
        image["exif"] = {"exposure_value": 13.2}
    record.save(folder)
    summary = tiny_job.run(workspace, "depth", **STEREO)["summary"]
    assert summary["sky"]["daylight"] is True
    assert summary["sky"]["share"] > 0.2
