"""Every option of dense stereo and its default, once; no torch.

Where the defaults come from: docs/surfaces-experiments.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.nerf.options.parts import option


@dataclass(frozen=True)
class StereoConfig:
    """Depth maps from neighbouring pictures by plane sweep."""

    long_side_px: int = option(
        320, "Long side of the pictures that are compared.", unit="px", ge=64, le=4096
    )
    num_planes: int = option(128, "Depths tried per pixel, even in inverse depth.", ge=16, le=1024)
    num_neighbours: int = option(8, "Pictures that each one is compared with.", ge=1, le=32)
    window_radius: int = option(
        3, "Half the side of the compared squares, without their middle.", unit="px", ge=1, le=15
    )
    smooth_small: float = option(
        0.3, "Cost of a step to the next depth between two pixels.", ge=0.0, le=100.0
    )
    smooth_large: float = option(
        5.0, "Cost of a jump in depth where the picture is plain.", ge=0.0, le=1000.0
    )
    edge_scale: float = option(
        0.05,
        "Brightness step, in [0, 1], that makes a jump in depth e times cheaper.",
        ge=1e-3,
        le=10.0,
    )
    best_angle_deg: float = option(
        6.0, "Angle between two views of a point that is liked best.", unit="degrees", ge=0.5, le=45
    )
    min_agreeing: int = option(
        2, "Neighbours whose own depth must agree for a depth to be kept.", ge=0, le=32
    )
    agree_within: float = option(
        0.02, "Relative difference in depth up to which two views agree.", ge=1e-4, le=0.5
    )
    find_sky: bool = option(
        True,
        "Tell the sky from what stands before it, where it is blue or burnt out, photos were "
        "exposed for daylight, or things before a far background are seen against it: it has no "
        "depth, and training lets light through there.",
    )
    find_dark: bool = option(
        True,
        "Tell the dark from what stands before it, where black and plain is a good part of the "
        "pictures, as before black cloth: it has no depth where no lit surface lies, and training "
        "lets light through there.",
    )
    find_blank: bool = option(
        True,
        "Tell the blank ground of pictures that a thing was cut out of, of one colour or "
        "transparent, or the burnt-out paper of a light tent, from the thing: it has no depth, and "
        "training lets light through there.",
    )
    complete_planes: bool = option(
        True,
        "Lay patches of even brightness on the planes that all views together show, where at least "
        "half of what is known of a patch is on one and other views do not see through it.",
    )
    level_light: str = option(
        "auto",
        "Bring all pictures to one exposure and white balance before anything learns their "
        "colours. auto does where surfaces that pictures share show that the light drifts.",
        choices=("auto", "on", "off"),
    )
    device: str = option(
        "auto",
        "Where pictures are compared: on a GPU with PyTorch, or on the CPU. Depths differ by "
        "rounding. auto takes a GPU that gives the CPU's values.",
        choices=("auto", "cpu", "cuda"),
    )
    standing_walls: bool = option(
        True,
        "Lay patches of even brightness on upright planes where they meet a floor along a line "
        "that several views see in the same place, and other views agree; and where neighbours see "
        "such a wall.",
    )
    hanging_fronts: bool = option(
        True,
        "Lay patches of even brightness on the upright plane below the near edge of a level "
        "surface, as of a chest's top, where lines on it are seen in the same place by several "
        "views. Part of standing_walls.",
    )
    level_tops: bool = option(
        True,
        "Lay plain table tops at the height of their rims: patches of even brightness, of which "
        "half of what is known lies at one height above a level plane, in several views. Part of "
        "complete_planes.",
    )
