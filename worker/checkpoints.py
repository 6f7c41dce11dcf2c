"""Uploads checkpoints beside a running stage: the latest only, replaced as a whole.

Order: the new one is uploaded under a prefix of its own, then the stage's row names it (under the
fencing token), then, after the COMMIT, the old one is deleted. At each moment the row names a
complete checkpoint, also where nobody knows whether a COMMIT was applied.
"""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from pipelines.workspace import Workspace
from storage import keys
from storage.claims import Claim
from storage.db import Database
from storage.errors import LostLeaseError, ObjectStoreError, StorageError
from storage.leases import save_checkpoint
from storage.objects import ObjectStore
from storage.steps import reached
from worker.transfer import upload_folder

_log = logging.getLogger("nerfworks.worker")


@dataclass(frozen=True)
class Snapshot:
    """A held state. files: name -> [bytes, mtime_ns] when it was taken."""

    folder: Path
    files: dict[str, list[int]]

    def is_intact(self) -> bool:
        """Whether no file was written into since."""
        try:
            stats = {name: (self.folder / name).stat() for name in self.files}
        except OSError:
            return False
        return all(
            [stats[name].st_size, stats[name].st_mtime_ns] == noted
            for name, noted in self.files.items()
        )


def snapshot_of(workspace: Workspace, stage: str, message: Mapping[str, Any]) -> Snapshot:
    """What a stage process says that it holds.

    Raises ValueError where that is not beside its checkpoint: nobody uploads what lies elsewhere.
    """
    folder = Path(message["path"])
    checkpoint = workspace.checkpoint(stage)
    if folder.parent != checkpoint.parent or not folder.name.startswith(f"{stage}.saved-"):
        raise ValueError(f"{stage} offers a checkpoint that is none of its own")
    return Snapshot(folder, message["files"])


class CheckpointUploader:
    """Takes snapshots of one claim and uploads the newest in a thread of its own."""

    def __init__(
        self,
        database: Database,
        store: ObjectStore,
        claim: Claim,
        guard: Callable[[], None],
        *,
        workers: int,
    ) -> None:
        self._database = database
        self._store = store
        self._claim = claim
        self._guard = guard
        self._workers = workers
        self._newest: Snapshot | None = None
        self._number = 0
        self._abandoned = False
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._loop, daemon=True, name="checkpoints")
        self._thread.start()

    def offer(self, snapshot: Snapshot) -> None:
        """Upload this one next; one that still waits is dropped."""
        with self._changed:
            self._drop_newest()
            self._newest = snapshot
            self._changed.notify()

    def close(self, *, finish: bool, timeout_s: float) -> None:
        """End the thread; `finish` first uploads what waits, else it is dropped."""
        with self._changed:
            self._closed = True
            if not finish:
                self._abandoned = True
                self._drop_newest()
            self._changed.notify()
        self._thread.join(timeout_s)
        self._abandoned = True
        self._thread.join()

    def _drop_newest(self) -> None:
        if self._newest is not None:
            shutil.rmtree(self._newest.folder, ignore_errors=True)
            self._newest = None

    def _check(self) -> None:
        if self._abandoned:
            raise LostLeaseError("the checkpoint is not wanted any more")
        self._guard()

    def _loop(self) -> None:
        while True:
            with self._changed:
                while self._newest is None and not self._closed:
                    self._changed.wait()
                snapshot, self._newest = self._newest, None
            if snapshot is None:
                return
            try:
                self._upload(snapshot)
            except (StorageError, SQLAlchemyError, OSError) as error:
                _log.warning("checkpoint of %s not kept: %s", self._claim.stage_id, error)
            finally:
                shutil.rmtree(snapshot.folder, ignore_errors=True)

    def _upload(self, snapshot: Snapshot) -> None:
        claim = self._claim
        self._number += 1
        prefix = keys.checkpoint_prefix(claim.root, claim.name, claim.token, self._number)
        try:
            upload_folder(
                self._store,
                snapshot.folder,
                prefix,
                self._check,
                workers=self._workers,
                step="checkpoint",
            )
            if not snapshot.is_intact():
                raise ObjectStoreError(f"{claim.name} wrote into files instead of replacing them")
            with self._database.session_scope(step="checkpoint") as session:
                old = save_checkpoint(session, claim, prefix)
        except SQLAlchemyError:
            # The COMMIT may have been applied: nobody knows which of the two the row names, so both
            # stay. The next checkpoint replaces the one, the stage's success drops the other.
            raise
        except Exception:
            self._store.delete_prefix(prefix)  # the row does not name it, and will not
            raise
        if old is not None:
            self._store.delete_prefix(old)
            reached("checkpoint.replaced")
