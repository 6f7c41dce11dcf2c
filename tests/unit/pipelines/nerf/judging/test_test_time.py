"""The test-time procedure on a tiny trained model of pictures whose colours vary."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.metrics import psnr
from pipelines.nerf.judging.test_time import (
    FittedPoses,
    fit_appearance,
    fit_poses,
    half_columns,
    other_half,
)
from pipelines.nerf.models.base import Model

# The class is reached through its module: pytest would take its name for that of a test.
from pipelines.nerf.options import evaluate as evaluation_config
from pipelines.nerf.space.camera_optimizer import CameraOptimizer
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.training.loop import train
from tests.unit.pipelines.nerf.toy_scene import SIZE, tiny_config, toy_cameras, toy_images

OPTIONS = evaluation_config.TestTimeConfig(
    pose_steps=160,
    pose_lr=4e-3,
    pose_lr_final=4e-4,
    appearance_steps=40,
    rays_per_step=256,
)
QUICK = replace(OPTIONS, pose_steps=3, appearance_steps=3, rays_per_step=64)
HELD_OUT = (0, 6, 18)


@dataclass(frozen=True)
class Toy:
    """A model of the toy scene, its pictures taken through warm and cool glass by turns.

    images: those pictures. rendered: what the model itself shows, with the mean code.
    """

    model: Model
    cameras: Cameras
    images: ImageData
    rendered: ImageData


def _with_pixels(images: ImageData, colors: Tensor) -> ImageData:
    return replace(images, pixels=(colors.clamp(0.0, 1.0) * 255.0).round().byte())


@pytest.fixture(scope="module")
def toy() -> Toy:
    cameras = toy_cameras()
    plain = toy_images(cameras)
    # By pairs: cameras stand high and low by turns, and the direction is not to tell the glass.
    glass = torch.tensor([[[1.0, 0.7, 0.5]], [[0.5, 0.7, 1.0]]])
    gains = glass[torch.arange(len(cameras)) // 2 % 2]
    colors = plain.pixels.reshape(len(cameras), SIZE * SIZE, 3).float() / 255.0
    images = _with_pixels(plain, (colors * gains).reshape(-1, 3))
    config = tiny_config(max_steps=300, engine="fast")
    config = replace(config, model=replace(config.model, camera_mode="off"))
    training = [index for index in range(len(cameras)) if index % 6]
    model = train(images, cameras, training, config, seed=0)
    with torch.no_grad():
        seen = [model(cameras.image_rays(index))["rgb"] for index in range(len(cameras))]
    return Toy(model, cameras, images, _with_pixels(plain, torch.cat(seen)))


def _psnr(toy: Toy, images: ImageData, index: int, code: Tensor | None, half: str) -> float:
    with torch.no_grad():
        shown = toy.model(toy.cameras.image_rays(index), appearance=code)["rgb"]
    columns = half_columns(SIZE, half)
    return psnr(shown.reshape(SIZE, SIZE, 3)[:, columns], images.image(index)[:, columns])


def _disturbance(num: int, length: float, angle: float) -> Tensor:
    """[N, 6]: translations of one length and rotations by one angle in random directions."""
    random = torch.randn(num, 2, 3, generator=torch.Generator().manual_seed(3))
    unit = torch.nn.functional.normalize(random, dim=-1)
    return torch.cat([length * unit[:, 0], angle * unit[:, 1]], dim=-1)


def _pose_errors(found: Cameras, truth: Cameras, index: int) -> tuple[float, float]:
    """(distance of the centres, angle between the rotations in radians)."""
    one, other = (item.scene_from_camera[index].double().numpy() for item in (found, truth))
    turn = one[:, :3] @ other[:, :3].T
    skew = turn - turn.T  # 2 sin(angle) times the axis' cross product matrix
    sine = 0.5 * np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]])
    return float(np.linalg.norm(one[:, 3] - other[:, 3])), float(np.arcsin(sine))


@pytest.mark.parametrize("mode", ["so3xr3", "se3"])
def test_disturbed_poses_are_found_again(toy: Toy, mode: str) -> None:
    """The pictures are the model's own, so the undisturbed pose is the exact answer."""
    tangent = _disturbance(len(toy.cameras), 0.03, 0.03)
    wrong = FittedPoses(tuple(range(len(tangent))), tangent, "so3xr3", (), ())
    disturbed = wrong.applied_to(toy.cameras)
    options = replace(OPTIONS, pose_mode=mode)
    fitted = fit_poses(toy.model, disturbed, toy.rendered, HELD_OUT, options, seed=1)
    found = fitted.applied_to(disturbed)
    for row, index in enumerate(HELD_OUT):
        assert _pose_errors(disturbed, toy.cameras, index) == pytest.approx((0.03, 0.03), rel=1e-3)
        moved, turned = _pose_errors(found, toy.cameras, index)
        # A sixth of what they were; moving and turning look alike before a far ball.
        assert moved < 0.005
        assert turned < 0.005
        before, after = fitted.loss_before[row], fitted.loss_after[row]
        assert before is not None
        assert after is not None
        assert after < 0.01 * before


