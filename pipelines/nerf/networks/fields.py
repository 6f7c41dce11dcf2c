"""The networks: what stands at a place, and what colour it shows in a direction.

Symbols: R rays, S samples, P any leading shape of points; G geometry features, A appearance code.
Points arrive in scene space and are contracted here. The parameter layout is described in
README.md; `engines/cpu/` reads it. Wiring is left to `models`.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from pipelines.nerf.networks.encodings import HashGrid, SphericalHarmonics
from pipelines.nerf.networks.fourier import FourierFeatures
from pipelines.nerf.networks.tensor_grids import CPEncoding, VMEncoding, VoxelGrid
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.plugins import plugin_components
from pipelines.nerf.space.contraction import unit_from_scene

GRADIENT_CLAMP = 15.0
APPEARANCE_INIT = 0.01
"""Spread of the codes at the start: images differ where the data asks for it, not by chance."""
POSITION_FREQUENCIES, DIRECTION_FREQUENCIES = 10, 4
"""Waves of the Fourier encodings. Source: NeRF, arXiv:2003.08934, section 5.1."""

Encoding = Any
"""An `nn.Module` from points or directions [..., 3] to features [..., `num_outputs`]."""
EncodingBuilder = Callable[[NerfactoConfig], Encoding]

POSITION_ENCODINGS: dict[str, EncodingBuilder] = {
    "hash": lambda config: HashGrid(config.grid),
    "vm": lambda config: VMEncoding(
        config.tensor_grid.resolution, config.tensor_grid.num_components
    ),
    "cp": lambda config: CPEncoding(
        config.tensor_grid.resolution, config.tensor_grid.num_components
    ),
    "voxel": lambda config: VoxelGrid(
        config.tensor_grid.resolution, config.tensor_grid.num_components
    ),
    "fourier": lambda config: FourierFeatures(
        3, POSITION_FREQUENCIES, 0.0, POSITION_FREQUENCIES - 1.0, include_input=True
    ),
}
DIRECTION_ENCODINGS: dict[str, EncodingBuilder] = {
    "spherical_harmonics": lambda config: SphericalHarmonics(),
    # Directions span [-1, 1] and waves are counted per unit interval: from half a wave on.
    "fourier": lambda config: FourierFeatures(
        3, DIRECTION_FREQUENCIES, -1.0, DIRECTION_FREQUENCIES - 2.0, include_input=True
    ),
}


def _encoding(kind: str, built_in: dict[str, EncodingBuilder], config: NerfactoConfig) -> Encoding:
    """The encoding that the option of this kind names, a plugin's too."""
    return (built_in | plugin_components(kind))[getattr(config, kind)](config)


