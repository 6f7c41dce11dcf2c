"""One training step on a device that is not there; run by `test_devices`.

    python -m tests.unit.pipelines.nerf.engines.gpu.pretend_step

PyTorch's spare backend gets the name "pretend", and tensors on it have shapes, types and a device
but no values (`FakeTensorMode`). So a tensor of the CPU among those of the device is an error, as
on a GPU, and so is whatever asks the device for a value or for how many there are. Stricter than a
GPU: also tensors of the CPU that are numbers or indices, which would be copied there in each step.
Prints each kind of step that went through; ends with the traceback of the first that did not. With
`--broken` it tries what must fail, and prints the errors.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import (
    DataDependentOutputException,
    DynamicOutputShapeException,
    FakeTensorMode,
)
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from pipelines.nerf.along_ray import samplers
from pipelines.nerf.along_ray.intervals import SPACINGS
from pipelines.nerf.data.depth_maps import DepthMaps, DepthSupervision
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.engines.gpu.step import Kind, TrainingStep
from pipelines.nerf.models.base import Model, StepPlan
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.train import FlatLossConfig, TrainConfig
from pipelines.nerf.space.cameras import Cameras
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

DEVICE = "pretend"
RAYS = 32
FAKE_ERRORS = (DataDependentOutputException, DynamicOutputShapeException)


class Backend:
    """What `torch.pretend` must be able to answer."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.float16]

    def is_available(self) -> bool:
        return True

    def is_initialized(self) -> bool:
        return True

    def current_device(self) -> int:
        return 0

    def device_count(self) -> int:
        return 1


