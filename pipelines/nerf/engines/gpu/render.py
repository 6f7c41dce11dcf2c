"""Nerfacto in `eval()` for pictures on a GPU, leaving out what can hardly be seen.

Symbols: R rays, S samples, K samples that are coloured, A numbers of an appearance code. The same
samples and values as `Nerfacto.forward`, with grids read from float16 copies and networks that keep
their hidden layers on the chip (`hash_grid`, `mlp`), in large tiles:

- `early_stop`: the field is asked in two halves, near and far; rays whose transmittance fell below
  it in the near half are gathered out before the far one;
- `weight_threshold`: samples of at most this weight get no colour of their own; the colours of the
  ray's others are scaled up to stand for them;
- `samples`: fewer samples per round than the model was trained with.

Each colour channel changes by at most early_stop + S weight_threshold by the first two. Gathering
asks the device for two counts per tile, the only times that the host waits. Elsewhere than on a GPU
the plain parts are asked, which is how this file is tested.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.along_ray.rendering import expected_depth, median_depth
from pipelines.nerf.along_ray.samplers import sample_proposals
from pipelines.nerf.models.base import Appearance, Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.networks.fields import MLP, DensityField, density_from_logits
from pipelines.nerf.space.contraction import unit_from_scene
from pipelines.nerf.space.rays import Rays, RaySamples

TILE_BYTES, TILE_SHARE = 2 * 2**30, 8
"""What a tile may take: this, or one part in so many of the GPU's memory where that is more. With
the paper's samples an H100 draws tiles of 2 GiB in 0.80 s for 1080p, of 8 GiB in 0.60 s."""
BYTES_PER_FEATURE = 12
"""float32 features of a sample, their place in the next kernel's input, and as much again."""


class _Parts(NamedTuple):
    """What the device is best at: features [P, L F] of unit points, outputs of a network."""

    encode: Callable[[HashGrid, Tensor], Tensor]
    apply: Callable[[MLP, Tensor], Tensor]


def can_draw(model: Model) -> bool:
    """Whether the model is one this file knows: Nerfacto with hash grids, without normals."""
    return (
        isinstance(model, Nerfacto)
        and isinstance(model.field.grid, HashGrid)
        and model.normal_head is None
    )


