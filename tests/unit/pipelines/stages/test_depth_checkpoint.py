"""A `depth` that was cut short goes on from what it has found, and ends with the same bytes."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.errors import Cancelled
from pipelines.manifest import RunHooks
from pipelines.nerf.stereo.engines import KernelEngine
from pipelines.sample.scenes import monument
from pipelines.stages import depth_checkpoint
from pipelines.workspace import MANIFEST, Workspace
from tests.unit.pipelines.stages import tiny_job

OPTIONS = {"long_side_px": 64, "num_planes": 24, "window_radius": 2, "num_neighbours": 4}
NUM_IMAGES, NUM_VIEWS = 12, 10


@pytest.fixture
def swept(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """Sizes of the pictures that were compared with their neighbours."""
    sizes: list[tuple[int, ...]] = []
    sweep = KernelEngine.best_planes

    def counted(self: KernelEngine, reference: Any, *told: Any) -> Any:
        sizes.append(reference.shape)
        return sweep(self, reference, *told)

    monkeypatch.setattr(KernelEngine, "best_planes", counted)
    return sizes


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What an attempt that nobody disturbs leaves."""
    workspace = tiny_job.make_capture(tmp_path_factory.mktemp("whole") / "job", NUM_IMAGES)
    return tiny_job.run(workspace, "depth", **OPTIONS)


def capture(root: Path) -> Workspace:
    return tiny_job.make_capture(root / "job", NUM_IMAGES)


def cut_short(
    workspace: Workspace, at: str, options: dict[str, Any] = OPTIONS, **more: Any
) -> list[str]:
    """Run until a cancel is noticed, which comes with a message. The messages so far."""
    messages: list[str] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: messages.append(message),
        is_cancelled=lambda: any(message.startswith(at) for message in messages),
        **more,
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(workspace, "depth", hooks, **options)
    assert not workspace.stage("depth").exists()
    return messages


def same_bytes(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return bool(one["files"] == other["files"] and one["summary"] == other["summary"])


@pytest.mark.parametrize(
    ("at", "left"),
    [
        ("looking for surfaces", NUM_VIEWS),
        ("depth 1/", NUM_VIEWS - 2),
        ("depth 7/", NUM_VIEWS - 8),
        ("comparing depths", 0),
        ("completing plain surfaces", 0),
        ("standing walls up", 0),
        ("comparing the pictures' light", 0),
    ],
)
def test_it_goes_on_and_ends_with_the_same_bytes(
    whole: dict[str, Any], tmp_path: Path, swept: list[tuple[int, ...]], at: str, left: int
) -> None:
    workspace = capture(tmp_path)
    cut_short(workspace, at)
    del swept[:]
    assert same_bytes(tiny_job.run(workspace, "depth", **OPTIONS), whole)
    full_size = max(swept, default=(0, 0))
    probed = NUM_VIEWS if at == "looking for surfaces" else 0
    assert len(swept) == left + probed, full_size
    assert not workspace.checkpoint("depth").exists()
    assert not list(workspace.stage("depth").glob(".*"))


def test_it_may_be_cut_short_again_and_again(
    whole: dict[str, Any], tmp_path: Path, swept: list[tuple[int, ...]]
) -> None:
    workspace = capture(tmp_path)
    for at in ("depth 2/", "depth 6/", "comparing depths", "standing walls up"):
        cut_short(workspace, at)
    assert same_bytes(tiny_job.run(workspace, "depth", **OPTIONS), whole)
    assert len(swept) == 2 * NUM_VIEWS, "each view once, and once small"


def with_more_planes(workspace: Workspace) -> dict[str, Any]:
    del workspace
    return {"num_planes": 25}


def with_another_picture(workspace: Workspace) -> dict[str, Any]:
    """As a new attempt of `ingest` would leave it: the manifest says that contents are others."""
    folder = workspace.stage("ingest")
    path = sorted((folder / "images").iterdir())[5]
    with Image.open(path) as opened:
        darker = np.asarray(opened) // 2
    Image.fromarray(darker).save(path)
    manifest = json.loads((folder / MANIFEST).read_text("utf-8"))
    (folder / MANIFEST).write_text(json.dumps(manifest | {"content": "darker"}), "utf-8")
    return {}


def with_another_pose(workspace: Workspace) -> dict[str, Any]:
    path = workspace.stage("ingest") / "cameras.json"
    told = json.loads(path.read_text("utf-8"))
    told["images"][5]["world_from_camera"][0][3] += 0.01
    path.write_text(json.dumps(told), "utf-8")
    return {}


Change = Callable[[Workspace], dict[str, Any]]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Change], dict[str, Any]]:
    """What an attempt that nobody disturbs leaves of a capture after a change."""

    @functools.cache
    def left(change: Change) -> dict[str, Any]:
        workspace = capture(tmp_path_factory.mktemp("fresh"))
        return tiny_job.run(workspace, "depth", **OPTIONS | change(workspace))

    return left


