"""What the options of every method are made of; `config` and `config_methods` build on it.

Plain dataclasses, no torch. Everybody else imports these names from `config`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pipelines.nerf.errors import NerfError
from pipelines.nerf.plugins import plugin_components


def option(default: Any, help: str, **bounds: Any) -> Any:
    """A dataclass field with its meaning; `bounds`: unit, ge, le, choices, plugins, former.

    former: names that older versions had for some of the choices, as stored jobs still say them.
    """
    return field(default=default, metadata={"help": help, **bounds})


def allowed_names(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """The names an option may have, those of plugins included; empty where any value may be."""
    choices = metadata.get("choices", ())
    extra = plugin_components(metadata["plugins"], choices) if "plugins" in metadata else {}
    return (*choices, *extra)


def spacing_option() -> Any:
    """How samples are spread along a ray."""
    return option(
        "piecewise",
        "How the first round's samples are spread between near and far.",
        choices=("piecewise", "uniform", "disparity"),
        plugins="spacing",
    )


def contraction_option() -> Any:
    """What is done about a world without bounds."""
    return option(
        "linf",
        "How unbounded space is bounded.",
        choices=("linf", "l2", "none"),
        plugins="contraction",
    )


@dataclass(frozen=True)
class HashGridConfig:
    """A multi-resolution hash grid (Instant-NGP, arXiv:2201.05989)."""

    num_levels: int = option(16, "Number of resolution levels.", ge=1, le=32)
    min_res: int = option(16, "Cells per side of the coarsest level.", ge=2, le=1024)
    max_res: int = option(2048, "Cells per side of the finest level.", ge=2, le=65536)
    log2_table_size: int = option(19, "log2 of the entries per level.", ge=8, le=24)
    features_per_level: int = option(
        2,
        "Features per entry. A CPU has kernels for 2 alone and trains others several times slower.",
        ge=1,
        le=8,
    )
    start_levels: int = option(
        0, "Levels learned from the first step on, the coarsest ones; 0 for all.", ge=0, le=32
    )
    steps_per_level: int = option(
        50, "Then one level more after every so many steps.", unit="steps", ge=1, le=10**6
    )


@dataclass(frozen=True)
class ModelConfig:
    """What every method has: where rays begin and end, and how cameras are corrected."""

    near: float = option(0.05, "Nearest sample.", unit="scene units", ge=0.0, le=10.0)
    far: float = option(1000.0, "Farthest sample.", unit="scene units", ge=1.0, le=1e6)
    background: str = option(
        "last_sample",
        "Colour behind the last sample.",
        choices=("last_sample", "black", "white", "random"),
    )
    camera_mode: str = option("so3xr3", "Camera optimisation.", choices=("off", "so3xr3", "se3"))
    camera_translation_penalty: float = option(1e-2, "Weight on moved cameras.", ge=0.0, le=1e3)
    camera_rotation_penalty: float = option(1e-3, "Weight on turned cameras.", ge=0.0, le=1e3)
    half_tables: bool = option(
        False, "Keep the tables of hash grids in half precision in `model.zip`: half its size."
    )

    def check(self, path: str) -> None:
        """Check options against each other; bounds and names are checked already.

        path: the dotted name of this config, for messages. Raises NerfError `bad_config`.
        """
        if self.near >= self.far:
            raise bad_option(f"{path}.near", self.near, f"less than far ({self.far})")


def check_grid(path: str, grid: HashGridConfig) -> None:
    """Raises NerfError `bad_config` where the finest level is coarser than the coarsest."""
    if grid.max_res < grid.min_res:
        raise bad_option(f"{path}.max_res", grid.max_res, f"at least min_res ({grid.min_res})")


def check_spacing(path: str, spacing: str, near: float) -> None:
    """Raises NerfError `bad_config` where samples even in disparity would begin at 0."""
    if spacing == "disparity" and near <= 0.0:
        raise bad_option(f"{path}.near", near, "more than 0 with spacing disparity")


def bad_option(path: str, value: object, allowed: str) -> NerfError:
    """The error of a wrong option, naming what is allowed."""
    return NerfError(
        "bad_config",
        f"The option {path} is {value!r}; allowed: {allowed}.",
        f"Set {path} to an allowed value.",
    )
