"""Methods and parts of other packages, through real entry points of a package on the path."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipelines.nerf.along_ray.intervals import t_from_s
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.catalogue import BUILT_IN_METHODS, find_method, methods
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.train import default_train_config, validate
from pipelines.nerf.plugins import forget_plugins, plugin_components
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.contraction import scene_from_unit, unit_from_scene
from pipelines.nerf.training.checkpoint import load_model, save_model
from pipelines.nerf.training.loop import train
from pipelines.options import OptionsError, resolve_options, train_config, train_options
from pipelines.presets import PRESETS
from tests.unit.pipelines.nerf.models.toy_runs import SCENE, same_state
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

TOY_MODULE = '''
"""A method that knows one colour and one density, and three parts."""

from dataclasses import dataclass

import torch
from torch import nn

from pipelines.nerf.options.train import ModelConfig, option
from pipelines.nerf.space.contraction import Contraction
from pipelines.nerf.along_ray.intervals import Spacing, weights_from_density
from pipelines.nerf.along_ray.losses import color_loss
from pipelines.nerf.models.base import Model, Outputs
from pipelines.nerf.plugins import Component, Method
from pipelines.nerf.along_ray.rendering import accumulation, composite, expected_depth, median_depth
from pipelines.nerf.along_ray.samplers import sample_along


@dataclass(frozen=True)
class ToyConfig(ModelConfig):
    num_samples: int = option(8, "Samples per ray.", ge=1, le=64)
    spacing: str = option("uniform", "Spacing.", choices=("uniform",), plugins="spacing")


class Toy(Model):
    method = "toy"

    def __init__(self, config, num_train_images):
        super().__init__(config, num_train_images)
        self.config = config
        self.color = nn.Parameter(torch.full((3,), 3.0))
        self.thickness = nn.Parameter(torch.zeros(()))

    def forward(self, rays, *, plan=None, appearance=None, generator=None):
        config = self.config
        rays = self.corrected(rays)
        samples = sample_along(
            rays, config.num_samples, config.near, config.far,
            spacing=config.spacing, generator=generator,
        )
        weights = weights_from_density(self.density(samples.positions(rays)), samples.t_edges)
        colors = torch.sigmoid(self.color).expand(*weights.shape, 3)
        return Outputs(
            rgb=composite(colors, weights, config.background, generator=generator),
            accumulation=accumulation(weights),
            depth=median_depth(weights.detach(), samples.t_edges),
            expected_depth=expected_depth(weights.detach(), samples.t_edges),
            weights=[weights],
            samples=[samples],
        )

    def loss_dict(self, outputs, truth, *, plan=None):
        return {"rgb": color_loss(outputs["rgb"], truth)}

    def density(self, points):
        return torch.exp(self.thickness) * torch.ones_like(points[..., 0])


class HalfGrid(nn.Module):
    num_outputs = 3

    def __init__(self, config):
        super().__init__()
        self.scale = nn.Parameter(torch.full((3,), float(config.hidden_dim)))

    def forward(self, unit):
        return unit * self.scale


PLUGINS = [
    Method(
        name="toy",
        summary="One colour.",
        config=ToyConfig,
        model="toy_package:Toy",
        train={"max_steps": 12, "optimizer": {"lr": 0.2}},
    ),
    Component("contraction", "tanh", Contraction(
        lambda x: 2.0 * torch.tanh(0.5 * x), lambda z: 2.0 * torch.atanh(0.5 * z))),
    Component("spacing", "square_root", Spacing(torch.sqrt, torch.square)),
    Component("position_encoding", "scaled", HalfGrid),
]
'''


def install(folder: Path, module: str, text: str, entry: str) -> None:
    """A package as an installer leaves it: a module and the metadata that names its entry point."""
    (folder / f"{module}.py").write_text(text, "utf-8")
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[nerfworks.methods]\n{entry}\n", "utf-8")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that Python imports from; what it brought is forgotten afterwards."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    forget_plugins()
    yield folder
    forget_plugins()
    for name in ("toy_package", "broken_package"):
        sys.modules.pop(name, None)


@pytest.fixture
def toy(site: Path) -> None:
    """The toy package is installed."""
    install(site, "toy_package", TOY_MODULE, "toy = toy_package:PLUGINS")


@pytest.fixture(scope="module")
def capture() -> tuple[ImageData, Cameras]:
    cameras = toy_cameras(6)
    return toy_images(cameras), cameras


def _toy_run(**model: Any) -> Any:
    config = default_train_config("toy")
    options = replace(config.model, near=0.3, far=5.0, background="black", **model)
    return replace(config, rays_per_step=64, device="cpu", model=options)


@pytest.mark.usefixtures("toy")
def test_an_installed_method_is_listed_with_its_defaults() -> None:
    assert list(methods())[: len(BUILT_IN_METHODS)] == [m.name for m in BUILT_IN_METHODS]
    assert methods()["toy"].summary == "One colour."
    config = default_train_config("toy")
    assert (config.method, config.max_steps, config.optimizer.lr) == ("toy", 12, 0.2)
    assert config.optimizer.lr_final == tiny_config().optimizer.lr_final
    validate(config)


@pytest.mark.usefixtures("toy")
def test_its_options_are_resolved_and_checked_like_any() -> None:
    chosen = {"train": {"method": "toy", "model": {"num_samples": 5, "spacing": "square_root"}}}
    resolved = resolve_options("preview", chosen)["train"]
    assert resolved["method"] == "toy"
    assert resolved["model"]["num_samples"] == 5
    assert resolved["max_steps"] == PRESETS["preview"].overrides["train"]["max_steps"]
    assert resolved["optimizer"]["lr"] == 0.2  # of the method
    config = train_config(train_options("toy").model_validate(resolved))
    assert type(config.model).__name__ == "ToyConfig"
    for wrong in ({"num_samples": 65}, {"spacing": "cube"}, {"num_nerf_samples": 3}):
        with pytest.raises(OptionsError, match=next(iter(wrong))):
            resolve_options("preview", {"train": {"method": "toy", "model": wrong}})


@pytest.mark.usefixtures("toy")
def test_it_trains_is_saved_and_is_rendered(
    capture: tuple[ImageData, Cameras], tmp_path: Path
) -> None:
    images, cameras = capture
    losses: list[float] = []
    model = train(
        images,
        cameras,
        [0, 1, 2, 3],
        _toy_run(spacing="square_root"),
        seed=0,
        checkpoint_path=tmp_path / "checkpoint.pt",
        on_progress=lambda progress: losses.append(progress.losses["rgb"]),
    )
    assert len(losses) == 12
    assert sum(losses[-3:]) < sum(losses[:3])

    save_model(tmp_path / "model.zip", model, SCENE, {})
    loaded = load_model(tmp_path / "model.zip").model
    assert type(loaded).__module__ == "toy_package"
    assert same_state(model, loaded)
    picture = Renderer(loaded, SCENE).render(cameras, 5)
    assert np.array_equal(picture.rgb, Renderer(model, SCENE).render(cameras, 5).rgb)
    with torch.no_grad():
        seen = loaded(cameras.image_rays(5))["rgb"].reshape(picture.rgb.shape)
    assert np.allclose(picture.rgb, seen.numpy(), atol=1e-6)


@pytest.mark.usefixtures("toy")
def test_its_parts_serve_the_built_in_methods(capture: tuple[ImageData, Cameras]) -> None:
    images, cameras = capture
    parts = {"contraction": "tanh", "spacing": "square_root", "position_encoding": "scaled"}
    base = tiny_config(max_steps=3)
    assert isinstance(base.model, NerfactoConfig)
    config = replace(base, model=replace(base.model, **parts))  # type: ignore[arg-type]
    validate(config)
    model = train(images, cameras, [0, 1, 2, 3], config, seed=0)
    assert isinstance(model, Nerfacto)
    assert model.field.grid.scale.shape == (3,)
    assert bool((model.field.grid.scale != base.model.hidden_dim).all())  # it was learned
    # The compiled renderer knows none of these: the model itself is asked.
    renderer = Renderer(model, SCENE)
    assert renderer.engine == "plain"
    assert np.isfinite(renderer.render(cameras, 4).rgb).all()


@pytest.mark.usefixtures("toy")
def test_its_contraction_and_spacing_are_those_that_are_used() -> None:
    points = torch.tensor([[0.5, -3.0, 40.0]])
    unit, inside = unit_from_scene(points, "tanh")
    assert inside is None
    assert torch.allclose(unit, torch.tanh(0.5 * points) * 0.5 + 0.5)
    near = points.clamp(-3.0, 3.0).double()
    assert torch.allclose(scene_from_unit(unit_from_scene(near, "tanh")[0], "tanh"), near)
    # Even steps of the root from 1 to 9: at the middle 2^2.
    t = t_from_s(torch.tensor([0.0, 0.5, 1.0]), 1.0, 9.0, "square_root")
    assert t.tolist() == pytest.approx([1.0, 4.0, 9.0])


def test_what_nobody_offers_is_refused_with_the_names_there_are() -> None:
    forget_plugins()
    with pytest.raises(NerfError, match="nerfacto, instant-ngp, nerf") as refused:
        find_method("toy")
    assert refused.value.code == "bad_config"
    with pytest.raises(OptionsError, match="nerfacto, instant-ngp, nerf"):
        resolve_options("preview", {"train": {"method": "toy"}})
    base = tiny_config()
    for name, allowed in (
        ("contraction", "linf, l2, none"),
        ("spacing", "piecewise, uniform, disparity"),
        ("position_encoding", "hash, vm, cp, voxel, fourier"),
    ):
        with pytest.raises(NerfError, match=allowed):
            validate(with_model(base, **{name: "tanh"}))


@pytest.mark.usefixtures("toy")
def test_a_package_that_went_is_forgotten(site: Path) -> None:
    assert "toy" in methods()
    assert "tanh" in plugin_components("contraction")
    (site / "toy_package-1.0.dist-info" / "entry_points.txt").write_text("", "utf-8")
    forget_plugins()
    assert "toy" not in methods()
    assert plugin_components("contraction") == {}


@pytest.mark.parametrize(
    ("text", "entry", "problem"),
    [
        ("import no_such_module_here", "bad = broken_package:PLUGINS", "cannot be loaded"),
        ("", "bad = broken_package:PLUGINS", "cannot be loaded"),
        ("PLUGINS = [42]", "bad = broken_package:PLUGINS", "neither a Method nor a Component"),
        (
            "from pipelines.nerf.plugins import Component\n"
            "PLUGINS = Component('colour', 'pink', None)",
            "bad = broken_package:PLUGINS",
            "neither a Method nor a Component",
        ),
    ],
)
def test_an_entry_point_that_is_no_use_is_refused_by_name(
    site: Path, text: str, entry: str, problem: str
) -> None:
    install(site, "broken_package", text, entry)
    with pytest.raises(NerfError, match=problem) as refused:
        methods()
    assert refused.value.code == "bad_plugin"
    assert "entry point bad " in refused.value.message
    assert "uninstall" in refused.value.hint
