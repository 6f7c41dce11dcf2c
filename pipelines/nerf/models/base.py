"""What every method is: a module from rays to what they show, and the terms it is fitted by.

The training loop, the renderer and the files of a model know methods through this class alone.
Symbols: R rays, S samples. A method is one file beside this one that wires parts; it is chosen by
`train.method` (`config.methods`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NotRequired, TypedDict

import torch
from torch import Tensor, nn

from pipelines.nerf.engines.hash_encoders import HASH_ENCODERS
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.parts import ModelConfig
from pipelines.nerf.space.camera_optimizer import CameraOptimizer
from pipelines.nerf.space.rays import Rays, RaySamples

Appearance = int | Tensor | None
"""Whose code to render with: a training image's, a code [A] itself, or None for the mean code."""


class Outputs(TypedDict):
    """What a batch of rays shows.

    rgb: [R, 3] in [0, 1]. accumulation: [R] in [0, 1].
    depth: [R], median; expected_depth: [R]; both distances along the ray in scene units.
    weights: [R, S] of each round of samples, the last one's for the colour; samples: likewise;
        both empty for methods whose rays have different numbers of samples.
    extra: tensors that the method's own losses need, by name.
    normals, predicted_normals: [R, 3], scene axes, of unit length or zero where nothing is, from a
        method that was asked for them.
    """

    rgb: Tensor
    accumulation: Tensor
    depth: Tensor
    expected_depth: Tensor
    weights: list[Tensor]
    samples: list[RaySamples]
    extra: NotRequired[dict[str, Tensor]]
    normals: NotRequired[Tensor]
    predicted_normals: NotRequired[Tensor]


@dataclass(frozen=True)
class StepPlan:
    """What one training step does besides the usual; made by `Model.plan_step`.

    step: counted from 0. exponent: the power of proposal weights before resampling; a tensor on the
        device where the step is captured, so that it can differ from run to run.
    update_proposals: whether the sampler's own networks learn in this step.
    samples: where the step's rays are to be asked, in place of the sampler's choice; only of
        methods that take them (`Model.takes_samples`). No term of the loss reads their `s_edges`.
    """

    step: int
    exponent: float | Tensor = 1.0
    update_proposals: bool = True
    samples: RaySamples | None = None


class Model(nn.Module, ABC):
    """A method. `train()` and `eval()` switch jitter, camera corrections and appearance codes.

    config: the method's options. num_train_images: rows of codes and camera corrections.
    """

    def __init__(self, config: ModelConfig, num_train_images: int) -> None:
        super().__init__()
        self.num_train_images = num_train_images
        self.engine = "plain"
        self.cameras_delta = CameraOptimizer(
            num_train_images,
            config.camera_mode,
            translation_penalty=config.camera_translation_penalty,
            rotation_penalty=config.camera_rotation_penalty,
        )

    config: ModelConfig
    takes_samples = False
    """Whether `StepPlan.samples` is heeded."""
    method = ""
    """The name in `train.method`."""

    @abstractmethod
    def forward(
        self,
        rays: Rays,
        *,
        plan: StepPlan | None = None,
        appearance: Appearance = None,
        generator: torch.Generator | None = None,
    ) -> Outputs:
        """What the rays show.

        rays: in training, `camera_indices` are indices of training images.
        plan: of the training step; None for the trained state.
        appearance: in `eval()`, the code to render with; methods without codes leave it alone.
        generator: random numbers for jitter and random background; None for neither.
        """

    @abstractmethod
    def loss_dict(
        self, outputs: Outputs, truth: Tensor, *, plan: StepPlan | None = None
    ) -> dict[str, Tensor]:
        """The terms whose sum is minimised, each a weighted scalar, by name.

        truth: [R, 3] in [0, 1]. The term "rgb" is the mean squared error of the final colours.
        """

    @abstractmethod
    def density(self, points: Tensor) -> Tensor:
        """Density [...] per scene unit at points [..., 3] in scene space."""

    def begin_step(self, step: int) -> tuple[int, ...]:
        """Let in the levels of hash grids that are due; called before `plan_step`.

        Returns how many levels of each grid are active.
        """
        grids = [module for module in self.modules() if isinstance(module, HashGrid)]
        for grid in grids:
            grid.active_levels = grid.levels_at(step)
        return tuple(grid.active_levels for grid in grids)

    def rays_of_step(self, rays_per_step: int) -> int:
        """Rays of the next step, of a run whose options ask for `rays_per_step`."""
        return rays_per_step

    def plan_step(self, step: int, generator: torch.Generator | None = None) -> StepPlan:
        """Decide what a training step does; called once before it. May update samplers.

        generator: random numbers on the model's device.
        """
        del generator
        return StepPlan(step)

    def finish_step(self, plan: StepPlan) -> None:
        """Called once after the optimiser's step."""

    def schedule_state(self) -> dict[str, Any]:
        """Plain values that `plan_step` needs to go on from a checkpoint, beside the weights."""
        return {}

    def load_schedule_state(self, state: dict[str, Any]) -> None:
        """The inverse of `schedule_state`."""

    def network_parameters(self) -> Iterable[nn.Parameter]:
        """All that is learned except the camera corrections."""
        cameras = {id(parameter) for parameter in self.cameras_delta.parameters()}
        return (parameter for parameter in self.parameters() if id(parameter) not in cameras)

    def set_engine(self, engine: str) -> None:
        """Choose "plain" or "fast"; both have the same values. By default, that of hash grids."""
        self.engine = engine
        for module in self.modules():
            if isinstance(module, HashGrid):
                module.encode = HASH_ENCODERS[engine]

    @property
    def appearance_dim(self) -> int:
        """Numbers of an appearance code; 0 without codes."""
        return 0

    def mean_appearance(self) -> Tensor | None:
        """The mean code [A] of all training images, or None without codes."""
        return None

    def bytes_per_ray(self) -> int:
        """Bytes of the largest tensors that one ray needs in `forward` without a graph."""
        return 2**18

    def corrected(self, rays: Rays) -> Rays:
        """The rays with the camera corrections, in training; as they are in `eval()`."""
        return self.cameras_delta.apply_to(rays) if self.training else rays


def hash_grid_bytes(num_samples: int, grids: Sequence[HashGrid]) -> int:
    """Bytes that the plain hash grids take for so many samples.

    Per sample, level and corner: an index (8 bytes), a weight (4) and F features (4 each), twice.
    """
    return max(
        num_samples * grid.config.num_levels * 8 * 2 * (12 + 4 * grid.config.features_per_level)
        for grid in grids
    )
