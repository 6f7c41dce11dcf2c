"""A run whose GPU engine breaks down in the middle: nothing is lost, and the reason is told.

On a CPU, with PyTorch's own parts as the engine and `TapedGraphs` as its graphs, so that a run that
was interrupted must end to the bit as one of the plain engine.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pipelines.nerf.data.depth_maps import DepthSupervision
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.engines.gpu.step import EAGER_STEPS, StepLosses
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.training import gpu_steps, loop
from pipelines.nerf.training.checkpoint import load_checkpoint
from pipelines.nerf.training.gpu_steps import GpuSteps
from pipelines.nerf.training.loop import TrainProgress, train
from pipelines.nerf.training.state import TrainingState, initial_state
from tests.threads import torch_threads
from tests.unit.pipelines.nerf.engines.gpu.taped_graphs import Tape, TapedGraphs
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

STEPS = 14
"""The first ten are of one kind, whose steps are replays from the fifth on; then there are two."""

Spoil = Callable[[TrainingState], None]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing from more; on a busy machine threads wait for each other."""
    with torch_threads(1):
        yield


def config_of(engine: str) -> TrainConfig:
    config = tiny_config(rays_per_step=32, max_steps=STEPS, engine=engine)
    return with_model(config, proposal_warmup_steps=1, proposal_update_every=2, camera_mode="off")


def run(config: TrainConfig, **given: Any) -> tuple[Model, list[TrainProgress]]:
    cameras = toy_cameras(6)
    told: list[TrainProgress] = []
    model = train(
        toy_images(cameras), cameras, range(6), config, seed=2, on_progress=told.append, **given
    )
    return model, told


def with_engine(monkeypatch: pytest.MonkeyPatch, spoil: Spoil) -> TapedGraphs:
    """Let `train` take the steps of the GPU engine on this CPU, spoiled."""
    graphs = TapedGraphs()

    def chosen(
        state: TrainingState,
        sampler: PixelSampler,
        cameras: Cameras,
        config: TrainConfig,
        depth: DepthSupervision | None,
    ) -> GpuSteps:
        for optimizer in state.optimizers.values():
            for group in optimizer.param_groups:
                # As on a GPU a tensor; in double precision it is the number itself.
                group["lr"] = torch.tensor(float(group["lr"]), dtype=torch.float64)
        spoil(state)
        return GpuSteps(state, sampler, cameras, depth=depth, recorder=lambda: graphs)

    monkeypatch.setattr(loop, "_gpu_steps", chosen)
    # On a CPU "auto" means numba's kernels, which cannot be taped.
    make = initial_state
    monkeypatch.setattr(
        loop, "initial_state", lambda config, *rest: make(replace(config, engine="plain"), *rest)
    )
    return graphs


def break_kernel(state: TrainingState, at: int) -> None:
    """A step one by one ends in the middle: when the optimiser has done its part."""
    optimizer = state.optimizers["networks"]
    ours = optimizer.step

    def step(*args: Any) -> None:
        ours(*args)
        if state.step == at:
            raise RuntimeError("CUDA error: no kernel image\nis available")

    optimizer.step = step  # type: ignore[method-assign, assignment]


def break_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    def record(graphs: TapedGraphs, work: Callable[[], None]) -> Tape:
        torch.rand(3, generator=torch.Generator())
        work()
        raise NerfError("gpu_failed", "The step could not be captured: no kernel image.")

    monkeypatch.setattr(TapedGraphs, "record", record)


