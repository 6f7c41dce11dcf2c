"""The check that decides whether the GPU engine is trusted, on the CPU with its engines."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pipelines.nerf.data.pixels import _UsablePixels
from pipelines.nerf.engines.gpu import self_check
from pipelines.nerf.engines.gpu.render import TileDrawer
from pipelines.nerf.engines.gpu.self_check import engine_problem, picture_problem, relative_gap
from pipelines.nerf.engines.gpu.step import TrainingStep
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.space import lenses
from pipelines.nerf.space.rays import Rays
from tests.unit.pipelines.nerf.toy_scene import tiny_config

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """And one thread: on a busy machine more would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    monkeypatch.setattr(self_check, "NUM_RAYS", 32)
    monkeypatch.setattr(self_check, "NUM_STEPS", 3)
    engine_problem.cache_clear()
    yield
    torch.set_num_threads(threads)


def plain_config() -> TrainConfig:
    """A run whose two engines are both PyTorch's, until a test changes one."""
    config = tiny_config()
    return replace(config, model=replace(config.model, position_encoding="fourier"))  # type: ignore[call-arg]


def spoil_fast(monkeypatch: pytest.MonkeyPatch, change: Callable[[Nerfacto], object]) -> None:
    """Change every model that is told to be fast."""

    def set_engine(model: Nerfacto, engine: str) -> None:
        model.engine = "plain"
        if engine == "fast":
            change(model)

    monkeypatch.setattr(Nerfacto, "set_engine", set_engine)


def test_engines_that_agree_are_no_problem() -> None:
    before = torch.random.get_rng_state()
    assert engine_problem(plain_config(), CPU) is None
    assert torch.equal(torch.random.get_rng_state(), before)


def test_a_wrong_gradient_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def half_too_much(gradient: Tensor) -> Tensor:
        return 1.5 * gradient

    def spoil(model: Nerfacto) -> None:
        parameters = dict(model.named_parameters())
        parameters["field.color_mlp.layers.0.weight"].register_hook(half_too_much)

    spoil_fast(monkeypatch, spoil)
    problem = engine_problem(plain_config(), CPU)
    assert problem == (
        "the gradient of field.color_mlp.layers.0.weight is off by 50 % "
        "(masked pictures of all lenses, held on the device)"
    )


def test_a_gradient_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    spoil_fast(monkeypatch, lambda model: model.cameras_delta.requires_grad_(False))
    problem = engine_problem(plain_config(), CPU)
    assert str(problem).startswith("only one engine has a gradient of cameras_delta.tangent")


def test_wrong_values_are_told_as_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    def brighten(model: Nerfacto) -> None:
        with torch.no_grad():
            model.field.color_mlp.layers[-1].bias.add_(1.0)  # type: ignore[operator]

    spoil_fast(monkeypatch, brighten)
    problem = engine_problem(plain_config(), CPU)
    assert problem is not None
    assert problem.startswith("the colour loss of the first step is")


def test_an_error_of_the_engine_is_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(model: Nerfacto) -> None:
        raise RuntimeError("Failed to find C compiler.\nPlease specify one.")

    spoil_fast(monkeypatch, fail)
    assert engine_problem(plain_config(), CPU) == "RuntimeError: Failed to find C compiler."


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (lenses, "_undistort_plane"),
        (lenses, "_undistort_fisheye"),
        (lenses, "_undistort_equirectangular"),
        (_UsablePixels, "find"),
    ],
)
def test_an_operation_of_lenses_or_masks_that_cannot_run_is_found(
    monkeypatch: pytest.MonkeyPatch, owner: object, name: str
) -> None:
    def fails(*args: object) -> Tensor:
        raise RuntimeError("no kernel image")

    monkeypatch.setattr(owner, name, fails)
    assert engine_problem(plain_config(), CPU) == "RuntimeError: no kernel image"


def test_pixels_that_cannot_be_fed_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = TrainingStep.optimise

    def fails(step: TrainingStep, *args: Any) -> None:
        if step._fed is not None:
            raise RuntimeError("no pinned memory")
        ours(step, *args)

    monkeypatch.setattr(TrainingStep, "optimise", fails)
    assert engine_problem(plain_config(), CPU) == "RuntimeError: no pinned memory"


def test_steps_that_draw_the_same_numbers_again_are_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Repeating(TrainingStep):
        def run(self, step: int, rates: Mapping[str, float]) -> None:
            before = self._pixel_random.get_state()
            super().run(step, rates)
            if step > self_check.FIRST_STEP:
                self._pixel_random.set_state(before)

    monkeypatch.setattr(self_check, "TrainingStep", Repeating)
    assert str(engine_problem(plain_config(), CPU)).startswith("step 2 drew no new random numbers")


