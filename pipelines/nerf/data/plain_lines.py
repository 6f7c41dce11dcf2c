"""Lines of pixels on plain surfaces as a term of the loss.

Which pixels: `PixelSampler.draw_batch`. What is asked of them: `along_ray.losses.bend_loss`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.nerf.along_ray.losses import bend_loss
from pipelines.nerf.data.depth_maps import DepthMaps
from pipelines.nerf.models.base import Outputs
from pipelines.nerf.options.train import FlatLossConfig, TrainConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.rays import Rays

PER_LINE = 4
"""Rays on a line."""
_RAMP_SHARE = 0.2
"""Of the run, until the whole weight counts: there are no surfaces yet that could bend."""


@dataclass(frozen=True)
class PlainLines:
    """How many rays of a step lie on lines, and what their bends weigh."""

    config: FlatLossConfig
    max_steps: int

    @classmethod
    def of(cls, config: TrainConfig) -> PlainLines | None:
        """Those of a run; None unless its options want them always."""
        wanted = config.flat.when == "always" and config.flat.weight > 0.0
        return cls(config.flat, config.max_steps) if wanted else None

    def count(self, num_rays: int) -> int:
        """Lines among so many rays."""
        return int(num_rays * self.config.share / PER_LINE)

    def weight(self, step: int) -> float:
        """What bends weigh in a step."""
        return self.config.weight * min(1.0, step / (_RAMP_SHARE * self.max_steps))

    def loss(
        self,
        outputs: Outputs,
        rays: Rays,
        cameras: Cameras,
        plain: Tensor,
        weight: float | Tensor,
        maps: DepthMaps | None = None,
    ) -> Tensor | None:
        """The weighted term of a step; None without lines, and for methods whose rays have no
        common samples.

        rays: of a batch of `PixelSampler.draw_batch`, plain: [L] of it. weight: of `weight`. maps:
        where they know both inner rays of a line, it is left out: nobody need guess there.
        """
        num_rays = PER_LINE * len(plain)
        if not outputs["weights"] or num_rays == 0:
            return None
        found, edges = outputs["weights"][-1], outputs["samples"][-1].t_edges
        turn = cameras.scene_from_camera[rays.camera_indices[:num_rays], :, :3]
        local = torch.einsum("rij,ri->rj", turn, rays.directions[:num_rays])
        if maps is not None:
            plain = torch.where(are_known(maps.distances(rays, cameras)[:num_rays]), 0.0, plain)
        given = found[:num_rays], edges[:num_rays], local, plain
        return weight * bend_loss(*given, self.config.curve, self.config.limit)


def are_known(distances: Tensor) -> Tensor:
    """[L] bool: whether maps know both inner rays of a line. distances: [4 L], 0 where unknown."""
    known: Tensor = (distances.reshape(PER_LINE, -1)[1:-1] > 0.0).all(dim=0)
    return known
