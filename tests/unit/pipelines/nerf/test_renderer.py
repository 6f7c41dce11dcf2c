"""Whole pictures: both engines, tiles, units and interruption."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.nerf import renderer as renderer_module
from pipelines.nerf.cameras import Cameras, SceneTransform
from pipelines.nerf.errors import NerfError
from pipelines.nerf.renderer import RenderedImage, Renderer

from .test_kernels import assert_close, random_model

SCENE = SceneTransform(center=(1.0, 2.0, 3.0), scale=0.25)


def two_cameras(width: int = 23, height: int = 17) -> Cameras:
    pose = np.eye(3, 4)
    pose[:, 3] = SCENE.center
    other = pose.copy()
    other[:, 3] += (0.5, 0.2, 0.8)
    return Cameras.from_arrays(
        world_from_camera=[pose, other],
        scene=SCENE,
        widths=[width] * 2,
        heights=[height] * 2,
        focal=[[20.0, 21.0]] * 2,
        principal=[[width / 2, height / 2]] * 2,
        models=["PINHOLE", "OPENCV"],
        distortion=[[0.0] * 6, [0.1, -0.05, 0.0, 0.0, 0.01, 0.0]],
    )


def assert_same(one: RenderedImage, other: RenderedImage) -> None:
    assert_close(one.rgb, other.rgb)
    assert_close(one.accumulation, other.accumulation)
    np.testing.assert_allclose(one.expected_depth, other.expected_depth, rtol=2e-3)
    assert np.isclose(one.depth, other.depth, rtol=1e-3).mean() > 0.98


@pytest.mark.parametrize("index", [0, 1], ids=["pinhole", "distorted"])
def test_both_engines_show_the_same_picture(index: int) -> None:
    model, cameras = random_model(), two_cameras()
    fast = Renderer(model, SCENE, early_stop=0.0, weight_threshold=0.0)
    assert fast.engine == "fast"
    image = fast.render(cameras, index)
    assert image.rgb.shape == (17, 23, 3)
    assert image.rgb.dtype == np.float32
    assert_same(image, Renderer(model, SCENE, engine="plain").render(cameras, index))


def test_a_pixel_shows_what_its_ray_sees() -> None:
    model, cameras = random_model(), two_cameras()
    renderer = Renderer(model, SCENE)
    image = renderer.render(cameras, 1)
    rays = cameras.generate_rays(torch.tensor([1]), torch.tensor([[7.5, 4.5]]))
    single = renderer.render_rays(rays.origins, rays.directions)
    np.testing.assert_allclose(single.rgb[0], image.rgb[4, 7], atol=1e-5)
    np.testing.assert_allclose(single.depth[0], image.depth[4, 7], rtol=1e-4)


def test_depth_is_in_world_units() -> None:
    model, cameras = random_model(), two_cameras()
    twice = SceneTransform(SCENE.center, SCENE.scale * 2.0)
    image, halved = (Renderer(model, scene).render(cameras, 0) for scene in (SCENE, twice))
    np.testing.assert_allclose(image.depth, 2.0 * halved.depth, rtol=1e-6)
    with torch.no_grad():
        scene_depth = model(cameras.image_rays(0))["expected_depth"].numpy()
    exact = Renderer(model, SCENE, early_stop=0.0, weight_threshold=0.0).render(cameras, 0)
    np.testing.assert_allclose(exact.expected_depth.ravel(), scene_depth / 0.25, rtol=1e-3)


@pytest.mark.parametrize("engine", ["fast", "plain"])
def test_tiles_do_not_show(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = Renderer(random_model(), SCENE, engine=engine)
    whole = renderer.render(two_cameras(), 0)
    monkeypatch.setattr(renderer_module, "FAST_TILE_RAYS", 50)
    monkeypatch.setattr(renderer_module, "MAX_PLAIN_RAYS", 50)
    shares: list[float] = []
    assert_same(renderer.render(two_cameras(), 0, progress=shares.append), whole)
    assert len(shares) == 8
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_model_in_training_goes_on_training_and_is_read_anew() -> None:
    model = random_model().train()
    renderer = Renderer(model, SCENE)
    before = renderer.render(two_cameras(), 0)
    assert model.training
    with torch.no_grad():
        model.field.color_mlp.layers[-1].bias += 1.0
    assert (renderer.render(two_cameras(), 0).rgb > before.rgb).mean() > 0.99


def test_what_progress_raises_ends_the_rendering() -> None:
    class Stop(Exception):
        pass

    def stop(share: float) -> None:
        raise Stop

    model = random_model().train()
    with pytest.raises(Stop):
        Renderer(model, SCENE).render(two_cameras(), 0, progress=stop)
    assert model.training


def test_an_unknown_engine_is_refused() -> None:
    with pytest.raises(NerfError, match="no engine warp"):
        Renderer(random_model(), SCENE, engine="warp")


@pytest.mark.gpu
def test_a_model_on_a_gpu_shows_the_same_picture() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    cameras = two_cameras()
    on_cpu = Renderer(random_model(), SCENE, engine="plain").render(cameras, 1)
    on_gpu = Renderer(random_model(), SCENE, device="cuda").render(cameras, 1)
    assert_same(on_cpu, on_gpu)
    with pytest.raises(NerfError, match="runs on the CPU"):
        Renderer(random_model(), SCENE, engine="fast", device="cuda")
