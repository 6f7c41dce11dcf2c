"""Who computes stereo: numba kernels on the CPU, or PyTorch on a GPU.

Both have the same two heavy parts, a view at a time: the best plane of every pixel, and what other
views' depths say of a map. They differ by rounding alone (`engine_gaps`). What is laid on planes
and walls, and all else, is the same code for both. As in training a GPU is tried out before it is
trusted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.devices import choose_device
from pipelines.nerf.engines.cpu.stereo.aggregation import aggregate_fast
from pipelines.nerf.engines.cpu.stereo.agreement import count_votes_fast
from pipelines.nerf.engines.cpu.stereo.matching import matching_cost_fast
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.aggregation import aggregate, jump_weights
from pipelines.nerf.stereo.agreement import count_votes
from pipelines.nerf.stereo.matching import WARPED_BYTES, matching_cost, plane_homographies
from pipelines.nerf.stereo.views import StereoView

Depths = NDArray[np.float32]
Votes = tuple[NDArray[np.int32], Depths]
Gap = tuple[float, float]
"""What was found, and what is allowed."""

_log = logging.getLogger("nerfworks.nerf")
_AT_ONCE_BYTES = 2**28
_VOLUMES, _FLOAT_BYTES = 4, 4
_MOST_OF_FREE = 0.5
"""Of a GPU's free memory: others may come."""
_OFF, _FEW = 0.05, 0.01
"""By how much a plane may differ, and how large a share of the pixels more: two depths that match
equally well, or a pixel on a border, go either way by rounding."""


class Engine(Protocol):
    """The heavy parts of stereo."""

    def best_planes(
        self, reference: Depths, others: Depths, homographies: Depths, config: StereoConfig
    ) -> Depths:
        """Of each pixel [H, W] the plane that neighbours match best at, with a fraction.

        reference: [H, W], brightness in [0, 1]; others: [N, H', W'], negative where there is no
        picture; homographies: [N, D, 3, 3] (`plane_homographies`).
        """
        ...

    def votes(
        self,
        view: StereoView,
        depth: Depths,
        others: Sequence[tuple[StereoView, Depths]],
        within: float,
    ) -> Votes:
        """What others' depths say of a view's; see `stereo.agreement`.

        Returns ([4, H, W] votes; [H, W] sums of the depths, in this view, of those that agree).
        """
        ...


class KernelEngine:
    """Numba kernels on all cores of the CPU."""

    def best_planes(
        self, reference: Depths, others: Depths, homographies: Depths, config: StereoConfig
    ) -> Depths:
        """As `Engine`."""
        cost = matching_cost_fast(reference, others, homographies, config.window_radius)
        weights = jump_weights(torch.from_numpy(reference), config.edge_scale).numpy()
        planes, _ = aggregate_fast(cost, weights, config.smooth_small, config.smooth_large)
        return planes

    def votes(
        self,
        view: StereoView,
        depth: Depths,
        others: Sequence[tuple[StereoView, Depths]],
        within: float,
    ) -> Votes:
        """As `Engine`."""
        votes = np.zeros((4, *depth.shape), np.int32)
        sums = np.zeros(depth.shape, np.float32)
        rays = view.rays()
        for other, known in others:
            lens = np.array(other.lens, np.float32)
            count_votes_fast(depth, rays, other.from_other(view), known, lens, within, votes, sums)
        return votes, sums


@dataclass(frozen=True)
class TorchEngine:
    """PyTorch on a device."""

    device: torch.device

    def best_planes(
        self, reference: Depths, others: Depths, homographies: Depths, config: StereoConfig
    ) -> Depths:
        """As `Engine`."""
        with torch.inference_mode():
            picture = self._there(reference)
            at_once = max(1, _AT_ONCE_BYTES // (WARPED_BYTES * reference.size))
            told = picture, self._there(others), self._there(homographies)
            cost = matching_cost(*told, config.window_radius, at_once)
            weights = jump_weights(picture, config.edge_scale)
            planes, _ = aggregate(cost, weights, config.smooth_small, config.smooth_large)
            found: Depths = planes.cpu().numpy()
            return found

    def votes(
        self,
        view: StereoView,
        depth: Depths,
        others: Sequence[tuple[StereoView, Depths]],
        within: float,
    ) -> Votes:
        """As `Engine`."""
        with torch.inference_mode():
            mine = self._there(depth)
            rays = self._there(view.rays()[0]), self._there(view.rays()[1])
            votes = torch.zeros(4, *mine.shape, dtype=torch.int32, device=self.device)
            sums = torch.zeros_like(mine)
            for other, known in others:
                pose, lens = other.from_other(view), np.array(other.lens, np.float32)
                told = self._there(pose), self._there(known), self._there(lens)
                count_votes(mine, rays, *told, within, votes, sums)
            return votes.cpu().numpy(), sums.cpu().numpy()

    def _there(self, values: Depths) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)


KERNELS = KernelEngine()


