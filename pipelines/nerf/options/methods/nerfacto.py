"""Options of Nerfacto. Defaults are the paper's as its authors ship it (nerfstudio 1.1.5); a
comment gives the reason for each departure."""

from __future__ import annotations

from dataclasses import dataclass, field

from pipelines.nerf.options.parts import (
    HashGridConfig,
    ModelConfig,
    bad_option,
    check_grid,
    check_spacing,
    contraction_option,
    option,
    spacing_option,
)
from pipelines.nerf.plugins import Method

MAX_GRID_VALUES = 2**30
BYTES_PER_VALUE = 16
"""In training: the value, its gradient and Adam's two moments, float32 each."""


@dataclass(frozen=True)
class ProposalConfig:
    """One proposal network: a small hash grid and a small MLP that give density."""

    grid: HashGridConfig = field(
        default_factory=lambda: HashGridConfig(
            num_levels=5, min_res=16, max_res=128, log2_table_size=17
        ),
        metadata={"help": "The network's hash grid."},
    )
    hidden_dim: int = option(16, "Width of the one hidden layer.", ge=1, le=256)


def _default_proposals() -> tuple[ProposalConfig, ...]:
    return (
        ProposalConfig(),
        ProposalConfig(
            grid=HashGridConfig(num_levels=5, min_res=16, max_res=256, log2_table_size=17)
        ),
    )


@dataclass(frozen=True)
class TensorGridConfig:
    """Position encodings other than the hash grid: CP, VM and the dense voxel grid."""

    resolution: int = option(
        128, "Vertices per side; of a voxel grid as many as memory allows.", ge=2, le=2048
    )
    num_components: int = option(16, "Components (CP, per mode of VM) or features.", ge=1, le=512)

    def check(self, path: str, encoding: str) -> None:
        """Raises NerfError `bad_config` where a grid of this encoding would not fit in memory."""
        most = self._finest(encoding)
        if self.resolution > most:
            gib = MAX_GRID_VALUES * BYTES_PER_VALUE // 2**30
            allowed = (
                f"at most {most} with {encoding} and {self.num_components} components, which take "
                f"{gib} GiB in training"
            )
            raise bad_option(f"{path}.resolution", self.resolution, allowed)

    def _finest(self, encoding: str) -> int:
        """The most vertices per side whose values are no more than `MAX_GRID_VALUES`."""
        share = MAX_GRID_VALUES // self.num_components
        if encoding == "voxel":  # N^3
            return max(n for n in range(2049) if n**3 <= share)
        if encoding == "vm":  # three planes of N^2 and three lines of N
            return max(n for n in range(2049) if 3 * (n * n + n) <= share)
        return 2048  # the lines of CP are short, other encodings have no such grid


@dataclass(frozen=True)
class NerfactoConfig(ModelConfig):
    """The paper's default method (section 5; defaults of nerfstudio 1.1.5)."""

    num_proposal_samples: tuple[int, ...] = option(
        (256, 96), "Samples per ray of each proposal round.", ge=1, le=4096
    )
    num_nerf_samples: int = option(48, "Samples per ray of the field.", ge=1, le=4096)
    proposals: tuple[ProposalConfig, ...] = field(
        default_factory=_default_proposals, metadata={"help": "The proposal networks."}
    )
    share_proposal_network: bool = option(False, "Use the first network in every round.")
    spacing: str = spacing_option()
    position_encoding: str = option(
        "hash",
        "What the field sees of a place.",
        choices=("hash", "vm", "cp", "voxel", "fourier"),
        plugins="position_encoding",
    )
    grid: HashGridConfig = field(
        default_factory=HashGridConfig, metadata={"help": "The field's hash grid."}
    )
    tensor_grid: TensorGridConfig = field(
        default_factory=TensorGridConfig,
        metadata={"help": "The field's grid where position_encoding is vm, cp or voxel."},
    )
    direction_encoding: str = option(
        "spherical_harmonics",
        "What the field sees of a direction.",
        choices=("spherical_harmonics", "fourier"),
        plugins="direction_encoding",
    )
    hidden_dim: int = option(64, "Width of the density MLP.", ge=1, le=1024)
    hidden_dim_color: int = option(64, "Width of the colour MLP.", ge=1, le=1024)
    geo_feature_dim: int = option(15, "Features from density to colour.", ge=1, le=256)
    appearance_dim: int = option(32, "Size of the per-image code; 0 for none.", ge=0, le=256)
    # The reference has none: there, no ray of training ever saw the mean code that renders use.
    appearance_dropout: float = option(
        0.25, "Share of training rays that see the mean code, as renders do.", ge=0.0, le=1.0
    )
    contraction: str = contraction_option()
    average_init_density: float = option(0.01, "Scale of density at the start.", ge=1e-6, le=1e3)
    single_jitter: bool = option(True, "One random offset per ray instead of one per sample.")
    interlevel_weight: float = option(1.0, "Weight of the interlevel loss.", ge=0.0, le=1e3)
    distortion_weight: float = option(0.002, "Weight of the distortion loss.", ge=0.0, le=1e3)
    predict_normals: bool = option(
        False,
        "Learn surface normals too, for callers of the library: no file of a job shows them. On a "
        "CPU a step takes about nine times as long.",
    )
    orientation_weight: float = option(1e-4, "Weight of the orientation loss.", ge=0.0, le=1e3)
    predicted_normal_weight: float = option(
        1e-3, "Weight of the predicted normals' loss.", ge=0.0, le=1e3
    )
    anneal_steps: int = option(1000, "Steps over which proposal weights sharpen.", ge=0, le=10**6)
    anneal_slope: float = option(
        10.0,
        "Slope of that sharpening at its start: 1 for a straight line, 0 for none before its end.",
        ge=0.0,
        le=1e3,
    )
    proposal_warmup_steps: int = option(
        5000, "Steps over which proposal updates become rarer.", ge=1, le=10**7
    )
    proposal_update_every: int = option(5, "Steps between proposal updates then.", ge=1, le=1000)

    def check(self, path: str) -> None:
        """As `ModelConfig.check`."""
        super().check(path)
        rounds, networks = len(self.num_proposal_samples), len(self.proposals)
        if rounds < 1 or networks < 1:
            raise bad_option(f"{path}.proposals", networks, "at least one network and one round")
        if networks < rounds and not self.share_proposal_network:
            allowed = (
                f"at least the {rounds} rounds of num_proposal_samples, or share_proposal_network"
            )
            raise bad_option(f"{path}.proposals", f"{networks} networks", allowed)
        check_grid(f"{path}.grid", self.grid)
        self.tensor_grid.check(f"{path}.tensor_grid", self.position_encoding)
        for index, proposal in enumerate(self.proposals):
            check_grid(f"{path}.proposals.{index}.grid", proposal.grid)
        check_spacing(path, self.spacing, self.near)


NERFACTO = Method(
    name="nerfacto",
    summary="The paper's default method: fast, unbounded, for real captures.",
    config=NerfactoConfig,
    model="pipelines.nerf.models.nerfacto:Nerfacto",
)
