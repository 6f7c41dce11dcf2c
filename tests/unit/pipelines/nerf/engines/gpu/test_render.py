"""Tiles of the GPU renderer, with the plain parts on the CPU, against the model itself."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pipelines.nerf.engines.gpu.render import TileDrawer, can_draw
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.space.rays import Rays
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras


def opaque_model(**changes: object) -> Nerfacto:
    """A random model whose rays end before, in and behind the middle of their samples."""
    torch.manual_seed(3)
    config = tiny_config().model
    assert isinstance(config, NerfactoConfig)
    model = Nerfacto(replace(config, **changes), 4)  # type: ignore[arg-type]
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, HashGrid):
                module.table.mul_(3e3 if module is model.field.grid else 1e3)
        for layer in model.field.color_mlp.layers:
            layer.get_parameter("weight").mul_(3.0)
        assert model.field.appearance is not None
        model.field.appearance.weight.normal_()
    return model.eval()


def some_rays() -> Rays:
    cameras = toy_cameras(4)
    return Rays(*(torch.cat(parts) for parts in zip(*(
        (rays.origins[::5], rays.directions[::5], rays.camera_indices[::5])
        for rays in (cameras.image_rays(index) for index in range(4))
    ), strict=True)))  # fmt: skip


@pytest.mark.parametrize("background", ["last_sample", "black", "white"])
@pytest.mark.parametrize("appearance", [None, 2])
def test_without_thresholds_tiles_are_those_of_the_model(
    background: str, appearance: int | None
) -> None:
    model, rays = opaque_model(background=background), some_rays()
    drawer = TileDrawer(model, appearance=appearance, early_stop=0.0, weight_threshold=-1.0)
    found = drawer.draw(rays)
    with torch.no_grad():
        expected = model(rays, appearance=appearance)
    for name, values in found.items():
        torch.testing.assert_close(values, expected[name], rtol=1e-4, atol=1e-5)
    assert found["rgb"].std() > 0.02


@pytest.mark.parametrize(("early_stop", "threshold"), [(0.05, 0.0), (0.0, 0.01), (0.05, 0.01)])
@pytest.mark.parametrize("background", ["last_sample", "black"])
def test_thresholds_change_colours_by_no_more_than_they_say(
    early_stop: float, threshold: float, background: str
) -> None:
    model, rays = opaque_model(background=background), some_rays()
    found = TileDrawer(model, early_stop=early_stop, weight_threshold=threshold).draw(rays)
    with torch.no_grad():
        expected = model(rays)
    change = (found["rgb"] - expected["rgb"]).abs().max()
    allowed = early_stop + model.config.num_nerf_samples * threshold
    assert 0.0 < float(change) <= allowed + 1e-5
    lost = expected["accumulation"] - found["accumulation"]
    assert float(lost.max()) <= early_stop + 1e-5
    assert float(lost.min()) >= -1e-5


def test_an_appearance_code_itself_may_be_given() -> None:
    model, rays = opaque_model(), some_rays()
    assert model.field.appearance is not None
    code = model.field.appearance.weight[1].detach()
    by_number = TileDrawer(model, appearance=1).draw(rays)["rgb"]
    assert torch.equal(TileDrawer(model, appearance=code).draw(rays)["rgb"], by_number)
    assert not torch.allclose(TileDrawer(model).draw(rays)["rgb"], by_number, atol=1e-3)


def test_fewer_samples_are_those_of_a_model_with_fewer() -> None:
    model, rays = opaque_model(), some_rays()
    fewer = opaque_model(num_proposal_samples=(12, 8), num_nerf_samples=6)
    found = TileDrawer(model, early_stop=0.0, weight_threshold=-1.0, samples=(12, 8, 6)).draw(rays)
    with torch.no_grad():
        expected = fewer(rays)
    torch.testing.assert_close(found["rgb"], expected["rgb"], rtol=1e-4, atol=1e-5)


def test_models_with_normals_or_other_encodings_are_left_to_the_plain_renderer() -> None:
    assert can_draw(opaque_model())
    assert not can_draw(opaque_model(predict_normals=True))
