"""What was measured of a capture that a person can do better, and the verdict that follows.

Each finding is a fact with the numbers behind it, and a sentence on what to do. A capture is `good`
where there is nothing but notes, `usable` with a moderate finding, `poor` with a severe one, and
`unusable` where the job ended for what the capture is.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pipelines.filming.around import look_around
from pipelines.filming.causes import Cause, Span, causes_of, is_fast, spans
from pipelines.filming.shots import Take
from pipelines.filming.words import clock, joined, listed, share

Severity = Literal["fatal", "severe", "moderate", "note"]
Verdict = Literal["good", "usable", "poor", "unusable"]
_VERDICTS: dict[Severity, Verdict] = {
    "fatal": "unusable",
    "severe": "poor",
    "moderate": "usable",
    "note": "good",
}
_ORDER: tuple[Severity, ...] = ("fatal", "severe", "moderate", "note")

CAPTURE_FAULTS = frozenset(
    {
        *("archive_bomb", "archive_damaged", "archive_encrypted", "archive_unsafe"),
        *("capture_unusable", "empty_file", "image_undecodable", "no_features", "no_images"),
        *("no_parallax", "no_video_stream", "poses_failed", "poses_malformed", "poses_missing"),
        "profile_unusable",
        *("projection_unsupported", "too_few_images", "too_few_registered", "too_large"),
        *("unknown_type", "video_too_long", "video_truncated", "video_undecodable"),
    }
)
"""Errors that a capture is to blame for; others say nothing of it."""
_OF_GIVEN: dict[str, Severity] = {
    "given_poses_contradicted": "severe",
    "given_poses_coarse": "moderate",
    "given_poses_replaced": "moderate",
}
"""How grave it is that poses do not fit; that nobody could tell is a note."""
CAPTURE_STAGES = ("ingest", "frames", "poses")

SEVERE_SHARE, MODERATE_SHARE = 0.25, 0.03
"""Shares of the pictures that are lost to one cause."""
BLURRED_SEVERE, BLURRED_MODERATE = 0.5, 0.1
"""Shares of the pictures that are blurred and have a pose all the same."""
FEW_PICTURES = 20
LITTLE_ANGLE_DEG = 4.0
FEW_DIRECTIONS_DEG, ALL_AROUND_DEG = 60.0, 330.0
ONE_HEIGHT_DEG, ORBIT_DEG = 12.0, 180.0
EXPOSURE_NOTE_EV, EXPOSURE_MODERATE_EV = 0.5, 1.0
"""Stops between neighbouring frames: a phone that adapts smoothly stays below 0.1."""
DARK_LUMA, BRIGHT_SHARE = 0.13, 0.2


@dataclass(frozen=True)
class Thresholds:
    """Shares of pictures with a pose below which a capture is not good, and not even usable."""

    good_ratio: float = 0.9
    usable_ratio: float = 0.6


@dataclass(frozen=True)
class Finding:
    """One thing to know.

    code: stable. what: what was measured, a sentence. advice: what to do, or empty. spans: the
    pictures it is about, as first and last index. measured: the numbers behind it.
    """

    code: str
    severity: Severity
    what: str
    advice: str
    spans: tuple[Span, ...] = ()
    measured: dict[str, Any] = field(default_factory=dict)


def find(take: Take, thresholds: Thresholds | None = None) -> list[Finding]:
    """All findings on a capture, the gravest first."""
    found = [
        *_failure(take),
        *_lost(take),
        *_too_few_placed(take, thresholds or Thresholds()),
        *_smeared(take),
        *_parallax(take),
        *_given(take),
        *_doubted(take),
        *_directions(take),
        *_exposure(take),
        *_light(take),
        *_count(take),
    ]
    return sorted(found, key=lambda finding: _ORDER.index(finding.severity))


def verdict_of(take: Take, findings: list[Finding]) -> tuple[Verdict | None, list[str]]:
    """The verdict and its reasons; None where the job ended too early, and not for the capture."""
    worst = findings[0].severity if findings else "note"
    if worst == "fatal":
        return "unusable", [one.what for one in findings if one.severity == "fatal"]
    if not take.was_sought:
        return None, ["The job ended before it was known how well the capture holds together."]
    if worst == "note":
        placed = f"{take.num_placed} of {len(take.shots)} {noun(take)} have a pose."
        return "good", [placed]
    return _VERDICTS[worst], [one.what for one in findings if one.severity == worst]


def noun(take: Take, number: int = 2) -> str:
    """What its pictures are called."""
    return ("frame" if take.is_film else "photo") + ("" if number == 1 else "s")


def where(take: Take, found: Iterable[Span]) -> str:
    """Times of a film ("from 0:12 to 0:19 and at 0:31"), or names of photos.

    Of several clips the clip's own times: "in clip 2 (b.mp4) from 0:12 to 0:19 and at 0:31".
    """
    places, number = [], None
    for span in found:
        place, clip = _where_one(take, span), take.clip_of(span[0])
        if clip is not None and take.shots[span[0]].clip != number:
            number = take.shots[span[0]].clip
            place = f"in clip {number + 1} ({clip.name}) {place}"
        places.append(place)
    return joined(places, more="other places" if take.is_film else "others")


def _where_one(take: Take, span: Span) -> str:
    first, last = (take.shots[index] for index in span)
    if first.time_s is not None and last.time_s is not None:
        clip = take.clip_of(span[0])
        offset_s = 0.0 if clip is None else clip.offset_s
        start, end = clock(first.time_s - offset_s), clock(last.time_s - offset_s)
        return f"at {start}" if start == end else f"from {start} to {end}"
    names = [shot.name or shot.file for shot in take.shots[span[0] : span[1] + 1]]
    return listed(names)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _failure(take: Take) -> list[Finding]:
    """What ended the job, where the capture is to blame."""
    error = take.error
    if error is None or error.get("code") not in CAPTURE_FAULTS:
        return []
    if error.get("stage") not in CAPTURE_STAGES:
        return []
    return [
        Finding(
            str(error["code"]),
            "fatal",
            str(error["message"]),
            str(error.get("hint", "")),
            measured=dict(error.get("details", {})),
        )
    ]


_LOST: dict[Cause, tuple[str, str]] = {
    "moved_too_fast": (
        "{where} you turned faster than the shutter: the picture moved by up to {speed} times its "
        "size a second, and {count} no pose",
        "Film {that} again, slower, keeping the subject in view.",
    ),
    "blurred": (
        "{where} the picture is blurred over about {blur} of 640 pixels, and {count} no pose",
        "Film {that} again with more light, holding still and letting the focus settle.",
    ),
    "too_few_features": (
        "{where} there is too little to see, {features} details a picture, and {count} no pose",
        "Keep something textured in view: step back from blank walls, or lay a newspaper or a "
        "patterned cloth beside the subject.",
    ),
    "broken_apart": (
        "{where} the pictures hang together with each other, but not with the rest; {count} no "
        "pose in common",
        "Film on without a break between the parts, or go back over a place that both show.",
    ),
    "clip_apart": (
        "{where} the pictures show nothing that another clip shows too, {shared}; {count} no pose "
        "in common",
        "Let clips overlap: begin each one at a view that another one shows, and move on from "
        "there; send what shows another place as a capture of its own.",
    ),
    "no_overlap": (
        "{where} the pictures share too little with the rest, {matches} details at most, and "
        "{count} no pose",
        "Film {that} again in smaller steps: two thirds of each view should be in the next.",
    ),
    "does_not_fit": (
        "{where} the pictures resemble others but fit nowhere, and {count} no pose",
        "Avoid mirrors, moving things and patterns that repeat, and keep what stands still in "
        "view.",
    ),
}


def _lost(take: Take) -> list[Finding]:
    """Stretches without poses, by their cause."""
    causes = causes_of(take)
    found = []
    for cause in dict.fromkeys(cause for cause in causes if cause is not None):
        indices = [index for index, one in enumerate(causes) if one == cause]
        what, advice = _LOST[cause]
        part = len(indices) / len(take.shots)
        severity: Severity = (
            "severe" if part >= SEVERE_SHARE else "moderate" if part >= MODERATE_SHARE else "note"
        )
        measured = _measured(take, indices)
        values = {
            "where": ("" if take.is_film else "in ") + where(take, spans(take, indices)),
            "count": f"{len(indices)} of {len(take.shots)} {noun(take)} "
            + ("has" if len(indices) == 1 else "have"),
            "speed": f"{measured.get('max_speed', 0.0):.1f}",
            "blur": f"{measured.get('median_blur_px', 0.0):.0f}",
            "features": f"{measured.get('median_features', 0):.0f}",
            "matches": f"{measured.get('most_matches', 0)}",
            "shared": _shared(take, indices),
            "that": "that part" if take.is_film else "those",
        }
        if cause == "moved_too_fast" and "max_speed" not in measured:
            what = "{where} the picture is smeared over about {blur} of 640 pixels by motion, and "
            what += "{count} no pose"
        text = _capital(what.format(**values)) + "."
        code = str(cause)
        found.append(
            Finding(
                code, severity, text, advice.format(**values), tuple(spans(take, indices)), measured
            )
        )
    return found


def _shared(take: Take, indices: list[int]) -> str:
    """What a picture of those clips shares with one of another clip, at most."""
    clips = [take.clip_of(index) for index in indices]
    most = max((clip.most_shared or 0 for clip in clips if clip is not None), default=0)
    return f"{most} details at most" if most else "not one detail"


def _measured(take: Take, indices: list[int]) -> dict[str, Any]:
    """Numbers on some pictures, those that are known."""
    shots = [take.shots[index] for index in indices]
    measured: dict[str, Any] = {"num_pictures": len(shots)}

    def put(name: str, values: list[float], how: Callable[[list[float]], float]) -> None:
        if values:
            measured[name] = round(how(values), 2)

    put("max_speed", [one.speed for one in shots if one.speed is not None], max)
    looks = [one.look for one in shots if one.look is not None]
    put("median_blur_px", [one.blur_px for one in looks if one.blur_px], statistics.median)
    features = [float(one.num_features) for one in shots if one.num_features is not None]
    put("median_features", features, statistics.median)
    matches = [one.best_inliers for one in shots if one.best_inliers is not None]
    if matches:
        measured["most_matches"] = max(matches)
    return measured


def _too_few_placed(take: Take, thresholds: Thresholds) -> list[Finding]:
    """The share of pictures with a pose; the causes are told beside it."""
    if not take.was_sought or take.error is not None:
        return []
    ratio = take.num_placed / len(take.shots)
    if ratio >= thresholds.good_ratio:
        return []
    severity: Severity = "severe" if ratio < thresholds.usable_ratio else "moderate"
    what = f"{take.num_placed} of {len(take.shots)} {noun(take)} have a pose."
    return [Finding("few_placed", severity, what, "", measured={"ratio": round(ratio, 3)})]


def _smeared(take: Take) -> list[Finding]:
    """Pictures that are blurred and have a pose all the same: they make a soft result."""
    indices = [
        index
        for index, shot in enumerate(take.shots)
        if shot.look is not None and shot.look.is_blurred and shot.is_placed is not False
    ]
    if not indices or not take.was_sought:
        return []
    part = len(indices) / len(take.shots)
    severity: Severity = (
        "severe" if part >= BLURRED_SEVERE else "moderate" if part >= BLURRED_MODERATE else "note"
    )
    fast = take.is_film and sum(is_fast(take.shots[i]) for i in indices) >= len(indices) / 2
    measured = _measured(take, indices)
    places = where(take, spans(take, indices))
    what = (
        f"{len(indices)} of {len(take.shots)} {noun(take)} {'is' if len(indices) == 1 else 'are'} "
        f"blurred over about {measured['median_blur_px']:.0f} of 640 pixels ({places})."
    )
    slower = "Move more slowly there: the picture is smeared while the shutter is open."
    lighter = "Use more light, hold still, and let the focus settle; the result is as soft as they."
    return [
        Finding(
            "soft_moving" if fast else "soft",
            severity,
            what,
            slower if fast else lighter,
            tuple(spans(take, indices)),
            measured,
        )
    ]


def _parallax(take: Take) -> list[Finding]:
    """Views that differ too little for depth."""
    if take.angle_deg is None or take.angle_deg >= LITTLE_ANGLE_DEG or take.error is not None:
        return []
    return [
        Finding(
            "little_parallax",
            "moderate",
            f"The same point is seen from directions only {take.angle_deg:.1f} degrees apart.",
            "Walk sideways around the subject, or go nearer: views from other places show depth, "
            "turning and zooming do not.",
            measured={"angle_deg": round(take.angle_deg, 2)},
        )
    ]


def _directions(take: Take) -> list[Finding]:
    """Sides of the subject that were not seen."""
    around = look_around(take.poses)
    if around is None or take.error is not None:
        return []
    measured = {
        "covered_deg": round(around.covered_deg, 1),
        "widest_gap_deg": round(around.widest_gap_deg, 1),
        "heights_deg": round(around.heights_deg, 1),
    }
    found = []
    if around.covered_deg < ALL_AROUND_DEG:
        few = around.covered_deg < FEW_DIRECTIONS_DEG
        found.append(
            Finding(
                "few_directions" if few else "part_unseen",
                "moderate" if few else "note",
                f"The subject was seen from {around.covered_deg:.0f} of 360 degrees around it; "
                f"{around.widest_gap_deg:.0f} degrees in one piece are missing.",
                "Walk further around it, all the way if you can: what no picture shows stays open.",
                measured=measured,
            )
        )
    if around.covered_deg >= ORBIT_DEG and around.heights_deg < ONE_HEIGHT_DEG:
        found.append(
            Finding(
                "one_height",
                "note",
                f"All views are from one height, within {around.heights_deg:.0f} degrees.",
                "Go around a second time from higher up: tops and undersides show then.",
                measured=measured,
            )
        )
    return found


def _exposure(take: Take) -> list[Finding]:
    """Moments at which the camera changed its exposure."""
    jumps = []
    for index in range(1, len(take.shots)):
        before, after = take.shots[index - 1], take.shots[index]
        if before.gain_ev is None or after.gain_ev is None or before.clip != after.clip:
            continue
        step = after.gain_ev - before.gain_ev
        if abs(step) >= EXPOSURE_NOTE_EV:
            jumps.append((index, step))
    if not jumps:
        return []
    largest = max(abs(step) for _, step in jumps)
    found = [(index, index) for index, _ in jumps]
    what = f"{_capital(where(take, found))} the exposure jumps, by up to {largest:.1f} stops."
    return [
        Finding(
            "exposure_jump",
            "moderate" if largest >= EXPOSURE_MODERATE_EV else "note",
            what,
            "Lock exposure and focus before filming (on most phones: hold a finger on the "
            "subject), and keep lamps and windows out of view.",
            tuple(found),
            {"max_ev": round(largest, 2)},
        )
    ]


def _given(take: Take) -> list[Finding]:
    """Poses that came along and do not fit the pictures."""
    if take.given is None:
        return []
    return [
        _told(warning, _OF_GIVEN.get(warning["code"], "note")) for warning in take.given["warnings"]
    ]


def _doubted(take: Take) -> list[Finding]:
    """Poses that were found, and that what pictures show contradicts, or that lack a side."""
    return [
        _told(warning, "moderate" if warning["code"] == "lenses_unsettled" else "severe")
        for warning in take.doubts
    ]


def _told(warning: Mapping[str, Any], severity: Severity) -> Finding:
    """A warning of the stage `poses`, as a finding."""
    return Finding(
        warning["code"],
        severity,
        warning["message"],
        warning["hint"],
        measured=dict(warning["details"]),
    )


def _light(take: Take) -> list[Finding]:
    """Too dark, or burnt out."""
    looks = [shot.look for shot in take.shots if shot.look is not None]
    if not looks:
        return []
    luma = statistics.median(look.luma for look in looks)
    bright = statistics.median(look.bright for look in looks)
    found = []
    if luma < DARK_LUMA:
        found.append(
            Finding(
                "too_dark",
                "moderate",
                f"The pictures are dark, at {share(luma)} of full brightness.",
                "Film by daylight, or with more lamps: dark pictures are noisy and blurred.",
                measured={"median_luma": round(luma, 3)},
            )
        )
    if bright >= BRIGHT_SHARE:
        found.append(
            Finding(
                "overexposed",
                "moderate",
                f"{share(bright)} of each picture is burnt out.",
                "Lower the exposure until white things show some texture.",
                measured={"median_bright": round(bright, 3)},
            )
        )
    return found


def _count(take: Take) -> list[Finding]:
    """Few pictures to learn from."""
    if not take.was_sought or take.error is not None or take.num_placed >= FEW_PICTURES:
        return []
    longer = "Film for half a minute." if take.is_film else "Take 40 or more, a step apart."
    return [
        Finding(
            "few_pictures",
            "moderate",
            f"There are only {take.num_placed} {noun(take, take.num_placed)} with a pose.",
            longer,
            measured={"num_placed": take.num_placed},
        )
    ]