def test_poses_that_are_right_stay_where_they_are(toy: Toy) -> None:
    fitted = fit_poses(toy.model, toy.cameras, toy.rendered, [0], OPTIONS, seed=2)
    found = fitted.applied_to(toy.cameras)
    assert max(_pose_errors(found, toy.cameras, 0)) < 0.004
    assert torch.equal(found.scene_from_camera[1:], toy.cameras.scene_from_camera[1:])


def test_a_fit_that_ends_worse_than_it_began_is_undone(toy: Toy) -> None:
    wild = replace(QUICK, pose_lr=0.5, pose_lr_final=0.5)
    fitted = fit_poses(toy.model, toy.cameras, toy.rendered, [0], wild, seed=2)
    assert torch.equal(fitted.tangent, torch.zeros(1, 6))
    assert fitted.loss_after == fitted.loss_before


@pytest.mark.parametrize("mode", ["so3xr3", "se3"])
def test_moved_cameras_have_the_rays_that_the_optimiser_gives(mode: str) -> None:
    cameras = toy_cameras(4)
    tangent = _disturbance(4, 0.4, 0.7)
    moved = FittedPoses((0, 1, 2, 3), tangent, mode, (), ()).applied_to(cameras)
    delta = CameraOptimizer(4, mode)
    with torch.no_grad():
        delta.tangent.copy_(tangent)
        for index in range(4):
            wanted = delta.apply_to(cameras.image_rays(index))
            found = moved.image_rays(index)
            assert torch.allclose(found.origins, wanted.origins, atol=1e-6)
            assert torch.allclose(found.directions, wanted.directions, atol=1e-6)


def test_world_poses_are_moved_by_world_units() -> None:
    # A quarter turn about the scene's z, and half a scene unit along x: 5 world units at 0.1.
    tangent = torch.tensor([[0.5, 0.0, 0.0, 0.0, 0.0, torch.pi / 2]])
    pose = np.concatenate([np.eye(3), [[1e6], [2.0], [3.0]]], axis=1)[None]
    moved = FittedPoses((7,), tangent, "so3xr3", (), ()).moved(pose, scale=0.1)[0]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert moved[:, :3] == pytest.approx(turn, abs=1e-6)
    assert moved[:, 3] == pytest.approx([1e6 + 5.0, 2.0, 3.0])


def test_a_fitted_code_shows_the_colours_of_the_half_that_it_never_saw(toy: Toy) -> None:
    fitted = fit_appearance(toy.model, toy.cameras, toy.images, HELD_OUT, OPTIONS, seed=1)
    assert fitted.codes.shape == (len(HELD_OUT), toy.model.appearance_dim)
    for row, index in enumerate(HELD_OUT):
        unseen = other_half(fitted.halves[row])
        with_mean = _psnr(toy, toy.images, index, None, unseen)
        with_code = _psnr(toy, toy.images, index, fitted.codes[row], unseen)
        assert with_code > with_mean + 1.0
        before, after = fitted.loss_before[row], fitted.loss_after[row]
        assert before is not None
        assert after is not None
        assert after < 0.9 * before


def _painted(images: ImageData, index: int, columns: slice) -> ImageData:
    """The images with part of one of them painted over."""
    pixels = images.pixels.clone().reshape(-1, SIZE, SIZE, 3)
    pixels[index, :, columns] = torch.tensor([255, 0, 80], dtype=torch.uint8)
    return replace(images, pixels=pixels.reshape(-1, 3))


def test_the_code_depends_on_the_chosen_half_alone(toy: Toy) -> None:
    fitted = fit_appearance(toy.model, toy.cameras, toy.images, [6], QUICK, seed=5)
    (half,) = fitted.halves
    hidden = _painted(toy.images, 6, half_columns(SIZE, other_half(half)))
    again = fit_appearance(toy.model, toy.cameras, hidden, [6], QUICK, seed=5)
    assert again.halves == fitted.halves
    assert torch.equal(again.codes, fitted.codes)
    assert again.loss_after == fitted.loss_after
    shown = _painted(toy.images, 6, half_columns(SIZE, half))
    other = fit_appearance(toy.model, toy.cameras, shown, [6], QUICK, seed=5)
    assert not torch.equal(other.codes, fitted.codes)


@pytest.mark.parametrize("width", [2, 7, 32])
def test_the_halves_share_out_all_columns(width: int) -> None:
    columns = list(range(width))
    left, right = columns[half_columns(width, "left")], columns[half_columns(width, "right")]
    assert left + right == columns
    assert len(right) - len(left) in (0, 1)


