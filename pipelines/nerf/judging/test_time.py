"""Fitting held-out cameras, then their look, to a trained model: the paper's test-time procedure.

Adam on each evaluation camera's pose with the colours of random pixels of its image; the poses
fixed, Adam on its appearance code with pixels of one half of the image, left or right as the seed
says. The model is not changed. Each image is fitted by itself: its result depends on the model, the
image, its number and the seed alone. Metrics are left to the caller; only those on the half not
seen are free of what the code was told.
Symbols: N images fitted, A numbers of a code, B pixels of a step.
Source: nerfstudio, arXiv:2302.04264, appendix, "Evaluation protocol"; the halves are those of NeRF
in the Wild, arXiv:2008.02268.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pipelines.nerf.along_ray.losses import color_loss
from pipelines.nerf.data.images import ImageData
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.options.evaluate import TestTimeConfig
from pipelines.nerf.space.camera_optimizer import CameraOptimizer, se3_exp, so3_exp
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.rays import Rays

LEFT, RIGHT = "left", "right"
MEASURED_RAYS = 2048
"""Pixels, always the same, on which the loss before and after a fit is taken."""

Progress = Callable[[float], None]


@dataclass(frozen=True)
class FittedPoses:
    """Corrections of some cameras.

    indices: the N cameras' rows. tangent: [N, 6] float32 on the CPU, [t, omega] in scene units and
    radians as in `camera_optimizer`. mode: "so3xr3" or "se3".
    loss_before, loss_after: N mean squared errors of colour on the same random pixels.
    """

    indices: tuple[int, ...]
    tangent: Tensor
    mode: str
    loss_before: tuple[float | None, ...]
    loss_after: tuple[float | None, ...]

    def motions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotations [N, 3, 3] about the camera centres, and shifts [N, 3] in scene units."""
        tangent = self.tangent.double()
        if self.mode == "se3":
            rotation, shift = se3_exp(tangent)
        else:
            rotation, shift = so3_exp(tangent[:, 3:]), tangent[:, :3]
        return rotation.numpy(), shift.numpy()

    def moved(self, poses: NDArray[np.float64], scale: float = 1.0) -> NDArray[np.float64]:
        """Poses [N, 3, 4] with the corrections; scale: scene units per unit of the poses."""
        rotation, shift = self.motions()
        return np.concatenate(
            [rotation @ poses[:, :, :3], poses[:, :, 3:] + shift[:, :, None] / scale], axis=-1
        )

    def applied_to(self, cameras: Cameras) -> Cameras:
        """All cameras, those at `indices` corrected."""
        poses = cameras.scene_from_camera.clone()
        rows = list(self.indices)
        moved = self.moved(poses[rows].double().cpu().numpy())
        poses[rows] = torch.from_numpy(moved).to(poses)
        return replace(cameras, scene_from_camera=poses)


@dataclass(frozen=True)
class FittedCodes:
    """Appearance codes of some images.

    indices: the N images. codes: [N, A] float32 on the model's device. halves: the half, "left" or
    "right", that each was fitted on. loss_before, loss_after: N mean squared errors of colour on
    the same random pixels of that half, before with the mean code.
    """

    indices: tuple[int, ...]
    codes: Tensor
    halves: tuple[str, ...]
    loss_before: tuple[float | None, ...]
    loss_after: tuple[float | None, ...]


