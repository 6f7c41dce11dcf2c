"""Steps that are recorded and replayed, on a CPU: as good as steps that are done one by one.

`TapedGraphs` stands in for CUDA graphs. Everything that differs from step to step of a kind must be
in a tensor, else the steps go apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.engines.gpu.step import (
    EAGER_STEPS,
    GROWTH_STEPS,
    LossReader,
    StepLosses,
    TrainingStep,
    loss_scale,
)
from pipelines.nerf.models.base import Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.decay import decay_gradients, set_table_decay
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.train import FlatLossConfig, OptimizerConfig, TrainConfig
from pipelines.nerf.training.state import learning_rates
from tests.unit.pipelines.nerf.engines.gpu.taped_graphs import TapedGraphs
from tests.unit.pipelines.nerf.engines.gpu.test_step import SEED
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

FIRST_STEP, NUM_STEPS, ANNEALED_AT = 10, 22, 20


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing from more; on a busy machine threads wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def config_of_all_kinds() -> TrainConfig:
    """The proposals learn in every second step, and the annealing ends in the middle of the run."""
    config = tiny_config(
        rays_per_step=32,
        flat=FlatLossConfig("always", contrast=1.0),
        optimizer=OptimizerConfig(decay_steps=1000, table_decay=1e-3),
    )
    return with_model(
        config, proposal_warmup_steps=1, proposal_update_every=2, anneal_steps=ANNEALED_AT
    )


def adam(parameters: Any) -> torch.optim.Adam:
    """As on a GPU: the rate is a tensor."""
    rate = torch.tensor(0.0, dtype=torch.float32)
    made = torch.optim.Adam(parameters, lr=rate, eps=1e-15, fused=True)
    made.register_step_pre_hook(decay_gradients)
    return made


@dataclass
class Toy:
    """A model and the step that trains it; both begin alike each time."""

    model: Model
    step: TrainingStep
    graphs: TapedGraphs
    pixel_random: torch.Generator
    config: TrainConfig

    def run(self, first: int = FIRST_STEP, num: int = NUM_STEPS) -> list[StepLosses]:
        told = []
        for number in range(first, first + num):
            self.step.run(number, learning_rates(self.config, number))
            told.append(self.step.losses())
        return told


def toy(
    *, taped: bool, scaler: torch.amp.GradScaler | None = None, masked: bool = False, **given: Any
) -> Toy:
    config = config_of_all_kinds()
    cameras = toy_cameras(6)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        model: Model = find_method(config.method).build(config.model, len(cameras)).train()
    graphs = TapedGraphs()
    pixel_random = torch.Generator().manual_seed(SEED)
    images: ImageData = toy_images(cameras)
    if masked:
        images = replace(images, valid=torch.arange(len(images.pixels)) % 3 > 0)
    step = TrainingStep(
        model,
        {
            "networks": adam(model.network_parameters()),
            "cameras": adam(model.cameras_delta.parameters()),
        },
        scaler or torch.amp.GradScaler("cpu", enabled=False),
        PixelSampler(images, range(len(cameras)), lines=PlainLines.of(config)),
        cameras,
        config.rays_per_step,
        pixel_random=pixel_random,
        model_random=torch.Generator().manual_seed(SEED + 1),
        capture=graphs if taped else False,
        **given,
    )
    set_table_decay(step.optimizers["networks"], model, config.optimizer.table_decay)
    return Toy(model, step, graphs, pixel_random, config)


def same_weights(one: Toy, other: Toy) -> bool:
    pairs = zip(one.model.parameters(), other.model.parameters(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("given", [{}, {"feed": True}, {"masked": True}])
def test_replayed_steps_are_those_that_run_one_by_one(given: dict[str, Any]) -> None:
    one_by_one, taped = toy(taped=False, **given), toy(taped=True, **given)
    expected, found = one_by_one.run(), taped.run()
    assert found == expected
    assert same_weights(one_by_one, taped)
    # With and without an update of the proposals, before and after the end of the annealing.
    assert len(taped.graphs.tapes) == 4
    assert taped.graphs.replays == NUM_STEPS - 4 * EAGER_STEPS
    assert not one_by_one.step.captures


def test_the_annealing_goes_on_in_replays() -> None:
    frozen = toy(taped=True)
    before = frozen.run(num=2 * EAGER_STEPS)  # the next step of each kind is recorded
    assert len(before) == 2 * EAGER_STEPS
    assert not frozen.graphs.tapes
    first = FIRST_STEP + 2 * EAGER_STEPS
    exponents = []
    for number in range(first, first + 4):
        frozen.step.run(number, learning_rates(frozen.config, number))
        exponents.append(float(frozen.step._exponent))
    assert frozen.graphs.replays == 4
    assert len(frozen.graphs.tapes) == 2
    assert exponents == sorted(set(exponents))
    assert exponents[-1] < 1.0


def test_replays_draw_other_pixels_each_time() -> None:
    one = toy(taped=True)
    one.run(num=2 * EAGER_STEPS + 2)
    seen = set()
    for number in range(2):
        one.step.run(FIRST_STEP + 2 * EAGER_STEPS + 2 + number, {"networks": 0.0, "cameras": 0.0})
        seen.add((round(one.step.losses().values["rgb"], 9), tuple(_state(one.pixel_random))))
    assert one.graphs.replays == 4
    assert len({loss for loss, _ in seen}) == len({state for _, state in seen}) == 2


def _state(generator: torch.Generator) -> list[int]:
    return [int(each) for each in generator.get_state()]


def test_gradients_of_two_replays_are_those_of_two_steps() -> None:
    """Adam's first moment, with beta1 = 0, is the gradient that it was given last."""
    toys = toy(taped=False), toy(taped=True)
    for one in toys:
        for optimizer in one.step.optimizers.values():
            optimizer.param_groups[0]["betas"] = (0.0, 0.99)
        one.run(num=2 * EAGER_STEPS + 2)
    gradients: list[list[Tensor]] = []
    for number in range(2):
        step = FIRST_STEP + 2 * EAGER_STEPS + 2 + number
        for one in toys:
            one.run(step, 1)
        found = [_given(one) for one in toys]
        assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
        gradients.append(found[1])
    assert toys[1].graphs.replays == 4
    assert any(not torch.equal(a, b) for a, b in zip(*gradients, strict=True))
    assert sum(bool(each.any()) for each in gradients[1]) > 10


