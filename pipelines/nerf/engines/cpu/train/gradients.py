"""Where training kernels put the gradient of a table: into a buffer that outlives the step.

A dense gradient of the field's table is 49 MB. Returned from backward in the usual way it is
allocated, zeroed, filled and added to `table.grad`, every step. The convention that spares this:

- `HashGrid.accumulate_in_place` (False unless the training engine sets it, see
  `accumulate_in_place`) says that backward may add straight into `table.grad`;
- backward asks `table_gradient` for the array to add to, and returns `returned_gradient`: the array
  in the usual case, None where it was `table.grad` itself and all is done already.

With the flag off, `torch.autograd.grad` and hooks work as always; with it on, only `.backward()`
does, and whoever zeroes gradients keeps the buffers (`zero_grad(set_to_none=False)`; `FusedAdam`
zeroes them while it reads them). A buffer that is asked for counts as changed (its version moves),
which tells `FusedAdam` the tables that took part in a step from those that did not.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipelines.nerf.networks.encodings import HashGrid

FLAG = "accumulate_in_place"


def accumulate_in_place(module: nn.Module) -> None:
    """Let every hash grid inside `module` add its gradient to a buffer allocated here, once."""
    for part in module.modules():
        if isinstance(part, HashGrid):
            setattr(part, FLAG, True)
            if part.table.grad is None:
                part.table.grad = torch.zeros_like(part.table)


def accumulates_in_place(grid: HashGrid) -> bool:
    """Whether backward may add to `grid.table.grad`."""
    return bool(getattr(grid, FLAG, False))


def table_gradient(table: Tensor, accumulate: bool) -> Tensor:
    """The array [E, F] that backward adds a table's gradient to.

    table: the leaf itself, not a detached copy. accumulate: as `accumulates_in_place`.
    Returns `table.grad` where it exists and may be added to, else new zeros.
    """
    if accumulate and table.is_leaf and table.grad is not None and table.grad.is_contiguous():
        torch.autograd.graph.increment_version(table.grad)
        return table.grad
    return torch.zeros_like(table, memory_format=torch.contiguous_format)


def returned_gradient(table: Tensor, buffer: Tensor) -> Tensor | None:
    """What backward returns for the table after adding to `buffer` of `table_gradient`."""
    return None if buffer is table.grad else buffer
