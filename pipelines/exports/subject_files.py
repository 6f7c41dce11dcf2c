"""What a job delivers of a thing that was walked round: `subject.glb`, a picture, and its report.

`subject.glb` is a piece of the delivered mesh (`pipelines.exports.cutting`) with its origin under
the thing and the axes of the world of cameras.json, whatever frame the mesh itself is asked for in:
a shift brings it back, which the file and the report hold.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.exports.cutting import cut_out
from pipelines.exports.formats import glb
from pipelines.exports.formats.glb import GlbStyle
from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, shifted
from pipelines.exports.subject import Decision, Thing
from pipelines.exports.subject_picture import save_subject_picture
from pipelines.scene.gaze import Gaze

SUBJECT, PICTURE = "subject.glb", "subject.jpg"
_CUT_SHARE, _WRITTEN_SHARE = 0.2, 0.8
_WORLD = "the world of cameras.json moved: the origin is under the subject"


def save_subject(
    folder: Path,
    whole: TriangleMesh,
    skin: TriangleMesh | TexturedMesh,
    thing: Thing,
    gaze: Gaze,
    metric: bool,
    style: GlbStyle,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    """Write `subject.glb` and `subject.jpg`; what is told of them: nothing, if nothing is left.

    whole, skin: the delivered mesh of the world with its vertices' colours, and as it is painted.
    on_progress: told the share that is done between steps; may raise.
    """
    cut = cut_out(skin, thing)
    if len(cut.faces) == 0:
        return {}
    on_progress(_CUT_SHARE)
    rows = np.column_stack([np.eye(3), -thing.origin])
    frame = Frame("z", metric, _WORLD, tuple(tuple(map(float, row)) for row in rows))

    def on_texture(done: float) -> None:
        on_progress(_CUT_SHARE + (_WRITTEN_SHARE - _CUT_SHARE) * done)

    glb.write_mesh(folder / SUBJECT, shifted(cut, -thing.origin), frame, style, on_texture)
    on_progress(_WRITTEN_SHARE)
    eyes = gaze.poses[:, :, 3]
    save_subject_picture(
        folder / PICTURE, whole, cut, thing.region, eyes, lambda: on_progress(_WRITTEN_SHARE)
    )
    return {
        "file": SUBJECT,
        "num_faces": len(cut.faces),
        "texture_px": max(cut.texture.shape) if isinstance(cut, TexturedMesh) else None,
    }


def as_dict(decision: Decision) -> dict[str, Any]:
    """The decision for the report: in the world of cameras.json, its unit, +Z up."""
    found: dict[str, Any] = {
        "kind": decision.kind,
        "why": decision.why,
        "measures": decision.measures,
        "file": None,
        "region": None,
        "world_from_subject": None,
    }
    if decision.thing is not None:
        region, origin = decision.thing.region, decision.thing.origin
        turn = float(np.degrees(np.arctan2(region.axes[1, 0], region.axes[0, 0])))
        found["region"] = {
            "center": [round(float(value), 6) for value in region.center],
            "size": [round(float(value), 6) for value in 2.0 * region.half],
            "rotation_deg": [0.0, 0.0, round(turn, 4)],
        }
        found["world_from_subject"] = np.column_stack([np.eye(3), origin]).tolist()
    return found
