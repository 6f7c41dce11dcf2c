"""Whole training steps without a host that waits: pixels, rays, model, losses and Adam on one GPU.

The host decides what a step does (`Model.plan_step`, plain arithmetic), writes the numbers that
change into tensors, and starts the step: the first few of each kind one kernel at a time, the rest
as one CUDA graph per kind (`graphs`). Kinds are the steps with and without an update of the
proposals, before and after the end of the annealing. Losses stay on the GPU until they are asked
for; `LossReader` brings them over behind the run.

The first steps of a kind are real steps of the run, so that nothing has to be undone: they compile
the Triton kernels, take the optimisers' state and fill the allocator, none of which a capture may
do. Elsewhere than on a GPU, and for methods whose steps ask the device (occupancy grids), the same
code runs without graphs.

Half precision is float16 rather than bfloat16: a density is exp(logit), and at a logit of 8 one
unit in the last place is 0.8 % of the density in float16 (11 bits), but 6 % in bfloat16 (8 bits).
What float16 lacks is range, hence `loss_scaler`: with a loss that is a mean over R rays, the
gradients of a ray are of the order 1 / R, and a scale of 8 R brings them to the middle of the
range. The scale is on the device; a step whose gradients overflow is left out by Adam's kernel
itself (its `found_inf`), and the scale is halved. After `GROWTH_STEPS` without that it is doubled
again, up to where it began: a scale that only fell would let the small gradients of the rest of the
run vanish for the sake of one bad batch. None of that needs the host; the scale comes over with the
losses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor, nn

from pipelines.nerf.data.depth_maps import DepthSupervision
from pipelines.nerf.data.pixels import Batch, PixelSampler
from pipelines.nerf.engines.gpu.graphs import CudaGraphs, Recorder, Replay
from pipelines.nerf.models.base import Model, StepPlan
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.decay import decay_gradients
from pipelines.nerf.space.cameras import Cameras

EAGER_STEPS = 3
"""Steps of each kind that run before it is captured: torch asks for at least one, three let the
allocator and the libraries settle."""
MAX_TERMS = 16
"""Places for terms of the loss; behind them is one for the loss scale."""
SCALE_PER_RAY = 8.0
GROWTH_STEPS = 1000
"""Steps without an overflow after which the loss scale is doubled again: where it was halved for a
reason that stays, one step in a thousand is lost."""


@dataclass(frozen=True)
class StepLosses:
    """Weighted terms by name, as training reports them, of the step counted from 0.

    scale: what the loss of the next step is multiplied by, None where it is not.
    """

    step: int
    values: dict[str, float]
    scale: float | None = None


def capturable_adam(
    parameters: Iterable[nn.Parameter], lr: float, eps: float, device: torch.device
) -> torch.optim.Adam:
    """Adam whose step can be captured: its rate, its count of steps and its skips are tensors.

    On a GPU one fused kernel reads each parameter, gradient and moment once. Elsewhere the same
    optimiser with a number for its rate.
    """
    if device.type == "cuda":
        held = torch.tensor(lr, dtype=torch.float32, device=device)
        adam = torch.optim.Adam(parameters, lr=held, eps=eps, fused=True, capturable=True)
        # torch would warn at each optimiser's first step, which is never captured.
        adam._warned_capturable_if_run_uncaptured = True
    else:
        adam = torch.optim.Adam(parameters, lr=lr, eps=eps, fused=True)
    adam.register_step_pre_hook(decay_gradients)
    return adam


def _hold_on_device(optimizer: torch.optim.Adam, device: torch.device) -> None:
    """Undo what restoring a checkpoint may have done: rates and counts of steps as tensors."""
    for group in optimizer.param_groups:
        group["lr"] = torch.as_tensor(group["lr"], dtype=torch.float32, device=device)
        group["capturable"] = True
    for state in optimizer.state.values():
        state["step"] = torch.as_tensor(state["step"], dtype=torch.float32, device=device)


def loss_scale(rays_per_step: int) -> float:
    """The power of two at or above 8 R."""
    return 2.0 ** math.ceil(math.log2(SCALE_PER_RAY * rays_per_step))


def loss_scaler(device: torch.device, rays_per_step: int) -> torch.amp.GradScaler:
    """The `loss_scale` of float16 on a GPU, which `TrainingStep` keeps it from exceeding; off on a
    CPU."""
    scale = loss_scale(rays_per_step)
    on_gpu = device.type == "cuda"
    return torch.amp.GradScaler(device.type, scale, growth_interval=GROWTH_STEPS, enabled=on_gpu)


@lru_cache
def _stream_of(device: torch.device) -> torch.cuda.Stream:
    """The stream of all steps on a device.

    One for every `TrainingStep`: memory is kept by stream, and autograd keeps a parameter's stream
    for as long as some graph holds it; one of another stream would break a capture.
    """
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


def can_capture(model: Model, device: torch.device) -> bool:
    """Whether the steps of a model can be CUDA graphs: on a GPU, and of a method without host."""
    return device.type == "cuda" and isinstance(model, Nerfacto)


@dataclass(frozen=True)
class Kind:
    """What distinguishes one graph from another."""

    update_proposals: bool
    annealing: bool


class TrainingStep:
    """Runs training steps of one model.

    model: in `train()`, on the device of the cameras. optimizers: by name, as `capturable_adam`
    makes them. scaler: as `loss_scaler`; any other is read by the host unless its optimisers are
    fused. sampler: holds the pixels on the device, or on the CPU, from where 28 bytes a ray follow
    each step. cameras: of the training images, on the device. pixel_random: of the sampler's
    device; model_random: of the model's. depth: where depth maps are learned from, on the device.
    capture: None for graphs where `can_capture`, False for none, or what records them instead.
    feed: None to bring pixels over where the sampler holds them elsewhere; True to do so anyway.
    before_new: called before each step that may compile or is recorded, when nothing of it has
        happened yet.

    States are restored (checkpoints) before the first step: graphs hold the tensors they were
    captured with.
    """

    def __init__(
        self,
        model: Model,
        optimizers: Mapping[str, torch.optim.Adam],
        scaler: torch.amp.GradScaler,
        sampler: PixelSampler,
        cameras: Cameras,
        rays_per_step: int,
        *,
        pixel_random: torch.Generator,
        model_random: torch.Generator,
        depth: DepthSupervision | None = None,
        capture: Recorder | bool | None = None,
        feed: bool | None = None,
        before_new: Callable[[], None] = lambda: None,
    ) -> None:
        self._model, self.optimizers, self._scaler = model, dict(optimizers), scaler
        self._sampler, self._cameras, self._rays_per_step = sampler, cameras, rays_per_step
        self._pixel_random, self._model_random = pixel_random, model_random
        self._depth = depth
        self.device = cameras.focal.device
        self._before_new = before_new
        on_gpu = self.device.type == "cuda"
        self._stream = _stream_of(self.device) if on_gpu else None
        self._recorder: Recorder | None = None if isinstance(capture, bool) else capture
        if capture is None and self._stream is not None and can_capture(model, self.device):
            self._recorder = CudaGraphs(self.device, self._stream, (pixel_random, model_random))
        self._fed: Batch | None = None
        if sampler.device.type != self.device.type if feed is None else feed:
            num_lines = 0 if sampler.lines is None else sampler.lines.count(rays_per_step)
            self._fed = Batch(
                torch.zeros(rays_per_step, dtype=torch.int64, device=self.device),
                torch.zeros(rays_per_step, 2, device=self.device),
                torch.zeros(rays_per_step, 3, device=self.device),
                torch.zeros(num_lines, device=self.device),
            )
        if on_gpu:
            for optimizer in self.optimizers.values():
                _hold_on_device(optimizer, self.device)
        self._exponent = torch.ones((), dtype=torch.float32, device=self.device)
        self._depth_weight, self._depth_spread = torch.ones(2, device=self.device).unbind()
        self._flat_weight = torch.ones((), device=self.device)
        self._values = torch.zeros(MAX_TERMS + 1, dtype=torch.float32, device=self.device)
        self._largest_scale = loss_scale(rays_per_step)
        self._one = torch.ones((), dtype=torch.float32, device=self.device)
        self._names: dict[Kind, tuple[str, ...]] = {}
        self._runs: dict[Kind, int] = {}
        self._graphs: dict[Kind, Replay] = {}
        self._latest: tuple[int, tuple[str, ...]] = (-1, ())

    @property
    def captures(self) -> bool:
        """Whether steps become graphs."""
        return self._recorder is not None

    def run(self, step: int, rates: Mapping[str, float]) -> None:
        """One step, counted from 0; returns when it was started.

        rates: the learning rate of each optimiser, by its name.
        """
        self._set_rates(rates)
        if self._depth is not None:
            weight, spread = self._depth.schedule(step)
            self._depth_weight.fill_(weight)
            self._depth_spread.fill_(spread)
        if self._sampler.lines is not None:
            self._flat_weight.fill_(self._sampler.lines.weight(step))
        plan = self._model.plan_step(step, self._model_random)
        kind = Kind(plan.update_proposals, bool(plan.exponent != 1.0))
        if self._stream is None:
            self._run_as(kind, plan)
        else:
            before = torch.cuda.current_stream(self.device)
            self._stream.wait_stream(before)
            with torch.cuda.stream(self._stream):
                self._run_as(kind, plan)
            before.wait_stream(self._stream)
        self._latest = (step, self._names[kind])
        self._model.finish_step(plan)

    def _run_as(self, kind: Kind, plan: StepPlan) -> None:
        runs = self._runs[kind] = self._runs.get(kind, 0) + 1
        is_eager = self._recorder is None or runs <= EAGER_STEPS
        if runs <= EAGER_STEPS or not (is_eager or kind in self._graphs):
            self._before_new()
        if self._fed is not None:
            drawn = self._sampler.draw_batch(self._rays_per_step, self._pixel_random)
            for held, item in zip(self._fed, drawn, strict=True):
                # From pinned memory, which the allocator keeps until the copy is done.
                item = item.pin_memory() if self._stream is not None else item
                held.copy_(item, non_blocking=True)
        if self._recorder is None:
            self.optimise(kind, plan)
            return
        self._exponent.fill_(plan.exponent)
        held_plan = self._with_held_exponent(kind, plan)
        if is_eager:
            self.optimise(kind, held_plan)
            return
        if kind not in self._graphs:
            self._graphs[kind] = self._recorder.record(lambda: self.optimise(kind, held_plan))
        # What gradients there are lies in the graphs' memory, where the next graph writes over it.
        self._forget_gradients()
        self._graphs[kind].replay()

    def _with_held_exponent(self, kind: Kind, plan: StepPlan) -> StepPlan:
        """The plan with a tensor for what differs from step to step of a kind."""
        held: Any = self._exponent
        return replace(plan, exponent=held) if kind.annealing else plan

    def _forget_gradients(self) -> None:
        for parameter in self._model.parameters():
            parameter.grad = None  # Adam leaves alone what has no gradient

    def optimise(self, kind: Kind, plan: StepPlan) -> None:
        """The step itself: only work on the device, nothing that the host has to wait for.

        Called by `run`, which decides whether it is captured, and by whoever checks it.
        """
        model, device = self._model, self.device
        drawn = self._fed or self._sampler.draw_batch(self._rays_per_step, self._pixel_random)
        index, pixels, colors, plain = drawn
        rays = self._cameras.generate_rays(index, pixels)
        half = device.type == "cuda"
        # A cache of half-precision weights would outlive the graph that it was made in.
        with torch.autocast(device.type, torch.float16, enabled=half, cache_enabled=False):
            outputs = model(rays, plan=plan, generator=self._model_random)
            losses = model.loss_dict(outputs, colors, plan=plan)
        if self._depth is not None:
            held = self._depth_weight, self._depth_spread
            term = self._depth.loss(outputs, rays, self._cameras, *held)
            losses = losses if term is None else {**losses, "depth": term}
        if self._sampler.lines is not None:
            maps = None if self._depth is None else self._depth.maps
            given = outputs, rays, self._cameras, plain, self._flat_weight, maps
            term = self._sampler.lines.loss(*given)
            losses = losses if term is None else {**losses, "flat": term}
        terms = torch.stack([loss.float() for loss in losses.values()])
        self._values[: len(losses)].copy_(terms.detach())
        self._names[kind] = tuple(losses)
        self._forget_gradients()
        total = torch.stack(list(losses.values())).sum()
        torch.autograd.backward(self._scaler.scale(total))
        for optimizer in self.optimizers.values():
            self._scaler.step(optimizer)
        self._scaler.update()
        if self._scaler.is_enabled():
            scale = self._scaler.scale(self._one).clamp_max(self._largest_scale)
            self._scaler.update(scale)
            self._values[MAX_TERMS].copy_(scale)

    def _set_rates(self, rates: Mapping[str, float]) -> None:
        """Rates that are tensors are filled in place, which a captured step sees."""
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                if isinstance(group["lr"], Tensor):
                    group["lr"].fill_(rates[name])
                else:
                    group["lr"] = rates[name]

    def losses(self) -> StepLosses:
        """The terms of the last step; waits for the GPU."""
        return self.told(*self.pending())

    def pending(self) -> tuple[int, tuple[str, ...], Tensor]:
        """(step, names, values on the device) of the last step, for `LossReader`."""
        return (*self._latest, self._values)

    def told(self, step: int, names: tuple[str, ...], values: Tensor) -> StepLosses:
        """What `pending` gave, in words. values: waited for where they are on a GPU."""
        *terms, scale = values.tolist()
        scaled = self._scaler.is_enabled()
        return StepLosses(step, dict(zip(names, terms, strict=False)), scale if scaled else None)


class LossReader:
    """Brings losses to the host behind the run: what is sent now is there a few steps later."""

    def __init__(self, device: torch.device) -> None:
        on_gpu = device.type == "cuda"
        self._host = torch.zeros(MAX_TERMS + 1, dtype=torch.float32, pin_memory=on_gpu)
        self._arrived = torch.cuda.Event() if on_gpu else None  # type: ignore[no-untyped-call]
        self._sent: Callable[[Tensor], StepLosses] | None = None

    def send(self, step: TrainingStep) -> None:
        """Start to copy the losses of the last step. What was sent before must have been taken."""
        number, names, values = step.pending()
        self._host.copy_(values, non_blocking=True)
        if self._arrived is not None:
            self._arrived.record(torch.cuda.current_stream(step.device))
        self._sent = partial(step.told, number, names)

    def take(self) -> StepLosses | None:
        """What was sent, or None before anything was.

        Waits for that copy alone, which bounds how far the host runs ahead of the GPU; sent n steps
        ago, it is there as a rule.
        """
        if self._sent is None:
            return None
        if self._arrived is not None:
            self._arrived.synchronize()
        found = self._sent(self._host)
        self._sent = None
        return found
