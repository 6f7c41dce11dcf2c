"""How many kernels a run's steps make Triton compile, step by step; run by `test_compile`.

    python -m tests.unit.pipelines.nerf.engines.gpu.pretend_launches

The training step itself, on the CPU, with the GPU's kernels in the place of the CPU's: they are
compiled for a GPU that is not there and not run, so values are whatever was in memory. Prints a
JSON list, one entry a step: [kind of step, kernels compiled so far, launches so far].
"""

from __future__ import annotations

import json

import torch

from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.engines.gpu.parts.hash_grid import hash_encode_triton
from pipelines.nerf.engines.gpu.step import EAGER_STEPS, TrainingStep, capturable_adam, loss_scaler
from pipelines.nerf.models.base import Model
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.catalogue import find_method
from tests.unit.pipelines.nerf.engines.gpu.pretend_gpu import PretendGpu
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

RAYS = 32
STEPS = 4 * (EAGER_STEPS + 2)
CPU = torch.device("cpu")


def main() -> None:
    """Run and print."""
    config = with_model(
        tiny_config(rays_per_step=RAYS),
        proposal_warmup_steps=1,
        proposal_update_every=2,
        anneal_steps=10 + STEPS // 2,
        position_encoding="hash",
    )
    cameras = toy_cameras(4)
    model: Model = find_method(config.method).build(config.model, 4).train()
    for module in model.modules():
        if isinstance(module, HashGrid):
            module.encode = hash_encode_triton  # what grids are handed on a GPU
    step = TrainingStep(
        model,
        {
            "networks": capturable_adam(model.network_parameters(), 0.0, 1e-15, CPU),
            "cameras": capturable_adam(model.cameras_delta.parameters(), 0.0, 1e-15, CPU),
        },
        loss_scaler(CPU, RAYS),
        PixelSampler(toy_images(cameras), range(4)),
        cameras,
        RAYS,
        pixel_random=torch.Generator(),
        model_random=torch.Generator(),
    )
    seen = []
    with PretendGpu(90) as gpu:
        for number in range(10, 10 + STEPS):
            plan = model.plan_step(number)  # decides and changes nothing
            kind = f"{plan.update_proposals} {plan.exponent != 1.0}"
            step.run(number, {"networks": 0.0, "cameras": 0.0})
            seen.append([kind, len(gpu.compiled), gpu.launches])
    print(json.dumps(seen))


if __name__ == "__main__":
    main()
