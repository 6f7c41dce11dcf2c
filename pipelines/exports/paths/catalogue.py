"""All camera paths of the video: one line for each. The file that it names holds the path.

Light, as the API reads the names. A path is a function `(images, num_frames) -> poses`: from the
capture's posed images to [num_frames, 3, 4], world_from_camera, OpenGL cameras, world units. It
raises ExportError (no_focus) where a capture has nothing to base it on.
"""

from __future__ import annotations

import importlib
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipelines.scene.cameras_file import PosedImage

PATHS: types.MappingProxyType[str, str] = types.MappingProxyType(
    {
        "smooth": "pipelines.exports.paths.smooth:smooth_flight",
        "orbit": "pipelines.exports.paths.orbit:orbit",
    }
)
"""From the name in `video.path` to "module:function"."""


def make_path(name: str, images: Sequence[PosedImage], num_frames: int) -> Any:
    """[num_frames, 3, 4] poses of the path of that name. Raises KeyError for an unknown one."""
    module_name, _, function_name = PATHS[name].partition(":")
    path: Callable[..., Any] = getattr(importlib.import_module(module_name), function_name)
    return path(images, num_frames)
