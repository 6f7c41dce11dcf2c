"""Compiles every Triton kernel for a GPU that need not be there; run by `test_kernels`.

    python -m tests.unit.pipelines.nerf.gpu.compile_kernels 80 90

For each architecture and kernel prints what ptxas made of it as JSON: {"kernel", "capability",
"shared_bytes", "ptx_loads_of_64_bits"}.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from pipelines.nerf.gpu import hash_grid, mlp

POINTERS_TO_INTEGERS = {"resolutions": "*i64", "offsets": "*i64", "dense": "*i1"}
NUMBERS = ("num_points", "num_levels")
GRID = {"F": 2, "L": 16, "IS_PAIRED": True, "IS_HALF": False, "B": hash_grid.POINTS_PER_PROGRAM}


def kernels() -> list[tuple[Any, dict[str, Any], int, str]]:
    """(kernel, values of its constants, warps, type of the table)."""
    found: list[tuple[Any, dict[str, Any], int, str]] = []
    for kernel in (
        hash_grid._forward_kernel,
        hash_grid._table_gradient_kernel,
        hash_grid._point_gradient_kernel,
    ):
        found.append((kernel, GRID, hash_grid.NUM_WARPS, "*i64"))
    found.append(
        (hash_grid._forward_kernel, {**GRID, "IS_HALF": True}, hash_grid.NUM_WARPS, "*i32")
    )
    for widths in [(10, 16, 1), (32, 64, 16), (63, 64, 64, 3)]:
        sizes = {**mlp._sizes(widths), "IS_DEEP": len(widths) == 4, "IS_HALF": True}
        backward = {"WANTS_VALUES": True, "NUM_SUMS": 1000, "TILES": 8, "B": mlp.BACKWARD_TILE}
        found.append(
            (mlp._forward_kernel, {**sizes, "B": mlp.FORWARD_TILE}, mlp.FORWARD_WARPS, "*fp32")
        )
        found.append((mlp._backward_kernel, {**sizes, **backward}, mlp.BACKWARD_WARPS, "*fp32"))
    return found


def compiled(kernel: Any, constants: dict[str, Any], warps: int, table: str, arch: int) -> Any:
    """The kernel for an architecture, down to machine code."""
    signature = {}
    for name in kernel.arg_names:
        if name.isupper():
            signature[name] = "constexpr"
        elif name in NUMBERS:
            signature[name] = "i32"
        else:
            signature[name] = POINTERS_TO_INTEGERS.get(name, table if name == "table" else "*fp32")
    chosen = {name: value for name, value in constants.items() if name in signature}
    source = ASTSource(fn=kernel, signature=signature, constexprs=chosen)
    return triton.compile(source, target=GPUTarget("cuda", arch, 32), options={"num_warps": warps})


def main() -> None:
    """Compile and print."""
    for arch in map(int, sys.argv[1:]):
        for kernel, constants, warps, table in kernels():
            made = compiled(kernel, constants, warps, table, arch)
            assert len(made.asm["cubin"]) > 0
            values = {
                "kernel": kernel.__name__,
                "capability": arch,
                "shared_bytes": made.metadata.shared,
                "ptx_loads_of_64_bits": made.asm["ptx"].count("ld.global.b64"),
            }
            print(json.dumps(values))


if __name__ == "__main__":
    main()
