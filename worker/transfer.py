"""Moves stage folders between a job's local folder and the object store.

`guard` is called while bytes move, and before what lies here is replaced; what it raises ends the
transfer (a cancel, a lost lease).

What is fetched comes under a name of its own, is checked, and takes its place by a rename. The
locks of those who fetch only spare two slots from bringing the same: nobody waits for one longer
than FETCH_LOCK_S, as its holder may be a worker that stands still.
"""

from __future__ import annotations

import json
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from pipelines.manifest import file_sha256
from pipelines.workspace import MANIFEST, Workspace
from storage.damage import CAPTURE
from storage.errors import ObjectMissingError, ObjectStoreFullError
from storage.objects import ObjectStore
from storage.queries import StageInput, StageWork
from storage.steps import reached
from worker.locks import FolderInUseError, folder_lock
from worker.outcomes import InputDamagedError

Guard = Callable[[], None]
FETCH_LOCK_S = 10.0
ROOM_WAIT_S = 1800.0
ROOM_STEP_S = 10.0


def _run_all(jobs: Iterable[Callable[[], None]], workers: int) -> None:
    """Run all jobs, several at once. Raises the first error after the others have stopped."""
    with ThreadPoolExecutor(workers, thread_name_prefix="transfer") as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in futures:
                future.result()
        except BaseException:
            for future in futures:
                future.cancel()
            wait(futures)
            raise