class TileDrawer:
    """Draws tiles of rays of one model, whose weights are copied here as they are now.

    model: of `can_draw`, in `eval()`. appearance: as in `Model.forward`. samples: per round, the
    field's last, each at most what the model's options say; None for those of the model.
    memory_share: how much of the usual memory a tile may take.
    """

    def __init__(
        self,
        model: Nerfacto,
        *,
        appearance: Appearance = None,
        early_stop: float = 1e-3,
        weight_threshold: float = 1e-3,
        samples: tuple[int, ...] | None = None,
        memory_share: float = 1.0,
    ) -> None:
        config = model.config
        own = (*config.num_proposal_samples, config.num_nerf_samples)
        self._model, self._config, self._appearance = model, config, appearance
        self._early_stop, self._weight_threshold = early_stop, weight_threshold
        self._samples = own if samples is None else samples
        device = next(model.parameters()).device
        self._parts = _gpu_parts(model, device) if device.type == "cuda" else _plain_parts()
        grids = [model.field.grid, *(network.grid for network in model.proposals)]
        widest = max(count * grid.num_outputs for count in self._samples for grid in grids)
        budget = int(_tile_bytes(device) * memory_share)
        self.tile_rays = max(1024, budget // (BYTES_PER_FEATURE * widest))
        """Rays of one tile whose tensors fit the memory meant for them."""

    @torch.no_grad()
    def draw(self, rays: Rays) -> dict[str, Tensor]:
        """rgb [R, 3], accumulation [R], depth [R] and expected_depth [R] in scene units."""
        config = self._config
        final, _, _ = sample_proposals(
            rays,
            [self._density_of(network) for network in self._model.round_networks()],
            self._samples[:-1],
            self._samples[-1],
            config.near,
            config.far,
            spacing=config.spacing,
        )
        density, geometry = self._field(rays, final)
        weights = weights_from_density(density, final.t_edges)
        found = weights.sum(dim=-1)
        return {
            "rgb": self._colors(rays, weights, geometry),
            "accumulation": found,
            "depth": median_depth(weights, final.t_edges),
            "expected_depth": expected_depth(weights, final.t_edges),
        }

    def _density_of(self, network: nn.Module) -> Callable[[Tensor], Tensor]:
        assert isinstance(network, DensityField)
        known = network

        def density(points: Tensor) -> Tensor:
            unit, inside = unit_from_scene(points, known.contraction)
            logits = self._parts.apply(known.mlp, self._parts.encode(known.grid, unit))
            return density_from_logits(logits.squeeze(-1), inside, known.average_init_density)

        return density

    def _field(self, rays: Rays, samples: RaySamples) -> tuple[Tensor, Tensor]:
        """(density [R, S], geometry [R, S, G]); zeros behind where a ray has ended."""
        num_near = (samples.num_samples + 1) // 2
        near = RaySamples(samples.s_edges[:, : num_near + 1], samples.t_edges[:, : num_near + 1])
        far = RaySamples(samples.s_edges[:, num_near:], samples.t_edges[:, num_near:])
        density, geometry = self._asked(near.positions(rays))
        if far.num_samples == 0:
            return density, geometry
        if self._early_stop <= 0.0:
            more, more_geometry = self._asked(far.positions(rays))
            return torch.cat([density, more], 1), torch.cat([geometry, more_geometry], 1)
        thickness = (density * near.t_edges.diff(dim=-1)).nan_to_num().sum(dim=-1)
        (going,) = torch.nonzero(torch.exp(-thickness) > self._early_stop, as_tuple=True)
        left = RaySamples(far.s_edges[going], far.t_edges[going])
        more, more_geometry = self._asked(left.positions(rays.select(going)))
        shape = (len(rays), samples.num_samples)
        whole = density.new_zeros(shape)
        features = geometry.new_zeros(*shape, geometry.shape[-1])
        whole[:, :num_near], features[:, :num_near] = density, geometry
        whole[going, num_near:], features[going, num_near:] = more, more_geometry
        return whole, features

    def _asked(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The field's density [R, S] and geometry [R, S, G] at points [R, S, 3]."""
        field = self._model.field
        unit, inside = unit_from_scene(points, field.contraction)
        outputs = self._parts.apply(field.density_mlp, self._parts.encode(field.grid, unit))
        density = density_from_logits(outputs[..., 0], inside, field.average_init_density)
        return density, outputs[..., 1:]

    def _colors(self, rays: Rays, weights: Tensor, geometry: Tensor) -> Tensor:
        """Pixels [R, 3]: sums of the colours of the samples that count."""
        background = self._config.background
        missing = (1.0 - weights.sum(dim=-1)).clamp_min(0.0)
        shares = weights
        if background == "last_sample":
            shares = torch.cat([weights[:, :-1], (weights[:, -1] + missing)[:, None]], dim=-1)
        ray, sample = torch.nonzero(shares > self._weight_threshold, as_tuple=True)
        field = self._model.field
        parts = [field.direction_encoding(rays.directions)[ray], geometry[ray, sample]]
        codes = self._codes()
        if codes is not None:
            parts.append(codes.expand(len(ray), -1))
        colors = torch.sigmoid(self._parts.apply(field.color_mlp, torch.cat(parts, dim=-1)))
        share = shares[ray, sample]
        rgb = torch.zeros_like(rays.directions).index_add_(0, ray, share[:, None] * colors)
        kept = torch.zeros_like(missing).index_add_(0, ray, share)
        # What was left out looks like the rest of its ray.
        rgb = rgb * (shares.sum(dim=-1) / kept.clamp_min(1e-12)).clamp_min(1.0)[:, None]
        return rgb + missing[:, None] if background == "white" else rgb

    def _codes(self) -> Tensor | None:
        """The appearance code [A] to render with, or None without codes."""
        table = self._model.field.appearance
        if table is None:
            return None
        if isinstance(self._appearance, Tensor):
            return self._appearance
        if self._appearance is not None:
            return table.weight[self._appearance]
        return self._model.field.mean_code()


def _tile_bytes(device: torch.device) -> int:
    if device.type != "cuda":
        return TILE_BYTES
    return max(TILE_BYTES, torch.cuda.get_device_properties(device).total_memory // TILE_SHARE)


def _plain_parts() -> _Parts:
    return _Parts(lambda grid, unit: grid(unit), lambda network, values: network(values))


def _gpu_parts(model: Nerfacto, device: torch.device) -> _Parts:
    """Triton's grids on float16 copies of the tables, fused networks where there is room."""
    # Imported here: a machine without a GPU needs no Triton.
    from pipelines.nerf.engines.gpu.parts.hash_grid import hash_encode_triton
    from pipelines.nerf.engines.gpu.parts.mlp import fused_mlp, has_room, supports

    grids = [module for module in model.modules() if isinstance(module, HashGrid)]
    copies = {id(grid): grid.table.detach().half() for grid in grids}
    fuses = has_room(device)

    def encode(grid: HashGrid, unit: Tensor) -> Tensor:
        levels = (grid.resolutions, grid.dense, grid.offsets)
        return hash_encode_triton(unit, grid.table, *levels, lookup=copies[id(grid)])

    def apply(network: MLP, values: Tensor) -> Tensor:
        if fuses and supports(network.layers):
            return fused_mlp(values, network.layers)
        with torch.autocast("cuda", torch.float16):
            outputs: Tensor = network(values)
        return outputs.float()

    return _Parts(encode, apply)