def half_columns(width: int, half: str) -> slice:
    """The columns of the "left" or "right" half; a middle column belongs to the right one."""
    return slice(0, width // 2) if half == LEFT else slice(width // 2, width)


def other_half(half: str) -> str:
    """ "right" for "left" and the reverse."""
    return RIGHT if half == LEFT else LEFT


def fit_poses(
    model: Model,
    cameras: Cameras,
    images: ImageData,
    indices: Sequence[int],
    options: TestTimeConfig,
    *,
    seed: int,
    progress: Progress = lambda fraction: None,
) -> FittedPoses:
    """Adam on six numbers per image, from the given pose; the mean code is used.

    cameras, images: of the same sizes, on the CPU. indices: rows of both that are fitted.
    progress: called after each step with the share done, in (0, 1]; what it raises ends the fit.
    An image of which masks leave nothing keeps its pose, and its losses are None. One whose fit
    ends with a larger loss keeps its pose too.
    Raises NerfError `non_finite_loss`.
    """
    schedule = _Schedule(
        options.pose_steps, options.pose_lr, options.pose_lr_final, options.rays_per_step
    )
    device = _device_of(model)
    tangents, losses = [], []
    with _frozen(model):
        for row, index in enumerate(indices):
            delta = CameraOptimizer(1, options.pose_mode).to(device)
            rays_of = _rays_of(cameras, index, device)
            losses.append(
                _minimise(
                    delta.tangent,
                    partial(_pose_loss, model, delta, rays_of),
                    _Pixels(images, index, None, device),
                    schedule,
                    _key(seed, index, "pose"),
                    _share_of(progress, row, len(indices)),
                )
            )
            tangents.append(delta.tangent[0].detach().cpu())
    return FittedPoses(
        indices=tuple(indices),
        tangent=torch.stack(tangents) if tangents else torch.zeros(0, 6),
        mode=options.pose_mode,
        loss_before=tuple(before for before, _ in losses),
        loss_after=tuple(after for _, after in losses),
    )


def fit_appearance(
    model: Model,
    cameras: Cameras,
    images: ImageData,
    indices: Sequence[int],
    options: TestTimeConfig,
    *,
    seed: int,
    progress: Progress = lambda fraction: None,
) -> FittedCodes:
    """Adam on one code per image, from the mean code, with the pixels of one half of the image.

    cameras: with the poses as they are to be, so those that `fit_poses` gave, if any.
    The seed chooses each half; where masks leave nothing of it, the other is taken. Where they
    leave nothing at all the code stays, and the losses are None. Else as `fit_poses`.
    Raises NerfError `bad_config` for a model without codes, `non_finite_loss`.
    """
    start = model.mean_appearance()
    if start is None:
        raise NerfError(
            "bad_config",
            "The model has no appearance codes that could be fitted.",
            "Train with train.model.appearance_dim above 0, or do not fit the appearance.",
        )
    schedule = _Schedule(
        options.appearance_steps,
        options.appearance_lr,
        options.appearance_lr_final,
        options.rays_per_step,
    )
    device = _device_of(model)
    codes, losses, halves = [], [], []
    with _frozen(model):
        for row, index in enumerate(indices):
            code = nn.Parameter(start.detach().clone())
            half = _chosen_half(seed, index)
            pixels = _Pixels(images, index, half, device)
            if not len(pixels):
                half = other_half(half)
                pixels = _Pixels(images, index, half, device)
            losses.append(
                _minimise(
                    code,
                    partial(_appearance_loss, model, code, _rays_of(cameras, index, device)),
                    pixels,
                    schedule,
                    _key(seed, index, "appearance"),
                    _share_of(progress, row, len(indices)),
                )
            )
            codes.append(code.detach())
            halves.append(half)
    return FittedCodes(
        indices=tuple(indices),
        codes=torch.stack(codes) if codes else start.detach().new_zeros(0, len(start)),
        halves=tuple(halves),
        loss_before=tuple(before for before, _ in losses),
        loss_after=tuple(after for _, after in losses),
    )


class _Pixels:
    """The usable pixels of one image, or of a half of it, to be drawn from uniformly."""

    def __init__(
        self, images: ImageData, index: int, half: str | None, device: torch.device
    ) -> None:
        width, height = (int(side) for side in images.sizes[index].tolist())
        usable = torch.ones(height, width, dtype=torch.bool)
        mask = images.mask(index)
        if mask is not None:
            usable &= mask
        if half is not None:
            usable[:, half_columns(width, other_half(half))] = False
        self._flat = usable.reshape(-1).nonzero().squeeze(-1)
        self._first = int(images.offsets[index])
        self._colors = images.pixels
        self._width = width
        self._device = device

    def __len__(self) -> int:
        return len(self._flat)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Pixel centres [B, 2], x and y, and colours [B, 3] in [0, 1]."""
        flat = self._flat[torch.randint(len(self), (count,), generator=generator)]
        rows = torch.div(flat, self._width, rounding_mode="floor")
        places = torch.stack([flat % self._width, rows], dim=-1).float() + 0.5
        colors = self._colors[self._first + flat].float() / 255.0
        return places.to(self._device), colors.to(self._device)


@dataclass(frozen=True)
class _Schedule:
    """Steps, the rate at the start and at the end (falling exponentially), and pixels a step."""

    steps: int
    lr: float
    lr_final: float
    rays: int


RaysOf = Callable[[Tensor], Rays]
LossOf = Callable[[Tensor, Tensor], Tensor]


def _minimise(
    parameter: nn.Parameter,
    loss_of: LossOf,
    pixels: _Pixels,
    schedule: _Schedule,
    key: int,
    progress: Progress,
) -> tuple[float | None, float | None]:
    """Adam on one parameter; the loss before and after. None without pixels.

    A fit that ends worse than it began is undone.
    """
    if not len(pixels):
        progress(1.0)
        return None, None
    fixed = pixels.draw(MEASURED_RAYS, torch.Generator().manual_seed(key + 1))
    generator = torch.Generator().manual_seed(key)
    given = parameter.detach().clone()
    optimizer = torch.optim.Adam([parameter], lr=schedule.lr)
    gamma = (schedule.lr_final / schedule.lr) ** (1.0 / schedule.steps)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma)
    with torch.no_grad():
        before = float(loss_of(*fixed))
    for step in range(schedule.steps):
        loss = loss_of(*pixels.draw(schedule.rays, generator))
        (parameter.grad,) = torch.autograd.grad(loss, parameter)
        optimizer.step()
        decay.step()
        progress((step + 1) / schedule.steps)
    with torch.no_grad():
        after = float(loss_of(*fixed))
    if not math.isfinite(after):
        raise NerfError(
            "non_finite_loss",
            f"The colour loss became {after} while fitting to a held-out image.",
            "Lower the rates in evaluate.test_time, or measure without fitting.",
        )
    if after > before:
        parameter.data.copy_(given)
        return before, before
    return before, after


def _pose_loss(
    model: Model, delta: CameraOptimizer, rays_of: RaysOf, places: Tensor, colors: Tensor
) -> Tensor:
    return color_loss(model(delta.apply_to(rays_of(places)))["rgb"], colors)


def _appearance_loss(
    model: Model, code: Tensor, rays_of: RaysOf, places: Tensor, colors: Tensor
) -> Tensor:
    return color_loss(model(rays_of(places), appearance=code)["rgb"], colors)


def _rays_of(cameras: Cameras, index: int, device: torch.device) -> RaysOf:
    """A function from pixel centres [B, 2] to their rays, all of camera 0."""
    camera = cameras.select([index]).to(device)

    def rays_of(places: Tensor) -> Rays:
        nobody = torch.zeros(len(places), dtype=torch.int64, device=device)
        return camera.generate_rays(nobody, places)

    return rays_of


def _share_of(progress: Progress, row: int, count: int) -> Progress:
    return lambda share: progress((row + share) / count)


def _key(seed: int, index: int, purpose: str) -> int:
    """A seed for one image and purpose; neighbours in any of them are unrelated."""
    words = np.random.SeedSequence([seed, index, *purpose.encode()]).generate_state(1)
    return int(words[0])


def _chosen_half(seed: int, index: int) -> str:
    return (LEFT, RIGHT)[_key(seed, index, "half") % 2]


def _device_of(model: Model) -> torch.device:
    return next(model.parameters()).device


@contextmanager
def _frozen(model: Model) -> Iterator[None]:
    """The model in `eval()` and without gradients of its own; afterwards as it was."""
    was_training = model.training
    wanted = [(parameter, parameter.requires_grad) for parameter in model.parameters()]
    model.train(False)
    for parameter, _ in wanted:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter, requires_grad in wanted:
            parameter.requires_grad_(requires_grad)
        model.train(was_training)
