"""Nerfacto: the paper's default method, wired from the parts (arXiv:2302.04264, section 5).

Rays -> camera corrections (training) -> proposals -> field -> colour and depth. Symbols: R rays,
S samples. Fitting is left to `training`, whole pictures to `renderer`.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from pipelines.nerf.along_ray.intervals import sample_pdf, weights_from_density
from pipelines.nerf.along_ray.losses import (
    color_loss,
    distortion_loss,
    interlevel_loss,
    orientation_loss,
    predicted_normal_loss,
)
from pipelines.nerf.along_ray.rendering import (
    accumulation,
    composite,
    composite_normals,
    expected_depth,
    median_depth,
)
from pipelines.nerf.along_ray.samplers import anneal_exponent, sample_proposals, weigh_density
from pipelines.nerf.models.base import Appearance, Model, Outputs, StepPlan, hash_grid_bytes
from pipelines.nerf.networks.encodings import HashGrid, hash_encode
from pipelines.nerf.networks.fields import DensityField, NerfactoField
from pipelines.nerf.networks.normals import PredictedNormals, normals_of_logits
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.space.rays import Rays, RaySamples

ALWAYS_UPDATE_BEFORE = 10


class Nerfacto(Model):
    """The model."""

    config: NerfactoConfig
    method = "nerfacto"
    takes_samples = True

    def __init__(self, config: NerfactoConfig, num_train_images: int) -> None:
        super().__init__(config, num_train_images)
        self.config = config
        self.field = NerfactoField(config, num_train_images)
        num_networks = 1 if config.share_proposal_network else len(config.num_proposal_samples)
        self.proposals = nn.ModuleList(
            DensityField(
                proposal,
                contraction=config.contraction,
                average_init_density=config.average_init_density,
            )
            for proposal in config.proposals[:num_networks]
        )
        self.normal_head: PredictedNormals | None = None
        if config.predict_normals:
            self.normal_head = PredictedNormals(config.geo_feature_dim)
        self.steps_since_update = 0

    def round_networks(self) -> list[nn.Module]:
        """The proposal network of each round, in order; the same one each time where shared."""
        num_rounds = len(self.config.num_proposal_samples)
        return [self.proposals[min(i, len(self.proposals) - 1)] for i in range(num_rounds)]

    def plan_step(self, step: int, generator: torch.Generator | None = None) -> StepPlan:
        """Anneal, and update the proposals when they are due (paper's schedule, Mip-NeRF 360)."""
        del generator
        config = self.config
        return StepPlan(
            step=step,
            exponent=anneal_exponent(step, config.anneal_steps, config.anneal_slope),
            update_proposals=proposals_due(step, self.steps_since_update + 1, config),
        )

    def finish_step(self, plan: StepPlan) -> None:
        """Count the steps since the proposals learned."""
        self.steps_since_update = 0 if plan.update_proposals else self.steps_since_update + 1

    def schedule_state(self) -> dict[str, Any]:
        """As `Model.schedule_state`."""
        return {"steps_since_update": self.steps_since_update}

    def load_schedule_state(self, state: dict[str, Any]) -> None:
        """As `Model.load_schedule_state`."""
        self.steps_since_update = int(state["steps_since_update"])

    def set_engine(self, engine: str) -> None:
        """As `Model.set_engine`. Learned normals need second derivatives, which only plain has."""
        super().set_engine(engine)
        if self.normal_head is not None and self.field.hash_grid is not None:
            self.field.hash_grid.encode = hash_encode

    def _kernels(self, where: Tensor) -> Any:
        """The compiled parts (`engines.cpu.train.twins`) for float32 tensors on the CPU, else
        None."""
        if self.engine != "fast" or where.device.type != "cpu" or where.dtype != torch.float32:
            return None
        # Imported here: a machine that trains on a GPU never loads the compiler.
        from pipelines.nerf.engines.cpu.train import twins as engine

        return engine

    def forward(
        self,
        rays: Rays,
        *,
        plan: StepPlan | None = None,
        appearance: Appearance = None,
        generator: torch.Generator | None = None,
    ) -> Outputs:
        """As `Model.forward`. The proposals have a graph where the plan updates them.

        The nearest sample is at `config.near` also in `eval()`: nobody trained what lies before it.
        """
        config = self.config
        rays = self.corrected(rays)
        plan = plan or StepPlan(0)
        kernels = self._kernels(rays.origins)
        if plan.samples is None:
            final, samples, weights = self._propose(rays, plan, generator, kernels)
        else:
            final, samples, weights = plan.samples, [], []
        codes = self._codes(rays, appearance, generator)
        if kernels and kernels.knows_field(self.field):
            rgb, found = kernels.shade(self.field, rays, final, codes, config.background, generator)
        else:
            density, geometry = self.field.density(final.positions(rays))
            colors = self.field.color(rays.directions, geometry, codes)
            found = weights_from_density(density, final.t_edges)
            rgb = composite(colors, found, config.background, generator=generator)
        with torch.no_grad():
            median = median_depth(found.detach(), final.t_edges)
            expected = expected_depth(found.detach(), final.t_edges)
        outputs = Outputs(
            rgb=rgb,
            accumulation=accumulation(found),
            depth=median,
            expected_depth=expected,
            weights=[*weights, found],
            samples=[*samples, final],
        )
        if self.normal_head is not None:
            self._add_normals(outputs, rays, self.normal_head)
        return outputs

    def _propose(
        self, rays: Rays, plan: StepPlan, generator: torch.Generator | None, kernels: Any
    ) -> tuple[RaySamples, list[RaySamples], list[Tensor]]:
        """As `samplers.sample_proposals`."""
        config = self.config
        with nullcontext() if plan.update_proposals else torch.no_grad():
            return sample_proposals(
                rays,
                self.round_networks(),
                config.num_proposal_samples,
                config.num_nerf_samples,
                config.near,
                config.far,
                spacing=config.spacing,
                exponent=plan.exponent,
                single_jitter=config.single_jitter,
                generator=generator,
                weigh=kernels.weigh if kernels else weigh_density,
                resample=kernels.resample if kernels else sample_pdf,
            )

    def _add_normals(self, outputs: Outputs, rays: Rays, head: PredictedNormals) -> None:
        """Normals from density and predicted ones, per sample for the losses and per ray.

        One more pass through the density network, at points that are constants: no loss on normals
        moves a camera, and the colours may come from a kernel, which keeps no features.
        """
        learns = self.training and torch.is_grad_enabled()
        with torch.inference_mode(False), torch.enable_grad():
            points = outputs["samples"][-1].positions(rays.detach()).clone().requires_grad_()
            logits, geometry = self.field.logits(points)
            # Only a loss on the density's own normals needs second derivatives, which are dear.
            normals = normals_of_logits(
                logits, points, create_graph=learns and self.config.orientation_weight > 0.0
            )
        if not learns:
            normals, geometry = normals.detach(), geometry.detach()
        predicted = head(self.field.unit(points.detach()), geometry)
        found = outputs["weights"][-1]
        outputs["extra"] = {
            "normals": normals,
            "predicted_normals": predicted,
            "directions": rays.directions.detach(),
        }
        outputs["normals"] = composite_normals(normals.detach(), found.detach())
        outputs["predicted_normals"] = composite_normals(predicted.detach(), found.detach())

    def loss_dict(
        self, outputs: Outputs, truth: Tensor, *, plan: StepPlan | None = None
    ) -> dict[str, Tensor]:
        """As `Model.loss_dict`; no interlevel term where the proposals have no graph, and none of
        the spread along the ray where the plan said where to look."""
        config = self.config
        *proposal_weights, weights = outputs["weights"]
        *proposal_samples, final = outputs["samples"]
        losses = {"rgb": color_loss(outputs["rgb"], truth)}
        placed = plan is not None and plan.samples is not None
        learns = plan is None or plan.update_proposals
        if not placed and learns and config.interlevel_weight > 0.0:
            edges = [samples.s_edges for samples in proposal_samples]
            pairs = list(zip(edges, proposal_weights, strict=True))
            kernels = self._kernels(weights)
            loss = kernels.interlevel_loss if kernels else interlevel_loss
            interlevel = loss(final.s_edges, weights, pairs)
            losses["interlevel"] = config.interlevel_weight * interlevel
        if not placed and config.distortion_weight > 0.0:
            distortion = distortion_loss(final.s_edges, weights)
            losses["distortion"] = config.distortion_weight * distortion
        if self.normal_head is not None:
            extra, fixed = outputs["extra"], weights.detach()
            normals, predicted = extra["normals"], extra["predicted_normals"]
            if config.orientation_weight > 0.0:
                losses["orientation"] = config.orientation_weight * orientation_loss(
                    fixed, normals, extra["directions"]
                )
            losses["predicted_normal"] = config.predicted_normal_weight * predicted_normal_loss(
                fixed, normals.detach(), predicted
            )
        if config.camera_mode != "off":
            losses["camera"] = self.cameras_delta.penalty()
        return losses

    def density(self, points: Tensor) -> Tensor:
        """As `Model.density`."""
        return self.field.density(points)[0]

    @property
    def appearance_dim(self) -> int:
        """As `Model.appearance_dim`."""
        return self.config.appearance_dim

    def mean_appearance(self) -> Tensor | None:
        """As `Model.mean_appearance`."""
        return self.field.mean_code()

    def bytes_per_ray(self) -> int:
        """As `Model.bytes_per_ray`."""
        counts = [*self.config.num_proposal_samples, self.config.num_nerf_samples]
        grids = [net.grid for net in self.round_networks()] + [self.field.grid]
        pairs = [
            (count, grid)
            for count, grid in zip(counts, grids, strict=True)
            if isinstance(grid, HashGrid)
        ]
        return max(hash_grid_bytes(count, [grid]) for count, grid in pairs)

    def _codes(
        self, rays: Rays, appearance: Appearance, generator: torch.Generator | None
    ) -> Tensor | None:
        if self.field.appearance is None:
            return None
        if self.training:
            codes = self.field.codes(rays.camera_indices)
            if codes is None or generator is None or self.config.appearance_dropout <= 0.0:
                return codes
            drawn = torch.rand((len(rays), 1), generator=generator, device=codes.device)
            is_dropped = drawn < self.config.appearance_dropout
            return torch.where(is_dropped, self.field.appearance.weight.mean(dim=0), codes)
        if isinstance(appearance, Tensor):
            code = appearance
        elif appearance is not None:
            code = self.field.appearance.weight[appearance]
        else:
            code = self.field.appearance.weight.mean(dim=0)
        return code.expand(len(rays), -1)


def proposal_update_interval(step: int, config: NerfactoConfig) -> float:
    """Steps between updates of the proposals: 1 at first, `proposal_update_every` after warm-up."""
    share = min(step / config.proposal_warmup_steps, 1.0)
    return max(1.0, share * config.proposal_update_every)


def proposals_due(step: int, steps_since_update: int, config: NerfactoConfig) -> bool:
    """Whether this step updates the proposals; `steps_since_update` is 1 right after an update."""
    if step < ALWAYS_UPDATE_BEFORE:
        return True
    return steps_since_update >= proposal_update_interval(step, config)