def break_replay(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """The replay of that number ends in the middle."""
    ours = Tape.replay

    def replay(tape: Tape) -> None:
        ours(tape)
        if tape.owner.replays == number:
            raise RuntimeError("CUDA error: no kernel image")

    monkeypatch.setattr(Tape, "replay", replay)


def nothing(state: TrainingState) -> None:
    pass


def same(one: Model, other: Model) -> bool:
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("where", "step", "goes_on_from"),
    [("nowhere", 0, 0), ("kernel", 1, 1), ("recording", 3, 3), ("replay", 6, 3)],
)
def test_a_run_whose_engine_breaks_down_ends_as_one_of_the_plain_engine(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    where: str,
    step: int,
    goes_on_from: int,
) -> None:
    expected, reported = run(config_of("plain"))
    if where == "recording":
        break_recording(monkeypatch)
    if where == "replay":
        break_replay(monkeypatch, step - EAGER_STEPS + 1)
    is_kernel = where == "kernel"
    graphs = with_engine(
        monkeypatch, (lambda state: break_kernel(state, step)) if is_kernel else nothing
    )
    with caplog.at_level(logging.WARNING):
        found, told = run(config_of("auto"))
    assert same(found, expected)
    last = {progress.step: progress for progress in told}
    assert sorted(last) == list(range(1, STEPS + 1))
    # Steps of the engine report what the step before them lost.
    for number in range(1 + step if where != "nowhere" else STEPS + 1, STEPS + 1):
        assert last[number].losses == reported[number - 1].losses
    if where == "nowhere":
        assert graphs.replays >= 6
        assert not caplog.records
        return
    (record,) = caplog.records
    assert f"at step {step} and is not used any more" in record.getMessage()
    assert f"goes on from step {goes_on_from} with PyTorch" in record.getMessage()
    assert "no kernel image" in record.getMessage()
    assert not any("\n" in str(each) for each in record.args or ())


def test_with_fast_the_run_ends_and_says_why(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint.pt"
    with_engine(monkeypatch, lambda state: break_kernel(state, 2))
    with pytest.raises(
        NerfError, match="broke down on cpu at step 2: RuntimeError: CUDA"
    ) as caught:
        run(config_of("fast"), checkpoint_path=path)
    assert caught.value.code == "gpu_failed"
    assert "train.engine" in caught.value.hint
    assert not caught.value.retryable


def test_a_gpu_that_does_not_answer_any_more_is_no_place_to_go_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with_engine(monkeypatch, lambda state: break_kernel(state, 2))

    def dead(*args: object) -> TrainingState:
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    monkeypatch.setattr(gpu_steps, "initial_state", dead)
    with pytest.raises(NerfError, match="does not answer any more") as caught:
        run(config_of("auto"))
    assert caught.value.code == "gpu_lost"
    assert caught.value.retryable


def test_memory_that_runs_out_is_no_fault_of_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(state: TrainingState) -> None:
        def forward(*args: Any, **kwargs: Any) -> None:
            raise torch.OutOfMemoryError("CUDA out of memory")

        state.model.forward = forward  # type: ignore[method-assign,assignment]

    with_engine(monkeypatch, spoil)
    with pytest.raises(torch.OutOfMemoryError):
        run(config_of("auto"))


def test_a_loss_that_is_not_finite_is_no_fault_of_the_engine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def spoil(state: TrainingState) -> None:
        with torch.no_grad():
            next(state.model.network_parameters()).fill_(float("nan"))  # type: ignore[call-overload]

    with_engine(monkeypatch, spoil)
    with pytest.raises(NerfError) as caught:
        run(config_of("auto"))
    assert caught.value.code == "non_finite_loss"


def test_what_goes_on_is_saved_and_gone_on_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    expected, _ = run(config_of("plain"))
    path = tmp_path / "checkpoint.pt"
    with_engine(monkeypatch, lambda state: break_kernel(state, 4))
    run(replace(config_of("auto"), max_steps=8), checkpoint_path=path)
    assert load_checkpoint(path)["step"] == 8
    resumed, told = run(config_of("auto"), checkpoint_path=path)
    assert [progress.step for progress in told] == list(range(9, STEPS + 1))
    assert same(resumed, expected)


def test_a_scale_that_changes_is_logged_and_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def scaled(state: TrainingState) -> None:
        state.scaler = torch.amp.GradScaler("cpu", 64.0, growth_interval=2, enabled=True)

    with_engine(monkeypatch, scaled)
    with caplog.at_level(logging.INFO):
        _, told = run(config_of("auto"))
    assert [progress.loss_scale for progress in told][:5] == [64.0, 64.0, 128.0, 128.0, 256.0]
    assert told[-1].loss_scale == 256.0  # eight per ray
    assert [record.getMessage() for record in caplog.records] == [
        "Step 1: loss scale 128.0, was 64.0",
        "Step 3: loss scale 256.0, was 128.0",
    ]


def test_gradients_that_no_scale_can_hold_end_the_run() -> None:
    losses = {"rgb": 0.1}
    loop._require_learning(StepLosses(7, losses, 1.0))
    loop._require_learning(StepLosses(7, losses))
    with pytest.raises(NerfError, match="nothing is learned") as caught:
        loop._require_learning(StepLosses(7, losses, 2.0**-11))
    assert caught.value.code == "non_finite_loss"