def _given(one: Toy) -> list[Tensor]:
    return [
        state["exp_avg"].clone()
        for optimizer in one.step.optimizers.values()
        for state in optimizer.state.values()
    ]


def test_no_gradient_of_a_graph_is_left_for_others_to_read() -> None:
    one = toy(taped=True)
    one.run(num=2 * EAGER_STEPS)
    assert any(parameter.grad is not None for parameter in one.model.parameters())
    one.run(FIRST_STEP + 2 * EAGER_STEPS, 1)
    assert all(parameter.grad is None for parameter in one.model.parameters())


def test_reading_what_another_graph_made_is_noticed() -> None:
    graphs, held = TapedGraphs(), torch.ones(2)
    made: list[Tensor] = []
    first = graphs.record(lambda: made.append(held * 2.0))
    first.replay()
    assert made[0].tolist() == [2.0, 2.0]
    with pytest.raises(AssertionError, match="another graph"):
        graphs.record(lambda: made.append(made[0] + 1.0))
    second = graphs.record(lambda: made.append(held + 1.0))
    second.replay()
    assert bool(made[0].isnan().all())
    with pytest.raises(AssertionError, match="asked for"):
        graphs.record(lambda: made.append(torch.tensor(held.sum().item())))


def test_recording_does_nothing_and_keeps_the_numbers_of_python() -> None:
    graphs, held, random = TapedGraphs(), torch.zeros(2), torch.Generator().manual_seed(0)
    factor = 3.0

    def work() -> None:
        held.add_(factor * torch.ones(2) + 0.0 * torch.rand(2, generator=random))

    before = _state(random)
    graph = graphs.record(work)
    factor = 5.0
    assert held.tolist() == [0.0, 0.0]
    assert _state(random) == before
    graph.replay()
    graph.replay()
    assert held.tolist() == [6.0, 6.0]
    assert _state(random) != before


def test_what_is_new_is_told_before_it_begins() -> None:
    told: list[tuple[int, list[int]]] = []
    current: int
    one: Toy = toy(taped=True, before_new=lambda: told.append((current, _state(one.pixel_random))))
    for current in range(FIRST_STEP, FIRST_STEP + 2 * EAGER_STEPS + 4):
        state = _state(one.pixel_random)
        one.run(current, 1)
        if told and told[-1][0] == current:
            assert told[-1][1] == state  # nothing was drawn yet
    # Of each of two kinds the steps that run one by one, and the one that is recorded.
    assert [step for step, _ in told] == list(range(FIRST_STEP, FIRST_STEP + 2 * EAGER_STEPS + 2))


def scaler(scale: float) -> torch.amp.GradScaler:
    return torch.amp.GradScaler("cpu", scale, growth_interval=GROWTH_STEPS, enabled=True)


@pytest.mark.parametrize("taped", [False, True])
def test_a_gradient_that_overflows_skips_the_step_and_halves_the_scale(taped: bool) -> None:
    largest = loss_scale(32)
    one = toy(taped=taped, scaler=scaler(largest))
    factor = torch.ones(())
    assert isinstance(one.model, Nerfacto)
    layer = one.model.field.color_mlp.layers[0]
    assert isinstance(layer, torch.nn.Linear)
    layer.weight.register_hook(lambda gradient: gradient * factor)
    assert one.run(num=2 * EAGER_STEPS + 2)[-1].scale == largest
    networks = list(one.model.network_parameters())
    before = [each.detach().clone() for each in networks]
    reader = LossReader(torch.device("cpu"))
    factor.fill_(float("inf"))
    (told,) = one.run(FIRST_STEP + 2 * EAGER_STEPS + 2, 1)
    assert told.scale == largest / 2
    assert all(torch.equal(a, b) for a, b in zip(before, networks, strict=True))
    reader.send(one.step)
    assert reader.take() == told
    factor.fill_(1.0)
    (told,) = one.run(FIRST_STEP + 2 * EAGER_STEPS + 3, 1)
    assert told.scale == largest / 2
    assert not all(torch.equal(a, b) for a, b in zip(before, networks, strict=True))
    assert one.graphs.replays == (4 if taped else 0)


def test_the_scale_grows_again_up_to_where_it_began() -> None:
    largest = loss_scale(32)
    quick = torch.amp.GradScaler("cpu", largest / 4, growth_interval=2, enabled=True)
    scales = [told.scale for told in toy(taped=True, scaler=quick).run(num=10)]
    assert scales == [largest / 4, largest / 2, largest / 2, *[largest] * 7]


def test_a_scaled_step_learns_what_one_without_a_scale_learns() -> None:
    plain, scaled = toy(taped=False), toy(taped=True, scaler=scaler(loss_scale(32)))
    for without, with_scale in zip(plain.run(num=12), scaled.run(num=12), strict=True):
        assert with_scale.values == pytest.approx(without.values, rel=1e-3)
