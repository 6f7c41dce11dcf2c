"""Every term of every method's loss against sums by hand, with weights that all differ."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pipelines.nerf.along_ray.losses import interlevel_loss
from pipelines.nerf.models.base import Model, StepPlan
from pipelines.nerf.models.instant_ngp import InstantNgp
from pipelines.nerf.models.nerf import Nerf
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.methods.instant_ngp import InstantNgpConfig
from pipelines.nerf.options.methods.nerf import NerfConfig
from pipelines.nerf.options.parts import ModelConfig
from pipelines.nerf.space.rays import Rays
from tests.unit.pipelines.nerf.toy_scene import tiny_model, toy_cameras

TINY = tiny_model()
WEIGHTS = {
    "camera_translation_penalty": 0.31,
    "camera_rotation_penalty": 0.17,
    "interlevel_weight": 0.7,
    "distortion_weight": 0.05,
    "orientation_weight": 0.3,
    "predicted_normal_weight": 0.9,
}
NERFACTO = replace(TINY, predict_normals=True, **WEIGHTS)  # type: ignore[arg-type]
NUM_RAYS = 30
TRUTH = torch.rand(NUM_RAYS, 3, generator=torch.Generator().manual_seed(7))


def _rays() -> Rays:
    rays = toy_cameras(3).image_rays(1).select(slice(300, 300 + NUM_RAYS))
    return replace(rays, camera_indices=torch.arange(NUM_RAYS) % 3)


def _shaken(model: Model) -> Model:
    """In training, with densities that vary and cameras that moved."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, HashGrid):
                module.table.normal_(generator=generator)
        model.cameras_delta.tangent.normal_(std=0.1, generator=generator)
    return model.train()


def _nerfacto(**changes: object) -> Nerfacto:
    torch.manual_seed(0)
    model = _shaken(Nerfacto(replace(NERFACTO, **changes), 3))  # type: ignore[arg-type]
    assert isinstance(model, Nerfacto)
    return model


def _mean_square(seen: Tensor) -> float:
    pairs = zip(seen.detach().flatten().tolist(), TRUTH.flatten().tolist(), strict=True)
    return sum((one - other) ** 2 for one, other in pairs) / TRUTH.numel()


def _moved_and_turned(model: Model) -> float:
    rows = model.cameras_delta.tangent.tolist()
    lengths = [
        (sum(v * v for v in row[:3]) ** 0.5, sum(v * v for v in row[3:]) ** 0.5) for row in rows
    ]
    moved, turned = (sum(column) / len(rows) for column in zip(*lengths, strict=True))
    return 0.31 * moved + 0.17 * turned


def _distortion(edges: Tensor, weights: Tensor) -> float:
    middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
    pairs = weights[:, :, None] * weights[:, None, :]
    apart = (middles[:, :, None] - middles[:, None, :]).abs()
    own = weights.square() * (edges[:, 1:] - edges[:, :-1]) / 3.0
    return float(((pairs * apart).sum((1, 2)) + own.sum(1)).mean())


@pytest.mark.parametrize("engine", ["plain", "fast"])
def test_every_term_of_nerfacto_is_its_sum_by_hand_times_its_weight(engine: str) -> None:
    model = _nerfacto()
    model.set_engine(engine)
    rays = _rays()
    outputs = model(rays, plan=StepPlan(0), generator=torch.Generator().manual_seed(2))
    losses = {name: float(loss.detach()) for name, loss in model.loss_dict(outputs, TRUTH).items()}

    *proposals, weights = (item.detach() for item in outputs["weights"])
    *rounds, final = (item.s_edges.detach() for item in outputs["samples"])
    extra = {name: item.detach() for name, item in outputs["extra"].items()}
    directions = model.corrected(rays).directions.detach()
    away = (extra["normals"] * directions[:, None, :]).sum(-1)
    assert 0.2 < float((away > 0.0).float().mean()) < 0.8
    behind = (weights * torch.where(away > 0.0, away, 0.0).square()).sum(-1).mean()
    agreement = (extra["normals"] * extra["predicted_normals"]).sum(-1)
    disagreement = (weights * (1.0 - agreement)).sum(-1).mean()
    pairs = list(zip(rounds, proposals, strict=True))
    expected = {
        "rgb": _mean_square(outputs["rgb"]),
        "interlevel": 0.7 * float(interlevel_loss(final, weights, pairs)),
        "distortion": 0.05 * _distortion(final, weights),
        "orientation": 0.3 * float(behind),
        "predicted_normal": 0.9 * float(disagreement),
        "camera": _moved_and_turned(model),
    }
    assert losses == pytest.approx(expected, rel=1e-4)
    assert min(losses.values()) > 1e-4