class OnlyDevice(TorchDispatchMode):
    """Refuses operations on tensors of the CPU, and indices that are masks, which are counted."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        tensors = [item for item in tree_leaves((args, kwargs or {})) if isinstance(item, Tensor)]
        if any(tensor.device.type == "cpu" for tensor in tensors):
            raise AssertionError(f"{func} of a tensor on the CPU")
        if "index" in func.overloadpacket.__name__:
            masks = [tensor for tensor in tensors[1:] if tensor.dtype == torch.bool]
            if masks:
                raise AssertionError(f"{func} with a mask")
        return func(*args, **(kwargs or {}))


def t_from_s(s: Tensor, near: float, far: float, spacing: str = "piecewise") -> Tensor:
    """`intervals.t_from_s`, whose two ends are worked out on the host, where nothing pretends."""
    forward, inverse = SPACINGS[spacing]
    with _disable_current_modes():
        ends = forward(torch.tensor([near, far], dtype=torch.float64))
        first, last = float(ends[0]), float(ends[1])
    return inverse(first + s * (last - first))


def moved(mode: FakeTensorMode, values: Tensor) -> Tensor:
    """The tensor as one of the device."""
    return mode.from_tensor(values).detach().to(DEVICE)


def move_model(mode: FakeTensorMode, model: Model) -> None:
    """What `Model.to` does."""
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None:
                module._parameters[name] = nn.Parameter(moved(mode, parameter))
        for name, buffer in module._buffers.items():
            if buffer is not None:
                module._buffers[name] = moved(mode, buffer)


def move_sampler(mode: FakeTensorMode, sampler: PixelSampler) -> None:
    """A sampler that holds its pixels on the device."""
    sampler.device = torch.device(DEVICE, 0)
    for owner in (sampler, sampler._usable):
        for name, value in vars(owner).items() if owner is not None else ():
            if isinstance(value, Tensor):
                vars(owner)[name] = moved(mode, value)


def lens(cameras: Cameras, name: str) -> Cameras:
    """The cameras with a lens of that name, numbered as `lenses` does."""
    number = {"pinhole": 0, "opencv": 1, "fisheye": 2, "panorama": 3}[name]
    kinds = torch.full_like(cameras.model, number)
    return replace(cameras, model=kinds, kinds=(number,))


def pictures(masked: bool) -> ImageData:
    """What the toy cameras see; masked: without their lower halves."""
    images = toy_images(toy_cameras(6))
    valid = torch.arange(len(images.pixels)) % (32 * 32) < 16 * 32
    return replace(images, valid=valid if masked else None)


def flat_maps(num: int) -> DepthMaps:
    """A wall before each camera."""
    wall = np.full((16, 16), 1.5, np.float32)
    return DepthMaps.from_arrays([wall] * num, [(14.0, 14.0, 8.0, 8.0)] * num, 1.0)


def run_step(config: TrainConfig, kind: Kind, lens_name: str, *, masked: bool, block: int) -> None:
    """One step of that kind, with depth maps where rays stand for single pixels."""
    cameras = lens(toy_cameras(6), lens_name)
    model: Model = find_method(config.method).build(config.model, 6).train()
    sampler = PixelSampler(pictures(masked), range(6), lines=PlainLines.of(config))
    sampler.block = block
    with FakeTensorMode() as mode:
        move_model(mode, model)
        move_sampler(mode, sampler)
        posed = cameras._map(lambda values: moved(mode, values))
        optimizers = {"networks": torch.optim.Adam(model.network_parameters(), fused=True)}
        if model.config.camera_mode != "off":
            corrections = model.cameras_delta.parameters()
            optimizers["cameras"] = torch.optim.Adam(corrections, fused=True)
        scaler = torch.amp.GradScaler("cpu", enabled=False)
        maps = DepthMaps(*(moved(mode, values) for values in vars(flat_maps(6)).values()))
        step = TrainingStep(
            model,
            optimizers,
            scaler,
            sampler,
            posed,
            RAYS,
            pixel_random=torch.Generator(),
            model_random=torch.Generator(),
            depth=DepthSupervision(maps, config.depth, config.max_steps) if block == 1 else None,
        )
        exponent: Any = torch.full((), 0.5, device=DEVICE) if kind.annealing else 1.0
        with OnlyDevice():
            step.optimise(kind, StepPlan(12, exponent, update_proposals=kind.update_proposals))
        assert ("depth" in step._names[kind]) == (block == 1)
        assert "flat" in step._names[kind]
        learned = {name for name, value in model.named_parameters() if value.grad is not None}
    assert ("proposals.0.grid.table" in learned) == kind.update_proposals
    assert ("cameras_delta.tangent" in learned) == (model.config.camera_mode != "off")


CASES: list[tuple[Kind, str, bool, int, dict[str, object]]] = [
    # Kind, lens, masks, side of a ray's square of pixels, options of the model.
    (Kind(True, True), "pinhole", False, 1, {"camera_mode": "so3xr3"}),
    (Kind(False, False), "opencv", True, 1, {"camera_mode": "se3", "background": "random"}),
    (Kind(False, True), "fisheye", False, 2, {"camera_mode": "off", "background": "white"}),
    (Kind(True, False), "panorama", True, 4, {"background": "black", "contraction": "none"}),
]


def broken(values: Tensor, host: Tensor) -> dict[str, Callable[[], object]]:
    """What no step may do. values: [4] on the device. host: [] on the CPU."""
    return {
        "number of the CPU": lambda: values + host,
        "index of the CPU": lambda: values[host.long()[None]],
        "mask": lambda: values[values > 0.0],
        "nonzero": lambda: torch.nonzero(values),
        "item": lambda: values.sum().item(),
        "bool": lambda: bool(values.sum() > 0.0),
        "copy": lambda: host.to(DEVICE),
    }


def main() -> None:
    """All cases, or all that must fail."""
    _setup_privateuseone_for_python_backend(DEVICE, backend_module=Backend())
    vars(samplers)["t_from_s"] = t_from_s
    if "--broken" in sys.argv:
        with FakeTensorMode():
            values, host = torch.ones(4, device=DEVICE), torch.zeros(())
            for name, attempt in broken(values, host).items():
                try:
                    with OnlyDevice():
                        attempt()
                except (AssertionError, *FAKE_ERRORS) as error:
                    print(f"{name}: {type(error).__name__}")
                else:
                    print(f"{name} went through")
        return
    for kind, lens_name, masked, block, options in CASES:
        config = with_model(
            tiny_config(rays_per_step=RAYS, flat=FlatLossConfig("always")), **options
        )
        run_step(config, kind, lens_name, masked=masked, block=block)
        print(kind, lens_name, masked, block, options, flush=True)


if __name__ == "__main__":
    main()
