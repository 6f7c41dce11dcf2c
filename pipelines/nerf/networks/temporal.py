"""Temporal distortion: where a moving scene's point was in the canonical frame.

Symbols: R rays, S samples, x a scene point, t a time in [0, 1]; the canonical frame is the scene at
t = 0. A field of a still scene is asked at x + offset(x, t). Reading times is left to `data`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.fourier import FourierFeatures
from pipelines.nerf.space.contraction import unit_from_scene


class TemporalDistortion(nn.Module):
    """Offset of a point at a time: a network on Fourier features of both.

    num_layers: linear layers, the last one included, >= 2. hidden_dim: their width.
    num_frequencies: of place and of time, exponents 0 to num_frequencies - 1.
    contraction: how scene points become the network's unit points, one of `CONTRACTIONS`.
    The last layer starts at zero, so that the scene starts out still.
    Source: D-NeRF, arXiv:2011.13961 (deformation network), which takes 8 layers; the default of 4
    is the reference implementation's.
    """

    def __init__(
        self,
        *,
        num_layers: int = 4,
        hidden_dim: int = 256,
        num_frequencies: int = 10,
        contraction: str = "none",
    ) -> None:
        super().__init__()
        if num_layers < 2 or hidden_dim < 1:
            raise NerfError(
                "bad_config",
                f"A temporal distortion of {num_layers} layers of width {hidden_dim} cannot move "
                "points.",
                "Give at least 2 layers of width 1.",
            )
        self.contraction = contraction
        top = num_frequencies - 1.0
        self.place = FourierFeatures(3, num_frequencies, 0.0, top, include_input=True)
        self.time = FourierFeatures(1, num_frequencies, 0.0, top, include_input=True)
        inputs = self.place.num_outputs + self.time.num_outputs
        layers: list[nn.Module] = []
        for _ in range(num_layers - 1):
            layers += [nn.Linear(inputs, hidden_dim), nn.ReLU()]
            inputs = hidden_dim
        last = nn.Linear(inputs, 3)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)

    def forward(self, points: Tensor, times: Tensor) -> Tensor:
        """What to add to each point to find it in the canonical frame.

        points: [R, S, 3], scene units. times: [R] in [0, 1].
        Returns [R, S, 3], scene units; exactly 0 for rays at t = 0.
        """
        unit, _ = unit_from_scene(points, self.contraction)
        time_features = self.time(times[:, None])[:, None, :].expand(-1, points.shape[1], -1)
        offsets = self.layers(torch.cat([self.place(unit), time_features], dim=-1))
        # By definition, not by learning: else the canonical frame could drift by any fixed motion.
        return torch.where((times == 0.0)[:, None, None], 0.0, offsets)
