"""Maps in files: found again, never half, and the same as in memory."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo import shelves as module
from pipelines.nerf.stereo.completing import completed
from pipelines.nerf.stereo.engines import KernelEngine
from pipelines.nerf.stereo.maps import find_depth_maps
from pipelines.nerf.stereo.shelves import MEMORY, FileShelves, Shelves
from tests.unit.pipelines.nerf.stereo.painted_wall import row_of_cameras
from tests.unit.pipelines.nerf.stereo.test_maps import known_points

CONFIG = StereoConfig(num_planes=24, num_neighbours=3, window_radius=2)


def in_files(folder: Path) -> FileShelves:
    return FileShelves(folder / "kept", folder / "scratch")


def test_what_is_kept_is_found_again_and_scratch_is_not(tmp_path: Path) -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    first = in_files(tmp_path)
    for shelf in (first.kept("raw", 3), first.scratch("filled", 3)):
        shelf[1] = values
        assert shelf.has(1)
        assert not shelf.has(0)
        assert len(shelf) == 3
    again = in_files(tmp_path)
    found = again.kept("raw", 3)
    assert found.has(1)
    assert found[1].dtype == np.float32
    assert np.array_equal(found[1], values)
    with pytest.raises(KeyError):
        found[0]
    assert not again.scratch("filled", 3).has(1)
    assert not again.kept("raw", 3, fresh=True).has(1)


def test_an_emptied_shelf_does_not_remember_what_lay_there(tmp_path: Path) -> None:
    shelves = in_files(tmp_path)
    shelves.kept("raw", 1)[0] = np.zeros(4)
    shelf = shelves.kept("raw", 1, fresh=True)
    shelf[0] = np.ones(4)
    assert shelves.kept("raw", 1)[0].all()


def test_a_file_that_lost_its_end_is_not_there(tmp_path: Path) -> None:
    in_files(tmp_path).kept("raw", 3)[1] = np.arange(100.0)
    (path,) = (tmp_path / "kept" / "raw").iterdir()
    whole = path.read_bytes()
    for length in (0, 40, len(whole) - 8):
        path.write_bytes(whole[:length])
        assert not in_files(tmp_path).kept("raw", 3).has(1)
    path.write_bytes(whole)
    path.with_suffix(".partial").write_bytes(whole[:50])
    assert in_files(tmp_path).kept("raw", 3).has(1)


def test_a_copy_by_link_stays_as_it_was(tmp_path: Path) -> None:
    """Runners hold a checkpoint by links while a stage goes on."""
    shelf = in_files(tmp_path).kept("raw", 1)
    shelf[0] = np.zeros(4)
    os.link(tmp_path / "kept" / "raw" / "000000.npy", tmp_path / "link.npy")
    shelf[0] = np.ones(4)
    assert not np.load(tmp_path / "link.npy").any()
    assert shelf[0].all()


def test_memory_holds_no_more_than_what_was_looked_at_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_RECENT_BYTES", 3 * 800)
    shelves = in_files(tmp_path)
    raw, votes = shelves.kept("raw", 9), shelves.kept("votes", 9)
    for index in range(9):
        raw[index] = np.full(100, float(index))
        votes[index] = np.full(100, -float(index))
        assert shelves._recent._bytes <= 3 * 800
    for index in (0, 8, 3, 8, 0):
        assert (raw[index] == index).all()
        assert (votes[index] == -index).all()
        assert shelves._recent._bytes <= 3 * 800
    assert raw[0] is raw[0], "what was looked at last is not read again"


def test_maps_in_files_are_those_in_memory(tmp_path: Path) -> None:
    views, depths = row_of_cameras(5)
    points = known_points(views, depths)

    def maps_on(shelves: Shelves) -> list[np.ndarray]:
        found = find_depth_maps(views, CONFIG, points, shelves=shelves)
        patches = shelves.scratch("patches", len(views))
        laid = completed(views, found, CONFIG, shelves=shelves, patches=patches)
        return [each.z for each in laid] + [each.votes for each in laid]

    both = zip(maps_on(MEMORY), maps_on(in_files(tmp_path)), strict=True)
    assert all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in both)


class Counting(KernelEngine):
    """Kernels that count the views whose pictures are compared."""

    def __init__(self) -> None:
        self.swept = 0

    def best_planes(self, *told, **named):  # type: ignore[no-untyped-def]
        self.swept += 1
        return super().best_planes(*told, **named)


@pytest.mark.parametrize("with_points", [True, False], ids=["points", "points looked for"])
def test_a_search_that_was_cut_short_goes_on(tmp_path: Path, with_points: bool) -> None:
    views, depths = row_of_cameras(6)
    points = known_points(views, depths) if with_points else None
    whole = find_depth_maps(views, CONFIG, points)

    def stop(fraction: float, message: str) -> None:
        if message.startswith("depth 3/"):
            raise InterruptedError

    first, second = Counting(), Counting()
    with pytest.raises(InterruptedError):
        find_depth_maps(views, CONFIG, points, stop, first, in_files(tmp_path))
    found = find_depth_maps(views, CONFIG, points, engine=second, shelves=in_files(tmp_path))
    assert first.swept == (3 if with_points else 3 + len(views))
    assert second.swept == 3
    for ours, theirs in zip(found, whole, strict=True):
        assert np.array_equal(ours.z, theirs.z)
        assert np.array_equal(ours.votes, theirs.votes)