@pytest.mark.parametrize("change", [with_more_planes, with_another_picture, with_another_pose])
@pytest.mark.parametrize("at", ["depth 7/", "standing walls up"])
def test_what_was_found_for_something_else_is_not_used(
    undisturbed: Callable[[Change], dict[str, Any]],
    tmp_path: Path,
    swept: list[tuple[int, ...]],
    change: Change,
    at: str,
) -> None:
    workspace = capture(tmp_path)
    cut_short(workspace, at)
    options = OPTIONS | change(workspace)
    expected = undisturbed(change)
    del swept[:]
    assert same_bytes(tiny_job.run(workspace, "depth", **options), expected)
    assert len(swept) == 2 * NUM_VIEWS


def test_a_state_that_cannot_be_read_begins_anew(
    whole: dict[str, Any], tmp_path: Path, swept: list[tuple[int, ...]]
) -> None:
    workspace = capture(tmp_path)
    cut_short(workspace, "depth 7/")
    (workspace.checkpoint("depth") / "state.json").write_text('{"fingerprint": ', "utf-8")
    del swept[:]
    assert same_bytes(tiny_job.run(workspace, "depth", **OPTIONS), whole)
    assert len(swept) == 2 * NUM_VIEWS


def test_a_pass_that_lost_a_file_is_no_reason_to_fail(
    whole: dict[str, Any], tmp_path: Path, swept: list[tuple[int, ...]]
) -> None:
    workspace = capture(tmp_path)
    cut_short(workspace, "standing walls up")
    held = sorted((workspace.checkpoint("depth") / "maps" / "planes-z").iterdir())
    held[4].write_bytes(held[4].read_bytes()[:200])
    del swept[:]
    assert same_bytes(tiny_job.run(workspace, "depth", **OPTIONS), whole)
    assert len(swept) == 2 * NUM_VIEWS


def test_a_machine_that_is_needed_keeps_what_is_found_before_it_stops(tmp_path: Path) -> None:
    workspace = capture(tmp_path)
    held: list[list[str]] = []
    asked: list[bool] = []

    def hold() -> None:
        found = workspace.checkpoint("depth").rglob("raw/*.npy")
        held.append(sorted(path.name for path in found))

    def shut_down() -> bool:
        asked.append(True)
        return len(asked) > NUM_VIEWS + 4

    hooks = RunHooks(is_shutdown=shut_down, is_cancelled=lambda: bool(held), on_checkpoint=hold)
    with pytest.raises(Cancelled):
        tiny_job.run_with(workspace, "depth", hooks, **OPTIONS)
    assert held == [[f"{index:06d}.npy" for index in range(len(held[0]))]]
    assert held[0]


def test_it_is_offered_by_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not once in a run of seconds; after each view where so much time has passed by then."""
    offered: list[int] = []
    for seconds in (depth_checkpoint.SAVE_S, 0.0):
        monkeypatch.setattr(depth_checkpoint, "SAVE_S", seconds)
        before = len(offered)
        hooks = RunHooks(on_checkpoint=lambda: offered.append(1))
        tiny_job.run_with(capture(tmp_path / str(seconds)), "depth", hooks, **OPTIONS)
        assert len(offered) - before == 0 or seconds == 0.0
    assert len(offered) > NUM_VIEWS


OUTDOORS = OPTIONS | {"long_side_px": 128, "num_planes": 48}


def outdoors(root: Path) -> Workspace:
    return tiny_job.make_capture(root / "job", NUM_IMAGES, monument.TAKE, 128)


@pytest.fixture(scope="module")
def whole_outdoors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What an attempt that nobody disturbs leaves of a figure under the sky."""
    return tiny_job.run(outdoors(tmp_path_factory.mktemp("outdoors")), "depth", **OUTDOORS)


@pytest.mark.parametrize("at", ["looking for the sky", "completing plain surfaces"])
def test_a_sky_that_was_found_stays_found(
    whole_outdoors: dict[str, Any], tmp_path: Path, at: str
) -> None:
    """The passes behind it see pictures without it, after a cut as well."""
    assert whole_outdoors["summary"]["sky"]["share"] > 0.2
    workspace = outdoors(tmp_path)
    cut_short(workspace, at, OUTDOORS)
    assert same_bytes(tiny_job.run(workspace, "depth", **OUTDOORS), whole_outdoors)
