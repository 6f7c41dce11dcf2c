"""The checkpoint of the poses: databases of features and matches, which steps are done in them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from pipelines.options import PosesOptions
from pipelines.sfm.source import Source
from pipelines.stage import StageContext

_FORMAT = 5
"""Of the checkpoint: raised where the same options give other databases or names of steps."""


class Checkpoint:
    """The databases, and which steps are complete in them: a retried attempt goes on from there.

    Databases without a state file, or made from other inputs or options, are thrown away.
    """

    def __init__(self, ctx: StageContext, source: Source, options: PosesOptions) -> None:
        self._ctx = ctx
        self._state_file = ctx.checkpoint / "state.json"
        inputs = [
            (file, path.stat().st_size)
            for file, path in zip(source.files, source.paths, strict=True)
        ]
        wanted = options.model_dump(
            include={"max_image_px", "num_features", "upsample", "camera_model", "matcher"}
            | {"sequential_overlap", "retrieval_neighbours"}
        )
        masks = [(i, path.stat().st_size) for i, path in sorted(source.mask_paths.items())]
        told = [_FORMAT, inputs, wanted, ctx.seed, *([masks] if masks else [])]
        text = json.dumps(told, sort_keys=True)
        self._fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._steps: list[str] = []
        ctx.checkpoint.mkdir(parents=True, exist_ok=True)
        if self._state_file.is_file():
            state = json.loads(self._state_file.read_text("utf-8"))
            here = all(self.database(step.split()[0]).is_file() for step in state["steps"])
            if here and state["fingerprint"] == self._fingerprint:
                self._steps = list(state["steps"])
        if not self._steps:
            self._state_file.unlink(missing_ok=True)
            for stale in list(ctx.checkpoint.glob("*.db*")):
                stale.unlink()

    def database(self, name: str) -> Path:
        """Where the database of that name lies, or will."""
        return self._ctx.checkpoint / f"{name}.db"

    def has(self, step: str) -> bool:
        """Whether that step is complete in its database."""
        return step in self._steps

    def save(self, step: str) -> None:
        """Mark a step complete and offer the checkpoint to the runner."""
        self._steps.append(step)
        state = {"fingerprint": self._fingerprint, "steps": self._steps}
        partial = self._state_file.with_suffix(".partial")
        partial.write_text(json.dumps(state), "utf-8")
        partial.replace(self._state_file)
        self._ctx.checkpoint_saved()
