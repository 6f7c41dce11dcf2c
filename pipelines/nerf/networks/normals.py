"""Surface normals: from the density's gradient, and predicted by a small network.

Symbols: g the gradient of the density logit (the logarithm of the density up to a constant) with
respect to a scene point; n = -g / |g|, which points out of the dense side. The gradient is taken
through the contraction, so normals are in scene axes everywhere. The reference implementation takes
it in contracted space instead: inside the unit cube that is the same direction, outside it is
tilted, because the L-infinity contraction shrinks the radial axis 2 m - 1 times as much as the
others at distance m. What the loss does with normals is left to `losses`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from pipelines.nerf.networks.fourier import FourierFeatures
from pipelines.nerf.space.vectors import unit_vectors

PREDICTED_FREQUENCIES = 2


def normals_from_density_gradient(gradient: Tensor) -> Tensor:
    """-g / |g|: out of the dense side. [..., 3] to unit [..., 3]; 0 where the gradient is 0.

    Source: Ref-NeRF, arXiv:2112.03907, section 4 (normals of the density).
    """
    return -unit_vectors(gradient)


def normals_of_logits(logits: Tensor, points: Tensor, *, create_graph: bool) -> Tensor:
    """Normals of logits that were just computed: no second pass through the network.

    logits: [...], each a function of its own point alone. points: [..., 3] scene units, requires
        grad, and what the logits were computed from.
    create_graph: keep what a loss on the normals needs; without it the normals are constants. The
        graph of the logits stays usable in both cases.
    Returns unit [..., 3] in scene axes; 0 where the density is flat.
    """
    gradient = torch.autograd.grad(
        logits.sum(), points, create_graph=create_graph, retain_graph=True
    )[0]
    return normals_from_density_gradient(gradient)


def density_normals(
    density_function: Callable[[Tensor], Tensor], points: Tensor, create_graph: bool
) -> Tensor:
    """Normals of a density field at scene points.

    density_function: scene points [..., 3] to logits [...], contraction included. A density serves
        as well: any increasing function of it has the same normals.
    points: [..., 3], scene units; taken as constants, so a loss on normals moves no camera.
    create_graph: for training: lets a gradient pass from the normals to the parameters of the
        function, which therefore must be differentiable twice (`HashGrid.encode`).
    Returns unit [..., 3] in scene axes; 0 where the density is flat. Works under `torch.no_grad()`.
    """
    with torch.inference_mode(False), torch.enable_grad():
        seen = points.detach().clone().requires_grad_()
        normals = normals_of_logits(density_function(seen), seen, create_graph=create_graph)
    return normals if create_graph else normals.detach()


class PredictedNormals(nn.Module):
    """Normals from place and geometry features by a small network: smoother than the gradient's.

    num_geometry_features: G. hidden_dim: width of the two hidden layers. The reference
    implementation puts a fourth linear layer right behind the third: no more than one can do.
    Source: Ref-NeRF, arXiv:2112.03907, section 4; Nerfacto, arXiv:2302.04264, section 5.
    """

    def __init__(self, num_geometry_features: int, hidden_dim: int = 64) -> None:
        super().__init__()
        self.position = FourierFeatures(
            3, PREDICTED_FREQUENCIES, 0.0, PREDICTED_FREQUENCIES - 1.0, include_input=True
        )
        self.layers = nn.Sequential(
            nn.Linear(self.position.num_outputs + num_geometry_features, hidden_dim),
            nn.ReLU(),
            nn.Linear(hidden_dim, hidden_dim),
            nn.ReLU(),
            nn.Linear(hidden_dim, 3),
        )

    def forward(self, unit_points: Tensor, geometry: Tensor) -> Tensor:
        """Unit normals [..., 3] in scene axes.

        unit_points: [..., 3] in [0, 1]. geometry: [..., G], the density network's features.
        """
        features = torch.cat([self.position(unit_points), geometry], dim=-1)
        # Mixed precision computes the layers in half, which is too coarse for a direction.
        raw = self.layers(features).to(unit_points.dtype)
        return unit_vectors(torch.tanh(raw))
