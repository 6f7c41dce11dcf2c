"""The step of the GPU engine, run without graphs on the CPU, against the training loop."""

from __future__ import annotations

import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pipelines import nerf
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.engines.gpu.step import (
    LossReader,
    TrainingStep,
    can_capture,
    capturable_adam,
    loss_scale,
    loss_scaler,
)
from pipelines.nerf.models.base import Model, StepPlan
from pipelines.nerf.networks.decay import set_table_decay
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.train import FlatLossConfig, OptimizerConfig, TrainConfig
from pipelines.nerf.training.loop import train
from pipelines.nerf.training.state import learning_rates
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

CPU = torch.device("cpu")
NERF = Path(nerf.__file__).parent
SEED = 5
STEPS = 14  # past the first ten, after which the proposals learn in some steps only


def toy_step(config: TrainConfig) -> tuple[Model, TrainingStep]:
    """A new model and the step that trains it, from the seeds that `train` takes."""
    cameras = toy_cameras(6)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        model: Model = find_method(config.method).build(config.model, len(cameras)).train()
    model.cameras_delta.keep_frame(cameras.scene_from_camera)
    rates = config.optimizer
    step = TrainingStep(
        model,
        {
            "networks": capturable_adam(model.network_parameters(), rates.lr, rates.eps, CPU),
            # As the training loop makes it on a CPU, so that nothing differs in its last bit.
            "cameras": torch.optim.Adam(
                model.cameras_delta.parameters(), lr=rates.camera_lr, eps=rates.eps
            ),
        },
        loss_scaler(CPU, config.rays_per_step),
        PixelSampler(toy_images(cameras), range(len(cameras)), lines=PlainLines.of(config)),
        cameras,
        config.rays_per_step,
        pixel_random=torch.Generator().manual_seed(SEED),
        model_random=torch.Generator().manual_seed(SEED + 1),
    )
    set_table_decay(step.optimizers["networks"], model, rates.table_decay)
    return model, step


def rare_updates(**changes: object) -> TrainConfig:
    """A run in which both kinds of steps occur, before and after the end of the annealing."""
    flat = FlatLossConfig("always", contrast=1.0)
    rates = OptimizerConfig(decay_steps=1000, table_decay=1e-3)
    config = tiny_config(rays_per_step=64, max_steps=STEPS, flat=flat, optimizer=rates, **changes)
    return with_model(config, proposal_warmup_steps=1, proposal_update_every=3, anneal_steps=12)


@pytest.fixture(scope="module")
def trained() -> tuple[Model, list[dict[str, float]]]:
    """What the training loop makes of the run, and the losses it reported after each step."""
    cameras = toy_cameras(6)
    reported: list[dict[str, float]] = []
    model = train(
        toy_images(cameras),
        cameras,
        range(6),
        rare_updates(),
        seed=SEED,
        on_progress=lambda progress: reported.append(progress.losses),
    )
    return model, reported


def test_steps_and_losses_are_those_of_the_training_loop(
    trained: tuple[Model, list[dict[str, float]]],
) -> None:
    expected, reported = trained
    config = rare_updates()
    model, step = toy_step(config)
    start = {name: value.clone() for name, value in model.state_dict().items()}
    reader = LossReader(CPU)
    assert reader.take() is None
    for number in range(STEPS):
        step.run(number, learning_rates(config, number))
        found = step.losses()
        assert found.step == number
        assert found.values == reported[number]
        reader.send(step)
        assert reader.take() == found
    assert {"interlevel" in losses for losses in reported} == {True, False}
    end = model.state_dict()
    assert all(torch.equal(end[name], value) for name, value in expected.state_dict().items())
    assert sum(not torch.equal(start[name], value) for name, value in end.items()) > 10


