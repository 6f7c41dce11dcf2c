"""All camera paths of the video: one line for each. The file that it names holds the path.

Light, as the API reads the names; `paths.flight` makes them. A path is a function `(images,
options, num_frames, mesh) -> Flight`: from the capture's posed images, `PathOptions` and the folder
of the job's mesh, whose walls are in the way where it has one, to world poses. It raises
ExportError (no_focus) where a capture has nothing to base it on.
"""

from __future__ import annotations

import types

PATHS: types.MappingProxyType[str, str] = types.MappingProxyType(
    {
        "smooth": "pipelines.exports.paths.smooth:smooth_flight",
        "orbit": "pipelines.exports.paths.orbit:orbit",
        "spiral": "pipelines.exports.paths.spiral:spiral",
        "interpolate": "pipelines.exports.paths.keyframes:through_captured",
        "keyframes": "pipelines.exports.paths.keyframes:through_keyframes",
        "camera_path": "pipelines.exports.paths.nerfstudio:as_in_file",
    }
)
"""From the name in `video.path` to "module:function"."""
