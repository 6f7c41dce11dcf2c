"""The capture report as data: `capture-report.json`.

Fixed keys: version, verdict (good, usable, poor, unusable, or null where the job ended before that
was known, and not for what the capture is), reasons[], advice[] (sentences, the most useful first),
findings[] {code, severity, what, advice, spans[], measured}, error (null, or stage, code, message,
hint), capture {kind, filename, duration_s}, clips[] (of a film in several: name, offset_s,
length_s, num, num_placed, is_apart, most_shared), pictures {num, num_placed, ratio}, lost {num,
seconds, spans[]}, parallax_deg, metric, given_poses (null, or of poses that came along verdict, why
and error_px, by which matches miss them), around (null, or covered_deg, widest_gap_deg,
heights_deg, sectors[36]), timeline[] one entry a picture {file, name, clip, time_s, placed, cause,
blur_px, luma, speed, exposure_ev, num_features, best_matches}, path[] {file, center}. A span is
{first, last} and of a film {from_s, to_s}, of several clips with the number of its `clip`, whose
own times these are less its offset_s. Units: pixels of a picture of 640, long sides of the picture
per second, stops since the first frame, degrees, world units.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from pipelines.filming.around import look_around
from pipelines.filming.causes import causes_of, spans
from pipelines.filming.findings import Finding, Thresholds, find, verdict_of
from pipelines.filming.shots import Take

REPORT_VERSION = 1


def build_report(take: Take, thresholds: Thresholds | None = None) -> dict[str, Any]:
    """The report of what is known of a capture."""
    findings = find(take, thresholds)
    verdict, reasons = verdict_of(take, findings)
    around = look_around(take.poses)
    num = len(take.shots)
    return {
        "version": REPORT_VERSION,
        "verdict": verdict,
        "reasons": reasons,
        "advice": list(dict.fromkeys(one.advice for one in findings if one.advice)),
        "findings": [_shown(take, one) for one in findings],
        "error": _error(take),
        "capture": {
            "kind": take.kind,
            "filename": take.filename,
            "duration_s": take.duration_s,
        },
        "clips": _clips(take),
        "pictures": {
            "num": num,
            "num_placed": take.num_placed if take.was_sought else None,
            "ratio": round(take.num_placed / num, 4) if num and take.was_sought else None,
        },
        "lost": lost_of(take),
        "parallax_deg": None if take.angle_deg is None else round(take.angle_deg, 2),
        "metric": take.is_metric,
        "given_poses": _given(take),
        "around": None
        if around is None
        else {
            "covered_deg": round(around.covered_deg, 1),
            "widest_gap_deg": round(around.widest_gap_deg, 1),
            "heights_deg": round(around.heights_deg, 1),
            "sectors": [bool(seen) for seen in around.covered],
        },
        "timeline": _timeline(take),
        "path": [
            {"file": take.shots[index].file, "center": [round(float(x), 4) for x in pose[:, 3]]}
            for index, pose in zip(take.posed, take.poses, strict=True)
        ],
    }


def _clips(take: Take) -> list[dict[str, Any]]:
    return [
        {
            **asdict(clip),
            "num": sum(shot.clip == number for shot in take.shots),
            "num_placed": sum(shot.clip == number and shot.is_placed is True for shot in take.shots)
            if take.was_sought
            else None,
        }
        for number, clip in enumerate(take.clips)
    ]


def _given(take: Take) -> dict[str, Any] | None:
    if take.given is None:
        return None
    found, refinement = take.given, take.given["refinement"]
    fit = found["sampled"]
    if refinement is not None:
        fit = refinement["after" if refinement["taken"] else "before"]
    return {
        "verdict": found["verdict"],
        "why": found["why"],
        "error_px": None if fit is None else fit["error_px"],
    }


def lost_of(take: Take) -> dict[str, Any]:
    """Pictures without a pose: how many, how many seconds they stand for, and which stretches."""
    lost = [index for index, shot in enumerate(take.shots) if shot.is_placed is False]
    stretches = [_stretch(take, span) for span in spans(take, lost)]
    if not take.is_film or take.duration_s is None:
        return {"num": len(lost), "seconds": None, "spans": stretches}
    each_s = take.duration_s / max(len(take.shots), 1)
    return {"num": len(lost), "seconds": round(each_s * len(lost), 2), "spans": stretches}


def _stretch(take: Take, span: tuple[int, int]) -> dict[str, Any]:
    first, last = (take.shots[index] for index in span)
    found: dict[str, Any] = {"first": first.name or first.file, "last": last.name or last.file}
    if first.time_s is not None and last.time_s is not None:
        found |= {"from_s": round(first.time_s, 2), "to_s": round(last.time_s, 2)}
    if take.clips:
        found["clip"] = first.clip
    return found


def _shown(take: Take, finding: Finding) -> dict[str, Any]:
    return {
        "code": finding.code,
        "severity": finding.severity,
        "what": finding.what,
        "advice": finding.advice,
        "spans": [_stretch(take, span) for span in finding.spans],
        "measured": finding.measured,
    }


def _error(take: Take) -> dict[str, Any] | None:
    if take.error is None:
        return None
    return {key: take.error.get(key) for key in ("stage", "code", "message", "hint")}


def _timeline(take: Take) -> list[dict[str, Any]]:
    return [
        {
            "file": shot.file,
            "name": shot.name,
            "clip": shot.clip,
            "time_s": shot.time_s,
            "placed": shot.is_placed,
            "cause": cause,
            "blur_px": None
            if shot.look is None or shot.look.blur_px is None
            else round(shot.look.blur_px, 2),
            "luma": None if shot.look is None else round(shot.look.luma, 4),
            "speed": shot.speed,
            "exposure_ev": shot.gain_ev,
            "num_features": shot.num_features,
            "best_matches": shot.best_inliers,
        }
        for shot, cause in zip(take.shots, causes_of(take), strict=True)
    ]
