"""Options of the original NeRF.

Defaults are for the captures of a job: unbounded, cameras in [-1, 1]^3. The settings of the
paper's bounded scenes are named in the class.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.nerf.options.parts import (
    ModelConfig,
    check_spacing,
    contraction_option,
    option,
    spacing_option,
)
from pipelines.nerf.plugins import Method


@dataclass(frozen=True)
class NerfConfig(ModelConfig):
    """NeRF (arXiv:2003.08934): two MLPs over Fourier features, 64 and 128 samples a ray.

    The paper's synthetic scenes: contraction none, spacing uniform, background white, near and far
    of the scene.
    """

    camera_mode: str = option("off", "Camera optimisation.", choices=("off", "so3xr3", "se3"))
    num_coarse_samples: int = option(64, "Samples per ray of the coarse MLP.", ge=1, le=4096)
    num_fine_samples: int = option(
        128, "Samples per ray that the fine MLP has more.", ge=1, le=4096
    )
    spacing: str = spacing_option()
    contraction: str = contraction_option()
    position_frequencies: int = option(10, "Waves per axis of a position.", ge=1, le=24)
    direction_frequencies: int = option(4, "Waves per axis of a direction.", ge=1, le=16)
    num_layers: int = option(8, "Hidden layers before density.", ge=1, le=32)
    hidden_dim: int = option(256, "Their width.", ge=2, le=4096)

    def check(self, path: str) -> None:
        """As `ModelConfig.check`."""
        super().check(path)
        check_spacing(path, self.spacing, self.near)


NERF = Method(
    name="nerf",
    summary="The original: two large MLPs; slow, small files.",
    config=NerfConfig,
    model="pipelines.nerf.models.nerf:Nerf",
    # The paper's Adam; 1,024 rays are those of its published code, whose memory a step needs.
    train={
        "max_steps": 200_000,
        "rays_per_step": 1024,
        "optimizer": {"lr": 5e-4, "lr_final": 5e-5, "decay_steps": 200_000, "eps": 1e-7},
    },
)
