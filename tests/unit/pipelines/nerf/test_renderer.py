"""Whole pictures: both engines, tiles, units and interruption."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.nerf import renderer as renderer_module
from pipelines.nerf.engines.hash_encoders import HASH_ENCODERS
from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.methods.nerfacto import TensorGridConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.render import ALL_SAMPLES, RenderConfig
from pipelines.nerf.renderer import RenderedImage, Renderer, pixels_in_blocks
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from tests.unit.pipelines.nerf.engines.cpu.parts.test_hash_grid import (
    assert_close,
    last_layer,
    random_model,
)

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


def test_less_memory_makes_smaller_tiles_and_the_same_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, cameras = random_model(), two_cameras()
    monkeypatch.setattr(renderer_module, "PLAIN_BYTES", {"cpu": 200 * model.bytes_per_ray()})
    usual = Renderer(model, SCENE, engine="plain")
    small = Renderer(model, SCENE, engine="plain", memory_share=0.25)
    assert (usual._plain_tile(), small._plain_tile()) == (200, 50)
    one, other = usual.render(cameras, 1), small.render(cameras, 1)
    np.testing.assert_allclose(one.rgb, other.rgb, atol=1e-5)


@pytest.mark.parametrize("index", [0, 1], ids=["pinhole", "distorted"])
def test_both_engines_show_the_same_picture(index: int) -> None:
    model, cameras = random_model(), two_cameras()
    fast = Renderer(model, SCENE, config=ALL_SAMPLES)
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


@pytest.mark.parametrize(("width", "height", "side"), [(8, 8, 4), (7, 5, 4), (6, 3, 1), (3, 2, 8)])
def test_pixels_in_blocks_come_square_by_square(width: int, height: int, side: int) -> None:
    expected = [
        y * width + x
        for top in range(0, height, side)
        for left in range(0, width, side)
        for y in range(top, min(top + side, height))
        for x in range(left, min(left + side, width))
    ]
    assert pixels_in_blocks(width, height, side).tolist() == expected


def test_blocks_do_not_show() -> None:
    model, cameras = random_model(), two_cameras()
    rows = Renderer(model, SCENE, config=RenderConfig(block_px=1)).render(cameras, 1)
    blocks = Renderer(model, SCENE, config=RenderConfig(block_px=4)).render(cameras, 1)
    for name in ("rgb", "accumulation", "depth", "expected_depth"):
        np.testing.assert_array_equal(getattr(blocks, name), getattr(rows, name))


def test_depth_is_in_world_units() -> None:
    model, cameras = random_model(), two_cameras()
    twice = SceneTransform(SCENE.center, SCENE.scale * 2.0)
    image, halved = (Renderer(model, scene).render(cameras, 0) for scene in (SCENE, twice))
    np.testing.assert_allclose(image.depth, 2.0 * halved.depth, rtol=1e-6)
    with torch.no_grad():
        scene_depth = model(cameras.image_rays(0))["expected_depth"].numpy()
    exact = Renderer(model, SCENE, config=ALL_SAMPLES).render(cameras, 0)
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
        last_layer(model.field.color_mlp).bias.add_(1.0)
    assert (renderer.render(two_cameras(), 0).rgb > before.rgb).mean() > 0.99


@pytest.mark.parametrize("chosen", ["auto", "plain"])
@pytest.mark.parametrize("before", ["plain", "fast"])
def test_a_model_keeps_its_engine_whatever_it_is_rendered_with(before: str, chosen: str) -> None:
    # Its field has no kernel, its grids have one.
    model = random_model(position_encoding="vm", tensor_grid=TensorGridConfig(8, 2))
    model.set_engine(before)
    grids = [module for module in model.modules() if isinstance(module, HashGrid)]
    used: list[str] = []

    def engines() -> list[str]:
        names = {encode: name for name, encode in HASH_ENCODERS.items()}
        return [model.engine, *(names[grid.encode] for grid in grids)]

    def note(share: float) -> None:
        used.extend(engines())
        raise InterruptedError

    renderer = Renderer(model, SCENE, engine=chosen)
    assert renderer.engine == "plain"
    with pytest.raises(InterruptedError):
        renderer.render(two_cameras(), 0, progress=note)
    assert set(used) == {"fast" if chosen == "auto" else "plain"}
    assert set(engines()) == {before}


def test_what_progress_raises_ends_the_rendering() -> None:
    class Stop(Exception):
        pass

    def stop(share: float) -> None:
        raise Stop

    model = random_model().train()
    with pytest.raises(Stop):
        Renderer(model, SCENE).render(two_cameras(), 0, progress=stop)
    assert model.training


def test_a_grid_that_no_kernel_reads_is_rendered_by_the_model() -> None:
    wide = HashGridConfig(num_levels=3, max_res=20, log2_table_size=8, features_per_level=4)
    model = random_model(grid=wide)
    renderer = Renderer(model, SCENE)
    assert renderer.engine == "plain"
    assert renderer.render(two_cameras(), 0).rgb.std() > 0.01
    with pytest.raises(NerfError, match="two features"):
        Renderer(model, SCENE, engine="fast")


def test_an_unknown_engine_is_refused() -> None:
    with pytest.raises(NerfError, match="no engine warp"):
        Renderer(random_model(), SCENE, engine="warp")


@pytest.mark.gpu
def test_a_model_on_a_gpu_shows_the_same_picture() -> None:
    if not torch.cuda.is_available():
        pytest.skip("pictures of a GPU are NOT tested: no CUDA device")
    cameras = two_cameras()
    on_cpu = Renderer(random_model(), SCENE, engine="plain").render(cameras, 1)
    on_gpu = Renderer(random_model(), SCENE, engine="plain", device="cuda").render(cameras, 1)
    assert_same(on_cpu, on_gpu)
    drawn = Renderer(random_model(), SCENE, engine="fast", device="cuda", config=ALL_SAMPLES)
    # Tables are read in half precision there.
    assert np.abs(drawn.render(cameras, 1).rgb - on_cpu.rgb).mean() < 0.02
