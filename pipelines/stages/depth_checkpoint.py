"""What the stage `depth` has found so far, in files: its memory, and where it goes on from.

`.checkpoint/depth/maps/` holds maps by pass and view, `state.json` which passes are complete and
what is to be told of them. A view's map is there as soon as it is found; the runner is offered the
folder once a minute, and before the machine is given up.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from pathlib import Path
from typing import Any

from pipelines.nerf.stereo.maps import MapShelf
from pipelines.nerf.stereo.shelves import FileShelves
from pipelines.registry import get_stage
from pipelines.stage import StageContext

_FORMAT = 1
"""Raised where the files mean something else; results that are others raise the stage's version."""
SAVE_S = 60.0
_SCRATCH = ".scratch"


class DepthCheckpoint:
    """The shelves of a search, and its passes.

    What was found for another `told`, which says all that results depend on, is thrown away.
    """

    def __init__(self, ctx: StageContext, num_views: int, told: Any) -> None:
        self._ctx, self._num_views = ctx, num_views
        self._state_file = ctx.checkpoint / "state.json"
        self._maps, self._scratch = ctx.checkpoint / "maps", ctx.out / _SCRATCH
        version = get_stage(ctx.stage).version
        text = json.dumps([_FORMAT, version, num_views, told], sort_keys=True)
        self._fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._passes: list[tuple[str, str, dict[str, Any]]] = []
        self._saved_at = time.monotonic()
        self.shelves = FileShelves(self._maps, self._scratch)
        state = self._read()
        fits = state is not None and state["fingerprint"] == self._fingerprint
        if state is not None and fits:
            self._passes = [(name, shelf, told) for name, shelf, told in state["passes"]]
        if not fits or not self._is_whole():
            self._passes = []
            shutil.rmtree(self._maps, ignore_errors=True)
            self._write()
        elif self._maps.is_dir():
            ctx.logger.info("going on from the checkpoint: %s", self.passes or "some views")

    @property
    def passes(self) -> list[str]:
        """The names of those that are complete, in their order."""
        return [name for name, _, _ in self._passes]

    @property
    def told(self) -> dict[str, Any]:
        """What complete passes tell."""
        return {key: value for _, _, told in self._passes for key, value in told.items()}

    def maps(self) -> MapShelf:
        """What the last complete pass has found. Raises LookupError where none is complete."""
        _, shelf, _ = self._passes[-1]
        return MapShelf.kept(self.shelves, shelf, self._num_views)

    def _is_whole(self) -> bool:
        """Whether all that the last pass has found is there: a machine may have lost power."""
        if not self._passes:
            return True
        maps = self.maps()
        return all(maps.has(index) for index in range(len(maps)))

    def complete(self, name: str, found: MapShelf, told: dict[str, Any]) -> None:
        """A pass is complete; only what it has found is needed from now on."""
        self._passes.append((name, found.name, told))
        self._write()
        for folder in self._maps.iterdir():
            if folder.name not in MapShelf.parts_of(found.name):
                shutil.rmtree(folder)
        self.offer()

    def offer(self) -> None:
        """Let the runner keep what there is, if it is time. Cheap: call it after every view."""
        if self._ctx.is_shutdown() or time.monotonic() - self._saved_at >= SAVE_S:
            self._saved_at = time.monotonic()
            self._ctx.checkpoint_saved()

    def close(self) -> None:
        """Remove what the stage's result does not need."""
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _read(self) -> dict[str, Any] | None:
        try:
            state: dict[str, Any] = json.loads(self._state_file.read_text("utf-8"))
        except (OSError, ValueError):
            return None
        return state

    def _write(self) -> None:
        """The state file is replaced as a whole."""
        self._ctx.checkpoint.mkdir(parents=True, exist_ok=True)
        partial = self._state_file.with_suffix(".partial")
        state = {"fingerprint": self._fingerprint, "passes": self._passes}
        partial.write_text(json.dumps(state), "utf-8")
        partial.replace(self._state_file)


def inputs_of(ctx: StageContext) -> list[Any]:
    """What says whether a stage's inputs are the same: the contents of what it reads."""
    workspace = ctx.workspace
    reads = [name for name in get_stage(ctx.stage).reads if workspace.is_complete(name)]
    files = [workspace.posed_cameras, workspace.sparse_points]
    return [
        *((name, workspace.manifest(name)["content"]) for name in reads),
        *(_digest(path) for path in files if path.is_file()),
    ]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
