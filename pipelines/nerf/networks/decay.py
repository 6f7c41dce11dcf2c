"""Hash grids whose tables decay: what few rays tell anything falls back to nothing.

An entry that is rarely read keeps the noise of its last steps, and space that nobody saw is full of
it. So a little of the entry itself is taken off in each step, as part of its gradient: what the
pictures say is far stronger, noise is not.

Plain PyTorch, before the step of any of torch's optimisers; `engines.cpu.train.adam` is the twin.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from pipelines.nerf.networks.encodings import HashGrid

DECAYS = "decays"
"""Of a group of an optimiser: one number for each of its parameters."""


def set_table_decay(optimizer: torch.optim.Optimizer, model: nn.Module, decay: float) -> None:
    """Let an optimiser's steps add `decay` times an entry to its gradient, in all hash grids.

    As weight decay in `torch.optim.Adam`, with one difference: an entry that never had a gradient
    stays as it is. Adam would go by the decay alone there, at its full rate, whatever its size.
    Source: Zip-NeRF, arXiv:2304.06706, section 4, which takes each level's mean square.
    """
    tables = {module.table for module in model.modules() if isinstance(module, HashGrid)}
    for group in optimizer.param_groups:
        group[DECAYS] = tuple(decay if item in tables else 0.0 for item in group["params"])


@torch.no_grad()
def decay_gradients(optimizer: torch.optim.Adam, *_: Any) -> None:
    """Add to each gradient what `set_table_decay` asked for: a hook before the optimiser's step.

    Where a loss scale is left for the step itself to take out (`grad_scale`), the decay gets it
    too. Nothing here waits for a GPU.
    """
    scale = getattr(optimizer, "grad_scale", None)
    for group in optimizer.param_groups:
        for parameter, decay in zip(group["params"], group.get(DECAYS, ()), strict=False):
            gradient = parameter.grad
            if gradient is None or not decay:
                continue
            known = gradient != 0
            if state := optimizer.state.get(parameter):
                known = known | (state["exp_avg"] != 0) | (state["exp_avg_sq"] != 0)
            part = decay * parameter * known
            gradient.add_(part if scale is None else part * scale)
