"""Every option of the evaluation and its default, once; no torch, as `config`.

The protocols that they make up are described in docs/evaluation.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pipelines.nerf.options.parts import option
from pipelines.nerf.options.render import RenderConfig


@dataclass(frozen=True)
class TestTimeConfig:
    """The test-time procedure: Adam on each held-out camera's pose, then on its code.

    The paper (arXiv:2302.04264, section on ablations) gives the order and the optimiser, neither
    rates nor steps: the rates of the poses are those of training, the rest was found on toy scenes.
    """

    pose_steps: int = option(200, "Steps on each pose.", unit="steps", ge=1, le=10**6)
    pose_lr: float = option(1e-3, "Rate of the poses at the start.", ge=1e-8, le=1.0)
    pose_lr_final: float = option(1e-4, "Rate of the poses at the end.", ge=1e-9, le=1.0)
    pose_mode: str = option("so3xr3", "How a pose is changed.", choices=("so3xr3", "se3"))
    appearance_steps: int = option(100, "Steps on each code.", unit="steps", ge=1, le=10**6)
    # Codes that were trained from near zero lie about 0.2 apart: faster, they leave that range.
    appearance_lr: float = option(3e-2, "Rate of the codes at the start.", ge=1e-8, le=10.0)
    appearance_lr_final: float = option(3e-3, "Rate of the codes at the end.", ge=1e-9, le=10.0)
    rays_per_step: int = option(1024, "Random pixels of one image per step.", ge=1, le=2**20)


@dataclass(frozen=True)
class EvaluateConfig:
    """Held-out metrics."""

    max_images: int = option(
        0, "Held-out images measured, evenly picked; 0 for all.", ge=0, le=100_000
    )
    fit_poses: bool = option(
        False, "Fit the held-out cameras' poses to their images before measuring."
    )
    fit_appearance: bool = option(
        False,
        "Fit each held-out image's appearance code to its left or right half before measuring; "
        "without effect on a model without codes.",
    )
    test_time: TestTimeConfig = field(
        default_factory=TestTimeConfig, metadata={"help": "How those fits are done."}
    )
    lpips_backbone: str = option("alex", "Network of LPIPS.", choices=("alex", "vgg"))
    floaters: bool = option(True, "Measure floaters on renders off the path.")
    floater_views: int = option(4, "Off-path views rendered for it.", ge=2, le=1000)
    floater_long_side_px: int = option(64, "Long side of those renders.", unit="px", ge=16, le=4096)
    render: RenderConfig = field(
        default_factory=RenderConfig,
        metadata={"help": "What rendering leaves out; as in the stages whose pictures it judges."},
    )
