"""Stereo by PyTorch on a device against the CPU's kernels, and when it is trusted.

Devices without a GPU: values are those of PyTorch on the CPU, and what stays on its device is seen
on one without values.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo import engines
from pipelines.nerf.stereo.aggregation import aggregate, jump_weights
from pipelines.nerf.stereo.agreement import count_votes
from pipelines.nerf.stereo.engines import (
    KERNELS,
    KernelEngine,
    TorchEngine,
    bytes_needed,
    choose_engine,
    disagreement,
    engine_gaps,
    engine_problem,
)
from pipelines.nerf.stereo.maps import find_depth_maps
from pipelines.nerf.stereo.matching import matching_cost
from tests.unit.pipelines.nerf.stereo.painted_wall import row_of_cameras
from tests.unit.pipelines.nerf.stereo.test_maps import known_points

CONFIG = StereoConfig(num_planes=32, num_neighbours=3, window_radius=2)
TORCH = TorchEngine(torch.device("cpu"))


def test_maps_are_those_of_the_kernels() -> None:
    views, depths = row_of_cameras(5)
    points = known_points(views, depths)
    by_kernels, by_torch = (
        find_depth_maps(views, CONFIG, points, engine=engine) for engine in (KERNELS, TORCH)
    )
    for index in (1, 2, 3):
        ours, theirs = by_torch[index], by_kernels[index]
        assert (ours.z > 0).mean() > 0.6
        assert ((ours.z > 0) != (theirs.z > 0)).mean() < 0.01
        both = (ours.z > 0) & (theirs.z > 0)
        assert np.quantile(np.abs(ours.z / np.where(both, theirs.z, 1.0) - 1.0)[both], 0.99) < 1e-3
        assert (ours.votes != theirs.votes).mean() < 0.01


def test_how_many_planes_are_compared_at_once_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    picture, *others = torch.from_numpy(rng.random((4, 20, 24)))
    maps = torch.eye(3).expand(3, 7, 3, 3).clone()
    maps[..., 0, 2] = torch.linspace(-4.0, 4.0, 7)
    told = picture.float(), torch.stack(others).float(), maps, 2
    assert torch.equal(matching_cost(*told, at_once=1), matching_cost(*told, at_once=7))
    assert torch.equal(matching_cost(*told, at_once=3), matching_cost(*told, at_once=7))


def test_nothing_of_the_cpu_is_mixed_in_and_no_value_asked_for() -> None:
    """On the device `meta`, which has no values, either is an error."""
    with torch.device("meta"):
        picture, others = torch.ones(20, 24), torch.ones(3, 18, 26)
        maps, weights = torch.ones(3, 9, 3, 3), torch.ones(4, 20, 24)
        rays, pose, lens = (torch.ones(24), torch.ones(20)), torch.ones(3, 4), torch.ones(4)
        votes, sums = torch.zeros(4, 20, 24, dtype=torch.int32), torch.zeros(20, 24)
    cost = matching_cost(picture, others, maps, 2, at_once=4)
    planes, margins = aggregate(cost, weights, 0.3, 5.0)
    count_votes(picture, rays, pose, others[0], lens, 0.02, votes, sums)
    for found in (cost, planes, margins, votes, sums, jump_weights(picture, 0.05)):
        assert found.device.type == "meta"
    with pytest.raises(RuntimeError, match="device"):
        matching_cost(picture, others.new_ones(others.shape, device="cpu"), maps, 2)


def test_an_engine_that_gives_the_same_values_is_trusted() -> None:
    gaps = engine_gaps(TORCH, KERNELS)
    assert set(gaps) == {"planes", "votes", "agreed depths"}
    assert disagreement(TORCH, KERNELS) is None


class _Shifted(KernelEngine):
    def best_planes(self, *told, **named):  # type: ignore[no-untyped-def]
        return super().best_planes(*told, **named) + np.float32(0.2)


class _Blind(KernelEngine):
    def votes(self, *told, **named):  # type: ignore[no-untyped-def]
        votes, sums = super().votes(*told, **named)
        return np.roll(votes, 1, axis=0), sums


class _Careless(KernelEngine):
    def votes(self, *told, **named):  # type: ignore[no-untyped-def]
        votes, sums = super().votes(*told, **named)
        return votes, sums * np.float32(1.002)


class _Empty(KernelEngine):
    def best_planes(self, *told, **named):  # type: ignore[no-untyped-def]
        return np.full_like(super().best_planes(*told, **named), np.nan)


class _Broken(KernelEngine):
    def best_planes(self, *told, **named):  # type: ignore[no-untyped-def]
        raise RuntimeError("no kernel image is available for execution on the device")


@pytest.mark.parametrize(
    ("engine", "told"),
    [
        (_Shifted(), "planes differ in 100.0%"),
        (_Empty(), "planes differ in 100.0%"),
        (_Blind(), "votes differ in"),
        (_Careless(), "agreed depths differ in"),
        (_Broken(), "RuntimeError: no kernel image"),
    ],
)
def test_an_engine_that_is_wrong_is_not(engine: KernelEngine, told: str) -> None:
    assert told in (disagreement(engine, KERNELS) or "")


@dataclass
class _Machine:
    """A machine with a GPU, as far as choosing goes."""

    problem: str | None = None
    free_bytes: int = 2**34

    def pretend(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (self.free_bytes, 2**35))
        monkeypatch.setattr(engines, "engine_problem", lambda device: self.problem)


def test_a_gpu_is_taken_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    views, _ = row_of_cameras(2)
    _Machine().pretend(monkeypatch)
    assert choose_engine(views, StereoConfig()) == TorchEngine(torch.device("cuda"))
    assert choose_engine(views, StereoConfig(device="cuda")) == TorchEngine(torch.device("cuda"))
    assert choose_engine(views, StereoConfig(device="cpu")) is KERNELS


@pytest.mark.parametrize(
    ("machine", "told"),
    [
        (_Machine(problem="planes differ in 40.0%"), "planes differ in 40.0%"),
        (_Machine(free_bytes=2**28), r"GiB are wanted and 0\.2 GiB are free"),
    ],
)
def test_a_gpu_that_cannot_is_left_for_the_kernels_and_that_is_told(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    machine: _Machine,
    told: str,
) -> None:
    views, _ = row_of_cameras(2)
    machine.pretend(monkeypatch)
    with caplog.at_level(logging.WARNING, "nerfworks.nerf"):
        assert choose_engine(views, StereoConfig()) is KERNELS
    assert "stereo runs on the CPU" in caplog.text
    with pytest.raises(NerfError, match=told) as caught:
        choose_engine(views, StereoConfig(device="cuda"))
    assert caught.value.code == "gpu_failed"


@pytest.mark.skipif(
    torch.cuda.is_available(), reason="stereo without a GPU is NOT tested: there is one"
)
def test_without_a_gpu_kernels_compute_and_asking_for_one_is_an_error() -> None:
    views, _ = row_of_cameras(2)
    assert choose_engine(views, StereoConfig()) is KERNELS
    with pytest.raises(NerfError, match=r"depth\.device is 'cuda'") as caught:
        choose_engine(views, StereoConfig(device="cuda"))
    assert caught.value.code == "bad_config"


def test_more_planes_and_larger_pictures_want_more_memory() -> None:
    small, large = row_of_cameras(2)[0], row_of_cameras(2, size=2)[0]
    base = bytes_needed(small, CONFIG)
    assert bytes_needed(large, CONFIG) > base
    assert bytes_needed(small, StereoConfig(num_planes=64)) > base


@pytest.mark.gpu
@pytest.mark.skipif(
    not torch.cuda.is_available(), reason="stereo on a GPU is NOT tested: no CUDA device"
)
def test_a_real_gpu_gives_the_values_of_the_kernels() -> None:
    assert engine_problem(torch.device("cuda")) is None
    assert disagreement(TorchEngine(torch.device("cuda")), KERNELS) is None
