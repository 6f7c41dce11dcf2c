"""Options of Instant-NGP.

Defaults are for the captures of a job: unbounded, cameras in [-1, 1]^3. The settings of the
paper's bounded scenes are named in the class.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pipelines.nerf.options.parts import (
    HashGridConfig,
    ModelConfig,
    check_grid,
    contraction_option,
    option,
)
from pipelines.nerf.plugins import Method


@dataclass(frozen=True)
class InstantNgpConfig(ModelConfig):
    """Instant-NGP (arXiv:2201.05989): a hash grid, marched through where a grid says it is full.

    The paper's synthetic scenes: contraction none, num_cascades 1, cone_angle 0, alpha_threshold 0,
    background white. Of contraction and cascades: with a contraction the hash grid sees contracted
    space; without one it spans the outermost cascade.
    """

    background: str = option(
        "random",
        "Colour behind the last sample.",
        choices=("last_sample", "black", "white", "random"),
    )
    camera_mode: str = option("off", "Camera optimisation.", choices=("off", "so3xr3", "se3"))
    grid: HashGridConfig = field(
        default_factory=HashGridConfig, metadata={"help": "The field's hash grid."}
    )
    hidden_dim: int = option(64, "Width of the density MLP.", ge=1, le=1024)
    hidden_dim_color: int = option(64, "Width of the colour MLP.", ge=1, le=1024)
    geo_feature_dim: int = option(15, "Features from density to colour.", ge=1, le=256)
    contraction: str = contraction_option()
    average_init_density: float = option(1.0, "Scale of density at the start.", ge=1e-6, le=1e3)
    num_cascades: int = option(
        4, "Occupancy grids, the first over [-1, 1]^3, each twice as wide as the last.", ge=1, le=10
    )
    occupancy_resolution: int = option(128, "Cells per side of each of them.", ge=4, le=512)
    occupancy_decay: float = option(
        0.95, "What is left of a cell's density at an update.", ge=0.0, le=1.0
    )
    occupancy_threshold: float = option(
        0.01, "Full cells stop more than this share of light in one step.", ge=0.0, le=0.99
    )
    occupancy_update_every: int = option(
        16, "Steps between updates.", unit="steps", ge=1, le=10_000
    )
    occupancy_warmup_steps: int = option(
        256, "Until this step an update looks at every cell.", unit="steps", ge=0, le=10**7
    )
    num_steps: int = option(
        1024, "Steps along the diagonal of [-1, 1]^3, of equal length.", ge=8, le=65536
    )
    cone_angle: float = option(
        1 / 256,
        "Share of the distance that a step is long, where that is longer; 0 for equal steps.",
        ge=0.0,
        le=1.0,
    )
    alpha_threshold: float = option(
        0.01, "Samples that stop a smaller share of light are left out.", ge=0.0, le=1.0
    )
    early_stop: float = option(
        1e-4, "Samples that less light than this reaches are left out.", ge=0.0, le=1.0
    )
    max_samples: int = option(
        2**18, "Most samples of a training step; rays beyond them wait.", ge=256, le=2**28
    )

    samples_per_step: int = option(
        0,
        "As many rays a step as bring about so many samples that light reaches; 0 for "
        "rays_per_step at any number of samples.",
        ge=0,
        le=2**28,
    )

    def check(self, path: str) -> None:
        """As `ModelConfig.check`."""
        super().check(path)
        check_grid(f"{path}.grid", self.grid)


INSTANT_NGP = Method(
    name="instant-ngp",
    summary="A hash grid and an occupancy grid; fast, best for objects and rooms.",
    config=InstantNgpConfig,
    model="pipelines.nerf.models.instant_ngp:InstantNgp",
    # Its rays have no common samples, so that bends of lines cannot be told.
    train={"flat": {"when": "never"}},
)
