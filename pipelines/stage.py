"""What a stage is, and what it is given.

A stage reads the folders of earlier stages and writes one folder of its own. It knows nothing of
databases, queues or object stores: the runner around it (a worker, or `python -m pipelines run`)
brings the inputs, publishes the folder and writes its manifest. This file imports no torch.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from pipelines.errors import Cancelled
from pipelines.workspace import Workspace

REPORT = "report.json"
"""What a stage, or a whole job, says of itself in its own words."""
CAPTURE_REPORT, CAPTURE_PAGE = "capture-report.json", "capture-report.html"
"""What a job says of how its capture was filmed."""
POSES_REPLACED = "replaced"
"""What `poses` says of given poses in whose place others were found from the pictures."""


Memory = Literal["full", "small"]
"""How a stage goes about memory, see `StageContext`."""


@dataclass(frozen=True)
class Artifact:
    """A file that a finished job offers for download.

    name: what people see and download, unique in a job. path: relative to the stage's folder.
    opens_with: one or two programs, shown beside the download.
    on_request: whether it is there only where options ask for it.
    """

    name: str
    path: str
    media_type: str
    opens_with: str
    on_request: bool = False


@dataclass(frozen=True)
class Stage:
    """One row of the registry.

    name: also the folder's name and the options' prefix.
    version: raised when the same inputs and options give another result.
    after: stages that must have succeeded or been skipped; their folders are the inputs.
    reads: stages whose folders the stage reads (a subset of all that come before it).
    run: dotted path "module:function" of `(options, ctx) -> summary`; resolved only where it runs.
    options: name of its options class, which `pipelines.options.STAGE_OPTIONS` holds.
    needs_gpu: whether a GPU worker should take it when there is one.
    time_limit_s: hard limit for one attempt.
    stall_s: an attempt that neither gets on nor writes a log line for so long is ended.
    explains: dotted path of `(workspace, stage's name, error) -> dict`, called where the stage
        fails: it may say more in `workspace.failed(name)`; what it returns is in the error's
        details as `check`. Errors of its own are logged and change nothing.
    """

    name: str
    version: int
    after: tuple[str, ...]
    reads: tuple[str, ...]
    run: str
    options: str
    needs_gpu: bool = False
    time_limit_s: float = 3600.0
    stall_s: float = 1800.0
    artifacts: tuple[Artifact, ...] = ()
    explains: str = ""


class ProgressSink(Protocol):
    """Receives a stage's progress: fraction in [0, 1], a short message, seconds left or None."""

    def __call__(self, fraction: float, message: str, eta_s: float | None) -> None: ...


def _ignore_progress(fraction: float, message: str, eta_s: float | None) -> None:
    del fraction, message, eta_s


@dataclass
class StageContext:
    """All that a stage may touch besides its options.

    stage: its name.
    workspace: the job's folder; a stage reads earlier stages' folders from it.
    out: the folder the stage writes to, empty at the start, published as a whole afterwards. Of a
        stage that raises PipelineError its `report.json` is kept, if it wrote one (`REPORT`).
    checkpoint: a folder that outlives a failed attempt, also when the next one runs elsewhere;
        a stage that calls `checkpoint_saved` after writing it can go on from there.
    seed: fixed per job, so that a run can be repeated.
    memory: "small" where an earlier attempt ran out of memory: it then takes less for passing
        things, tiles and caches, at the price of time and not of results. It has fewer threads,
        too, which need nothing of the stage.
    is_shutdown: whether it is stopped only because its machine is needed: within seconds it may
        save what the next attempt can go on from, before it reports progress again.
    """

    stage: str
    workspace: Workspace
    out: Path
    checkpoint: Path
    seed: int = 0
    memory: Memory = "full"
    logger: logging.Logger = field(default_factory=lambda: logging.getLogger("nerfworks.stage"))
    on_progress: ProgressSink = _ignore_progress
    is_cancelled: Callable[[], bool] = lambda: False
    is_shutdown: Callable[[], bool] = lambda: False
    on_checkpoint: Callable[[], None] = lambda: None

    @property
    def memory_share(self) -> float:
        """How much of the usual memory passing things may take, in (0, 1]."""
        return SMALL_SHARE if self.memory == "small" else 1.0

    def progress(self, fraction: float, message: str = "", eta_s: float | None = None) -> None:
        """Report progress and notice a cancel. Cheap: call it as often as is convenient."""
        self.check_cancelled()
        self.on_progress(min(max(fraction, 0.0), 1.0), message, eta_s)

    def told_part(self, message: str, begin: float, end: float) -> Callable[[float], None]:
        """What reports the share that is done of a part, which goes from `begin` to `end`."""
        return lambda done: self.progress(begin + (end - begin) * done, message)

    def check_cancelled(self) -> None:
        """Raise `Cancelled` once the job's cancel was asked for."""
        if self.is_cancelled():
            raise Cancelled(f"The job was cancelled during {self.stage}.")

    def checkpoint_saved(self) -> None:
        """Tell the runner that `checkpoint` holds a complete state worth keeping."""
        self.on_checkpoint()


SMALL_SHARE = 0.25
"""Of what a stage usually takes for passing things, where memory ran out before."""

FailureExplainer = Callable[[Workspace, str, Mapping[str, Any]], dict[str, Any]]
"""See `Stage.explains`; the error as `PipelineError.as_dict` gives it."""

StageFunction = Callable[[Any, StageContext], dict[str, Any]]
"""`(options, ctx) -> summary`; the summary is JSON-able and ends in the manifest and the report."""