def choose_engine(views: Sequence[StereoView], config: StereoConfig) -> Engine:
    """The engine that `config.device` asks for: kernels, where there is no GPU that can.

    Raises NerfError: bad_config where there is no GPU to use, gpu_failed where one is asked for and
    gives other values than the CPU, or has too little memory for the largest picture.
    """
    device = choose_device(config.device, "depth.device")
    if device.type == "cpu":
        return KERNELS
    problem = engine_problem(device) or _lack_of_memory(device, views, config)
    if problem is None:
        return TorchEngine(device)
    if config.device != "auto":
        raise NerfError(
            "gpu_failed",
            f"Stereo does not work on {device}: {problem}.",
            "Set depth.device to auto or cpu.",
        )
    _log.warning("stereo runs on the CPU: on %s %s", device, problem)
    return KERNELS


def bytes_needed(views: Sequence[StereoView], config: StereoConfig) -> int:
    """What PyTorch takes on a device for the largest of the pictures."""
    most = max((view.picture.size for view in views), default=0)
    return _AT_ONCE_BYTES + (_VOLUMES * config.num_planes * _FLOAT_BYTES + WARPED_BYTES) * most


def _lack_of_memory(
    device: torch.device, views: Sequence[StereoView], config: StereoConfig
) -> str | None:
    free, _ = torch.cuda.mem_get_info(device)
    needed = bytes_needed(views, config)
    if needed <= _MOST_OF_FREE * free:
        return None
    return f"{needed / 2**30:.1f} GiB are wanted and {free / 2**30:.1f} GiB are free"


@lru_cache
def engine_problem(device: torch.device) -> str | None:
    """Why a device is not to be trusted with stereo, None if it is. Once a process."""
    return disagreement(TorchEngine(device), TorchEngine(torch.device("cpu")))


def disagreement(engine: Engine, expected: Engine) -> str | None:
    """In what an engine's values differ from another's by too much, or how it fails, or None."""
    try:
        gaps = engine_gaps(engine, expected)
    except RuntimeError as error:  # of CUDA, its compilers and its memory
        return f"{type(error).__name__}: {error}"
    wrong = [f"{name} differ in {gap:.1%}" for name, (gap, most) in gaps.items() if not gap <= most]
    return ", ".join(wrong) or None


def engine_gaps(engine: Engine, expected: Engine) -> dict[str, Gap]:
    """By how much two engines differ on a made capture, as shares of the pixels."""
    views, inverse = _made_views()
    config = StereoConfig(num_planes=len(inverse), window_radius=2)
    planes, votes = [], []
    for one in (engine, expected):
        homographies = homographies_to(views[0], views[1:], inverse)
        others = np.stack([view.picture for view in views[1:]])
        planes.append(one.best_planes(views[0].picture, others, homographies, config))
        truth = np.full_like(views[0].picture, 1.0 / inverse[len(inverse) // 2])
        noisy = truth * np.linspace(0.9, 1.1, views[0].picture.shape[1], dtype=np.float32)
        votes.append(one.votes(views[0], noisy, [(view, truth) for view in views[1:]], 0.02))
    (ours, our_sums), (theirs, their_sums) = votes
    same = (ours == theirs).all(axis=0)
    off = ~(np.abs(our_sums - their_sums) <= 1e-3 * np.abs(their_sums))
    return {
        "planes": (float((~(np.abs(planes[0] - planes[1]) <= _OFF)).mean()), _FEW),
        "votes": (float((~same).mean()), _FEW),
        "agreed depths": (float(off[same].mean()) if same.any() else 1.0, _FEW),
    }


def _made_views() -> tuple[list[StereoView], NDArray[np.float64]]:
    """Four cameras in a row before a speckled wall, and the inverse depths to try, [D]."""
    height, width, focal, step = 48, 64, 64.0, 4
    inverse = np.linspace(0.1, 0.9, 17)
    speckles = np.random.default_rng(0).random((height, width + 3 * step)).astype(np.float32)
    wall = 0.25 * (speckles + np.roll(speckles, 1, 0) + np.roll(speckles, 1, 1))
    baseline = step / (focal * inverse[len(inverse) // 2])
    lens = (focal, focal, width / 2, height / 2)
    views = []
    for k in range(4):
        pose = np.column_stack([np.eye(3), [k * baseline, 0.0, 0.0]])
        shown = np.ascontiguousarray(wall[:, k * step : k * step + width])
        views.append(StereoView(shown, lens, pose))
    return views, inverse


def homographies_to(
    view: StereoView, others: Sequence[StereoView], inverse: NDArray[np.float64]
) -> Depths:
    """[N, D, 3, 3] float32, from a view's pixels to others', at inverse depths [D]."""
    found: Depths = (
        plane_homographies(
            torch.from_numpy(view.matrix()),
            torch.from_numpy(np.stack([other.matrix() for other in others])),
            torch.from_numpy(np.stack([other.from_other(view) for other in others])).double(),
            torch.from_numpy(inverse),
        )
        .numpy()
        .astype(np.float32)
    )
    return found
