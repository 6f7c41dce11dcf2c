"""NeRF: two MLPs over Fourier features, the second asked where the first saw matter.

Rays -> camera corrections (training) -> even samples -> coarse MLP -> more samples -> fine MLP ->
colour and depth. Symbols: R rays, S samples. Source: Mildenhall et al., arXiv:2003.08934.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.along_ray.losses import color_loss
from pipelines.nerf.along_ray.rendering import accumulation, composite, expected_depth, median_depth
from pipelines.nerf.along_ray.samplers import sample_along, sample_fine
from pipelines.nerf.models.base import Appearance, Model, Outputs, StepPlan
from pipelines.nerf.networks.fourier import FourierFeatures
from pipelines.nerf.options.methods.nerf import NerfConfig
from pipelines.nerf.space.contraction import unit_from_scene
from pipelines.nerf.space.rays import Rays, RaySamples

DENSITY_SHIFT = -1.0
RESAMPLING_PADDING = 1e-5
"""Of the weights before the second round. Source: the published code of the paper."""


class NerfField(nn.Module):
    """Density and colour by one MLP over Fourier features of position and direction.

    The position enters again after layer L / 2 + 1 of L, the fifth of the paper's eight.
    Source: arXiv:2003.08934, section 5.1 and figure 7.
    """

    def __init__(self, config: NerfConfig) -> None:
        super().__init__()
        self.contraction = config.contraction
        # Positions lie in the unit cube, where a wave of exponent 0 goes round once; directions in
        # [-1, 1]^3, where one of exponent -1 does.
        self.position_encoding = FourierFeatures(
            3, config.position_frequencies, 0.0, config.position_frequencies - 1.0, True
        )
        self.direction_encoding = FourierFeatures(
            3, config.direction_frequencies, -1.0, config.direction_frequencies - 2.0, True
        )
        width, inputs = config.hidden_dim, self.position_encoding.num_outputs
        self.skip = config.num_layers // 2 + 1
        joined = {0: inputs, self.skip: width + inputs}
        self.layers = nn.ModuleList(
            nn.Linear(joined.get(index, width), width) for index in range(config.num_layers)
        )
        self.density_layer = nn.Linear(width, 1)
        self.feature_layer = nn.Linear(width, width)
        self.color_layer = nn.Linear(width + self.direction_encoding.num_outputs, width // 2)
        self.rgb_layer = nn.Linear(width // 2, 3)
        for module in self.modules():
            if isinstance(module, nn.Linear):  # PyTorch's own start fades over eight layers
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density [...] per scene unit and features [..., width] at scene points [..., 3].

        softplus(x - 1): the paper's ReLU learns nothing from a start where it is 0 everywhere.
        0 outside of [-1, 1]^3 where nothing contracts the world.
        Source: Mip-NeRF, arXiv:2103.13415, appendix A.
        """
        unit, inside = unit_from_scene(points, self.contraction)
        encoded = self.position_encoding(unit)
        hidden = encoded
        for index, layer in enumerate(self.layers):
            if index == self.skip:
                hidden = torch.cat([encoded, hidden], dim=-1)
            hidden = torch.relu_(layer(hidden))
        logits = self.density_layer(hidden).squeeze(-1)
        precise = logits if logits.dtype == torch.float64 else logits.float()
        density = torch.nn.functional.softplus(precise + DENSITY_SHIFT)
        return (density if inside is None else density * inside), hidden

    def color(self, directions: Tensor, hidden: Tensor) -> Tensor:
        """Colour [R, S, 3] in [0, 1] of directions [R, 3] and features [R, S, width]."""
        encoded = self.direction_encoding(directions)[:, None, :].expand(*hidden.shape[:-1], -1)
        features = torch.cat([self.feature_layer(hidden), encoded], dim=-1)
        return torch.sigmoid(self.rgb_layer(torch.relu_(self.color_layer(features))))


class Nerf(Model):
    """The model."""

    config: NerfConfig
    method = "nerf"

    def __init__(self, config: NerfConfig, num_train_images: int) -> None:
        super().__init__(config, num_train_images)
        self.config = config
        self.coarse = NerfField(config)
        self.fine = NerfField(config)

    def forward(
        self,
        rays: Rays,
        *,
        plan: StepPlan | None = None,
        appearance: Appearance = None,
        generator: torch.Generator | None = None,
    ) -> Outputs:
        """As `Model.forward`; the coarse colours are in `extra`, in training alone."""
        config = self.config
        rays = self.corrected(rays)
        coarse = sample_along(
            rays,
            config.num_coarse_samples,
            config.near,
            config.far,
            spacing=config.spacing,
            single_jitter=False,
            generator=generator,
        )
        density, hidden = self.coarse.density(coarse.positions(rays))
        coarse_weights = weights_from_density(density, coarse.t_edges)
        fine = sample_fine(
            rays,
            coarse,
            coarse_weights,
            config.num_fine_samples,
            config.near,
            config.far,
            spacing=config.spacing,
            padding=RESAMPLING_PADDING,
            single_jitter=False,
            generator=generator,
        )
        colors, weights = self._seen(self.fine, rays, fine)
        with torch.no_grad():
            median = median_depth(weights.detach(), fine.t_edges)
            expected = expected_depth(weights.detach(), fine.t_edges)
        outputs = Outputs(
            rgb=composite(colors, weights, config.background, generator=generator),
            accumulation=accumulation(weights),
            depth=median,
            expected_depth=expected,
            weights=[coarse_weights, weights],
            samples=[coarse, fine],
        )
        if self.training:
            colors = self.coarse.color(rays.directions, hidden)
            coarse_rgb = composite(colors, coarse_weights, config.background, generator=generator)
            outputs["extra"] = {"coarse_rgb": coarse_rgb}
        return outputs

    def _seen(self, field: NerfField, rays: Rays, samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Colours [R, S, 3] and weights [R, S]."""
        density, hidden = field.density(samples.positions(rays))
        return field.color(rays.directions, hidden), weights_from_density(density, samples.t_edges)

    def loss_dict(
        self, outputs: Outputs, truth: Tensor, *, plan: StepPlan | None = None
    ) -> dict[str, Tensor]:
        """As `Model.loss_dict`: both rounds' colours count alike. Source: the paper's eq. 6."""
        losses = {"rgb": color_loss(outputs["rgb"], truth)}
        if "extra" in outputs:
            losses["coarse"] = color_loss(outputs["extra"]["coarse_rgb"], truth)
        if self.config.camera_mode != "off":
            losses["camera"] = self.cameras_delta.penalty()
        return losses

    def density(self, points: Tensor) -> Tensor:
        """As `Model.density`, of the fine MLP."""
        return self.fine.density(points)[0]

    def bytes_per_ray(self) -> int:
        """As `Model.bytes_per_ray`: some five layers of the fine MLP are held at once."""
        config = self.config
        count = config.num_coarse_samples + config.num_fine_samples
        return count * 5 * 4 * max(config.hidden_dim, self.fine.position_encoding.num_outputs)