def test_gaps_are_relative_to_what_is_expected() -> None:
    assert relative_gap(torch.tensor([3.0, 5.0]), torch.tensor([3.0, 4.0])) == pytest.approx(0.2)
    assert relative_gap(torch.zeros(2), torch.zeros(2)) == 0.0
    assert relative_gap(torch.ones(2), torch.zeros(2)) == float("inf")
    assert not relative_gap(torch.tensor([float("nan")]), torch.ones(1)) <= 1.0


def test_a_model_that_is_drawn_as_it_sees_itself_is_no_problem() -> None:
    model = Nerfacto(tiny_config().model, 4)  # type: ignore[arg-type]
    model.train()
    assert picture_problem(model) is None
    assert model.training


@pytest.mark.parametrize("value", [5.0, float("nan")])
def test_wrong_colours_of_the_gpu_renderer_are_named(
    monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    model = Nerfacto(tiny_config().model, 4)  # type: ignore[arg-type]
    ours = TileDrawer.draw

    def spoiled(drawer: TileDrawer, rays: Rays) -> dict[str, Tensor]:
        return {name: seen + value for name, seen in ours(drawer, rays).items()}

    monkeypatch.setattr(TileDrawer, "draw", spoiled)
    assert "colours" in str(picture_problem(model))


def test_few_rays_that_are_wrong_are_named_where_their_mean_is_small(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours = TileDrawer.draw

    def spoiled(drawer: TileDrawer, rays: Rays) -> dict[str, Tensor]:
        seen = ours(drawer, rays)
        seen["rgb"][: len(rays) // 25] += 0.2  # 0.008 in the mean of all
        return seen

    monkeypatch.setattr(self_check, "PICTURE_RAYS", 100)
    monkeypatch.setattr(TileDrawer, "draw", spoiled)
    model = Nerfacto(tiny_config().model, 4)  # type: ignore[arg-type]
    assert "2 % of its colours are off by 0.2" in str(picture_problem(model))


def sharp_model() -> Nerfacto:
    """Of surfaces so sharp that coarser numbers make some rays miss them."""
    torch.manual_seed(0)
    model = Nerfacto(tiny_config().model, 4)  # type: ignore[arg-type]
    for name, parameter in model.named_parameters():
        parameter.data.mul_(10_000.0 if name.endswith("table") else 5.0)
    return model


def with_numbers_of(model: Nerfacto, dtype: torch.dtype, rays: Rays) -> dict[str, Tensor]:
    coarse = copy.deepcopy(model)
    for parameter in coarse.parameters():
        parameter.data = parameter.data.to(dtype).float()
    with torch.no_grad():
        return coarse(rays)


def test_rays_that_rounding_moves_say_nothing_of_the_renderer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = sharp_model()
    moved: list[Tensor] = []

    def rounded(drawer: TileDrawer, rays: Rays) -> dict[str, Tensor]:
        found = with_numbers_of(model, torch.bfloat16, rays)
        moved.append((found["rgb"] - model(rays)["rgb"]).abs())
        return found

    monkeypatch.setattr(TileDrawer, "draw", rounded)
    assert picture_problem(model) is None
    (of_all,) = moved
    assert of_all.flatten().quantile(self_check.FEW) > self_check.COLOR_TOLERANCE_OF_FEW


def test_wrong_colours_are_named_where_rounding_moves_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = sharp_model()

    def spoiled(drawer: TileDrawer, rays: Rays) -> dict[str, Tensor]:
        seen = with_numbers_of(model, torch.bfloat16, rays)
        seen["rgb"][::25] += 0.3
        return seen

    monkeypatch.setattr(TileDrawer, "draw", spoiled)
    assert "colours are off" in str(picture_problem(model))


def test_nothing_is_trusted_where_all_colours_hang_on_rounding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(self_check, "STEADY", -1.0)
    model = Nerfacto(tiny_config().model, 4)  # type: ignore[arg-type]
    assert picture_problem(model) == "the colours of 1024 of 1024 rays hang on rounding"


def test_a_renderer_that_cannot_run_is_a_problem_and_no_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(drawer: TileDrawer, rays: Rays) -> dict[str, Tensor]:
        raise RuntimeError("no C compiler")

    monkeypatch.setattr(TileDrawer, "draw", fails)
    model = Nerfacto(tiny_config().model, 4)  # type: ignore[arg-type]
    assert picture_problem(model) == "RuntimeError: no C compiler"
