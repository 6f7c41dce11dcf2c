"""Instant-NGP: a hash grid, asked along the rays only where an occupancy grid holds matter.

Rays -> camera corrections (training) -> march -> what is seen of it -> field -> colour and depth.
Symbols: R rays, P samples of all rays together. Source: Mueller et al., arXiv:2201.05989.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pipelines.nerf.along_ray.losses import color_loss
from pipelines.nerf.along_ray.occupancy import SCENE_DIAGONAL, OccupancyGrid, Stride, march
from pipelines.nerf.along_ray.packed import (
    PackedSamples,
    packed_composite,
    packed_expected_depth,
    packed_light,
    packed_median_depth,
    packed_weights,
    sum_by_ray,
)
from pipelines.nerf.models.base import Appearance, Model, Outputs, StepPlan, hash_grid_bytes
from pipelines.nerf.networks.fields import NerfactoField
from pipelines.nerf.options.methods.instant_ngp import InstantNgpConfig
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.space.rays import Rays

POINTS_PER_PASS = {"cpu": 2**15, "cuda": 2**20}
"""Points whose density is asked for at once without a graph, by kind of device."""
SEEN_PER_RAY = 64
"""Samples of a ray that are seen, for the estimate of memory alone."""
RAYS_TOGETHER = 16
"""Rays of a step are a multiple of it where their number is adapted."""
SHARE_OF_A_STEP = 0.2
"""What a step counts in the running mean of samples per ray: it forgets within some ten steps."""


class InstantNgp(Model):
    """The model."""

    config: InstantNgpConfig
    method = "instant-ngp"

    def __init__(self, config: InstantNgpConfig, num_train_images: int) -> None:
        super().__init__(config, num_train_images)
        self.config = config
        self.field = NerfactoField(_field_config(config), num_train_images)
        self.stride = Stride(SCENE_DIAGONAL / config.num_steps, config.cone_angle)
        self.occupancy = OccupancyGrid(
            config.occupancy_resolution,
            config.num_cascades,
            decay=config.occupancy_decay,
            threshold=-math.log1p(-config.occupancy_threshold) / self.stride.length,
        )
        self.samples_per_ray = 0.0
        self._counted: tuple[int, int] | None = None
        # Without a contraction the hash grid covers [-1, 1]^3, which is to be the last cascade.
        self.shrink = 1.0 / self.occupancy.half_side if config.contraction == "none" else 1.0

    def plan_step(self, step: int, generator: torch.Generator | None = None) -> StepPlan:
        """As `Model.plan_step`; looks at the occupancy anew where that is due."""
        config = self.config
        if step % config.occupancy_update_every == 0:
            self.occupancy.update(
                self._density,
                everywhere=generator is None or step < config.occupancy_warmup_steps,
                generator=generator,
            )
        return StepPlan(step)

    def rays_of_step(self, rays_per_step: int) -> int:
        """As `Model.rays_of_step`; with `samples_per_step` what the last steps call for.

        At least 16, at most 16 times what the options say, in sixteens.
        Source: the adaptive batch of arXiv:2201.05989, appendix E.2.
        """
        wanted = self.config.samples_per_step
        if wanted == 0 or self.samples_per_ray == 0.0:
            return rays_per_step
        rays = min(wanted / self.samples_per_ray, RAYS_TOGETHER * rays_per_step)
        return max(1, round(rays / RAYS_TOGETHER)) * RAYS_TOGETHER

    def finish_step(self, plan: StepPlan) -> None:
        """Learn from the step how many samples a ray has: a running mean."""
        del plan
        if self._counted is not None:
            samples, rays = self._counted
            found = max(samples, 1) / rays
            old = self.samples_per_ray or found
            self.samples_per_ray = old + SHARE_OF_A_STEP * (found - old)
            self._counted = None

    def schedule_state(self) -> dict[str, Any]:
        """As `Model.schedule_state`."""
        return {"samples_per_ray": self.samples_per_ray}

    def load_schedule_state(self, state: dict[str, Any]) -> None:
        """As `Model.load_schedule_state`."""
        self.samples_per_ray = float(state["samples_per_ray"])

    def forward(
        self,
        rays: Rays,
        *,
        plan: StepPlan | None = None,
        appearance: Appearance = None,
        generator: torch.Generator | None = None,
    ) -> Outputs:
        """As `Model.forward`; without `weights` and `samples`, whose number differs by ray.

        In training `extra["kept"]`, [R] bool, tells which rays were followed: the first ones, as
        many as `max_samples` allows. Of the others the outputs tell nothing.
        A ray that meets nothing has the depth `config.far`.
        """
        config = self.config
        rays = self.corrected(rays)
        samples = march(
            rays, self.occupancy, config.near, config.far, self.stride, generator=generator
        )
        kept = None
        if self.training:
            samples, kept = first_rays(samples, config.max_samples)
        samples = self._seen(rays.detach(), samples)
        if kept is not None and config.samples_per_step > 0:
            self._counted = len(samples), int(kept.sum())
        if self.training and len(samples) == 0:
            samples = _sample_of_no_length(samples, config.near)

        density, geometry = self.field.density(samples.positions(rays) * self.shrink)
        directions = rays.directions[samples.ray]
        colors = self.field.color(directions, geometry[:, None], None).squeeze(1).to(density.dtype)
        weights = packed_weights(density, samples)
        fixed = weights.detach()
        outputs = Outputs(
            rgb=packed_composite(colors, weights, samples, config.background, generator=generator),
            accumulation=sum_by_ray(weights, samples),
            depth=packed_median_depth(fixed, samples, config.far),
            expected_depth=packed_expected_depth(fixed, samples, config.far),
            weights=[],
            samples=[],
        )
        if kept is not None:
            outputs["extra"] = {"kept": kept}
        return outputs

    @torch.no_grad()
    def _seen(self, rays: Rays, samples: PackedSamples) -> PackedSamples:
        """The samples that light reaches and that stop some of it."""
        config = self.config
        if len(samples) == 0:
            return samples
        points = samples.positions(rays)
        budget = POINTS_PER_PASS.get(points.device.type, POINTS_PER_PASS["cpu"])
        density = torch.cat([self._density(part) for part in torch.split(points, budget)])
        light, alpha = packed_light(density, samples)
        # At the start all densities are low: then what is below their mean is left out, no more.
        usual = -torch.expm1(-self.occupancy.mean_density * self.stride.length)
        threshold = usual.clamp_max(config.alpha_threshold)
        return samples.select((alpha >= threshold) & (light >= config.early_stop))

    def loss_dict(
        self, outputs: Outputs, truth: Tensor, *, plan: StepPlan | None = None
    ) -> dict[str, Tensor]:
        """As `Model.loss_dict`, over the rays that were followed."""
        rgb = outputs["rgb"]
        if "extra" in outputs:
            kept = outputs["extra"]["kept"]
            rgb, truth = rgb[kept], truth[kept]
        losses = {"rgb": color_loss(rgb, truth)}
        if self.config.camera_mode != "off":
            losses["camera"] = self.cameras_delta.penalty()
        return losses

    def density(self, points: Tensor) -> Tensor:
        """As `Model.density`; 0 in empty cells, as rays see it."""
        return self._density(points) * self.occupancy.contains(points)

    def _density(self, points: Tensor) -> Tensor:
        """Density [...] of the field alone at scene points [..., 3]."""
        return self.field.density(points * self.shrink)[0]

    def bytes_per_ray(self) -> int:
        """As `Model.bytes_per_ray`; the march and the look for what is seen bound themselves."""
        return hash_grid_bytes(SEEN_PER_RAY, [self.field.grid])


def first_rays(samples: PackedSamples, most: int) -> tuple[PackedSamples, Tensor]:
    """The samples of as many whole rays from the first on as `most` samples hold, at least of one.

    Returns (samples, [R] bool: the rays that were kept). Rays are drawn at random, so that the
    first ones are as good as any. Source: the adaptive batch of arXiv:2201.05989, appendix E.2.
    """
    total = torch.cumsum(samples.counts(), dim=0)
    kept = total <= most
    if len(kept):
        kept[0] = True
    return samples.select(kept[samples.ray]), kept


def _sample_of_no_length(samples: PackedSamples, near: float) -> PackedSamples:
    """One sample that shows nothing: a batch that meets nothing still needs a graph."""
    at = samples.t_start.new_full((1,), near)
    return PackedSamples(samples.ray.new_zeros(1), at, at, samples.num_rays)


def _field_config(config: InstantNgpConfig) -> NerfactoConfig:
    """The options of Nerfacto's field, which is Instant-NGP's without appearance codes."""
    return NerfactoConfig(
        grid=config.grid,
        hidden_dim=config.hidden_dim,
        hidden_dim_color=config.hidden_dim_color,
        geo_feature_dim=config.geo_feature_dim,
        contraction=config.contraction,
        appearance_dim=0,
        average_init_density=config.average_init_density,
    )