def upload_folder(
    store: ObjectStore,
    folder: Path,
    prefix: str,
    guard: Guard,
    *,
    workers: int,
    step: str,
    expected: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Upload all files below a folder; its manifest, if any, last.

    Links are passed over: a stage could name a file by one that is closed to it and open to us.
    step: the operation in `storage.steps` that this is. expected: `{path, bytes}` of files that
    must be there. Raises FileNotFoundError where somebody has cleaned up meanwhile.
    """
    for item in expected:
        if not _has_size(folder / item["path"], item["bytes"]):
            raise FileNotFoundError(f"{folder / item['path']} is gone, or shorter than it was")

    def check(count: int) -> None:
        guard()
        reached(f"{step}.bytes")

    def put(name: str) -> Callable[[], None]:
        def move() -> None:
            guard()
            store.put_file(prefix + name, folder / name, check)
            reached(f"{step}.put")

        return move

    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if stat.S_ISREG(path.lstat().st_mode)
    )
    _run_all([put(name) for name in names if name != MANIFEST], workers)
    if MANIFEST in names:
        put(MANIFEST)()
    reached(f"{step}.stored")


def publish_folder(
    store: ObjectStore,
    folder: Path,
    prefix: str,
    guard: Guard,
    on_full: Guard,
    *,
    workers: int,
    expected: Sequence[Mapping[str, Any]],
) -> None:
    """`upload_folder` of what a stage has made, which may be hours of work: where the store has no
    room it waits for some, up to ROOM_WAIT_S.

    on_full: called before each wait. Raises ObjectStoreFullError in the end.
    """
    give_up_at = time.monotonic() + ROOM_WAIT_S
    while True:
        try:
            return upload_folder(
                store, folder, prefix, guard, workers=workers, step="publish", expected=expected
            )
        except ObjectStoreFullError:
            if time.monotonic() > give_up_at:
                raise
        on_full()
        again_at = time.monotonic() + ROOM_STEP_S
        while time.monotonic() < again_at:
            guard()
            time.sleep(0.2)


def download_folder(
    store: ObjectStore,
    prefix: str,
    folder: Path,
    guard: Guard,
    *,
    workers: int,
    expected: Sequence[Mapping[str, Any]] = (),
    is_here: Callable[[], bool] = lambda: False,
) -> None:
    """Replace a folder by all objects below a prefix. It appears whole or not at all.

    expected: `{path, sha256}` of files that must be there. Raises ObjectMissingError for others.
    is_here: asked at the end, whether another has brought the same meanwhile; then that one stays,
    as somebody may be reading it.
    """
    temporary = folder.with_name(f".fetch-{folder.name}-{secrets.token_hex(4)}")

    def get(key: str) -> Callable[[], None]:
        def move() -> None:
            guard()
            store.get_file(key, temporary / key.removeprefix(prefix), lambda count: guard())

        return move

    try:
        temporary.mkdir(parents=True)
        _run_all([get(key) for key in store.list(prefix)], workers)
        for item in expected:
            path = temporary / item["path"]
            if not path.is_file() or file_sha256(path) != item["sha256"]:
                raise ObjectMissingError(f"{prefix}{item['path']} is missing or damaged.")
        guard()
        if not is_here():
            _replace(folder, temporary, is_here)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _replace(folder: Path, temporary: Path, is_here: Callable[[], bool]) -> None:
    """Put a folder in another's place; the other goes in one step, before its files do."""
    aside = temporary.with_name(f"{temporary.name}-old")
    try:
        with suppress(FileNotFoundError):
            folder.rename(aside)
        try:
            temporary.rename(folder)
        except OSError:  # another was faster
            if not is_here():
                raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _is_here(workspace: Workspace, wanted: StageInput) -> bool:
    try:
        local: dict[str, Any] = workspace.manifest(wanted.name)
    except (OSError, ValueError):
        return False
    if any(local.get(key) != wanted.manifest.get(key) for key in ("fingerprint", "content")):
        return False
    folder = workspace.stage(wanted.name)
    return all(
        _has_size(folder / item["path"], item["bytes"]) for item in wanted.manifest.get("files", [])
    )


def _has_size(path: Path, num_bytes: int) -> bool:
    """Whether the file is there, as long as it was: disks are cleaned up, and fill."""
    return path.is_file() and path.stat().st_size == num_bytes


def _is_capture_here(workspace: Workspace, work: StageWork) -> bool:
    return _has_size(workspace.capture_file, work.capture_bytes)


def missing_bytes(
    workspace: Workspace, reads: Iterable[str], work: StageWork, *, wants_capture: bool
) -> int:
    """What `fetch_inputs`, and `fetch_capture` where it is wanted, have yet to bring."""
    inputs = [work.inputs[name] for name in reads if name in work.inputs]
    missing = [found.manifest for found in inputs if not _is_here(workspace, found)]
    needed = sum(item["bytes"] for manifest in missing for item in manifest.get("files", []))
    if wants_capture and not _is_capture_here(workspace, work):
        needed += work.capture_bytes
    return int(needed)


@contextmanager
def _fetching(workspace: Workspace, name: str, guard: Guard) -> Iterator[None]:
    """Wait a little for who else brings the same here; then go on, with the lock or without."""
    with ExitStack() as held:
        with suppress(FolderInUseError):
            lock = folder_lock(workspace.root, f"fetch-{name}", FETCH_LOCK_S, guard=guard)
            held.enter_context(lock)
        yield


@contextmanager
def _blaming(name: str, *, of_parent: bool = False) -> Iterator[None]:
    """Say of what is not in the store as it was put there whose it is (`InputDamagedError`)."""
    try:
        yield
    except ObjectMissingError as error:
        raise InputDamagedError(name, str(error), of_parent=of_parent) from error


def fetch_inputs(
    store: ObjectStore,
    workspace: Workspace,
    reads: Iterable[str],
    work: StageWork,
    guard: Guard,
    *,
    workers: int,
) -> None:
    """Bring the folders that a stage reads; those that lie here with the same manifest stay.

    Raises InputDamagedError where one does not come as it was published.
    """
    for name in reads:
        wanted = work.inputs.get(name)
        if wanted is None or _is_here(workspace, wanted):
            continue  # skipped: there is no folder; or it was made here
        with _fetching(workspace, name, guard):
            if _is_here(workspace, wanted):
                continue
            with _blaming(name, of_parent=work.is_export):
                download_folder(
                    store,
                    wanted.prefix,
                    workspace.stage(name),
                    guard,
                    workers=workers,
                    expected=wanted.manifest.get("files", []),
                    is_here=partial(_is_here, workspace, wanted),
                )
                if not _is_here(workspace, wanted):
                    raise ObjectMissingError(f"{wanted.prefix}{MANIFEST} is missing or damaged.")


def fetch_capture(store: ObjectStore, workspace: Workspace, work: StageWork, guard: Guard) -> None:
    """Bring the uploaded bytes. Raises InputDamagedError where others come, or none.

    Half of a capture would pass for one that is of no use, and the job would fail for good.
    """
    if _is_capture_here(workspace, work):
        return
    with _fetching(workspace, "capture", guard):
        path = workspace.capture_file
        if _is_capture_here(workspace, work):
            return
        temporary = path.with_name(f".fetch-{secrets.token_hex(4)}")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with _blaming(CAPTURE):
                store.get_file(work.capture_key, temporary, lambda count: guard())
                if file_sha256(temporary) != work.capture_sha256:
                    raise ObjectMissingError(f"{work.capture_key} is damaged.")
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_job_file(workspace: Workspace, work: StageWork) -> None:
    """Write what the stages may know of the job."""
    workspace.root.mkdir(parents=True, exist_ok=True)
    facts = {"filename": work.filename, "kind": work.kind, "seed": work.seed}
    temporary = workspace.job_file.with_name(f".job-{secrets.token_hex(4)}.json")
    try:
        temporary.write_text(json.dumps(facts), "utf-8")
        temporary.replace(workspace.job_file)
    finally:
        temporary.unlink(missing_ok=True)


def restore_checkpoint(
    store: ObjectStore,
    workspace: Workspace,
    stage: str,
    prefix: str | None,
    guard: Guard,
    *,
    workers: int,
) -> None:
    """Make the stage's checkpoint folder hold the last state that was recorded, or nothing.

    What an earlier attempt left here is not trusted: it may have died while it wrote.
    """
    guard()
    folder = workspace.checkpoint(stage)
    shutil.rmtree(folder, ignore_errors=True)
    for leftover in list(folder.parent.glob(f"{stage}.saved-*")):
        shutil.rmtree(leftover, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    if prefix is not None:
        download_folder(store, prefix, folder, guard, workers=workers)
