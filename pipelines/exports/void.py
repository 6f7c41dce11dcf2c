"""Where photos show that nothing stands, as the stage `depth` told: what exports leave out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.patch_colors import grown
from pipelines.nerf.stereo.void import RIM_PX
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.depth_views import Pinhole
from pipelines.workspace import Workspace


class Void(NamedTuple):
    """file: the image, as in `cameras.json`. lens: of a pinhole in its place, which sees is_void
    [H, W] and what is known of depth, z [H, W], 0 where nothing is."""

    file: str
    lens: Pinhole
    is_void: NDArray[np.bool_]
    z: NDArray[np.float32]


def void_of_photos(workspace: Workspace) -> Iterator[Void]:
    """The sky, and the ground of cut-out pictures, up to what stands before them; nothing of a
    capture without them.

    Nothing of one before the dark either: what is dark may be something that nobody saw lit.
    """
    if not workspace.is_complete("depth"):
        return
    told = workspace.manifest("depth")["summary"]
    shares = {kind: told.get(kind, {}).get("share") for kind in ("sky", "blank", "dark")}
    if shares["dark"] or not (shares["sky"] or shares["blank"]):
        return
    for image, found in DepthMapsFile(workspace.stage("depth")):
        yield Void(image.file, image.lens, grown(found.is_void, RIM_PX), found.z)
