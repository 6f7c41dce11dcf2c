"""Every option of rendering and its default, once; no torch, as `config`.

Each option leaves out work that can hardly be seen; what each gains and costs is in README.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.nerf.options.parts import option


@dataclass(frozen=True)
class RenderConfig:
    """What rendering may leave out: nothing with 0 for the cells and all thresholds."""

    baked_cells: int = option(
        128,
        "Cells per side of a grid that answers for the first proposal network; 0 asks the network.",
        ge=0,
        le=512,
    )
    skip_below: float = option(
        1e-3,
        "Samples whose interval holds at most this weight by the round before are not looked at.",
        ge=0.0,
        le=0.5,
    )
    early_stop: float = option(
        1e-3, "Samples that at most this share of the light reaches are left out.", ge=0.0, le=0.5
    )
    color_weight: float = option(
        0.03,
        "Neighbouring samples share a colour until they weigh more than this together.",
        ge=0.0,
        le=1.0,
    )
    block_px: int = option(
        4, "Side of the squares of pixels that are rendered together; 1 for rows.", ge=1, le=64
    )
    weight_threshold: float = option(
        1e-3,
        "On a GPU, in place of color_weight: samples of at most this weight get no colour.",
        ge=0.0,
        le=0.5,
    )


ALL_SAMPLES = RenderConfig(
    baked_cells=0, skip_below=0.0, early_stop=0.0, color_weight=0.0, weight_threshold=0.0
)
"""The model itself, to rounding."""