class _TruncatedExp(torch.autograd.Function):
    """exp whose gradient is bounded: a density of e^20 must not blow up the step."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        ctx.save_for_backward(logits)
        return torch.exp(logits)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (logits,) = ctx.saved_tensors
        return gradients[0] * torch.exp(logits.clamp(-GRADIENT_CLAMP, GRADIENT_CLAMP))


def truncated_exp(logits: Tensor) -> Tensor:
    """exp(x), with exp(clamp(x, -15, 15)) as its derivative. In float32, any shape."""
    precise = logits if logits.dtype == torch.float64 else logits.float()
    result: Tensor = _TruncatedExp.apply(precise)  # type: ignore[no-untyped-call]
    return result


class MLP(nn.Module):
    """Linear layers with ReLU between them and none behind the last.

    widths: (inputs, hidden..., outputs).
    """

    def __init__(self, *widths: int) -> None:
        super().__init__()
        pairs = pairwise(widths)
        self.layers = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in pairs)

    def forward(self, values: Tensor) -> Tensor:
        """[..., inputs] to [..., outputs]."""
        return self.tail(self.layers[0](values))

    def tail(self, values: Tensor) -> Tensor:
        """All that follows the first linear layer, whose outputs are given."""
        for layer in self.layers[1:]:
            values = layer(torch.relu_(values))
        return values


class DensityField(nn.Module):
    """A proposal network: hash grid, one hidden layer, density."""

    def __init__(
        self, config: ProposalConfig, *, contraction: str, average_init_density: float
    ) -> None:
        super().__init__()
        self.contraction = contraction
        self.average_init_density = average_init_density
        self.grid = HashGrid(config.grid)
        self.mlp = MLP(self.grid.num_outputs, config.hidden_dim, 1)

    def forward(self, points: Tensor) -> Tensor:
        """Density [...] per scene unit at points [..., 3] in scene space."""
        unit, inside = unit_from_scene(points, self.contraction)
        logits = self.mlp(self.grid(unit)).squeeze(-1)
        return density_from_logits(logits, inside, self.average_init_density)


def density_from_logits(logits: Tensor, inside: Tensor | None, scale: float) -> Tensor:
    """scale * exp(logit), 0 where not inside. [...] per scene unit."""
    density = scale * truncated_exp(logits)
    return density if inside is None else density * inside


class NerfactoField(nn.Module):
    """Density and colour of the scene.

    num_images: training images, one appearance code each (where the config wants codes).
    """

    def __init__(self, config: NerfactoConfig, num_images: int) -> None:
        super().__init__()
        self.contraction = config.contraction
        self.average_init_density = config.average_init_density
        self.geo_feature_dim = config.geo_feature_dim
        self.grid: Encoding = _encoding("position_encoding", POSITION_ENCODINGS, config)
        features = self.grid.num_outputs
        self.density_mlp = MLP(features, config.hidden_dim, 1 + config.geo_feature_dim)
        self.direction_encoding: Encoding = _encoding(
            "direction_encoding", DIRECTION_ENCODINGS, config
        )
        self.num_direction_features = self.direction_encoding.num_outputs
        inputs = self.num_direction_features + config.geo_feature_dim + config.appearance_dim
        self.color_mlp = MLP(inputs, config.hidden_dim_color, config.hidden_dim_color, 3)
        self.appearance: nn.Embedding | None = None
        if config.appearance_dim:
            self.appearance = nn.Embedding(num_images, config.appearance_dim)
            nn.init.normal_(self.appearance.weight, std=APPEARANCE_INIT)

    @property
    def hash_grid(self) -> HashGrid | None:
        """The position encoding where it is a hash grid, which is all that kernels know."""
        return self.grid if isinstance(self.grid, HashGrid) else None

    def unit(self, points: Tensor) -> Tensor:
        """What the encoding sees of scene points [..., 3]: points [..., 3] in [0, 1]^3."""
        return unit_from_scene(points, self.contraction)[0]

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density [...] per scene unit and geometry features [..., G] at scene points [..., 3]."""
        unit, inside = unit_from_scene(points, self.contraction)
        outputs = self.density_mlp(self.grid(unit))
        density = density_from_logits(outputs[..., 0], inside, self.average_init_density)
        return density, outputs[..., 1:]

    def logits(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The logarithm [...] of the density, up to a constant and whether or not inside the unit
        cube, and geometry features [..., G] at scene points [..., 3]."""
        outputs = self.density_mlp(self.grid(self.unit(points)))
        return outputs[..., 0], outputs[..., 1:]

    def color(self, directions: Tensor, geometry: Tensor, codes: Tensor | None) -> Tensor:
        """Colour [R, S, 3] in [0, 1].

        directions: [R, 3], unit. geometry: [R, S, G] from `density`. codes: [R, A] or None.
        The first layer's products with direction and code are the same for all samples of a ray,
        so they are taken once per ray; the sum is that of the whole layer.
        """
        first = self.color_mlp.layers[0]
        assert isinstance(first, nn.Linear)
        start = self.num_direction_features
        stop = start + self.geo_feature_dim
        per_ray = torch.nn.functional.linear(
            self.direction_encoding(directions), first.weight[:, :start], first.bias
        )
        if codes is not None:
            per_ray = per_ray + torch.nn.functional.linear(codes, first.weight[:, stop:])
        hidden = torch.nn.functional.linear(geometry, first.weight[:, start:stop])
        return torch.sigmoid(self.color_mlp.tail(hidden + per_ray[:, None, :]))

    def codes(self, camera_indices: Tensor) -> Tensor | None:
        """The appearance codes [R, A] of training images, or None where there are none."""
        if self.appearance is None:
            return None
        # The gradient of an embedding sorts on a GPU; that of `index_select` adds.
        return self.appearance.weight.index_select(0, camera_indices)

    def mean_code(self) -> Tensor | None:
        """The mean code [A] of all training images: how the scene looks by default."""
        return None if self.appearance is None else self.appearance.weight.mean(dim=0)