def test_losses_sent_to_the_reader_stay_those_of_their_step() -> None:
    config = rare_updates()
    _, step = toy_step(config)
    reader = LossReader(CPU)
    step.run(0, learning_rates(config, 0))
    first = step.losses()
    reader.send(step)
    step.run(1, learning_rates(config, 1))
    taken = reader.take()
    assert taken == first
    assert taken != step.losses()
    assert reader.take() is None


@pytest.mark.parametrize("exponent", [0.0, 0.37, 0.5, 1.0])
def test_an_exponent_held_in_a_tensor_draws_the_samples_of_the_number(exponent: float) -> None:
    config = rare_updates()
    model, _ = toy_step(config)
    cameras = toy_cameras(6)
    rays = cameras.generate_rays(torch.arange(6), torch.full((6, 2), 11.5))
    plan = model.plan_step(0)
    held: Tensor = torch.tensor(exponent)

    def edges(power: float | Tensor) -> list[Tensor]:
        chosen = replace(plan, exponent=power)
        random = torch.Generator().manual_seed(1)
        return [s.t_edges for s in model(rays, plan=chosen, generator=random)["samples"]]

    for with_tensor, with_number in zip(edges(held), edges(exponent), strict=True):
        torch.testing.assert_close(with_tensor, with_number, rtol=1e-4, atol=1e-5)


def test_a_rate_held_in_a_tensor_is_filled_in_place() -> None:
    config = rare_updates()
    _, step = toy_step(config)
    (group,) = step.optimizers["networks"].param_groups
    held = torch.tensor(1.0)
    group["lr"] = held
    step.run(0, {"networks": 0.125, "cameras": 0.5})
    assert group["lr"] is held
    assert float(held) == 0.125
    assert step.optimizers["cameras"].param_groups[0]["lr"] == 0.5


@pytest.mark.parametrize(("rays", "expected"), [(1, 8), (1000, 8192), (4096, 32768), (4097, 65536)])
def test_loss_scale_is_the_next_power_of_two_above_eight_times_the_rays(
    rays: int, expected: int
) -> None:
    assert loss_scale(rays) == expected
    assert not loss_scaler(CPU, rays).is_enabled()


ASKING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "is_nonzero", "equal")
"""Operations whose result the host has to wait for: item, bool, data-dependent shapes."""


class Watch(TorchDispatchMode):
    """Notes the operations that would make a host wait for its GPU, with the file that asked."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, str]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        # `lift_fresh` is a tensor made from Python numbers, copied to wherever it is to be.
        if name in ASKING or name == "lift_fresh":
            files = (Path(frame.filename) for frame in traceback.extract_stack())
            ours = [file.name for file in files if NERF in file.parents]
            self.found.append((name, ours[-1] if ours else "elsewhere"))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("update", [True, False])
def test_a_model_asks_its_device_for_nothing_in_a_step(update: bool) -> None:
    model, _ = toy_step(rare_updates())
    cameras = toy_cameras(6)
    rays = cameras.generate_rays(torch.arange(6), torch.full((6, 2), 11.5))
    plan = StepPlan(12, exponent=0.5, update_proposals=update)
    random = torch.Generator().manual_seed(0)
    with Watch() as watch:
        outputs = model(rays, plan=plan, generator=random)
        losses = model.loss_dict(outputs, torch.rand(6, 3), plan=plan)
        torch.autograd.backward(torch.stack(list(losses.values())).sum())
    # The ends of the spacing, worked out on the CPU wherever the rays are.
    assert set(watch.found) <= {("lift_fresh", "intervals.py")}


def test_the_watch_sees_what_a_host_waits_for() -> None:
    with Watch() as watch:
        values = torch.tensor([0.0, 1.0])
        assert bool(values.sum() > 0.0)
        torch.nonzero(values)
    assert [name for name, _ in watch.found] == ["lift_fresh", "_local_scalar_dense", "nonzero"]


def test_nothing_is_captured_on_a_cpu() -> None:
    model, step = toy_step(rare_updates())
    assert not can_capture(model, CPU)
    assert not step.captures
