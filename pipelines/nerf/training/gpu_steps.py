"""Training steps of the GPU engine, and the way back to PyTorch's own where it breaks down.

`GpuSteps` starts steps (`engines.gpu.step`) that the host does not wait for. A kernel that cannot
be compiled for a new shape, a step that cannot be captured, a graph that cannot be replayed: such
things show in the middle of a run, when it is too late for `engines.gpu.self_check`. So the state
is kept, as copies on its device, before each step that may compile or is recorded, and every
`KEPT_EVERY` steps. With `train.engine=auto` a run whose engine breaks down goes on from the last
copy with the plain engine: the state is made so here, and `EngineLost` tells the loop, which does
those steps. With `fast` the run ends.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch

from pipelines.nerf.data.depth_maps import DepthSupervision
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.engines.gpu.graphs import Recorder
from pipelines.nerf.engines.gpu.self_check import engine_errors
from pipelines.nerf.engines.gpu.step import LossReader, StepLosses, TrainingStep
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.training.state import TrainingState, initial_state, learning_rates

LOG = logging.getLogger(__name__)

KEPT_EVERY = 500
"""Steps between copies of the state where nothing new happens: the most that are done twice."""


@dataclass(frozen=True)
class StepShape:
    """What decides the sizes of a step's tensors.

    num_rays: of the batch. block: side of the squares of pixels that rays stand for.
    levels: active levels of each hash grid.
    """

    num_rays: int
    block: int
    levels: tuple[int, ...]


class EngineLost(Exception):
    """The GPU engine broke down; the state is one from before, and of the plain engine."""


class GpuSteps:
    """Steps of one run.

    state: what the steps change; restored from a checkpoint before the first of them.
    depth: on the cameras' device, where depth maps are learned from.
    recorder: called for each new shape of steps; what records these, or None for what
        `TrainingStep` takes by itself.
    """

    def __init__(
        self,
        state: TrainingState,
        sampler: PixelSampler,
        cameras: Cameras,
        *,
        depth: DepthSupervision | None = None,
        recorder: Callable[[], Recorder | None] = lambda: None,
    ) -> None:
        self._state, self._sampler, self._cameras = state, sampler, cameras
        self._depth = depth
        self._recorder = recorder
        self._shape: StepShape | None = None
        self._step: TrainingStep | None = None
        self._reader = LossReader(cameras.focal.device)
        self._scale: float | None = None
        self._kept: dict[str, Any] | None = None

    def run(self, config: TrainConfig, shape: StepShape, *, check: bool) -> StepLosses | None:
        """Start the step that is due.

        check: read the losses of the last step that was checked; None unread. Steps of another
        shape than the last one's are captured anew. Raises EngineLost; with `train.engine=fast`
        NerfError `gpu_failed`, and `gpu_lost` where the GPU does not answer any more.
        """
        due = self._state.step
        try:
            return self._run(config, shape, check=check)
        except torch.OutOfMemoryError:
            raise  # the plain engine needs more
        except engine_errors() as error:
            self._go_back(config, due, error)
            raise EngineLost from error

    def _run(self, config: TrainConfig, shape: StepShape, *, check: bool) -> StepLosses | None:
        state = self._state
        self._sampler.block = shape.block
        if self._step is None or shape != self._shape:
            self._step, self._shape = self._start(shape), shape
        if self._kept is None or state.step - self._kept["step"] >= KEPT_EVERY:
            self._keep()
        self._step.run(state.step, learning_rates(config, state.step))
        state.step += 1
        if not check:
            return None
        found = self._reader.take()
        self._reader.send(self._step)
        if found is None:
            found = self._step.losses()
        self._note_scale(found)
        return found

    def _start(self, shape: StepShape) -> TrainingStep:
        state = self._state
        return TrainingStep(
            state.model,
            state.optimizers,
            state.scaler,
            self._sampler,
            self._cameras,
            shape.num_rays,
            pixel_random=state.pixel_random,
            model_random=state.model_random,
            depth=self._depth,
            capture=self._recorder(),
            before_new=self._keep,
        )

    def _keep(self) -> None:
        """Copy the state as it is before the step that is due."""
        if self._kept is not None and self._kept["step"] == self._state.step:
            return
        self._kept = None  # its memory first
        self._kept = copy.deepcopy(self._state.as_dict())

    def _note_scale(self, found: StepLosses) -> None:
        if self._scale is not None and found.scale != self._scale:
            LOG.info("Step %d: loss scale %s, was %s", found.step, found.scale, self._scale)
        self._scale = found.scale

    def _go_back(self, config: TrainConfig, due: int, error: Exception) -> None:
        """Make the state the last one that was kept, of the plain engine; see `run`."""
        device = self._cameras.focal.device
        what = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        if config.engine == "fast":
            raise NerfError(
                "gpu_failed",
                f"The compiled engine broke down on {device} at step {due}: {what}",
                "Set train.engine to auto, or plain.",
            ) from error
        self._step = None
        try:
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            self._become_plain(config, device)
        except torch.OutOfMemoryError:
            raise
        except engine_errors() as again:
            raise NerfError(
                "gpu_lost",
                f"{device} broke down at step {due} and does not answer any more: {what}",
                "Look into the driver's log; with train.engine=plain fewer kernels are asked for.",
                retryable=True,
            ) from again
        LOG.warning(
            "The GPU engine broke down on %s at step %d and is not used any more, training goes "
            "on from step %d with PyTorch: %s",
            device,
            due,
            self._state.step,
            what,
        )

    def _become_plain(self, config: TrainConfig, device: torch.device) -> None:
        """All new, since a capture that failed leaves generators and gradients as it likes."""
        state, kept = self._state, self._kept
        assert kept is not None, "the state is kept before the first step"
        fresh = initial_state(
            replace(config, engine="plain"),
            state.model.num_train_images,
            0,
            device,
            state.pixel_random.device,
        )
        fresh.model.cameras_delta.common = state.model.cameras_delta.common
        fresh.restore(kept)
        fresh.elapsed_s = state.elapsed_s  # time that was spent stays spent
        fresh.model.train()
        for each in fields(state):
            setattr(state, each.name, getattr(fresh, each.name))
        self._kept = None
