"""Training steps that look where depth maps say (`along_ray.guided`), among the others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pipelines.nerf.along_ray.guided import samples_around
from pipelines.nerf.data.depth_maps import DepthSupervision
from pipelines.nerf.data.pixels import PixelSampler
from pipelines.nerf.models.base import Model, StepPlan
from pipelines.nerf.options.train import GuidedConfig, TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.rays import Rays
from pipelines.nerf.training.state import TrainingState

LEAST_RAYS = 16
"""Of a step: fewer tell less than the step costs beside them."""
_ROOM = 2.0
"""Times the nearest sample: where samples begin to lie around a surface, or further away."""


@dataclass(frozen=True)
class GuidedSteps:
    """The rule of one run.

    depth: on the device of the cameras. near: nearest sample, scene units.
    """

    depth: DepthSupervision
    config: GuidedConfig
    max_steps: int
    near: float

    @classmethod
    def of(
        cls, config: TrainConfig, model: Model, depth: DepthSupervision | None
    ) -> GuidedSteps | None:
        """Those of a run; None where its options, method or capture have none."""
        if depth is None or config.guided.share == 0.0 or not model.takes_samples:
            return None
        if depth.maps.known_share < config.guided.least_known:
            return None
        return cls(depth, config.guided, config.max_steps, config.model.near)

    @property
    def _last(self) -> float:
        """Steps within which they are."""
        return self.config.until * self.max_steps

    def is_due(self, step: int) -> bool:
        """Whether a step is one of them: evenly among the others, the first one never."""
        share = self.config.share
        return step < self._last and int((step + 1) * share) > int(step * share)

    def num_rays(self, step: int, others: int) -> int:
        """Rays drawn for a step, of a run whose other steps have so many."""
        return self.config.rays_per_step if self.is_due(step) else others

    def spread(self, step: int) -> float:
        """How far around the surface samples lie, as a power from first to last."""
        config, done = self.config, min(step / self._last, 1.0)
        return config.spread * float((config.spread_final / config.spread) ** done)

    def batch(
        self, state: TrainingState, plan: StepPlan, sampler: PixelSampler, cameras: Cameras
    ) -> tuple[StepPlan, Rays, Tensor] | None:
        """Pixels of known depth: the plan with samples for them, their rays and colours [K, 3].

        None where they are too few.
        """
        drawn = sampler.draw(self.config.rays_per_step, state.pixel_random)
        index, pixels, colors = (item.to(cameras.focal.device) for item in drawn)
        rays = cameras.generate_rays(index, pixels)
        distances, spread = self.depth.maps.distances(rays, cameras), self.spread(plan.step)
        has_room = distances * (1.0 - spread) > _ROOM * self.near
        rows = (torch.isfinite(distances) & has_room).nonzero().squeeze(-1)
        if len(rows) < LEAST_RAYS:
            return None
        samples = samples_around(
            distances[rows],
            self.near,
            self.config.num_free_samples,
            self.config.num_near_samples,
            spread,
            state.model_random,
        )
        return replace(plan, samples=samples), rays.select(rows), colors[rows]
