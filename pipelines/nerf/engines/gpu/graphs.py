"""Work on a GPU as CUDA graphs: recorded once, then started again by one call of the host.

All graphs of one `CudaGraphs` share a pool of memory, since only one runs at a time. So what one of
them made is gone once another has run: nothing may be read after a graph but what lay outside of
the pool before it was recorded, which its work writes into.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch

from pipelines.nerf.errors import NerfError


class Replay(Protocol):
    """Recorded work."""

    def replay(self) -> None:
        """Do it again, with what is now in the tensors that it reads."""


class Recorder(Protocol):
    """What turns work into a `Replay`; `CudaGraphs`, or a stand-in where there is no GPU."""

    def record(self, work: Callable[[], None]) -> Replay:
        """The work that a call of `work` would start; recording does none of it."""


class CudaGraphs:
    """Records what is started on one stream of a GPU.

    generators: whose random numbers the work draws; each replay goes on with them.
    """

    def __init__(
        self,
        device: torch.device,
        stream: torch.cuda.Stream,
        generators: Sequence[torch.Generator],
    ) -> None:
        self._device, self._stream = device, stream
        self._generators = [each for each in generators if each.device.type == "cuda"]
        self._first: torch.cuda.CUDAGraph | None = None

    def record(self, work: Callable[[], None]) -> torch.cuda.CUDAGraph:
        """As `Recorder.record`. Raises NerfError `gpu_failed`, or torch.OutOfMemoryError."""
        graph = torch.cuda.CUDAGraph()
        # Else every replay would draw the numbers of the recording. Later releases may find the
        # generators by themselves; `self_check` sees whether new numbers are drawn.
        register = getattr(graph, "register_generator_state", None)
        if register is not None:
            for generator in self._generators:
                register(generator)
        pool = None if self._first is None else self._first.pool()
        torch.cuda.synchronize(self._device)
        try:
            # Other threads of the process may go on using the GPU meanwhile.
            with torch.cuda.graph(
                graph, pool=pool, stream=self._stream, capture_error_mode="thread_local"
            ):
                work()
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            raise NerfError(
                "gpu_failed",
                f"The training step could not be captured as a CUDA graph on {self._device} with "
                f"torch {torch.__version__}: {str(error).splitlines()[0]}",
                "Set train.engine to plain.",
            ) from error
        self._first = self._first or graph
        return graph