@pytest.mark.parametrize(
    ("changes", "absent"),
    [
        ({"interlevel_weight": 0.0}, "interlevel"),
        ({"distortion_weight": 0.0}, "distortion"),
        ({"orientation_weight": 0.0}, "orientation"),
        ({"camera_mode": "off"}, "camera"),
    ],
)
def test_a_term_without_weight_is_left_out_and_the_others_stay(
    changes: dict[str, object], absent: str
) -> None:
    found = []
    for model in (_nerfacto(), _nerfacto(**changes)):
        outputs = model(_rays(), generator=torch.Generator().manual_seed(2))
        found.append(
            {name: float(loss.detach()) for name, loss in model.loss_dict(outputs, TRUTH).items()}
        )
    whole, rest = found
    assert whole.keys() - rest.keys() == {absent}
    if absent != "camera":  # without corrections the rays are others
        assert rest == pytest.approx({name: whole[name] for name in rest}, rel=1e-5)


@pytest.mark.parametrize("penalties", [True, False])
@pytest.mark.parametrize(("kind", "config"), [(Nerf, NerfConfig), (InstantNgp, InstantNgpConfig)])
def test_the_other_methods_add_colours_and_camera_penalties(
    kind: type[Model], config: type[ModelConfig], penalties: bool
) -> None:
    own: dict[type[ModelConfig], dict[str, object]] = {
        NerfConfig: {"num_layers": 2, "hidden_dim": 16, "num_coarse_samples": 8},
        InstantNgpConfig: {"grid": TINY.grid, "num_steps": 64, "occupancy_resolution": 16},
    }
    cameras = {
        "camera_mode": "so3xr3" if penalties else "off",
        "camera_translation_penalty": 0.31,
        "camera_rotation_penalty": 0.17,
    }
    torch.manual_seed(0)
    model = _shaken(kind(config(**own[config], **cameras), 3))  # type: ignore[arg-type]
    outputs = model(_rays(), generator=torch.Generator().manual_seed(2))
    losses = {name: float(loss.detach()) for name, loss in model.loss_dict(outputs, TRUTH).items()}
    expected = {"rgb": _mean_square(outputs["rgb"])}
    if kind is Nerf:
        expected["coarse"] = _mean_square(outputs["extra"]["coarse_rgb"])
    if penalties:
        expected["camera"] = _moved_and_turned(model)
    assert losses == pytest.approx(expected, rel=1e-5)


def test_losses_on_normals_teach_the_density_and_move_no_camera() -> None:
    learned = {
        "orientation": ("field.grid.table", "field.density_mlp.layers.0.weight"),
        # The prediction is made from the density network's features, which learn from it too.
        "predicted_normal": ("normal_head.layers.0.weight", "field.grid.table"),
    }
    for term, names in learned.items():
        model = _nerfacto()
        outputs = model(_rays(), generator=torch.Generator().manual_seed(2))
        model.loss_dict(outputs, TRUTH)[term].backward()
        for name in names:
            gradient = model.get_parameter(name).grad
            assert gradient is not None, name
            assert bool(gradient.any()), name
        assert model.cameras_delta.tangent.grad is None
        assert all(parameter.grad is None for parameter in model.proposals.parameters())


def test_normals_teach_the_same_with_compiled_colours() -> None:
    gradients = []
    for engine in ("plain", "fast"):
        model = _nerfacto()
        model.set_engine(engine)
        outputs = model(_rays(), generator=torch.Generator().manual_seed(2))
        torch.stack(list(model.loss_dict(outputs, TRUTH).values())).sum().backward()
        gradients.append({name: item.grad for name, item in model.named_parameters()})
    plain, fast = gradients
    assert plain.keys() == fast.keys()
    for name, expected in plain.items():
        found = fast[name]
        assert expected is not None, name
        assert found is not None, name
        assert float((found - expected).abs().max()) <= 2e-3 * float(expected.abs().max()), name
