"""Folders on their way to the object store and back."""

from __future__ import annotations

import errno
import hashlib
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipelines.workspace import Workspace
from storage.claims import Claim, claim_stage
from storage.errors import ObjectStoreError, ObjectStoreFullError
from storage.jobs import stage_id
from storage.models import StageRow
from storage.objects import OnBytes
from storage.objects_local import LocalObjectStore
from storage.queries import StageInput, StageWork
from tests.factories import make_database, make_job
from worker import transfer
from worker.checkpoints import CheckpointUploader, Snapshot
from worker.locks import folder_lock
from worker.outcomes import InputDamagedError, crash_of, failure_of
from worker.transfer import (
    download_folder,
    fetch_capture,
    fetch_inputs,
    missing_bytes,
    restore_checkpoint,
    upload_folder,
)


def no_guard() -> None:
    return


@pytest.fixture
def store(tmp_path: Path) -> LocalObjectStore:
    return LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"")


def stage_folder(root: Path, text: str = "result") -> tuple[Path, dict[str, Any]]:
    folder = root / "train"
    (folder / "deep").mkdir(parents=True, exist_ok=True)
    (folder / "deep" / "file.txt").write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    manifest = {
        "fingerprint": "f",
        "content": digest,
        "files": [{"path": "deep/file.txt", "bytes": len(text), "sha256": digest}],
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder, manifest


def work_with(manifest: dict[str, Any]) -> StageWork:
    inputs = {"train": StageInput("train", "p/", manifest)}
    return StageWork("k", 0, "", "f", "video", 0, {}, inputs, None)


def test_the_manifest_is_uploaded_last(store: LocalObjectStore, tmp_path: Path) -> None:
    folder, _ = stage_folder(tmp_path)
    order: list[str] = []

    class Watching(LocalObjectStore):
        def put_file(
            self, key: str, path: Path, on_bytes: OnBytes | None = None, *, final: bool = False
        ) -> None:
            assert not final, "a stage may still write to it"
            order.append(key)
            super().put_file(key, path, on_bytes)

    watching = Watching(store.root, public_url="", signing_key=b"")
    upload_folder(watching, folder, "p/", no_guard, workers=4, step="publish")
    assert order == ["p/deep/file.txt", "p/manifest.json"]


def test_inputs_come_once_and_again_only_where_they_differ(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    folder, manifest = stage_folder(tmp_path)
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    workspace = Workspace(tmp_path / "job")
    workspace.root.mkdir()
    reads, work = ("train", "skipped"), work_with(manifest)
    fetch_inputs(store, workspace, reads, work, no_guard, workers=2)
    here = workspace.stage("train") / "deep" / "file.txt"
    first = here.stat().st_ino
    fetch_inputs(store, workspace, reads, work, no_guard, workers=2)
    assert here.stat().st_ino == first
    stage_folder(workspace.root, "of an attempt that was lost")
    fetch_inputs(store, workspace, reads, work, no_guard, workers=2)
    assert here.read_text() == "result"


def test_what_lies_here_needs_no_room(store: LocalObjectStore, tmp_path: Path) -> None:
    folder, manifest = stage_folder(tmp_path / "made", "result")
    upload_folder(store, folder, "p/", no_guard, workers=1, step="publish")
    workspace = Workspace(tmp_path / "job")
    work = replace(work_with(manifest), capture_bytes=5)

    def missing(wants_capture: bool) -> int:
        return missing_bytes(workspace, ["ingest", "train"], work, wants_capture=wants_capture)

    assert (missing(False), missing(True)) == (6, 11)
    fetch_inputs(store, workspace, ["train"], work, no_guard, workers=1)
    assert (missing(False), missing(True)) == (0, 5)
    workspace.capture_file.parent.mkdir(parents=True, exist_ok=True)
    workspace.capture_file.write_bytes(b"half")
    assert missing(True) == 5
    workspace.capture_file.write_bytes(b"whole")
    assert missing(True) == 0


def test_a_damaged_input_is_not_accepted(store: LocalObjectStore, tmp_path: Path) -> None:
    folder, manifest = stage_folder(tmp_path)
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    store.path_of("p/deep/file.txt").write_text("rotten")
    workspace = Workspace(tmp_path / "job")
    workspace.root.mkdir()
    with pytest.raises(ObjectStoreError, match="damaged"):
        fetch_inputs(store, workspace, ("train",), work_with(manifest), no_guard, workers=2)
    assert not workspace.stage("train").exists()


@pytest.mark.parametrize("file", ["deep/file.txt", "manifest.json"])
@pytest.mark.parametrize("left", [None, "re", "RESULT"])
@pytest.mark.parametrize("is_export", [False, True])
def test_a_damaged_input_is_told_by_the_name_of_who_made_it(
    store: LocalObjectStore, tmp_path: Path, file: str, left: str | None, is_export: bool
) -> None:
    folder, manifest = stage_folder(tmp_path)
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    stored = store.path_of(f"p/{file}")
    stored.unlink() if left is None else stored.write_text(left)
    workspace = Workspace(tmp_path / "job")
    workspace.root.mkdir()
    work = replace(work_with(manifest), is_export=is_export)
    with pytest.raises(InputDamagedError) as found:
        fetch_inputs(store, workspace, ("train",), work, no_guard, workers=2)
    told = failure_of("mesh", found.value)
    assert (told["code"], told["details"]) == ("input_damaged", {"input": "train"})
    assert "train" in told["hint"]
    assert ("export" in told["hint"]) == is_export
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    fetch_inputs(store, workspace, ("train",), work, no_guard, workers=2)


def test_a_store_that_does_not_answer_damages_nothing(tmp_path: Path) -> None:
    class Away(LocalObjectStore):
        def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
            raise ObjectStoreError("timed out")

    store = Away(tmp_path / "objects", public_url="", signing_key=b"")
    folder, manifest = stage_folder(tmp_path)
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    workspace, work = Workspace(tmp_path / "job"), work_with(manifest)
    workspace.root.mkdir()
    for fetch in (
        lambda: fetch_inputs(store, workspace, ("train",), work, no_guard, workers=2),
        lambda: fetch_capture(store, workspace, replace(work, capture_bytes=5), no_guard),
    ):
        with pytest.raises(ObjectStoreError) as found:
            fetch()
        assert failure_of("mesh", found.value)["code"] == "object_store_unavailable"


@pytest.mark.parametrize("came", ["wholf", "who", None])
def test_a_damaged_capture_is_not_accepted(
    store: LocalObjectStore, tmp_path: Path, came: str | None
) -> None:
    """It would pass for one that is of no use, and the job would fail for good."""
    workspace = Workspace(tmp_path / "job")
    digest = hashlib.sha256(b"whole").hexdigest()
    work = replace(work_with({}), capture_key="c/k", capture_bytes=5, capture_sha256=digest)
    store.path_of("c").mkdir(parents=True)
    if came is not None:
        store.path_of("c/k").write_text(came)
    with pytest.raises(InputDamagedError) as found:
        fetch_capture(store, workspace, work, no_guard)
    told = failure_of("ingest", found.value)
    assert (told["code"], told["details"]) == ("input_damaged", {"input": "capture"})
    assert "Upload the same file again" in told["hint"]
    assert not list(workspace.capture_file.parent.iterdir())
    store.path_of("c/k").write_text("whole")
    fetch_capture(store, workspace, work, no_guard)
    assert workspace.capture_file.read_text() == "whole"


@pytest.mark.parametrize("left", ["res", None])
def test_an_input_that_somebody_cleaned_up_comes_again(
    store: LocalObjectStore, tmp_path: Path, left: str | None
) -> None:
    folder, manifest = stage_folder(tmp_path)
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    workspace = Workspace(tmp_path / "job")
    workspace.root.mkdir()
    reads, work = ("train",), work_with(manifest)
    fetch_inputs(store, workspace, reads, work, no_guard, workers=2)
    here = workspace.stage("train") / "deep" / "file.txt"
    here.unlink() if left is None else here.write_text(left)
    assert missing_bytes(workspace, reads, work, wants_capture=False) == len("result")
    fetch_inputs(store, workspace, reads, work, no_guard, workers=2)
    assert here.read_text() == "result"


def test_a_result_of_which_a_file_is_gone_is_not_published(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    folder, manifest = stage_folder(tmp_path)
    (folder / "deep" / "file.txt").unlink()
    with pytest.raises(FileNotFoundError, match="gone"):
        upload_folder(
            *(store, folder, "p/", no_guard),
            workers=1,
            step="publish",
            expected=manifest["files"],
        )
    assert list(store.list("p/")) == []


def test_a_guard_ends_a_transfer_and_leaves_nothing(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    class StopError(Exception):
        pass

    def stop() -> None:
        raise StopError

    folder, _ = stage_folder(tmp_path)
    with pytest.raises(StopError):
        upload_folder(store, folder, "p/", stop, workers=2, step="publish")
    assert list(store.list("p/")) == []
    upload_folder(store, folder, "p/", no_guard, workers=2, step="publish")
    with pytest.raises(StopError):
        download_folder(store, "p/", tmp_path / "new", stop, workers=2)
    assert not [path for path in tmp_path.iterdir() if "new" in path.name]


class LostError(Exception):
    """What a guard raises."""


def inputs_and_capture(store: LocalObjectStore, tmp_path: Path) -> StageWork:
    folder, manifest = stage_folder(tmp_path / "made")
    upload_folder(store, folder, "p/", no_guard, workers=1, step="publish")
    store.path_of("c").mkdir(parents=True)
    store.path_of("c/k").write_text("whole")
    digest = hashlib.sha256(b"whole").hexdigest()
    return replace(work_with(manifest), capture_key="c/k", capture_bytes=5, capture_sha256=digest)


def fetch(
    store: LocalObjectStore, workspace: Workspace, work: StageWork, guard: transfer.Guard
) -> None:
    fetch_capture(store, workspace, work, guard)
    fetch_inputs(store, workspace, ("train",), work, guard, workers=1)


def test_who_stands_still_while_it_fetches_holds_nobody_up(
    store: LocalObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "FETCH_LOCK_S", 0.3)
    work, workspace = inputs_and_capture(store, tmp_path), Workspace(tmp_path / "job")
    with (
        folder_lock(workspace.root, "fetch-capture", 0.0),
        folder_lock(workspace.root, "fetch-train", 0.0),
    ):
        fetch(store, workspace, work, no_guard)
        assert workspace.capture_file.read_text() == "whole"
        assert (workspace.stage("train") / "deep" / "file.txt").read_text() == "result"
        begun = time.monotonic()
        fetch(store, workspace, work, no_guard)  # nobody is waited for where nothing is missing
        assert time.monotonic() - begun < 0.3


@pytest.mark.parametrize("held", ["fetch-capture", "fetch-train"])
def test_who_waits_for_another_s_fetch_hears_a_cancel(
    store: LocalObjectStore, tmp_path: Path, held: str
) -> None:
    work, workspace = inputs_and_capture(store, tmp_path), Workspace(tmp_path / "job")
    begun = time.monotonic()

    def guard() -> None:
        if time.monotonic() > begun + 0.5:
            raise LostError

    with folder_lock(workspace.root, held, 0.0), pytest.raises(LostError):
        fetch(store, workspace, work, guard)
    assert time.monotonic() - begun < 3.0


def test_the_later_of_two_who_bring_the_same_leaves_the_earlier_s_in_place(
    store: LocalObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stage may be reading it."""
    monkeypatch.setattr(transfer, "FETCH_LOCK_S", 0.2)
    work, workspace = inputs_and_capture(store, tmp_path), Workspace(tmp_path / "job")
    there: list[int] = []

    class Slow(LocalObjectStore):
        def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
            super().get_file(key, path, on_bytes)
            if not there:
                fetch_inputs(store, workspace, ("train",), work, no_guard, workers=1)
                there.append(workspace.stage("train").stat().st_ino)

    slow = Slow(store.root, public_url="", signing_key=b"")
    fetch_inputs(slow, workspace, ("train",), work, no_guard, workers=1)
    assert workspace.stage("train").stat().st_ino == there[0]
    assert {path.name for path in workspace.root.iterdir()} == {".locks", "train"}


def test_who_has_lost_its_lease_replaces_nothing(store: LocalObjectStore, tmp_path: Path) -> None:
    """The next holder's inputs and checkpoint lie there."""
    work, workspace = inputs_and_capture(store, tmp_path), Workspace(tmp_path / "job")
    stage_folder(workspace.root, "of a later generation")
    fetched: list[str] = []

    class Last(LocalObjectStore):
        def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
            super().get_file(key, path, on_bytes)
            fetched.append(key)

    def guard() -> None:
        if len(fetched) == 2:
            raise LostError

    last = Last(store.root, public_url="", signing_key=b"")
    with pytest.raises(LostError):
        fetch_inputs(last, workspace, ("train",), work, guard, workers=1)
    assert (workspace.stage("train") / "deep" / "file.txt").read_text() == "of a later generation"
    kept = workspace.checkpoint("first") / "state"
    kept.parent.mkdir(parents=True)
    kept.write_text("of who runs now")
    with pytest.raises(LostError):
        restore_checkpoint(store, workspace, "first", None, guard, workers=1)
    assert kept.read_text() == "of who runs now"
    assert {path.name for path in workspace.root.iterdir()} == {".checkpoint", ".locks", "train"}


def claimed(tmp_path: Path) -> tuple[Any, Claim]:
    database = make_database(tmp_path)
    with database.session_scope() as session:
        claim = claim_stage(session, stage_id(make_job(session).id, "first"), "w", 60.0)
    assert claim is not None
    return database, claim


def snapshot_of(folder: Path, text: str) -> Snapshot:
    folder.mkdir(parents=True)
    (folder / "state").write_text(text)
    found = (folder / "state").stat()
    return Snapshot(folder, {"state": [found.st_size, found.st_mtime_ns]})


def test_only_the_latest_checkpoint_is_kept_and_comes_back(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    database, claim = claimed(tmp_path)
    for number in (1, 2):
        uploader = CheckpointUploader(database, store, claim, no_guard, workers=2)
        uploader._number = number  # as if it were one uploader over time
        uploader.offer(snapshot_of(tmp_path / f"saved-{number}", f"state {number}"))
        uploader.close(finish=True, timeout_s=10)
    with database.read_scope() as session:
        prefix = session.get_one(StageRow, claim.stage_id).checkpoint_prefix
    assert list(store.list(claim.root)) == [f"{prefix}state"]
    workspace = Workspace(tmp_path / "job")
    leftover = workspace.checkpoint("first.saved-old")
    leftover.mkdir(parents=True)
    workspace.checkpoint("first").mkdir(parents=True)
    (workspace.checkpoint("first") / "half").write_text("of an attempt that died")
    restore_checkpoint(store, workspace, "first", prefix, no_guard, workers=2)
    assert [path.name for path in workspace.checkpoint("first").iterdir()] == ["state"]
    assert (workspace.checkpoint("first") / "state").read_text() == "state 2"
    assert not leftover.exists()


def test_a_checkpoint_that_was_written_into_is_not_kept(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    database, claim = claimed(tmp_path)
    snapshot = snapshot_of(tmp_path / "saved", "state")
    (snapshot.folder / "state").write_text("state and more")
    uploader = CheckpointUploader(database, store, claim, no_guard, workers=2)
    uploader.offer(snapshot)
    uploader.close(finish=True, timeout_s=10)
    assert list(store.list(claim.root)) == []
    assert not snapshot.folder.exists()


def test_errors_around_a_stage_have_codes_that_people_can_act_on() -> None:
    with pytest.raises(OSError, match="No space") as full, open("/dev/full", "wb", 0) as file:
        file.write(b"x")
    assert full.value.errno == errno.ENOSPC
    for error, code, retryable in (
        (full.value, "disk_full", True),
        (ObjectStoreFullError(""), "disk_full", True),
        (ObjectStoreError(""), "object_store_unavailable", True),
        (KeyError("/secret"), "internal_error", True),
    ):
        told = failure_of("train", error)
        assert (told["code"], told["retryable"]) == (code, retryable)
        assert "/secret" not in json.dumps(told)


@pytest.mark.parametrize(
    ("status", "out_of_memory", "cause", "code"),
    [
        (-9, True, "out_of_memory", "out_of_memory"),
        (-9, False, "killed", "worker_lost"),
        (137, False, "killed", "worker_lost"),
        (-11, False, "crashed", "stage_crashed"),
        (1, False, "crashed", "stage_crashed"),
    ],
)
def test_an_exit_status_says_what_happened(
    status: int, out_of_memory: bool, cause: str, code: str
) -> None:
    crash = crash_of("train", status, out_of_memory)
    assert (crash.cause, crash.error["code"], crash.exit_code) == (cause, code, status)