def test_the_seed_chooses_left_and_right_about_equally_often(toy: Toy) -> None:
    quickest = replace(QUICK, appearance_steps=1, rays_per_step=1)
    halves: list[str] = []
    for seed in range(2):
        indices = list(range(len(toy.cameras)))
        halves += fit_appearance(
            toy.model, toy.cameras, toy.images, indices, quickest, seed=seed
        ).halves
    # 48 throws of a coin: 24 with a deviation of 3.5.
    assert 11 <= halves.count("left") <= 37
    assert halves.count("left") + halves.count("right") == len(halves)


def test_the_same_seed_gives_the_same_fit_whichever_images_are_beside(toy: Toy) -> None:
    alone = fit_poses(toy.model, toy.cameras, toy.images, [6], QUICK, seed=4)
    among = fit_poses(toy.model, toy.cameras, toy.images, [18, 6], QUICK, seed=4)
    assert torch.equal(alone.tangent[0], among.tangent[1])
    assert alone.loss_after[0] == among.loss_after[1]
    other = fit_poses(toy.model, toy.cameras, toy.images, [6], QUICK, seed=5)
    assert not torch.equal(other.tangent, alone.tangent)
    codes = [
        fit_appearance(toy.model, toy.cameras, toy.images, [6], QUICK, seed=4).codes
        for _ in range(2)
    ]
    assert torch.equal(*codes)


def test_the_model_is_left_as_it_was(toy: Toy) -> None:
    model = copy.deepcopy(toy.model).train()
    frozen = next(model.parameters())
    frozen.requires_grad_(False)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    wanted = [parameter.requires_grad for parameter in model.parameters()]
    fit_poses(model, toy.cameras, toy.images, [0], QUICK, seed=0)
    fit_appearance(model, toy.cameras, toy.images, [0], QUICK, seed=0)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])
    assert [parameter.requires_grad for parameter in model.parameters()] == wanted
    assert all(parameter.grad is None for parameter in model.parameters())
    assert model.training


def test_masked_pixels_are_never_looked_at(toy: Toy) -> None:
    middle = slice(10, 22)
    usable = torch.ones(len(toy.cameras), SIZE, SIZE, dtype=torch.bool)
    usable[:, :, middle] = False
    masked = replace(toy.images, valid=usable.reshape(-1))
    painted = replace(_painted(toy.images, 6, middle), valid=masked.valid)
    both = (masked, painted)
    poses = [fit_poses(toy.model, toy.cameras, images, [6], QUICK, seed=0) for images in both]
    assert torch.equal(poses[0].tangent, poses[1].tangent)
    codes = [fit_appearance(toy.model, toy.cameras, images, [6], QUICK, seed=0) for images in both]
    assert torch.equal(codes[0].codes, codes[1].codes)


def test_a_half_without_usable_pixels_is_not_chosen_and_an_empty_image_is_not_fitted(
    toy: Toy,
) -> None:
    usable = torch.zeros(len(toy.cameras), SIZE, SIZE, dtype=torch.bool)
    usable[0, :, half_columns(SIZE, "left")] = True
    images = replace(toy.images, valid=usable.reshape(-1))
    for seed in range(4):
        fitted = fit_appearance(toy.model, toy.cameras, images, [0, 6], QUICK, seed=seed)
        assert fitted.halves[0] == "left"
        assert fitted.loss_after[1] is None
        mean = toy.model.mean_appearance()
        assert mean is not None
        assert torch.equal(fitted.codes[1], mean)
    poses = fit_poses(toy.model, toy.cameras, images, [0, 6], QUICK, seed=0)
    assert bool(poses.tangent[0].any())
    assert not bool(poses.tangent[1].any())
    assert poses.loss_before[1] is None


def test_progress_goes_up_to_one_and_can_end_the_fit(toy: Toy) -> None:
    shares: list[float] = []
    fit_poses(toy.model, toy.cameras, toy.images, [0, 6], QUICK, seed=0, progress=shares.append)
    assert shares == pytest.approx([k / 6 for k in range(1, 7)])

    class StoppedError(Exception):
        pass

    def stop(share: float) -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        fit_appearance(toy.model, toy.cameras, toy.images, [0], QUICK, seed=0, progress=stop)
    assert all(parameter.requires_grad for parameter in toy.model.parameters())


def test_a_model_without_codes_is_refused(toy: Toy) -> None:
    config = tiny_config()
    plain = type(toy.model)(replace(config.model, appearance_dim=0), 4)  # type: ignore[call-arg]
    with pytest.raises(NerfError, match="no appearance codes"):
        fit_appearance(plain, toy.cameras, toy.images, [0], QUICK, seed=0)


def test_a_loss_that_is_not_finite_is_named(toy: Toy) -> None:
    broken = copy.deepcopy(toy.model)
    with torch.no_grad():
        for parameter in broken.network_parameters():
            parameter.fill_(torch.nan)
    with pytest.raises(NerfError, match="fitting to a held-out image") as caught:
        fit_poses(broken, toy.cameras, toy.images, [0], QUICK, seed=0)
    assert caught.value.code == "non_finite_loss"
