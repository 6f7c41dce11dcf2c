"""What reads a hash grid under each engine: the definition, or a compiled twin of it.

`Model.set_engine` hands one to its grids, so that the networks know nothing of engines. Which twin
serves is decided in each call by where table and points lie, because a model may be moved after its
engine was chosen. A machine that only uses the definition loads no compiler.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.encodings import HashEncode, hash_encode

CPU_FEATURES = 2
"""Features per entry that the twin on the CPU is made for."""


def hash_encode_compiled(
    points: Tensor, table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
) -> Tensor:
    """As `encodings.hash_encode`, by the compiled twin for table and points where there is one.

    That is for float32 tables: on a CUDA GPU, and on the CPU with two features per entry. A twin
    has first derivatives alone; a backward pass through it with `create_graph` raises NerfError
    `bad_config`.
    """
    twin = _twin_for(table, points)
    if twin is None:
        return hash_encode(points, table, resolutions, dense, offsets)
    encoded = twin(points, table, resolutions, dense, offsets)
    if encoded.requires_grad:
        encoded.register_hook(_refuse_second_derivatives)  # type: ignore[no-untyped-call]
    return encoded


HASH_ENCODERS: dict[str, HashEncode] = {"plain": hash_encode, "fast": hash_encode_compiled}
"""By the engine's name."""


def _twin_for(table: Tensor, points: Tensor) -> HashEncode | None:
    where = {table.device.type, points.device.type}
    if table.dtype != torch.float32:
        return None
    # Imported here: a machine that only uses the plain definition never loads a compiler.
    if where == {"cpu"} and table.shape[1] == CPU_FEATURES:
        from pipelines.nerf.engines.cpu.parts.hash_grid import hash_encode_fast

        return hash_encode_fast
    if where == {"cuda"}:
        from pipelines.nerf.engines.gpu.parts.hash_grid import hash_encode_triton

        return hash_encode_triton
    return None


def _refuse_second_derivatives(gradient: Tensor) -> None:
    """A backward hook: to a second pass the compiled twin's gradients would be constants."""
    # Inside a backward pass gradients are only recorded when it was asked to create a graph.
    if torch.is_grad_enabled():
        raise NerfError(
            "bad_config",
            "The compiled hash grid has no second derivatives, which were asked for on features "
            f"{list(gradient.shape)}.",
            "Train normals with the engine 'plain'.",
        )
