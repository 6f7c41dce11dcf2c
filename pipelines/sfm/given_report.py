"""What report.json says of poses that came with a capture, and what is to be told."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.sfm.agreement import LITTLE
from pipelines.sfm.given import Judged, Posed, movement
from pipelines.sfm.given_fit import Fit, suspects
from pipelines.sfm.given_lenses import TELLING, LensTrial
from pipelines.sfm.given_scale import Scale

DOUBTFUL_PX = 3.0
"""Median miss from which the report warns."""


def given_report(judged: Judged, posed: Posed, long_side_px: int) -> dict[str, Any]:
    """What report.json says under `given`."""
    fit, refined = judged.fit, judged.refined
    found: dict[str, Any] = {
        "mode": judged.mode,
        "verdict": judged.verdict,
        "why": judged.why,
        "features_px": long_side_px,
        "sampled": None if judged.sampled is None else judged.sampled.as_dict(),
        "refinement": None,
        "suspects": [posed.files[index] for index in suspects(fit)],
        "reading": judged.reading,
        "written": None if judged.written is None else judged.written.as_dict(),
        "seconds": round(judged.seconds, 2),
    }
    if refined is not None and judged.before is not None:
        turned, moved = movement(judged.start, refined.poses)
        found["refinement"] = {
            "taken": judged.verdict == "refined",
            "before": judged.before.as_dict(),
            "after": None if judged.after is None else judged.after.as_dict(),
            "num_seen": int(refined.is_seen.sum()),
            "num_carried": int((~refined.is_seen).sum()),
            "replaced": [posed.files[index] for index in np.flatnonzero(refined.is_anew).tolist()],
            "moved": {"median": _round(np.median(moved)), "most": _round(moved.max())},
            "turned_deg": {"median": _round(np.median(turned)), "most": _round(turned.max())},
            "extent": _round(np.linalg.norm(np.ptp(judged.start[:, :, 3], axis=0))),
            "sensor_depth": None
            if judged.depths is None
            else {
                name: {"ratio": _round(beside.ratio), "spread": _round(beside.spread)}
                for name, beside in zip(("before", "after"), judged.depths, strict=True)
            },
            "scale": None if judged.scale is None else judged.scale.as_dict(),
            "lens": None if judged.lens_trial is None else judged.lens_trial.as_dict(),
        }
    return found


def _round(value: Any) -> float:
    return float(f"{float(value):.5g}")


def given_warnings(judged: Judged, posed: Posed) -> list[dict[str, Any]]:
    """What is to be told of poses that do not fit the pictures."""
    fit = judged.fit
    if fit is None:
        return [
            {
                "code": "given_poses_unverified",
                "message": f"Whether the capture's poses fit its pictures is not known: "
                f"{judged.why}. They were taken as they are.",
                "hint": "Nothing needs to be done where they come from a program that you trust.",
                "details": {},
            }
        ]
    wrong = suspects(fit)
    if fit.agreement < LITTLE or wrong:
        return [_contradicted(judged, fit, [posed.files[index] for index in wrong])]
    warnings = [] if judged.written is None else [_reread(judged, judged.written)]
    warnings += [] if judged.scale is None else _of_scale(judged.scale)
    if judged.verdict == "refined" and judged.lens_trial is not None:
        warnings += _of_lens(judged.lens_trial)
    if fit.error_px > DOUBTFUL_PX:
        warnings.append(
            {
                "code": "given_poses_coarse",
                "message": f"The capture's poses fit its pictures only coarsely: {judged.why}.",
                "hint": "Expect blurred surfaces; poses.given=refine adjusts them wherever that is "
                "no worse, or send the pictures alone to have their poses found.",
                "details": {"error_px": round(fit.error_px, 3)},
            }
        )
    return warnings


def _reread(judged: Judged, written: Fit) -> dict[str, Any]:
    return {
        "code": "given_poses_reread",
        "message": f"The capture's poses agree with only {written.agreement:.0%} of what its "
        f"pictures show as they are written. They fit if {judged.reading}, and were read so.",
        "hint": "Nothing needs to be done. Other programs will read them as they are written; "
        "poses.given=trust does so here.",
        "details": {"agreement": round(written.agreement, 4)},
    }


def replaced(found: dict[str, Any], agreement: float) -> dict[str, Any]:
    """What is to be told of poses that were not used. found: what `given_report` says of them.

    agreement: of the poses that were found from the pictures.
    """
    fit = found["sampled"]
    return {
        "code": "given_poses_replaced",
        "message": f"The capture's poses agree with only {fit['agreement']:.0%} of what its "
        f"pictures show, and were not used. Poses that were found from the pictures agree with "
        f"{agreement:.0%}.",
        "hint": "Scale, place and depth of the capture are lost with its poses. Check that no "
        "picture was added, removed or renamed since they were written; poses.given=trust takes "
        "them as they are.",
        "details": {"agreement": fit["agreement"], "found_agreement": round(agreement, 4)},
    }


def _of_scale(scale: Scale) -> list[dict[str, Any]]:
    if not scale.is_contradicted or scale.by_sensor is None:
        return []
    return [
        {
            "code": "given_scale_contradicted",
            "message": f"By the depth that came with the capture all lengths are "
            f"{scale.by_sensor:.4g} times what its camera poses say. The poses were believed.",
            "hint": "Measure something whose length you know, and scale what you export by that; a "
            "factor of about 1000 or 0.001 means that the depth was written in another unit.",
            "details": scale.as_dict(),
        }
    ]


def _of_lens(trial: LensTrial) -> list[dict[str, Any]]:
    if trial.refused is not None or abs(trial.zoom - 1.0) < TELLING:
        return []
    return [
        {
            "code": "given_lens_corrected",
            "message": f"The lens that came with the capture does not fit its pictures: their "
            f"focal length is {trial.zoom:.3f} times as long. It was corrected.",
            "hint": "Nothing needs to be done. It may be that of another camera, such as the depth "
            "sensor's, or of pictures of another size.",
            "details": trial.as_dict(),
        }
    ]


def _contradicted(judged: Judged, fit: Fit, files: list[str]) -> dict[str, Any]:
    details = {"agreement": round(fit.agreement, 4), "error_px": round(fit.error_px, 3)}
    if files:
        names = ", ".join(files[:5]) + (", ..." if len(files) > 5 else "")
        return {
            "code": "given_poses_contradicted",
            "message": f"{len(files)} of {len(judged.poses)} pictures show something else than "
            f"their poses say: {names}.",
            "hint": "Check that each pose belongs to its picture, or leave these pictures out.",
            "details": {**details, "files": files},
        }
    hint = (
        "Check that no picture was added, removed or renamed since the poses were written, and "
        "which axes they are in; or send the pictures alone to have their poses found."
    )
    if judged.reading is not None:
        hint = f"The pictures would fit if {judged.reading}: check how they were written. {hint}"
    return {
        "code": "given_poses_contradicted",
        "message": f"The capture's poses agree with only {fit.agreement:.0%} of what its pictures "
        "show.",
        "hint": hint,
        "details": details,
    }
