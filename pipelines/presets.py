"""The presets: complete sets of options, by what they change of the defaults.

No torch is imported.
"""

from __future__ import annotations

import dataclasses
import types
from typing import Any

from pipelines.exports.catalogue import KINDS


@dataclasses.dataclass(frozen=True)
class Preset:
    """A complete set of options, and the stages that are left out.

    overrides: what differs from the defaults, by stage.
    without: stages that its jobs skip. None of the others may need their results; `report` says
    what there is.
    """

    name: str
    summary: str
    overrides: dict[str, Any]
    without: frozenset[str] = frozenset()


_SMALL_PICTURES: dict[str, Any] = {
    "frames": {"num_frames": 72, "long_side_px": 960},
    "poses": {"max_image_px": 960, "num_features": 4096},
}

# docs/speed.md, "The preview's rate" and "On an H100", and for cameras docs/poses-experiments.md,
# "Corrected poses", have the measurements. The cameras' counts where they are corrected: a rate
# that stays leaves each of them off by some of its steps.
_FALLING_RATE: dict[str, Any] = {
    "lr_final": 1e-5,
    "decay": "linear",
    "decay_steps": 0,
    "table_decay": 3e-8,
    "camera_lr_final": 1e-6,
    "camera_decay_steps": 0,
}

PRESETS: types.MappingProxyType[str, Preset] = types.MappingProxyType(
    {
        preset.name: preset
        for preset in (
            Preset(
                "check",
                "Is the capture any good? Its poses and how it was filmed, in a minute or two: "
                "nothing is made of it.",
                _SMALL_PICTURES,
                without=frozenset({"depth", "draft", "train", "evaluate", *KINDS, "assess"}),
            ),
            Preset(
                "draft",
                "A mesh from depth maps alone, in a minute or two on a laptop: nothing is trained.",
                {
                    **_SMALL_PICTURES,
                    "draft": {
                        "resolution": 256,
                        "num_views": 128,
                        "max_faces": 200_000,
                        "required": True,
                    },
                    # Nobody judges a model here: every image may take part in the mesh.
                    "train": {"data": {"eval_mode": "none"}},
                },
                without=frozenset({"train", "evaluate", *KINDS, "assess"}),
            ),
            Preset(
                "preview",
                "A look within minutes, also without a GPU: small pictures, small networks.",
                {
                    **_SMALL_PICTURES,
                    "train": {
                        "max_steps": 1650,
                        "rays_per_step": 1024,
                        # 40 % of all; with them 1,650 steps take as long as 1,500 without
                        # (docs/speed.md, "Steps that know where to look").
                        "guided": {"share": 0.67},
                        "model": {
                            "num_proposal_samples": (64, 32),
                            "num_nerf_samples": 24,
                            "grid": {"log2_table_size": 17, "max_res": 1024},
                            "anneal_steps": 300,
                            # In short runs codes cost dBs on held-out views (photos-fox, 300 and
                            # 600 steps, one seed, poses corrected as well: 2 to 4), as in the
                            # paper's table 2. Corrected poses cost .1 to .3
                            # (docs/poses-experiments.md).
                            "appearance_dim": 0,
                            "camera_mode": "off",
                        },
                        "data": {"long_side_px": 480},
                        "optimizer": {**_FALLING_RATE, "lr": 0.015},
                    },
                    "pointcloud": {"num_points": 500_000},
                    "mesh": {"render_long_side_px": 240},
                    "video": {
                        "turn_deg_per_s": 60,
                        "min_seconds": 5,
                        "max_seconds": 10,
                        "long_side_px": 960,
                        "field_px": 320,
                    },
                },
            ),
            Preset(
                "detailed",
                "20 to 30 minutes on a laptop: more pictures, more steps, finer surfaces.",
                {
                    "frames": {"num_frames": 120, "long_side_px": 1280},
                    "poses": {"max_image_px": 1280, "num_features": 6144},
                    "depth": {"long_side_px": 480, "num_planes": 160},
                    "train": {
                        "max_steps": 6000,
                        "rays_per_step": 2048,
                        "model": {
                            "num_proposal_samples": (96, 48),
                            "num_nerf_samples": 32,
                            "anneal_steps": 800,
                            "appearance_dim": 0,
                            "camera_mode": "off",
                        },
                        "data": {"long_side_px": 800},
                        "optimizer": _FALLING_RATE,
                    },
                    "mesh": {
                        "resolution": 384,
                        "render_long_side_px": 480,
                        "max_faces": 400_000,
                    },
                    "video": {
                        "turn_deg_per_s": 60,
                        "min_seconds": 6,
                        "max_seconds": 12,
                        "long_side_px": 1280,
                        "field_px": 480,
                    },
                },
            ),
            Preset(
                "standard",
                "The paper's Nerfacto: 30,000 steps, for a GPU.",
                {"train": {"optimizer": _FALLING_RATE}},
            ),
            Preset(
                "high",
                "The paper's long run: 70,000 steps and finer assets.",
                {
                    "train": {"max_steps": 70_000, "optimizer": _FALLING_RATE},
                    "pointcloud": {"num_points": 3_000_000},
                    "mesh": {
                        "resolution": 512,
                        "render_long_side_px": 640,
                        "max_faces": 1_000_000,
                    },
                    "video": {"long_side_px": 1920},
                },
            ),
        )
    }
)
