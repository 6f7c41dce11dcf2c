"""Nerfacto: the paper's default method, wired from the parts (arXiv:2302.04264, section 5).

Rays -> camera corrections (training) -> proposals -> field -> colour and depth. Symbols: R rays,
S samples. Fitting is left to `training`, whole pictures to `renderer`.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TypedDict

import torch
from torch import Tensor, nn

from pipelines.nerf.camera_optimizer import CameraOptimizer
from pipelines.nerf.config import NerfactoConfig
from pipelines.nerf.encodings import HashGrid
from pipelines.nerf.fields import DensityField, NerfactoField
from pipelines.nerf.intervals import weights_from_density
from pipelines.nerf.losses import color_loss, distortion_loss, interlevel_loss
from pipelines.nerf.rays import Rays, RaySamples
from pipelines.nerf.rendering import accumulation, composite, expected_depth, median_depth
from pipelines.nerf.samplers import anneal_exponent, sample_proposals

ALWAYS_UPDATE_BEFORE = 10


class Outputs(TypedDict):
    """What a batch of rays shows.

    rgb: [R, 3] in [0, 1]. accumulation: [R] in [0, 1].
    depth: [R], median; expected_depth: [R]; both distances along the ray in scene units.
    weights: [R, S] of each proposal round, then of the field; samples: likewise.
    """

    rgb: Tensor
    accumulation: Tensor
    depth: Tensor
    expected_depth: Tensor
    weights: list[Tensor]
    samples: list[RaySamples]


class Nerfacto(nn.Module):
    """The model. `train()` and `eval()` switch jitter, camera corrections and appearance codes.

    num_train_images: rows of the appearance codes and camera corrections.
    """

    def __init__(self, config: NerfactoConfig, num_train_images: int) -> None:
        super().__init__()
        self.config = config
        self.num_train_images = num_train_images
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
        self.cameras_delta = CameraOptimizer(
            num_train_images,
            config.camera_mode,
            translation_penalty=config.camera_translation_penalty,
            rotation_penalty=config.camera_rotation_penalty,
        )

    def set_engine(self, engine: str) -> None:
        """Choose "plain" or "fast" for every hash grid; both have the same values."""
        for module in self.modules():
            if isinstance(module, HashGrid):
                module.engine = engine

    def round_networks(self) -> list[nn.Module]:
        """The proposal network of each round, in order; the same one each time where shared."""
        num_rounds = len(self.config.num_proposal_samples)
        return [self.proposals[min(i, len(self.proposals) - 1)] for i in range(num_rounds)]

    def forward(
        self,
        rays: Rays,
        *,
        step: int | None = None,
        update_proposals: bool = True,
        appearance: int | None = None,
        generator: torch.Generator | None = None,
    ) -> Outputs:
        """What the rays show.

        rays: in training, `camera_indices` are indices of training images.
        step: training step, for the annealing of proposal weights; None for the trained state.
        update_proposals: false runs the proposals without a graph, so they cost no backward pass.
        appearance: in `eval()`, whose training image's code to use; None for the mean code.
        generator: random numbers for jitter and random background; None for neither.
        The nearest sample is at `config.near` also in `eval()`: nobody trained what lies before it.
        """
        config = self.config
        if self.training:
            rays = self.cameras_delta.apply_to(rays)
        exponent = 1.0
        if step is not None:
            exponent = anneal_exponent(step, config.anneal_steps, config.anneal_slope)
        with nullcontext() if update_proposals else torch.no_grad():
            final, samples, weights = sample_proposals(
                rays,
                self.round_networks(),
                config.num_proposal_samples,
                config.num_nerf_samples,
                config.near,
                config.far,
                exponent=exponent,
                single_jitter=config.single_jitter,
                generator=generator,
            )
        density, geometry = self.field.density(final.positions(rays))
        found = weights_from_density(density, final.t_edges)
        colors = self.field.color(rays.directions, geometry, self._codes(rays, appearance))
        rgb = composite(colors, found, config.background, generator=generator)
        with torch.no_grad():
            median = median_depth(found.detach(), final.t_edges)
            expected = expected_depth(found.detach(), final.t_edges)
        return Outputs(
            rgb=rgb,
            accumulation=accumulation(found),
            depth=median,
            expected_depth=expected,
            weights=[*weights, found],
            samples=[*samples, final],
        )

    def loss_dict(
        self, outputs: Outputs, truth: Tensor, *, update_proposals: bool = True
    ) -> dict[str, Tensor]:
        """The terms whose sum is minimised, each a weighted scalar, by name.

        truth: [R, 3] in [0, 1]. The interlevel term is left out where the proposals have no graph.
        """
        config = self.config
        *proposal_weights, weights = outputs["weights"]
        *proposal_samples, final = outputs["samples"]
        losses = {"rgb": color_loss(outputs["rgb"], truth)}
        if update_proposals and config.interlevel_weight > 0.0:
            edges = [samples.s_edges for samples in proposal_samples]
            pairs = list(zip(edges, proposal_weights, strict=True))
            interlevel = interlevel_loss(final.s_edges, weights, pairs)
            losses["interlevel"] = config.interlevel_weight * interlevel
        if config.distortion_weight > 0.0:
            distortion = distortion_loss(final.s_edges, weights)
            losses["distortion"] = config.distortion_weight * distortion
        if config.camera_mode != "off":
            losses["camera"] = self.cameras_delta.penalty()
        return losses

    def _codes(self, rays: Rays, appearance: int | None) -> Tensor | None:
        if self.training:
            return self.field.codes(rays.camera_indices)
        if appearance is None:
            code = self.field.mean_code()
        else:
            index = torch.tensor([appearance], device=rays.origins.device)
            chosen = self.field.codes(index)
            code = None if chosen is None else chosen[0]
        return None if code is None else code.expand(len(rays), -1)


def proposal_update_interval(step: int, config: NerfactoConfig) -> float:
    """Steps between updates of the proposals: 1 at first, `proposal_update_every` after warm-up."""
    share = min(step / config.proposal_warmup_steps, 1.0)
    return max(1.0, share * config.proposal_update_every)


def proposals_due(step: int, steps_since_update: int, config: NerfactoConfig) -> bool:
    """Whether this step updates the proposals; `steps_since_update` is 1 right after an update."""
    if step < ALWAYS_UPDATE_BEFORE:
        return True
    return steps_since_update >= proposal_update_interval(step, config)
