"""A Triton driver for a GPU that is not there: kernels are compiled for it, down to machine code,
and none is run.

With it set, the product's own calls decide what is compiled: their types, constants, alignments and
numbers of warps, which is what a hand-written list of signatures gets wrong. Symbols: sm_90 is the
architecture 90. What a kernel needs of a processor comes from `cuobjdump`, which Triton brings.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver

TOOLS = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
SHARED_KIB = {75: 64, 80: 163, 86: 99, 89: 99, 90: 227, 100: 227, 120: 99}
"""Shared memory that one block may have, KiB. Source: CUDA C++ programming guide, "Technical
specifications per compute capability"."""
THREADS = {75: 1024, 80: 2048, 86: 1536, 89: 1536, 90: 2048, 100: 2048, 120: 1536}
"""Threads that one processor holds. Same source."""
REGISTERS = 65_536
"""Of one processor, 4 bytes each."""


@dataclass(frozen=True)
class Compiled:
    """What became of one kernel.

    name: of its function. warps: per block. shared: bytes per block that Triton asks for.
    registers, stack, local: per thread, the latter two in bytes: what did not fit the registers.
    instructions: how often each occurs in the machine code, by name. blocks: numbers of blocks of
    its first launch.
    """

    name: str
    constants: dict[str, Any]
    blocks: tuple[int, ...]
    warps: int
    shared: int
    registers: int
    stack: int
    local: int
    instructions: Counter[str]

    def count(self, start: str) -> int:
        """Instructions whose names begin so."""
        return sum(n for name, n in self.instructions.items() if name.startswith(start))

    def resident_share(self, arch: int) -> float:
        """Threads of a processor that registers and shared memory let run at once, of those that
        it could hold."""
        threads = 32 * self.warps
        # Registers are handed out by 8 for each thread.
        by_registers = REGISTERS // (-(-self.registers // 8) * 8 * threads)
        # A kibibyte of each block is the system's.
        by_shared = (SHARED_KIB[arch] + 1) * 1024 // (self.shared + 1024)
        return min(by_registers, by_shared, THREADS[arch] // threads) * threads / THREADS[arch]


class _Utils:
    """What Triton asks of a driver's library when it loads a kernel."""

    def __init__(self, arch: int) -> None:
        self._arch = arch

    def get_device_properties(self, device: int) -> dict[str, int]:
        return {"max_shared_mem": SHARED_KIB[self._arch] * 1024}

    def load_binary(self, name: str, *_: Any) -> tuple[int, int, int, int, int]:
        return 0, 0, 0, 0, 1024


class PretendGpu:
    """Triton's active driver within a `with` block: compiles for sm_`arch`, starts nothing.

    `compiled` has one entry for each specialisation, in order of their first launch; `launches`
    counts all of them.
    """

    def __init__(self, arch: int) -> None:
        self.arch = arch
        self.utils = _Utils(arch)
        self.compiled: list[Compiled] = []
        self.launches = 0

    def get_current_device(self) -> int:
        # Triton keeps what it compiled by device.
        return self.arch

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", self.arch, 32)

    def launcher_cls(self, source: Any, metadata: Any) -> Any:
        """Called by Triton once for each kernel it loads; what is returned, at each launch."""
        found: list[Any] = []

        def launch(
            x: int, y: int, z: int, stream: int, function: int, packed: Any, *_: Any
        ) -> None:
            self.launches += 1
            if not found:
                found.append(_report(source, metadata, (x, y, z)))
                self.compiled.append(found[0])

        return launch

    def __enter__(self) -> PretendGpu:
        driver.set_active(self)
        return self

    def __exit__(self, *_: object) -> None:
        driver._active = None


def _report(source: Any, metadata: Any, blocks: tuple[int, ...]) -> Compiled:
    names = source.fn.arg_names
    constants = {names[place[0]]: value for place, value in source.constants.items()}
    made = triton.compile(source, target=metadata.target, options=_options(metadata))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.cubin"
        file.write_bytes(made.asm["cubin"])
        usage = _tool("--dump-resource-usage", file)
        code = _tool("--dump-sass", file)
    found = re.search(r"REG:(\d+) STACK:(\d+) SHARED:\d+ LOCAL:(\d+)", usage)
    assert found, usage
    line = r"^\s+/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+\s+)?([A-Z][A-Z0-9_.]*)"
    return Compiled(
        name=metadata.name,
        constants=constants,
        blocks=blocks,
        warps=metadata.num_warps,
        shared=metadata.shared,
        registers=int(found[1]),
        stack=int(found[2]),
        local=int(found[3]),
        instructions=Counter(re.findall(line, code, re.MULTILINE)),
    )


def _options(metadata: Any) -> dict[str, Any]:
    """What the launch asked for; the rest is as it is by default."""
    return {"num_warps": metadata.num_warps, "debug": metadata.debug}


def _tool(option: str, file: Path) -> str:
    command = [str(TOOLS / "cuobjdump"), option, str(file)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
